"""Tasks: what a world starts as, what an agent may do, for how long, and what counts. See docs/tasks.md."""
