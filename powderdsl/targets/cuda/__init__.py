"""Bit planes as CUDA C++, compiled on the user's machine."""
