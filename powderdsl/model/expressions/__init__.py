"""Syntax of expressions -> typed operands."""
