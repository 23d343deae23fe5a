"""Jobs: submitted, followed, cancelled, deleted."""
