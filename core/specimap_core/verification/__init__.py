"""Check of a finished result against evidence that was not used to make it."""
