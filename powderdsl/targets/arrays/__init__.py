"""Bit planes on NumPy's arrays."""
