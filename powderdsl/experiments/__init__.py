"""Experiments: benchmarks, run folders, and studies of many runs."""
