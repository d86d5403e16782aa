"""Bit planes as C++, compiled on the user's machine."""
