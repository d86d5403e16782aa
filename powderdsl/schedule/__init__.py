"""The planner of all targets: bit planes become loops, guards, movements and buffers."""
