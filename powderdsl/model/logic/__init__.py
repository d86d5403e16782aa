"""What conditions allow: the constraint search, and the conflicts and needless rules that it finds."""
