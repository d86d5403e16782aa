"""Runs the tests that stand in packs: small worlds, and what must become of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from powderdsl import reference
from powderdsl.draw import to_numpy
from powderdsl.model.state import slots
from powderdsl.model.text import one_line
from powderdsl.model.types import Example, Ruleset
from powderdsl.simulator import compile

if TYPE_CHECKING:
    from powderdsl.simulator import Simulator, World

SEEDS = (0, 1, 2, 3, 4)
"""What a test runs with if it names no seed: a rule that needs luck should not pass by luck."""

ANYTHING = "?"
"""The character of `expect` that matches every element."""


@dataclass(frozen=True)
class ExampleResult:
    """What came of one test.

    `problem` is empty if it passed with every seed, otherwise a sentence about the first seed it failed with:
    `seed`, after how many steps, and the world then, in the test's characters.
    """

    example: Example
    seeds: tuple[int, ...]
    problem: str = ""
    seed: int = 0
    step: int = 0
    after: tuple[str, ...] = ()

    @property
    def passed(self) -> bool:
        return not self.problem


def run_examples(ruleset: Ruleset, backend: str = "reference", device: str = "cpu") -> list[ExampleResult]:
    """Run every test of a ruleset's packs, in the order of the files.

    A test runs with its own seed, or with each of SEEDS. It passes if the last world looks as `expect` says
    and every condition under `always` holds in every cell after every step.
    """
    sim = compile(ruleset, backend=backend, device=device)
    return [_run(example, sim) for example in ruleset.tests]


def _run(example: Example, sim: Simulator) -> ExampleResult:
    legend = dict(example.legend)
    ids = {char: _id(sim.ruleset, name) for char, name in legend.items()}
    given = np.array([[ids[char] for char in row] for row in example.given], dtype=np.uint8)
    seeds = SEEDS if example.seed is None else (example.seed,)
    world = sim.world(np.repeat(given[None], len(seeds), axis=0), seed=list(seeds))
    # Conditions that hold always are looked at after each step; otherwise only the end counts.
    stride = 1 if example.always else max(example.steps, 1)
    for step in range(stride, example.steps + 1, stride):
        world = sim.step(world, steps=stride)
        for condition in example.always:
            holds = reference.evaluate(condition, _context(world))
            if not holds.all():
                index, row, column = (int(part[0]) for part in np.nonzero(~holds))
                words = one_line(condition.span) if condition.span else "a condition"
                problem = f"`{words}` does not hold at row {row}, column {column}"
                return _failure(example, seeds, index, step, world, ids, problem)
    wanted = _wanted(example, ids)
    if wanted is not None:
        differs = (to_numpy(world.ids) != wanted) & (wanted >= 0)
        if differs.any():
            index, row, column = (int(part[0]) for part in np.nonzero(differs))
            found = _name(sim.ruleset, int(world.ids[index, row, column]))
            asked = _name(sim.ruleset, int(wanted[row, column]))
            problem = f"row {row}, column {column} is `{found}`, not `{asked}`"
            return _failure(example, seeds, index, example.steps, world, ids, problem)
    return ExampleResult(example, seeds)


def _failure(
    example: Example,
    seeds: tuple[int, ...],
    index: int,
    step: int,
    world: World,
    ids: Mapping[str, int],
    problem: str,
) -> ExampleResult:
    after = _rows(to_numpy(world.ids)[index], ids, example)
    return ExampleResult(example, seeds, problem, seeds[index], step, after)


def _wanted(example: Example, ids: Mapping[str, int]) -> NDArray[np.int16] | None:
    """The ids that `expect` asks for, int16 [H, W]; −1 where anything will do."""
    if example.expect is None:
        return None
    rows = [[-1 if char == ANYTHING else ids[char] for char in row] for row in example.expect]
    return np.array(rows, dtype=np.int16)


def _rows(world: NDArray[np.uint8], ids: Mapping[str, int], example: Example) -> tuple[str, ...]:
    """A world in characters, those that the test itself uses first: two may mean the same element."""
    used = "".join([*example.given, *(example.expect or ())])
    characters: dict[int, str] = {}
    for char in sorted(ids, key=lambda char: char not in used):
        characters.setdefault(ids[char], char)
    return tuple("".join(characters[number] for number in row) for row in world.tolist())


def _id(ruleset: Ruleset, name: str) -> int:
    element = ruleset.element(name)
    assert element is not None, f"the checked model has a test with the unknown element {name}"
    return element.id


def _name(ruleset: Ruleset, number: int) -> str:
    return next(element.name for element in ruleset.elements if element.id == number)


def _context(world: World) -> reference.Context:
    """What a condition reads of a world: its state as the oracle holds it, parameters, the clock."""
    ruleset = world.sim.ruleset
    wide: dict[str, type] = {"flag": np.bool_, "real": np.float32, "vec2": np.float32}
    state: reference.State = {
        slot.name: to_numpy(world.state[slot.name]).astype(wide.get(slot.kind.name, np.int64))
        for slot in slots(ruleset)
    }
    dtypes: dict[str, type] = {"int": np.int64, "flag": np.bool_, "real": np.float32, "chance": np.float64}
    params: dict[str, reference.Array] = {
        param.name: np.full(len(world), float(param.default), dtypes[param.kind.name])
        for param in ruleset.params
    }
    clock = reference.Clock(to_numpy(world.seed), to_numpy(world.index), to_numpy(world.step))
    return reference.Context(ruleset, state, params, {}, clock)
