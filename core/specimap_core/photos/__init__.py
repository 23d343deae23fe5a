"""Photos: files read, turned upright, selected and shown."""
