"""Uploads: resumable ones, and several files in one form."""
