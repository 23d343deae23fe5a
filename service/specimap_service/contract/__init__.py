"""The API's description: what FastAPI derives from the routes, with scopes, refusals, examples and events added."""
