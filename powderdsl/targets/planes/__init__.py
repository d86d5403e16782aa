"""Bit planes as Python source, for NumPy's arrays and for torch tensors."""
