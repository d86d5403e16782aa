"""Running rules: worlds, the simulator, the choice of a backend, and observations."""
