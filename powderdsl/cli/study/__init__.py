"""Checks of a study before it runs that need the commands that it calls."""
