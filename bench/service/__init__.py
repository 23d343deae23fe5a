"""What the service costs: `python -m bench.service`."""
