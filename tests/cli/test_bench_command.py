"""`powderdsl bench`: what it prints and writes, what it refuses, and Ctrl-C."""

from __future__ import annotations

import json

import pytest

from powderdsl.cli import exits
from powderdsl.cli.commands import bench as bench_command
from tests.cli.commands import powderdsl

QUICK = ("bench", "life", "--size", "6x8", "--rounds", "2", "--seconds", "0.001", "--steps", "2")
TORCH = (*QUICK, "--backend", "torch", "--batch", "2")


pytestmark = pytest.mark.usefixtures("folder")


def test_all_combinations_are_measured():
    given = (*TORCH, "--backend", "reference", "--batch", "3", "--profile")
    data = json.loads(powderdsl(*given, "--json").stdout)
    measured = [(cell["backend"], cell["batch"]) for cell in data["cells"]]
    assert measured == [("torch", 2), ("torch", 3), ("reference", 2), ("reference", 3)]
    result = powderdsl(*given, exits=0)
    lines = result.stdout.splitlines()
    assert [tuple(line.split()[:3]) for line in lines if line.startswith(("torch", "reference"))] == [
        (backend, str(batch), "6×8") for backend, batch in measured
    ]
    passes = [*data["cells"][0]["passes"]]
    table = result.stdout.split("\n\n")[-1].splitlines()
    assert [line.split("  ")[0] for line in table[1:-3]] == passes
    assert [line.split("  ")[0] for line in table[-3:-1]] == ["all passes", "whole step"]


def test_without_a_compiler_webassembly_is_measured(monkeypatch):
    def none():
        raise bench_command.NoCompiler("no C++ compiler found")

    monkeypatch.setattr(bench_command, "find_compiler", none)
    result = powderdsl(*QUICK, "--batch", "1", exits=0)
    assert "no C++ compiler found" in result.stderr
    assert "\nwasm " in result.stdout
    assert "\nnative " not in result.stdout


def test_help_says_what_the_workloads_are():
    text = powderdsl("bench", "--help").stdout
    assert all(f"\n    {name} " in text for name in ("gusts", "shapes", "noise", "few"))


# Programs beside the backends

PROGRAM = """
CALLS = []


def load(state):
    assert state["element"].shape == (2, 6, 8)
    assert not state["element"][0, 0, 0] == 99
    state["element"][:] = 99  # a program may write into the worlds that it is given
    return CALLS.append
"""


def test_a_program_is_measured_beside_a_backend(tmp_path):
    (tmp_path / "mine.py").write_text(PROGRAM)
    assert "÷ mine" in powderdsl(*TORCH, "--beside", "mine.py", exits=0).stdout
    data = json.loads(powderdsl(*TORCH, "--beside", "mine.py", "--json").stdout)
    torch, mine = data["cells"]
    assert (torch["backend"], mine["backend"]) == ("torch", "mine")
    assert mine["beside"] == {"mine": 1.0}
    assert torch["beside"]["mine"] > 1
    assert len(mine["round_seconds"]) == 2
    (tmp_path / "mine.py").rename("torch.py")
    result = powderdsl(*TORCH, "--beside", "torch.py", exits=exits.BAD_INPUT)
    assert "`torch` is the name of another program or of a backend" in result.stderr


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("def load(state)\n    pass\n", "(bad.py, line 1)"),
        ("x = 1\n", "does not define `load(state)`"),
        ("def load(state):\n    pass\n", "does not return a function"),
        ("def load(state):\n    return state['lava']\n", "bad.py:2: KeyError"),
        (
            "def load(state):\n    def run(steps):\n        1 / 0\n    return run\n",
            "bad.py:3: ZeroDivisionError",
        ),
        ("import no_such_module\n", "bad.py:1: ModuleNotFoundError"),
    ],
)
def test_a_program_with_a_mistake_is_named_with_its_line(tmp_path, text, words):
    (tmp_path / "bad.py").write_text(text)
    assert words in powderdsl(*TORCH, "--beside", "bad.py", exits=exits.BAD_INPUT).stderr
