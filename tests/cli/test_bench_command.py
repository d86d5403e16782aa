"""`powderdsl bench`: what it prints and writes, what it refuses, and Ctrl-C."""

from __future__ import annotations

import json
import re

import pytest

from powderdsl.cli import exits
from powderdsl.cli.commands import bench as bench_command
from tests.cli.commands import powderdsl
from tests.compilers import skip_without_compiler

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


# Checks

CHECK = (*QUICK[:3], "16", *QUICK[4:], "--batch", "2", "--check")


def test_a_backend_is_compared_with_the_cpu():
    given = (*CHECK, "--backend", "wasm", "--backend", "torch", "--backend", "reference")
    text = powderdsl(*given, exits=0).stdout
    heading, *rows = text.split("\n\n")[1].splitlines()
    assert heading.split()[-2:] == ["kernels/step", "check"]
    assert [row.split()[-1] for row in rows] == ["equal"] * 3
    cells = json.loads(powderdsl(*given, "--json", exits=0).stdout)["cells"]
    assert [cell["check"] for cell in cells] == ["equal"] * 3
    wasm, torch, reference = (cell["kernels_per_step"] for cell in cells)
    assert wasm is reference is None
    assert 10 < torch < 500


def test_the_first_difference_is_named(monkeypatch):
    from powderdsl.targets.torch.packed import PlanesProgram

    right = PlanesProgram.run

    def wrong(self, job):
        """One cell is wrong after three steps."""
        state = dict(right(self, job))
        if job.clock.since + job.steps >= 3:
            state["element"] = state["element"].clone()
            state["element"][1, 2, 3] ^= 1
        return state

    monkeypatch.setattr(PlanesProgram, "run", wrong)
    result = powderdsl(*CHECK, "--backend", "torch", "--backend", "torch-cells", exits=exits.FAILED)
    torch, cells = result.stdout.split("\n\n")[1].splitlines()[1:]
    assert re.search(r"element of world 1, cell \(2, 3\), step 3: (0 instead of 1|1 instead of 0)$", torch)
    assert cells.split()[-1] == "equal"


def test_calls_of_several_steps_are_compared_too(monkeypatch):
    from powderdsl.targets.torch.packed import PlanesProgram

    right = PlanesProgram.run
    monkeypatch.setattr(
        PlanesProgram, "run", lambda self, job: right(self, job._replace(steps=min(job.steps, 6)))
    )
    result = powderdsl(*CHECK, "--backend", "torch", exits=exits.FAILED)
    assert re.search(r"element of world 0, cell \(\d+, \d+\), step 7: ", result.stdout)


def test_backends_that_do_not_run_say_so_and_the_others_run(monkeypatch):
    from powderdsl.targets.torch.program import TorchProgram

    monkeypatch.setattr(TorchProgram, "run", lambda self, job: 1 // 0)
    backends = [word for name in ("cuda", "torch-cells", "torch") for word in ("--backend", name)]
    result = powderdsl(*CHECK, *backends, exits=exits.FAILED)
    cuda, cells, torch = result.stdout.split("\n\n")[1].splitlines()[1:]
    assert re.search(r"– +the cuda backend is not available: its kernels run on a CUDA device$", cuda)
    assert cells.endswith("ZeroDivisionError: integer division or modulo by zero")
    assert torch.split()[-1] == "equal"
    cells = json.loads(powderdsl(*CHECK, *backends, "--json", exits=exits.FAILED).stdout)["cells"]
    assert [cell["world_steps_per_second"] is None for cell in cells] == [True, True, False]
    assert powderdsl(*QUICK, *backends, exits=exits.BAD_INPUT).stdout == ""


def test_a_gpu_is_checked_with_all_that_runs_there():
    assert bench_command._usual_backends("cuda", True) == ("torch", "torch-fused", "cuda")
    assert bench_command._usual_backends("cuda:1", False) == ("torch", "cuda")
    assert bench_command._usual_backends("mps", True) == ("torch", "torch-fused")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning")  # of torch about itself
def test_compiled_functions_are_checked(monkeypatch, tmp_path):
    skip_without_compiler()
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path))
    (cell,) = json.loads(powderdsl(*CHECK, "--backend", "torch-fused", "--json", exits=0).stdout)["cells"]
    assert cell["check"] == "equal"
    assert cell["kernels_per_step"] > 0


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
