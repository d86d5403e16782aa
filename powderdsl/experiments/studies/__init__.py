"""Studies: many runs of commands over a grid of settings, as data. One command gives the table and the figure."""
