"""What backends with a network share: a process of their own, weights files, and what is there of all this."""
