"""How fast rules run: worlds, rounds of measuring, and reports as text, JSON and a plot."""
