"""The second Powderworld against recorded steps of its engine: every pass alone, and whole steps.

Each pass runs alone from the recorded state before it, all steps of one file as one batch of worlds. Recordings say
where a defect of the engine shows in the result of a pass:

* `powderworld2` conserves what the engine loses: the same in all cells but those where a defect shows, and after
  a whole step in all worlds where none does;
* `powderworld2_defects` has the defects too: the same in all cells.

Ids, gravity, density and `fell` must be equal, what creatures keep within 1e-4, velocity within 1e-3. The engine's
three custom numbers are fields of their own here: see `fields_of`. A gravity of 2, which only sums of a defect have,
counts as none: such cells never fall.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import powderdsl
from powderdsl.model.state import slots
from powderdsl.model.types import Ruleset
from tests.recordings import Recording, State, given, read_recording, recording_paths, where_first
from tests.tiers import tiered

DATA = Path(__file__).parents[1] / "data" / "second"
RECORDINGS = recording_paths("POWDERDSL_SECOND_RECORDINGS", DATA, "before_custom1")
PASSES = (
    "stone", "mole", "gravity", "piling", "lemming", "flow", "melt", "freeze", "fire",
    "plant", "lava", "acid", "cloner", "fish", "bird", "kangaroo", "snake", "wind",
)  # fmt: skip
RULESETS = ("powderworld2", "powderworld2_defects")
FLOWING = ("empty", "water", "gas", "lava", "acid", "kangaroo", "lemming")
CLOSE = {"velocity": 1e-3, "flying": 1e-4, "leap": 1e-4, "energy": 1e-4}
"""How far floats may be from the recorded ones."""


@dataclass(frozen=True)
class Runner:
    """The compiled rules on one backend, taking and giving recorded states."""

    backend: str
    ruleset: Ruleset
    simulator: Any

    def world(self, state: State) -> Any:
        """A recorded state as worlds."""
        world = self.simulator.world(given(state["ids"], self.backend))
        fields = {slot.name: slot for slot in slots(self.ruleset)}
        found = {name: value for name, value in self.fields_of(state).items() if name in fields}
        for name, value in found.items():
            prop = self.ruleset.property(name)
            if prop is not None:  # cells of other elements have the value of their element, and no other
                usual = np.array([float(number) for number in prop.values])[state["ids"]]
                own = np.isin(state["ids"], sorted(prop.stored))
                found[name] = np.where(own, value, usual).astype(fields[name].dtype)
        return self.simulator.replace(
            world, **{name: given(value, self.backend) for name, value in found.items()}
        )

    def run(self, state: State, random: State, passes: tuple[str, ...]) -> Any:
        """The world after one step that runs only `passes`."""
        draws = {stream: given(draw, self.backend) for stream, draw in random.items()}
        return self.simulator.step(self.world(state), random=draws, passes=list(passes))

    def fields_of(self, state: State) -> State:
        """The fields that stand for a recorded state's numbers."""
        ids, first, second = state["ids"], state["custom1"], state["custom2"]

        def only(values: np.ndarray, *names: str) -> np.ndarray:
            numbers = [self.ruleset.element(name).id for name in names]  # type: ignore[union-attr]  # all are there
            return np.where(np.isin(ids, numbers), values, 0)

        found = {
            "gravity": (state["gravity"] == 1).astype(np.uint8),
            "momentum": only(first, *FLOWING).astype(np.int8),
            "fell": state["custom3"].astype(np.int8),
            "velocity": state["velocity"].astype(np.float32),
            "clone": only(first, "cloner").astype(np.uint8),
            "digging": 2 * only(first, "mole").astype(np.uint8),  # quarters of a turn as eighths
            "crawling": 2 * only(first, "snake").astype(np.uint8),
            "energy": only(second, "snake").astype(np.float32),
            "leap": only(second, "kangaroo").astype(np.float32),
            "flying": np.stack([only(first, "bird"), only(second, "bird")], 1).astype(np.float32),
        }
        return found | ({"density": state["density"].astype(np.int8)} if "density" in state else {})

    def differing(self, world: Any, recorded: State) -> dict[str, np.ndarray]:
        """Where a world differs from a recorded state, bool [n, H, W], by field. The same without a field: no entry."""
        found = {"ids": np.asarray(world.ids) != recorded["ids"]}
        for name, value in self.fields_of(recorded).items():
            if name not in world.state:
                continue
            ours = np.asarray(world[name]).astype(np.float64)
            other = ~(np.abs(ours - value) <= CLOSE.get(name, 0))  # NaN is not close
            found[name] = other.any(axis=1) if other.ndim == 4 else other
        return {name: mask for name, mask in found.items() if mask.any()}


@cache
def compiled(name: str, backend: str) -> Runner:
    ruleset = powderdsl.load(name)
    return Runner(backend, ruleset, powderdsl.compile(ruleset, backend=backend))


RUNNERS = [(name, backend) for name in RULESETS for backend in ("reference", "wasm")]


@pytest.fixture(params=tiered(RUNNERS, RUNNERS[1:3]), ids="-".join)
def runner(request: pytest.FixtureRequest) -> Runner:
    return compiled(*request.param)


@pytest.fixture(params=RECORDINGS, ids=lambda path: path.stem)
def recording(request: pytest.FixtureRequest) -> Recording:
    return read_recording(request.param)


def defects(recording: Recording) -> np.ndarray:
    assert recording.defect is not None
    return recording.defect


def assert_none(differing: dict[str, np.ndarray], but: np.ndarray) -> None:
    """Fail if a field differs somewhere, cells [n, H, W] or worlds [n, 1, 1] left out."""
    found = {name: mask & ~but for name, mask in differing.items()}
    assert not any(mask.any() for mask in found.values()), {
        name: where_first(mask) for name, mask in found.items() if mask.any()
    }


def test_names_and_order_are_the_engines(runner: Runner, recording: Recording) -> None:
    assert tuple(runner.simulator.elements) == recording.elements
    assert tuple(runner.simulator.passes) == recording.passes == PASSES


@pytest.mark.parametrize("alone", PASSES)
def test_single_pass(runner: Runner, recording: Recording, alone: str) -> None:
    k = PASSES.index(alone)
    world = runner.run(recording.states[k], recording.random, (alone,))
    conserving = runner.ruleset.name == "powderworld2"
    but = defects(recording)[k] if conserving else np.zeros_like(defects(recording)[k])
    before = recording.states[k]
    if conserving and "density" in before:  # sums that a defect left behind are no cells of these rules
        usual = np.array([float(number) for number in runner.ruleset.property("density").values])  # type: ignore[union-attr]
        sums = (before["gravity"] > 1) | (before["density"] != usual[before["ids"]])
        but = but | sums.any(axis=(-2, -1), keepdims=True)
    assert_none(runner.differing(world, recording.states[k + 1]), but)


def test_whole_step(runner: Runner, recording: Recording) -> None:
    world = runner.run(recording.states[0], recording.random, PASSES)
    worlds = defects(recording).any(axis=(0, -2, -1))[:, None, None]
    before = recording.states[0]
    worlds = worlds | (before["gravity"] > 1).any(axis=(-2, -1), keepdims=True)
    but = worlds if runner.ruleset.name == "powderworld2" else np.zeros_like(worlds)
    assert_none(runner.differing(world, recording.states[-1]), but)
