"""The Powderworld ruleset against recorded steps of the published engine, pass by pass.

The recorded state and random numbers go into the ruleset, all steps of one file as one batch of worlds, on both
backends: passes 1..k in one step from the state before it, for each k.

What must agree: element ids, gravity and clone in every cell; velocity within 1e-3 (4e-6 is what another
order of summing floats makes of it); momentum in every cell before the wind. After the wind, ids may differ
in one cell of 10,000 (a velocity on the border of two octants may round either way), and momentum where the
engine's one known quirk can explain it: see `quirk_can_explain`. What the ruleset does in those cells
instead is checked for itself, in `test_wind_carries_what_a_cell_holds`.
"""

from __future__ import annotations

from itertools import product
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

import powderdsl
from powderdsl.simulation.simulator import Simulator
from tests.recordings import Recording, State, given, read_recording, recording_paths, where_first

DATA = Path(__file__).parents[1] / "data"
RECORDINGS = recording_paths("POWDERDSL_RECORDINGS", DATA, "before_ids")
FIELDS = ("gravity", "momentum", "clone", "velocity")
PASSES = (
    "stone", "gravity", "piling", "flow", "melt", "freeze", "fire", "plant", "lava", "acid", "cloner", "wind",
)  # fmt: skip
# Passes that read the scratch field, which a step starts at zero: no recorded state can hold it.
EMPTY = 0

VELOCITY_TOLERANCE = 1e-3
IDS_AFTER_WIND = 0.9999  # share of cells that must agree
# Cells between the start of an overrun cell and the effect: up to 2 in the full recordings, and one to spare.
QUIRK_REACH = 3
MOVING_SPEED = 0.1  # the wind pass moves nothing below it

Mask = npt.NDArray[np.bool_]


@pytest.fixture(scope="module", params=["reference", "wasm"])
def simulator(request: pytest.FixtureRequest) -> Simulator:
    return powderdsl.compile("powderworld", backend=request.param)


@pytest.fixture(params=RECORDINGS, ids=lambda path: path.stem)
def recording(request: pytest.FixtureRequest) -> Recording:
    return read_recording(request.param)


def run(simulator: Simulator, state: State, random: dict[str, np.ndarray], passes: tuple[str, ...]) -> State:
    """The state after one step that runs only `passes`, as NumPy arrays."""
    fields = {name: given(state[name], simulator.backend) for name in FIELDS}
    world = simulator.replace(simulator.world(given(state["ids"], simulator.backend)), **fields)
    draws = {stream: given(draw, simulator.backend) for stream, draw in random.items()}
    world = simulator.step(world, random=draws, passes=list(passes))
    return {"ids": np.asarray(world.ids), **{name: np.asarray(world[name]) for name in FIELDS}}


def near(mask: Mask, reach: int) -> Mask:
    """Cells [B, H, W] within `reach` rows and columns of a cell of the mask, around the edges too."""
    shifts = product(range(-reach, reach + 1), repeat=2)
    return np.any([np.roll(mask, shift, (-2, -1)) for shift in shifts], axis=0)


def may_be_overrun(before_wind: State) -> Mask:
    """Empty cells [B, H, W] that hold a momentum and have wind to move them when the wind pass begins.

    The pass moves everything twice: wind beside a cell in the first round may be on it in the second.
    """
    windy = np.hypot(before_wind["velocity"][:, 0], before_wind["velocity"][:, 1]) > MOVING_SPEED
    may: Mask = (before_wind["ids"] == EMPTY) & (before_wind["momentum"] != 0) & near(windy, 1)
    return may


def quirk_can_explain(before_wind: State) -> Mask:
    """Cells [B, H, W] whose momentum after the wind the engine's quirk may have falsified.

    When a cell moves into an empty cell that itself moves in that very sub-step, the engine subtracts the
    empty cell's leftover momentum from the arriving cell's. So there was such an empty cell, and close by,
    since the wind carries nothing far.
    """
    return near(may_be_overrun(before_wind), QUIRK_REACH)


def assert_same(ours: State, recording: Recording, passes_done: int) -> None:
    """Fail unless a state is the recorded one after so many passes, within what the module's head allows."""
    engine = recording.states[passes_done]
    other_ids = ours["ids"] != engine["ids"]
    other_momentum = ours["momentum"] != engine["momentum"]
    if recording.passes[passes_done - 1] == "wind":
        before = recording.states[passes_done - 1]
        assert other_ids.mean() <= 1 - IDS_AFTER_WIND, f"ids: {where_first(other_ids)}"
        # A cell that rounding sent elsewhere took all its fields along.
        other_momentum &= ~other_ids
        unexplained = other_momentum & ~quirk_can_explain(before)
        assert not unexplained.any(), f"momentum, no quirk near: {where_first(unexplained)}"
        # One overrun falsifies one cell, so there are no more of those than cells to overrun.
        at_most = np.count_nonzero(may_be_overrun(before))
        assert np.count_nonzero(other_momentum) <= at_most, f"momentum: {where_first(other_momentum)}"
    else:
        assert not other_ids.any(), f"ids: {where_first(other_ids)}"
        assert not other_momentum.any(), f"momentum: {where_first(other_momentum)}"
    for name in ("gravity", "clone"):
        other = (ours[name] != engine[name]) & ~other_ids
        assert not other.any(), f"{name}: {where_first(other)}"
    assert ours["velocity"].dtype == np.float32
    close = (np.abs(ours["velocity"] - engine["velocity"]) <= VELOCITY_TOLERANCE).all(
        axis=1
    )  # NaN is not close
    assert close.all(), f"velocity: {where_first(~close)}"


def test_names_and_order_are_the_engines(simulator: Simulator, recording: Recording) -> None:
    assert tuple(simulator.elements) == recording.elements
    assert tuple(simulator.passes) == recording.passes == PASSES


@pytest.mark.parametrize("last", PASSES)
def test_passes_up_to_each_one_are_the_engines(simulator: Simulator, recording: Recording, last: str) -> None:
    done = PASSES.index(last) + 1
    assert_same(run(simulator, recording.states[0], recording.random, PASSES[:done]), recording, done)


def test_wind_carries_what_a_cell_holds(simulator: Simulator, recording: Recording) -> None:
    """In each world, the non-empty cells are the same before and after the wind, with all they hold.

    With the quirk they would not be: this is what the ruleset does where the engine cannot be followed.
    """

    def cells(state: State, world: int) -> np.ndarray:
        held = np.stack([state["ids"], state["gravity"], state["momentum"], state["clone"]]).astype(int)[
            :, world
        ]
        solid = held[:, held[0] != EMPTY]
        return solid[:, np.lexsort(solid)]

    before = recording.states[-2]
    after = run(simulator, before, recording.random, ("wind",))
    for world in range(len(before["ids"])):
        np.testing.assert_array_equal(cells(after, world), cells(before, world))
