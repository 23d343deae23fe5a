"""What the figures rest on: runs judged against truth, subsampling studies, validation."""
