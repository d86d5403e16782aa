"""Running the command line in tests."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from click.testing import CliRunner, Result

from powderdsl.cli import main
from tests.fuzz.command import command as fuzz

ROOT = Path(__file__).resolve().parents[2]

PACK = """\
pack: grit
about: A powder for tests.
needs: core
params: {vanish: 20%}
elements:
  grit: {id: 200, density: 4, gravity: yes, color: "#123456", glyph: G, tags: powder}
passes:
  grit:
    after: flow
    do: grit -> empty if count(grit) == 1 and interact < vanish
"""
"""A pack without a mistake, for tests to change."""


def powderdsl(*arguments: object, exits: int | None = None, **environment: str) -> Result:
    """Run in this process, and end as said. `stdout`, `stderr` and `exit_code` tell what came of it."""
    command, words = (fuzz, arguments[1:]) if arguments[:1] == ("fuzz",) else (main, arguments)
    result = CliRunner().invoke(command, [str(word) for word in words], env=environment)
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    assert "Traceback" not in result.output
    assert exits in (None, result.exit_code), result.output
    return result


def command_line(*arguments: object) -> list[str]:
    """`fuzz` is a module of the tests, as developers call it; all else is a command of powderdsl's."""
    words = ["tests.fuzz", *arguments[1:]] if arguments[:1] == ("fuzz",) else ["powderdsl", *arguments]
    return [sys.executable, "-m", *(str(word) for word in words)]


def environment_with(**changes: str) -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(ROOT), **changes}
