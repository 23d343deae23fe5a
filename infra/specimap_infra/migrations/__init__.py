"""Alembic's scripts; ``specimap_infra.migrate`` runs them."""
