"""Benchmarks: time, memory and accuracy, printed as tables and kept in ``bench/results/``."""
