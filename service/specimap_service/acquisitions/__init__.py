"""Acquisitions, their files, and the judging of arriving files."""
