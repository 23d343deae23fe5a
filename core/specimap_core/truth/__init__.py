"""Known truth of an acquisition, and a result judged by it."""
