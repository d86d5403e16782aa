"""`python -m tests.fuzz`, from the root of the repository."""

from __future__ import annotations

from tests.fuzz.command import command

if __name__ == "__main__":
    command(prog_name="python -m tests.fuzz")
