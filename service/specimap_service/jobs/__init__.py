"""Jobs: submitted, followed, ended."""
