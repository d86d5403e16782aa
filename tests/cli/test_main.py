"""The group of commands: help, exit codes, and what people read when something goes wrong."""

from __future__ import annotations

import os
import subprocess

import click
import pytest
from click.testing import CliRunner

from powderdsl.cli import exits, main, output
from powderdsl.cli.dispatch import COMMANDS
from powderdsl.diagnostics import CODES, CompileError, Diagnostic, Label
from tests.cli.commands import command_line, environment_with, powderdsl, process


def test_help_lists_every_command():
    result = powderdsl("--help", exits=0)
    assert all(f"\n  {name} " in result.stdout for name in COMMANDS)


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_help_and_its_name(name):
    assert powderdsl(name, "--help", exits=0).stdout.startswith(f"Usage: powderdsl {name}")
    assert main.get_command(click.Context(main), name).name == name


def test_version():
    assert powderdsl("--version").stdout.startswith("powderdsl 0.")


def test_no_command_is_a_usage_error():
    powderdsl(exits=exits.BAD_INPUT)


def test_an_unknown_command_gets_a_suggestion():
    assert "did you mean `check`?" in powderdsl("chek", "core", exits=exits.BAD_INPUT).stderr


@pytest.mark.parametrize(
    "arguments",
    [
        ("check",),
        ("run",),
        ("run", "core", "--steps", "many"),
        ("run", "core", "--size", "0x4"),
        ("run", "core", "--batch", "0"),
        ("run", "core", "--seed", "-1"),
        ("run", "core", "--seed", str(2**64)),
        ("run", "core", "--threads", "0"),
        ("run", "core", "--scale", "0"),
        ("run", "core", "--fps", "0"),
        ("run", "core", "--every", "0"),
        ("run", "core", "--backend", "abacus"),
        ("run", "core", "--set", "no-equals-sign"),
        ("run", "core", "--out", "x.jpg"),
        ("run", "core", "--nonsense"),
        ("compile", "core"),
        ("compile", "core", "--emit", "poetry"),
        ("render", "garden", "--rules", "core"),
        ("render", "garden", "--rules", "core", "--out", "x.gif"),
        ("explain", "PD301", "PD302"),
    ],
)
def test_bad_usage_exits_with_2_and_says_how(arguments):
    result = powderdsl(*arguments, exits=exits.BAD_INPUT)
    assert result.stderr.startswith("Usage: powderdsl")
    assert result.stdout == ""


def failing(monkeypatch: pytest.MonkeyPatch, error: BaseException, **environment: str):
    """Run a command that ends with this error."""

    @click.command("show")
    def command() -> None:
        raise error

    monkeypatch.setattr(type(main), "get_command", lambda self, ctx, name: command)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    return CliRunner().invoke(main, ["show"])


def test_our_own_mistakes_ask_for_a_report(monkeypatch):
    result = failing(monkeypatch, ZeroDivisionError("division by zero"))
    assert result.exit_code == exits.INTERNAL
    assert "error[PD901]: a mistake in powderdsl itself: ZeroDivisionError: division by zero" in result.stderr
    assert "please report it" in result.stderr
    assert "Traceback" not in result.output


def test_the_traceback_is_there_for_who_asks(monkeypatch):
    result = failing(monkeypatch, ZeroDivisionError("division by zero"), POWDERDSL_DEBUG="1")
    assert "Traceback" in result.stderr
    assert "PD901" in result.stderr


@pytest.mark.parametrize(
    ("error", "status", "words"),
    [
        (KeyboardInterrupt(), exits.INTERRUPTED, ""),
        (exits.BadInput("no such thing"), exits.BAD_INPUT, "error: no such thing"),
        (OSError(28, "No space left on device", "x.gif"), exits.BAD_INPUT, "error: x.gif: No space left"),
        (MemoryError(), exits.BAD_INPUT, "error: not enough memory"),
        (RuntimeError("you tried to allocate, not enough memory"), exits.BAD_INPUT, "not enough memory"),
        (ValueError("a mistake of ours"), exits.INTERNAL, "PD901"),
    ],
)
def test_every_end_has_its_code(monkeypatch, error, status, words):
    result = failing(monkeypatch, error)
    assert result.exit_code == status
    assert words in result.stderr
    assert "Traceback" not in result.output


def test_several_diagnostics_are_counted(monkeypatch):
    found = [Diagnostic(code, "something", Label(None)) for code in list(CODES)[:2]]
    result = failing(monkeypatch, CompileError(found))
    assert result.exit_code == exits.BAD_INPUT
    assert result.stderr.endswith("\n2 errors\n")


def test_values_that_the_api_refuses_are_bad_input():
    for error in (ValueError("one"), TypeError("one"), KeyError("one")):
        with pytest.raises(exits.BadInput, match=r"\Aone\Z"), exits.user_values():
            raise error


class Terminal:
    def __init__(self, terminal: bool):
        self.isatty = lambda: terminal


def test_color_is_for_terminals_that_want_it(monkeypatch):
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setenv("TERM", "xterm")
    assert output.color_wanted(Terminal(True))
    assert not output.color_wanted(Terminal(False))
    monkeypatch.setenv("TERM", "dumb")
    assert not output.color_wanted(Terminal(True))
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("NO_COLOR", "1")
    assert not output.color_wanted(Terminal(True))


def test_a_terminal_without_the_characters_gets_others():
    result = process("show", "powderworld", PYTHONIOENCODING="ascii", PYTHONUTF8="0", LC_ALL="C")
    assert result.returncode == 0, result.stderr
    assert result.stdout.isascii()


@pytest.mark.skipif(not hasattr(os, "pipe2"), reason="needs a shell")
def test_a_closed_pipe_is_no_mistake():
    with subprocess.Popen(
        command_line("compile", "powderworld", "--emit", "model"),
        env=environment_with(),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as running:
        running.stdout.close()
        assert "Traceback" not in running.stderr.read()
        running.wait(timeout=60)
