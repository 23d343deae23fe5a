"""The command line."""

from specimap_cli.app import main

__all__ = ["main"]
