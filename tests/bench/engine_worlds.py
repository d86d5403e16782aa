"""A step of the second Powderworld, beside the torch engine of 2023: `python -m tests.bench.engine_worlds`.

Needs the engine: see `beside_engine.py`. Before worlds are measured, they are compared: after a step with the same
random numbers, the engine must have the ids of the same rules with its defects. Recorded worlds come from
`tests/data/second`, or from the folder that POWDERDSL_SECOND_RECORDINGS names.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch

from powderdsl.experiments.bench import Plan, start_worlds
from tests.bench.beside_engine import State, load, stepped
from tests.bench.rounds import microseconds
from tests.recordings import STREAMS, given, read_recording
from tests.semantics.test_second_recordings import RECORDINGS, Runner, compiled

WORLDS, STEPS, ROUNDS = 32, 16, 5
"""Worlds at once, steps of a call, and rounds in which all backends run one after the other."""
ROUNDED = 1e-4
"""In how many cells ids may differ: a bird at rest has speed 1 to within rounding, and moves if that is above 1."""
BACKENDS = ("wasm", "native")
RULES = {  # with the defects of the engine, and the elements of the worlds
    "powderworld2": ("powderworld2_defects", ()),
    "powderworld2_ogbench": (
        "powderworld2_ogbench+piling_defect",
        ("empty", "wall", "sand", "water", "gas", "wood", "ice", "fire", "plant", "stone", "dust"),
    ),
}
RECORDED = {"designed": "64×64", "creatures_32x32": "32×32", "mixtures": "32×32"}


def starts(runner: Runner, elements: tuple[str, ...]) -> Iterator[tuple[str, Any]]:
    """Worlds by what they are."""
    sim = runner.simulator
    for side in (64, 32):
        for workload in ("noise", "shapes"):
            plan = Plan(sim.ruleset, workload=workload, sizes=[(side, side)], batches=[WORLDS], only=elements)
            world = start_worlds(sim, plan, plan.cells[0])
            if workload == "noise":
                yield f"random cells, {side}×{side}", sim.world(world.ids)
            yield f"{workload}, {side}×{side}", world
    if not elements:
        for name, size in RECORDED.items():
            state = read_recording(next(path for path in RECORDINGS if path.stem == name)).states[0]
            chosen = np.arange(WORLDS) * len(state["ids"]) // WORLDS
            yield f"{name}, {size}", runner.world({field: values[chosen] for field, values in state.items()})


def differing(like: Runner, state: State) -> int:
    """In how many cells a step of the engine gives other ids than the rules, with the same random numbers."""
    random = np.random.default_rng(1)
    shape = state["element"].shape
    draws = {name: ((random.integers(0, 256, shape) + 0.5) / 256).astype(np.float32) for name in STREAMS}
    world = like.simulator.world(given(state["element"], like.backend))
    fields = {name: given(values, like.backend) for name, values in state.items() if name != "element"}
    world = like.simulator.replace(world, **fields)
    after = like.simulator.step(
        world, random={name: given(draw, like.backend) for name, draw in draws.items()}
    )
    found = int((stepped(state, draws)[:, 0] != after.ids).sum())
    assert found <= ROUNDED * state["element"].size, f"{found} of {state['element'].size} ids differ"
    return found


def main() -> None:
    torch.set_num_threads(1)
    for rules, (defects, elements) in RULES.items():
        runners = [compiled(rules, name) for name in BACKENDS]
        for (kind, world), *others in zip(*(starts(one, elements) for one in runners), strict=True):
            state = {name: value.numpy().copy() for name, value in world.state.items()}
            cells = f"{differing(compiled(defects, 'wasm'), state)} of {state['element'].size} ids differ"
            makers = {"engine": lambda state=state: load(state)}
            for one, start in zip(runners, (world, *(other for _, other in others)), strict=True):
                makers[one.backend] = lambda sim=one.simulator, start=start: (
                    lambda steps: sim.step(start, steps)
                )
            engine, *spent = microseconds(makers, WORLDS, STEPS, ROUNDS).values()
            times = ", ".join(
                f"{name} {ours:.1f} µs ({engine / ours:.0f}×)"
                for name, ours in zip(BACKENDS, spent, strict=True)
            )
            print(f"{rules}, {kind}: engine {engine:.0f} µs, {times}; {cells}", flush=True)


if __name__ == "__main__":
    main()
