"""The command line. A command's module is imported when the command is called; torch, when a world runs."""

from powderdsl.cli.dispatch import main

__all__ = ["main"]
