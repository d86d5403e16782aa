"""Studies: runs of commands over a grid of settings, described as data, with a table and a figure."""
