"""The four stages in order, each resumable from its artefact. Importing this package loads none of them."""
