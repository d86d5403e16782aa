"""Tasks: start worlds, an agent's actions, the length of episodes, and rewards. See docs/tasks.md."""
