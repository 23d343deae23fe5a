"""The accuracy report: its model, and the documents made of it. Importing this package loads neither."""
