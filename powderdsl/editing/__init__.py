"""Completion, hover texts, places of names, and one layout of files, for editors."""
