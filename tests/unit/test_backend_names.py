"""Names of backends: each is what runs, or is refused; old names say what runs now."""

from __future__ import annotations

import json
import warnings
from pathlib import Path

import pytest
import torch

import powderdsl
from powderdsl.compiler import BACKENDS, RENAMED_BACKENDS, starting_backend
from powderdsl.diagnostics import CompileError
from powderdsl.envs.tensor_env import TensorEnv
from powderdsl.experiments.bench.plan import make_plan
from powderdsl.rl.config import check_config, from_json, preset
from powderdsl.simulation.programs import CompiledProgram, make_program
from powderdsl.targets.torch.program import TorchProgram
from tests.cli.commands import powderdsl as command

PROGRAMS = {"dense": TorchProgram, "planes": CompiledProgram, "arrays": CompiledProgram}


@pytest.mark.parametrize("old", RENAMED_BACKENDS)
def test_an_old_name_runs_the_same_with_a_warning(old: str) -> None:
    new = RENAMED_BACKENDS[old]
    with pytest.warns(DeprecationWarning, match=f"`{old}` is `{new}` now") as found:
        sim = powderdsl.compile("life", backend=old)
    assert [Path(one.filename) for one in found] == [Path(__file__)]
    assert sim.backend == sim.running == new
    assert type(sim._program) is type(powderdsl.compile("life", backend=new)._program) is PROGRAMS[old]
    assert new in BACKENDS
    assert old not in BACKENDS


def test_the_warning_names_the_users_line_from_anywhere() -> None:
    with pytest.warns(DeprecationWarning, match="`dense` is `torch` now") as found:
        TensorEnv("sand-pushing", 1, backend="dense")
    assert [Path(one.filename) for one in found] == [Path(__file__)]
    with pytest.warns(DeprecationWarning, match="`planes` is `wasm` now"):
        plan = make_plan(powderdsl.load("life"), backends=["planes", "wasm"])
    assert {cell.backend for cell in plan.cells} == {"wasm"}


def test_commands_note_an_old_name() -> None:
    given = ("run", "life", "--size", "8", "--steps", "2", "--backend")
    old, new = command(*given, "planes"), command(*given, "wasm")
    assert old.exit_code == new.exit_code == 0
    assert old.stdout == new.stdout
    assert "note: the backend `planes` is `wasm` now" in old.stderr
    assert "note:" not in new.stderr
    assert command("run", "life", "--backend", "plains").exit_code == 2
    assert "planes" not in command("run", "--help").stdout


@pytest.mark.parametrize("old", RENAMED_BACKENDS)
def test_settings_of_recorded_runs(old: str) -> None:
    """A file from before is not the user's doing: it is read as it is meant, without a word."""
    now = preset("small", "sand-pushing", backend=RENAMED_BACKENDS[old])
    recorded = json.loads(json.dumps(now.as_json() | {"backend": old}))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert from_json(recorded) == now
    assert check_config(preset("small", "sand-pushing", backend=old)).backend == old
    with pytest.raises(CompileError, match=f"it takes one of {', '.join(BACKENDS)}"):
        preset("small", "sand-pushing", backend="plains")


@pytest.mark.parametrize("backend", ["wasm", "native"])
def test_what_runs_on_the_cpu_is_refused_elsewhere(backend: str) -> None:
    with pytest.raises(CompileError, match=f"the {backend} backend is not available") as found:
        make_program(powderdsl.load("life"), backend, torch.device("meta"))
    assert "on the backend `torch` or `auto` on `meta`" in str(found.value)


def test_other_devices_run_tensors() -> None:
    program = make_program(powderdsl.load("life"), "auto", torch.device("meta"))
    assert type(program) is TorchProgram


def test_without_a_compiler_native_names_what_needs_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CXX", "no-such")
    with pytest.raises(CompileError, match="run on the backend `wasm`, or install"):
        powderdsl.compile("life", backend="native")


def test_what_starts_at_once() -> None:
    assert [starting_backend(name) for name in ("cpu", "cpu:0", "cuda", "cuda:1", "mps")] == [
        *("wasm", "wasm"),
        *("torch", "torch", "torch"),
    ]
