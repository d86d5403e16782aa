"""`python -m tests.fuzz`: what it says, saves and returns; a backend that is made wrong is found, reduced and replayed."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

import pytest

from powderdsl.simulation.simulator import Simulator
from powderdsl.targets.cpp.build import Building
from tests.cli.commands import command_line, environment_with, powderdsl
from tests.compilers import skip_without_compiler
from tests.fuzz import COMPARED, differential
from tests.fuzz.cases import read_case, write_case
from tests.fuzz.reducer import reduce_case


@pytest.mark.slow
def test_every_target_is_compared_unless_some_are_named(tmp_path: Path) -> None:
    skip_without_compiler()
    given = ("fuzz", "--jobs", 1, "--worlds", 1, "--steps", 1, "--seeds", "0..1", "--save", tmp_path)
    named = f"{', '.join(COMPARED[:-1])} and {COMPARED[-1]}"
    assert f": {named} against the reference" in powderdsl(*given, exits=0).stdout
    some = powderdsl(*given, "--backends", "reference,cuda-emulated", exits=0)
    assert ": cuda-emulated against the reference" in some.stdout


@pytest.mark.slow
def test_damaged_files(tmp_path: Path) -> None:
    # A process of its own: the memory that loading takes is the peak of the process, which tests raise as well.
    line = command_line("fuzz", "--front-end", "--seeds", "0..30", "--jobs", 1, "--save", tmp_path)
    result = subprocess.run(line, env=environment_with(), capture_output=True, text=True)
    assert result.returncode == 0, result.stdout
    assert "30 inputs" in result.stdout
    assert "no problems found" in result.stdout


@pytest.mark.slow
def test_a_wrong_backend_is_found_reduced_and_replayed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Planes that turn each second row's new cells: only rules that change elements fail, which is what is left."""
    compiled = differential._compiled

    def wrong(ruleset: Any, backend: str, how: Building, threads: int) -> Simulator:
        simulator = compiled(ruleset, backend, how, threads)
        if backend == "wasm":
            step = simulator.step

            def broken(world: Any, *args: Any, **options: Any) -> Any:
                after = step(world, *args, **options)
                ids = after.ids.clone()
                changed = (ids != world.ids).any(0)
                ids[:, changed] = world.ids[:, changed]
                return simulator.replace(after, ids=ids)

            monkeypatch.setattr(simulator, "step", broken)
        return simulator

    monkeypatch.setattr(differential, "_compiled", wrong)
    plan = differential.Plan(("wasm",), worlds=2, steps=2)
    outcomes = (differential.run_seed(seed, plan) for seed in range(20))
    finding = next(found for outcome in outcomes for found in outcome.findings)
    small = reduce_case(finding.case, differential.still_fails(finding, plan.building))
    assert small.steps == 1
    assert small.start.ids.size <= 2
    assert len(small.text) < len(finding.case.text) / 2
    write_case(tmp_path / "case.yaml", small, finding.problem)
    assert "fields" not in (tmp_path / "case.yaml").read_text() or small.start.fields
    replayed = powderdsl("fuzz", "--replay", tmp_path / "case.yaml", exits=1)
    assert "wasm differs after step 1: `element`" in replayed.stdout
    monkeypatch.setattr(differential, "_compiled", compiled)
    differential._simulator.cache_clear()
    replayed = powderdsl("fuzz", "--replay", tmp_path / "case.yaml", exits=0)
    assert "wasm and the reference agree" in replayed.stdout
    assert read_case(tmp_path / "case.yaml").text == small.text
