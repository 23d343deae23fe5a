"""Alembic's scripts; ``specimap.infra.migrate`` runs them."""
