"""Acquisitions, their files and how these are judged."""
