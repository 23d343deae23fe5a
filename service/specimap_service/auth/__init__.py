"""Keys, their scopes and their rate limits; the audit trail."""
