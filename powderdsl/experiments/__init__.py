"""Experiments: measuring speed, the folders of runs, and studies over many of them."""
