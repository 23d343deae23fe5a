"""Evidence for the accuracy figures: runs judged against truth, subsampling studies, validation."""
