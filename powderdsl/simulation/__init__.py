"""Runs rules: worlds, the simulator, the choice of a target, and observations."""
