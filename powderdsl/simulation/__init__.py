"""Running rules: worlds, the simulator, the choice of a target, and what of a world is shown."""
