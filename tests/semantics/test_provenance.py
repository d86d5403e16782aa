"""Which rule wrote each cell: the same on every backend, and what an independent account of the step says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from powderdsl.compiler import load
from powderdsl.model.types import Ruleset
from powderdsl.simulation.simulator import compile
from powderdsl.simulation.tracing import SLOT, Provenance, RecordedStep, Recorder
from powderdsl.testing.generators.cases import Choices, Start, random_start
from tests.fuzz import STARTS_AT_ONCE
from tests.semantics.test_differential import compositions
from tests.tiers import tiered

BACKENDS = ("reference", *STARTS_AT_ONCE)


def recorded(ruleset: Ruleset, start: Start, backend: str) -> Provenance:
    """Provenance of two steps on a backend, which must not change what becomes of the worlds."""
    sim = compile(ruleset, backend=backend)
    world = start.world(sim)
    found = Recorder(sim).step(world, 2, params=start.params or None)
    plain = sim.step(world, 2, params=start.params or None)
    assert found.world.state.keys() == plain.state.keys()
    assert all(bool((found.world.state[name] == plain.state[name]).all()) for name in plain.state)
    assert SLOT not in found.world.state
    assert str(found.numbers.dtype) == "torch.int16"
    return found


@pytest.mark.parametrize("name", tiered(compositions(), ["core+bird", "langtons_ant"]))
def test_shipped_rules_on_all_backends(name):
    ruleset, written = load(name), 0
    for shape in ((2, 5, 33), (1, 2, 2)):
        start = random_start(ruleset, Choices.seeded(1), shape)
        oracle, *others = (recorded(ruleset, start, backend) for backend in BACKENDS)
        assert all(bool((other.numbers == oracle.numbers).all()) for other in others)
        written += int((oracle.numbers > 0).sum())
    # Of empty space and walls alone nothing moves.
    assert (written == 0) == (name in ("core", "core2", "core+bird"))


@pytest.mark.parametrize(
    "name", tiered(["powderworld", "langtons_ant", "cyclic"], ["langtons_ant", "cyclic"])
)
def test_the_last_writers_of_shipped_rules_are_those_of_the_trace(name):
    ruleset = load(name)
    for shape in ((2, 4, 5), (1, 1, 2)):
        world = replace(random_start(ruleset, Choices.seeded(7), shape), params={}).world(
            compile(ruleset, backend="torch")
        )
        found = Recorder(world.sim).step(world)
        changed = found.world.ids != world.ids
        assert bool((found.numbers[changed] > 0).all()), "a change without a writer"
        for number in range(len(world)):
            for cell in np.ndindex(*shape[1:]):
                step = RecordedStep(world.select([number]), cell)
                rules = [
                    one.attempt and one.attempt.rule for one in step.writes if one.slot.name == "element"
                ]
                assert found.rule_at(*cell, world=number) == (rules[-1] if rules else None)


def test_only_the_last_step_counts_and_no_step_writes_nothing():
    sim = compile(load("life"), backend="torch")
    ids = np.zeros((1, 5, 5), np.int64)
    ids[0, 2, 1:4] = 1
    world = sim.world(ids)
    recorder = Recorder(sim)
    written = [
        set(zip(*np.nonzero(recorder.step(world, steps).numbers[0].numpy()), strict=True))
        for steps in range(3)
    ]
    ends = {(1, 2), (3, 2), (2, 1), (2, 3)}
    assert written == [set(), ends, ends]
    born, died = (recorder.step(world).rule_at(*cell) for cell in ((1, 2), (2, 1)))
    assert "dead_cell -> live_cell" in born.span.text
    assert "live_cell -> dead_cell" in died.span.text
    assert born.place.startswith("rules/life.yaml:")


def test_worlds_of_other_rules_are_refused():
    one, other = (compile(load(name), backend="torch") for name in ("life", "cyclic"))
    with pytest.raises(ValueError, match="this world belongs to cyclic"):
        Recorder(one).step(other.world(np.zeros((2, 2), np.int64)))
