"""What is computed where: bit planes become loops, guards, movements and buffers. The only planner of all targets."""
