"""Targets: each prints a program as code and runs it. How to add one: docs/compiler.md, "A target"."""
