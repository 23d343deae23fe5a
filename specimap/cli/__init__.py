"""The command line."""

from specimap.cli.app import main

__all__ = ["main"]
