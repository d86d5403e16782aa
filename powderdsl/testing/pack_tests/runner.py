"""Runs the tests that stand in packs: small worlds, and what must become of them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from typing import TYPE_CHECKING, Any

from powderdsl.arrays import NDArray, np
from powderdsl.diagnostics import Span
from powderdsl.model import reference
from powderdsl.model.check import restricted, without
from powderdsl.model.examples import direction_word
from powderdsl.model.text import one_line, show_number, show_single, show_value
from powderdsl.model.types import Cell, Example, FieldGrid, Kind, Ruleset
from powderdsl.simulation.programs import starting_backend
from powderdsl.simulation.simulator import compile
from powderdsl.testing.generators.cases import holding
from powderdsl.testing.pack_tests.chances import chance_problem, world_context

if TYPE_CHECKING:
    from powderdsl.simulation.simulator import Simulator, World

SEEDS = (0, 1, 2, 3, 4)
"""Seeds of a test that names none: several, since a rule that depends on chance should not pass by luck."""

MOST = 8
"""Added packs that are left out in turn, to see which of them change what a test shows."""

ANYTHING = "?"
"""The character of `expect` that matches every element."""


@dataclass(frozen=True)
class ExampleResult:
    """The result of one test.

    `problem` is empty if it passed with every seed, otherwise a sentence about the first seed it failed with:
    `seed`, after how many steps, and the world then, in the test's characters. `field` is the field that is not as
    expected, if one is, and `field_after` its rows, a word a cell.
    `added` are loaded packs that the test does not speak of, without which it passes: then it has not failed, it comes
    out differently.
    """

    example: Example
    seeds: tuple[int, ...]
    problem: str = ""
    seed: int = 0
    step: int = 0
    after: tuple[str, ...] = ()
    field: str = ""
    field_after: tuple[str, ...] = ()
    added: tuple[str, ...] = ()

    @property
    def passed(self) -> bool:
        """Whether it came out as it says, with all seeds."""
        return not self.problem

    @property
    def failed(self) -> bool:
        """Whether it did not, and no added pack is the reason."""
        return bool(self.problem) and not self.added


def run_examples(
    ruleset: Ruleset, *, sim: Simulator | None = None, seen: Callable[[Any], None] | None = None
) -> list[ExampleResult]:
    """Run every test of a ruleset's packs, in the order of the files.

    A test runs with its own seed, or with each of SEEDS. It passes if the last world looks as `expect` says, its
    fields hold what `expect_fields` says, every condition under `always` holds in every cell after every step, and
    what `often` says happens about as often. Tests of one size run as one batch. One that does not pass runs again with
    the packs of its scope alone, if more are loaded.

    Args:
        sim: what runs them, instead of a new simulator of this ruleset on a backend that starts at once.
        seen: called with the worlds of each batch at its end.
    """
    sim = sim or compile(ruleset, starting_backend("cpu"), tensors=False)
    sizes: dict[tuple[int, int], list[int]] = {}
    for number, example in enumerate(ruleset.tests):
        sizes.setdefault((len(example.given), len(example.given[0])), []).append(number)
    results: dict[int, ExampleResult] = {}
    for numbers in sizes.values():
        batch = [_Running.of(ruleset.tests[number], sim) for number in numbers]
        found = _run(batch, sim, seen)
        results |= dict(zip(numbers, found, strict=True))
    return _judged([results[number] for number in range(len(ruleset.tests))], ruleset, sim)


def _judged(results: list[ExampleResult], ruleset: Ruleset, sim: Simulator) -> list[ExampleResult]:
    """The results; a test that fails only with packs outside its scope names these packs."""
    scopes: dict[tuple[str, ...], list[ExampleResult]] = {}
    for result in results:
        scope = result.example.scope
        if not result.passed and scope and ruleset.added_to(scope):
            scopes.setdefault(scope, []).append(result)
    added: dict[Span, tuple[str, ...]] = {}
    fewer: dict[str, list[Span]] = {}
    for scope, wrong in scopes.items():
        others = ruleset.added_to(scope)
        right = _passing(restricted(ruleset, scope), {result.example.span for result in wrong}, sim)
        added |= dict.fromkeys(right, others)
        for pack in others[:MOST] if len(others) > 1 else ():
            fewer.setdefault(pack, []).extend(right)
    alone: dict[Span, tuple[str, ...]] = {}
    for pack in (pack for pack in ruleset.packs if fewer.get(pack)):
        for place in _passing(without(ruleset, pack), fewer[pack], sim):
            alone[place] = (*alone.get(place, ()), pack)
    added |= alone
    return [replace(one, added=added.get(one.example.span, ())) for one in results]


def _passing(ruleset: Ruleset | None, places: Collection[Span], sim: Simulator) -> tuple[Span, ...]:
    """The places of the tests that pass with other rules."""
    tests = tuple(replace(one, scope=()) for one in ruleset.tests if one.span in places) if ruleset else ()
    if ruleset is None or not tests:
        return ()
    results = run_examples(replace(ruleset, tests=tests), sim=sim.of(ruleset))
    return tuple(dict.fromkeys(result.example.span for result in results if result.passed))


def start_of(example: Example, sim: Simulator, seed: int) -> World:
    """The start world of a test, one of a seed."""
    return _started([(example, seed)], sim)


def _started(worlds: Sequence[tuple[Example, int]], sim: Simulator) -> World:
    """The start worlds of some tests of one size, with a seed each."""
    grids = []
    for example, _ in worlds:
        ids = _ids(example, sim.ruleset)
        grids.append([[ids[char] for char in row] for row in example.given])
    world = sim.world(np.array(grids, dtype=np.uint8), seed=[seed for _, seed in worlds])
    return with_fields(world, [example for example, _ in worlds])


def _ids(example: Example, ruleset: Ruleset) -> dict[str, int]:
    """The elements that a test's characters mean."""
    ids = {element.name: element.id for element in ruleset.elements}
    return {char: ids[name] for char, name in example.legend}


@dataclass(frozen=True)
class _Running:
    """A test with what its characters mean, and the seeds it runs with."""

    example: Example
    ids: Mapping[str, int]
    seeds: tuple[int, ...]

    @classmethod
    def of(cls, example: Example, sim: Simulator) -> _Running:
        return cls(example, _ids(example, sim.ruleset), SEEDS if example.seed is None else (example.seed,))

    def stops(self) -> set[int]:
        """The steps after which it is looked at: conditions that hold always want every one."""
        steps = self.example.steps
        return {steps, *(range(1, steps) if self.example.always else ())}

    def look(self, world: World, step: int) -> ExampleResult | None:
        """The failure after a step, if any; `world` holds this test's worlds alone."""
        for index, problem, field in self._problems(world, step):
            after = _rows(world.sim.kind.to_numpy(world.ids)[index], self.ids, self.example)
            drawn = field_rows(field, world, index) if field else ()
            return ExampleResult(
                self.example, self.seeds, problem, self.seeds[index], step, after, field, drawn
            )
        return None

    def _problems(self, world: World, step: int) -> Iterator[tuple[int, str, str]]:
        """The world that is wrong, how, and the field that is not as expected, if one is."""
        example = self.example
        for condition in example.always if step else ():
            fails = ~reference.evaluate(condition, world_context(world, condition))
            if fails.any():
                index, row, column = (int(part[0]) for part in np.nonzero(fails))
                words = one_line(condition.span) if condition.span else "a condition"
                yield index, f"`{words}` does not hold at row {row}, column {column}", ""
        if step < example.steps:
            return
        wanted = self._wanted()
        differs = (world.sim.kind.to_numpy(world.ids) != wanted) & (wanted >= 0)
        if differs.any():
            index, row, column = (int(part[0]) for part in np.nonzero(differs))
            found, asked = int(world.ids[index, row, column]), int(wanted[row, column])
            names = {element.id: element.name for element in world.sim.ruleset.elements}
            yield index, f"row {row}, column {column} is `{names[found]}`, not `{names[asked]}`", ""
        for grid in example.expect_fields:
            problem = field_problem(grid, world)
            if problem is not None:
                yield problem[0], f"`{grid.name}` in {problem[1]}", grid.name

    def _wanted(self) -> NDArray[np.int16]:
        """The ids that `expect` asks for, int16 [H, W]; −1 where anything will do."""
        rows = self.example.expect or [ANYTHING * len(row) for row in self.example.given]
        return np.array(
            [[-1 if char == ANYTHING else self.ids[char] for char in row] for row in rows], np.int16
        )


def _run(batch: list[_Running], sim: Simulator, seen: Callable[[Any], None] | None) -> list[ExampleResult]:
    """Tests of one size, all at once: each has a slice of the batch."""
    world = _started([(one.example, seed) for one in batch for seed in one.seeds], sim)
    ends = list(accumulate(len(one.seeds) for one in batch))
    results: dict[int, ExampleResult] = {}
    now = 0
    for stop in sorted(set[int]().union(*(one.stops() for one in batch))):
        world = sim.step(world, steps=stop - now)
        now = stop
        for number, one in enumerate(batch):
            if number in results or stop not in one.stops():
                continue
            own = world.select(slice(ends[number] - len(one.seeds), ends[number]))
            problem = one.look(own, stop)
            if problem is not None:
                results[number] = problem
    if seen is not None:
        seen(world)
    for number, one in enumerate(batch):
        if one.example.often and number not in results:
            seed = one.seeds[0]
            start = start_of(one.example, sim, seed)
            problem_of = chance_problem(start, one.example.steps, one.example.often, seed)
            if problem_of:
                results[number] = ExampleResult(one.example, one.seeds, problem_of, seed, one.example.steps)
    return [results.get(number, ExampleResult(one.example, one.seeds)) for number, one in enumerate(batch)]


def _rows(world: NDArray[np.uint8], ids: Mapping[str, int], example: Example) -> tuple[str, ...]:
    """A world in characters. Of two for the same element, the one that the test itself uses is taken."""
    used = "".join([*example.given, *(example.expect or ())])
    characters: dict[int, str] = {}
    for char in sorted(ids, key=lambda char: char not in used):
        characters.setdefault(ids[char], char)
    return tuple("".join(characters[number] for number in row) for row in world.tolist())


def with_fields(world: World, examples: Sequence[Example]) -> World:
    """Fresh worlds with the fields that their tests draw; `examples` has the test of each world."""
    names = dict.fromkeys(grid.name for example in examples for grid in example.fields)
    slots = {slot.name: slot for slot in world.sim.slots}
    changed = {}
    to_numpy = world.sim.kind.to_numpy
    for name in names:
        values = to_numpy(world.state[name]).copy()
        may_hold = holding(world.sim.ruleset, slots[name], to_numpy(world.ids))
        for index, example in enumerate(examples):
            for grid in example.fields:
                if grid.name == name:
                    _draw(grid, values, index, may_hold[index])
        changed[name] = values
    found = world.sim.replace(world, **changed) if changed else world
    return found


def _draw(grid: FieldGrid, values: NDArray[Any], world: int, may_hold: NDArray[np.bool_]) -> None:
    """Put the drawn values into those of one of some worlds, [B, H, W] or [B, 2, H, W]."""
    for row, cells in enumerate(grid.cells):
        for column, cell in enumerate(cells):
            if cell and (may_hold[row, column] or not grid.everywhere):
                drawn = [low for low, _ in cell] if values.ndim == 4 else cell[0][0]
                values[(world, ..., row, column)] = drawn


def field_problem(grid: FieldGrid, world: World) -> tuple[int, str] | None:
    """The first of some worlds that is not as the grid says: its number, and `row 1, column 2 is 3, not 4`."""
    slot = next(slot for slot in world.sim.slots if slot.name == grid.name)
    to_numpy = world.sim.kind.to_numpy
    found, fresh = (to_numpy(one.state[grid.name]) for one in (world, world.sim.world(world.ids)))
    low, high = fresh.copy(), fresh.copy()
    counts = holding(world.sim.ruleset, slot, to_numpy(world.ids))
    if not grid.everywhere:
        counts = np.ones(counts.shape, bool)
    for row, cells in enumerate(grid.cells):
        for column, cell in enumerate(cells):
            if cell is None:
                counts[:, row, column] = False
            elif cell:
                ends = np.moveaxis(np.array(cell, float), 0, -1)  # [2, components]
                ends = ends if found.ndim == 4 else ends[:, 0]
                low[..., row, column], high[..., row, column] = ends
    wrong = (found < low) | (found > high)
    wrong = (wrong.any(axis=1) if wrong.ndim == 4 else wrong) & counts
    if not wrong.any():
        return None
    index, row, column = (int(part[0]) for part in np.nonzero(wrong))
    here = (index, ..., row, column)
    wanted = _wanted(world.sim.ruleset, slot.kind, grid.cells[row][column], fresh[here])
    return (
        index,
        f"row {row}, column {column} is {_word(world.sim.ruleset, slot.kind, found[here])}, not {wanted}",
    )


def field_rows(name: str, world: World, index: int) -> tuple[str, ...]:
    """A field of one world as tests draw it: rows of words, in columns. Floats with all their digits."""
    kind = next(slot.kind for slot in world.sim.slots if slot.name == name)
    values = world.sim.kind.to_numpy(world.state[name])[index]
    words = field_words(world.sim.ruleset, kind, values)
    wide = [max(len(row[column]) for row in words) for column in range(len(words[0]))]
    return tuple(" ".join(word.rjust(size) for word, size in zip(row, wide, strict=True)) for row in words)


def field_words(rules: Ruleset, kind: Kind, values: NDArray[Any]) -> list[list[str]]:
    """The values [H, W] or [2, H, W] of a field, as drawings have them."""
    height, width = values.shape[-2:]
    return [
        [_word(rules, kind, values[..., row, column]) for column in range(width)] for row in range(height)
    ]


def _word(rules: Ruleset, kind: Kind, value: NDArray[Any]) -> str:
    """A value of a cell, as a drawing has it."""
    if kind.name in ("real", "vec2"):
        return ",".join(map(show_single, value.reshape(-1).tolist()))
    return direction_word(int(value)) if kind.name == "direction" else show_value(rules, kind, int(value))


def _wanted(rules: Ruleset, kind: Kind, cell: Cell, fresh: NDArray[Any]) -> str:
    """The value that a cell should hold, a range, or its default."""
    if not cell:
        return f"{_word(rules, kind, fresh)}, its default"
    if kind.name not in ("int", "real", "vec2"):
        return _word(rules, kind, np.asarray(cell[0][0]))
    return ",".join(
        show_number(low) if low == high else f"{show_number(low)}..{show_number(high)}" for low, high in cell
    )
