"""Exit codes of commands, and messages about failures."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import IO, Any

import click

from powderdsl.cli.output import counted, write_diagnostics
from powderdsl.system.interrupts import Terminated

OK = 0
FAILED = 1
"""The command ran, but the result is negative: a test failed, or a warning counts as an error."""
BAD_INPUT = 2
INTERNAL = 70
"""A bug in powderdsl (EX_SOFTWARE of sysexits.h)."""
INTERRUPTED = 130
"""Ctrl-C. For other signals the code is 128 plus the signal's number, as in shells: 143 for SIGTERM."""


class BadInput(click.ClickException):
    """The user's input cannot be used; the message is one line."""

    exit_code = BAD_INPUT

    def show(self, file: IO[Any] | None = None) -> None:
        click.echo(f"error: {self.format_message()}", file=file, err=file is None)


def version() -> str:
    return str(sys.modules["powderdsl"].__version__)  # our own package, so it has been imported


PACKAGES = {"PIL": "pillow", "gymnasium": "'powderdsl[rl]'"}
"""Names for pip of packages whose module has another name."""


@contextmanager
def user_values() -> Iterator[None]:
    """Turn errors that the Python API raises for the user's values into a message of one line."""
    try:
        yield
    except (ValueError, TypeError, LookupError) as error:
        # str() of a KeyError is the repr of its message.
        words = error.args[0] if isinstance(error, KeyError) and error.args else error
        raise BadInput(" ".join(str(words).split())) from error


def report_failure(error: BaseException) -> int:
    """Report on stderr why a command ended, and return the exit code."""
    from powderdsl.diagnostics import CompileError

    match error:
        case click.Abort(__cause__=EOFError() as cause):  # click takes it for the end of typed input
            _report_internal(cause)
            return INTERNAL
        case click.Abort(__cause__=Terminated() as ending) | (Terminated() as ending):
            click.echo(ending, err=True)
            return 128 + ending.number
        case click.Abort() | KeyboardInterrupt():
            return INTERRUPTED
        case click.ClickException():
            error.show()
            return BAD_INPUT
        case CompileError():
            write_diagnostics(error.diagnostics, sys.stderr)
            if len(error.diagnostics) > 1:
                click.echo(f"\n{counted(len(error.diagnostics), 'error')}", err=True)
            return BAD_INPUT
        case ModuleNotFoundError(name=str(module)) if not module.startswith("powderdsl"):
            from powderdsl.system.writing import failure

            name = module.split(".")[0]
            message, fix = f"this command needs {name}, which is not installed", PACKAGES.get(name, name)
            return report_failure(failure("PD612", message, helps=(f"pip install {fix}",)))
        case OSError():
            file = f"{error.filename}: " if error.filename else ""
            click.echo(f"error: {file}{error.strerror or error}", err=True)
            return BAD_INPUT
    # torch raises its own RuntimeError on every device.
    if isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and "memory" in str(error)):
        click.echo("error: not enough memory: fewer or smaller worlds may fit", err=True)
        return BAD_INPUT
    _report_internal(error)
    return INTERNAL


def _report_internal(error: BaseException) -> None:
    import platform
    import traceback

    from powderdsl.diagnostics import Diagnostic, Label

    if os.environ.get("POWDERDSL_DEBUG") == "1":
        traceback.print_exception(error)
    words = " ".join([f"{type(error).__name__}:", *str(error).split()])[:300].rstrip(":")
    message = f"a bug in powderdsl: {words}"
    system = f"powderdsl {version()}, Python {platform.python_version()}, {platform.system()}"
    helps = (
        "please report it with the command and its input files",
        "set POWDERDSL_DEBUG=1 to see the traceback",
    )
    write_diagnostics([Diagnostic("PD901", message, Label(None), notes=(system,), helps=helps)], sys.stderr)
