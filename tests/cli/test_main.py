"""The group of commands: help, exit codes, and what people read when something goes wrong."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Iterator
from types import SimpleNamespace

import click
import pytest
from click.testing import CliRunner

from powderdsl.cli import exits, main, output
from powderdsl.cli.dispatch import COMMANDS
from powderdsl.diagnostics import CODES, CompileError, Diagnostic, Label
from tests.cli.commands import ROOT, command_line, environment_with, powderdsl


def test_help_lists_every_command():
    assert powderdsl("--version").stdout.startswith("powderdsl 0.")
    lines = powderdsl("--help", exits=0).stdout.splitlines()
    shown = [line.split()[0] for line in lines if line.startswith("  ") or line.endswith(":")]
    start = shown.index("Start:")
    assert [word for word in shown[start:] if word in COMMANDS] == [*COMMANDS]
    assert [word for word in shown[start:] if word.endswith(":")][:3] == ["Start:", "Rules:", "Learn:"]


def test_a_page_lists_the_variables_that_commands_read():
    read = re.compile(r"environ(?:\.\w+\(|\[)?\"([A-Z_]+)\"")
    found = {
        name for path in (ROOT / "powderdsl").rglob("*.py") for name in read.findall(path.read_text("utf-8"))
    }
    assert {"NO_COLOR", "POWDERDSL_DEBUG"} < found
    listed = re.findall(r"^\| `([A-Z_]+)` \|", (ROOT / "docs" / "shell.md").read_text("utf-8"), re.M)
    # Those of others: torch's threads and profiler, and the terminal.
    assert found - {*listed} == {"KINETO_LOG_LEVEL", "OMP_NUM_THREADS", "TERM"}
    assert "docs/shell.md lists environment variables" in powderdsl("--help").stdout


@pytest.mark.parametrize("streams", [">&-", "<&- >&- 2>&-"])
def test_streams_may_be_closed(streams, tmp_path):
    """What goes there is lost; a file that is written does not take its place."""
    out = tmp_path / "world.png"
    words = command_line("render", "powderworld", "--world", "garden", "--out", out)
    command = ["sh", "-c", f'"$@" {streams}', "sh", *words]
    ended = subprocess.run(command, env=environment_with(), capture_output=True, text=True)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert out.read_bytes().endswith(b"IEND\xaeB`\x82")


def leaves(command: click.Command, *words: str) -> Iterator[tuple[tuple[str, ...], click.Command]]:
    """Commands without commands of their own, and what calls them."""
    names = command.list_commands(click.Context(command)) if isinstance(command, click.Group) else ()
    for name in names:
        yield from leaves(command.get_command(click.Context(command), name), *words, name)
    if not names:
        yield words, command


def test_many_options_are_in_sections():
    for words, command in leaves(main):
        text = powderdsl(*words, "--help", exits=0).stdout
        assert text.startswith(f"Usage: {' '.join(('powderdsl', *words))} ")
        assert command.name == words[-1]
        names = [option.opts[-1] for option in command.params if isinstance(option, click.Option)]
        first = re.search(r"^\w[\w ]*:$", text, re.M).start()
        shown = re.findall(r"^  (?:-\w, )?(--[\w-]+)", text[first:], re.M)
        assert sorted(shown) == sorted([*names, "--help"]), words
        rest = text.partition("\nOptions:")[2]
        assert len(names) <= 10 or rest.count("\n  -") <= 4, words


def test_help_has_the_defaults_of_presets():
    help_text = " ".join(powderdsl("train", "--help").stdout.split())
    assert "[paper: 256, small: 128, fcn: 32]" in help_text
    assert "Number of parallel worlds. [default: 32]" in help_text
    help_text = " ".join(powderdsl("wm", "train", "--help").stdout.split())
    assert "Number of features of the first block. [paper: 32, small: 16]" in help_text
    assert "..." not in powderdsl("wm", "--help").stdout.partition("Commands:")[2]


def failing(monkeypatch: pytest.MonkeyPatch, error: BaseException, **environment: str):
    """Run a command that ends with this error."""

    @click.command("show")
    def command() -> None:
        raise error

    monkeypatch.setattr(type(main), "get_command", lambda self, ctx, name: command)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    return CliRunner().invoke(main, ["show"])


@pytest.mark.parametrize(
    ("error", "status", "words"),
    [
        (KeyboardInterrupt(), exits.INTERRUPTED, ""),
        (exits.BadInput("no such thing"), exits.BAD_INPUT, "error: no such thing"),
        (OSError(28, "No space left on device", "x.gif"), exits.BAD_INPUT, "error: x.gif: No space left"),
        (
            ModuleNotFoundError(name="PIL.Image"),
            exits.BAD_INPUT,
            "PIL, which is not installed\n  = help: pip install pillow",
        ),
        (ModuleNotFoundError(name="powderdsl.sand"), exits.INTERNAL, "error[PD901]"),
        (MemoryError(), exits.BAD_INPUT, "error: not enough memory"),
        (RuntimeError("you tried to allocate, not enough memory"), exits.BAD_INPUT, "not enough memory"),
        (
            ZeroDivisionError("by 0"),
            exits.INTERNAL,
            "error[PD901]: a bug in powderdsl: ZeroDivisionError: by 0",
        ),
        (ValueError("a mistake of ours"), exits.INTERNAL, "please report it"),
        (
            CompileError([Diagnostic(code, "wrong", Label(None)) for code in list(CODES)[:2]]),
            exits.BAD_INPUT,
            "\n2 errors\n",
        ),
    ],
)
def test_every_end_has_its_code(monkeypatch, error, status, words):
    result = failing(monkeypatch, error)
    assert result.exit_code == status
    assert words in result.stderr
    assert "Traceback" not in result.output
    told = failing(monkeypatch, error, POWDERDSL_DEBUG="1")
    assert ("Traceback" in told.stderr) == (status == exits.INTERNAL)
    assert words in told.stderr


def test_values_that_the_api_refuses_are_bad_input():
    for error in (ValueError("one"), TypeError("one"), KeyError("one")):
        with pytest.raises(exits.BadInput, match=r"\Aone\Z"), exits.user_values():
            raise error


@pytest.mark.parametrize(
    ("is_terminal", "term", "no_color", "force_color", "wanted"),
    [
        (True, "xterm", "", "", True),
        (False, "xterm", "", "", False),
        (True, "dumb", "", "", False),
        (True, "xterm", "1", "", False),
        (False, "dumb", "", "1", True),
        (True, "xterm", "1", "1", False),
    ],
)
def test_color_is_for_terminals_that_want_it(monkeypatch, is_terminal, term, no_color, force_color, wanted):
    monkeypatch.setenv("NO_COLOR", no_color)
    monkeypatch.setenv("FORCE_COLOR", force_color)
    monkeypatch.setenv("TERM", term)
    assert output.color_wanted(SimpleNamespace(isatty=lambda: is_terminal)) == wanted


def test_a_terminal_without_the_characters_gets_others():
    environment = environment_with(PYTHONIOENCODING="ascii", PYTHONUTF8="0", LC_ALL="C")
    show = command_line("show", "powderworld")
    result = subprocess.run(show, env=environment, capture_output=True, text=True, check=True)
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


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_shells_complete_commands(shell):
    def answer(step, **words):
        environment = environment_with(_POWDERDSL_COMPLETE=f"{shell}_{step}", **words)
        return subprocess.check_output(command_line(), env=environment, text=True)

    source = answer("source")
    assert f"_POWDERDSL_COMPLETE={shell}_complete" in source
    if shutil.which(shell):
        script = f"autoload compinit; compinit -u\n{source}" if shell == "zsh" else source
        subprocess.run([shell, "-c", script], check=True)
    words = {"COMP_WORDS": "powderdsl tra", "COMP_CWORD": "tra" if shell == "fish" else "1"}
    assert all(word in answer("complete", **words) for word in ("trace", "train"))


def completed(line: str) -> set[str]:
    environment = {"COMP_WORDS": f"powderdsl {line}", "COMP_CWORD": str(len(line.split()))}
    answer = powderdsl(_POWDERDSL_COMPLETE="bash_complete", **environment, exits=0).stdout
    return {entry.partition(",")[2] for entry in answer.splitlines() if entry.startswith("plain,")}


@pytest.mark.parametrize(
    ("line", "found", "lost"),
    [
        ("run core+w", {"core+water", "core+wireworld"}, {"water"}),
        ("check powderworld-ga", {"powderworld-gas"}, set()),
        ("show san", {"sand", "sand-pushing"}, {"water"}),
        ("train sand-pushing --split h", {"handmade"}, {"train"}),
        ("train --split te", {"test"}, {"train"}),
        ("evaluate sand-pushing --split train,t", {"train,test"}, {"test"}),
        ("run core --world fi", {"fish-tank"}, {"fish"}),
        ("run core --backend na", {"native"}, {"wasm"}),
        ("wm train --held-out gas,st", {"gas,stone"}, {"stone"}),
    ],
)
def test_names_complete_parameters(line, found, lost):
    assert found <= completed(line)
    assert not lost & completed(line)


def test_runs_complete_parameters(folder):
    (folder / "runs" / "pond").mkdir(parents=True)
    assert completed("evaluate po") == completed("curves po") == {"pond"}
