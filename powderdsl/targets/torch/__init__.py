"""The readable target: one element per cell, on torch tensors."""
