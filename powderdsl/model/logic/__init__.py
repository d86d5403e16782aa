"""The constraint search on conditions, and the conflicts and needless rules that it finds."""
