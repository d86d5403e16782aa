"""Completion, hover texts, positions of names, and the standard layout of files, for editors."""
