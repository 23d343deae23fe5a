"""Features of photos, found and matched."""
