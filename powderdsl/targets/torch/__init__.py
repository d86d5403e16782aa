"""One element a cell, on torch tensors: the target to read."""
