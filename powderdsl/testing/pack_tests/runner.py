"""Runs the tests in packs: small worlds and their expected futures."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from math import ceil, log, prod
from typing import TYPE_CHECKING, Any

from powderdsl.arrays import NDArray, np
from powderdsl.model import reference
from powderdsl.model.check import select_packs, without_pack
from powderdsl.model.examples import direction_word
from powderdsl.model.text import one_line, show_number, show_single, show_value
from powderdsl.model.types import Cell, Example, Expr, FieldGrid, Kind, Ruleset
from powderdsl.simulation.programs import starting_backend
from powderdsl.simulation.simulator import compile
from powderdsl.testing.generators.cases import holding

if TYPE_CHECKING:
    from powderdsl.simulation.simulator import Simulator, World

SEEDS = (0, 1, 2, 3, 4)
"""Seeds of a test without a seed: several, so that a random rule does not pass by chance."""

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
    problem: str = ""
    seed: int = 0
    step: int = 0
    after: tuple[str, ...] = ()
    field: str = ""
    field_after: tuple[str, ...] = ()
    added: tuple[str, ...] = ()

    @property
    def passed(self) -> bool:
        """True if the worlds end as expected with all seeds."""
        return not self.problem

    @property
    def failed(self) -> bool:
        """True if the worlds end otherwise, but not because of an added pack."""
        return bool(self.problem) and not self.added


def run_examples(
    ruleset: Ruleset, *, sim: Simulator | None = None, seen: Callable[[Any], None] | None = None
) -> list[ExampleResult]:
    """Run every test of a ruleset's packs, in the order of the files.

    A test runs with its own seed, or with each of SEEDS. It passes if the last world looks as `expect` says, its
    fields hold what `expect_fields` says, every condition under `always` holds in every cell after every step, and
    what `often` says happens about as often. One that does not pass runs again with the packs of its scope alone, if
    more are loaded.

    Args:
        sim: the simulator to use; by default, a new one on a backend that starts instantly.
        seen: called with the final worlds of each test.
    """
    sim = sim or compile(ruleset, starting_backend("cpu"), tensors=False)
    results = [_result(example, sim, seen) for example in ruleset.tests]
    return [replace(result, added=_added(result, ruleset, sim)) for result in results]


def _added(result: ExampleResult, ruleset: Ruleset, sim: Simulator) -> tuple[str, ...]:
    """The packs outside a failed test's scope with which it fails; those without each of which it passes, if any."""
    scope = result.example.scope
    added = ruleset.added_to(scope) if scope and not result.passed else ()
    if not added or not _passes(result.example, select_packs(ruleset, scope), sim):
        return ()
    some = added[:MOST] if len(added) > 1 else ()
    return tuple(pack for pack in some if _passes(result.example, without_pack(ruleset, pack), sim)) or added


def _passes(example: Example, ruleset: Ruleset | None, sim: Simulator) -> bool:
    """True if a test passes with other rules; False if they do not contain the test."""
    tests = [test for test in ruleset.tests if test.span == example.span] if ruleset is not None else []
    return ruleset is not None and any(_result(test, sim.of(ruleset), None).passed for test in tests)


def start_of(example: Example, sim: Simulator, *seeds: int) -> World:
    """The start worlds of a test, one for each seed."""
    ids = _ids(example, sim.ruleset)
    grid = np.array([[ids[char] for char in row] for row in example.given], dtype=np.uint8)
    world = sim.world(np.stack([grid] * len(seeds)), seed=list(seeds))
    fields = {}
    for drawn in example.fields:
        values = sim.kind.to_numpy(world.state[drawn.name]).copy()
        may_hold = holding(sim.ruleset, sim.slot_by_name[drawn.name], grid)
        for row, cells in enumerate(drawn.cells):
            for column, cell in enumerate(cells):
                if cell and (may_hold[row, column] or not drawn.everywhere):
                    lows = np.array([low for low, _ in cell])
                    values[..., row, column] = lows if values.ndim == 4 else lows[0]
        fields[drawn.name] = values
    return sim.replace(world, **fields) if fields else world


def _ids(example: Example, ruleset: Ruleset) -> dict[str, int]:
    """The elements of a test's characters."""
    ids = {element.name: element.id for element in ruleset.elements}
    return {char: ids[name] for char, name in example.legend}


def _result(example: Example, sim: Simulator, seen: Callable[[Any], None] | None) -> ExampleResult:
    """Run a test with its own seed, or with all SEEDS."""
    seeds = SEEDS if example.seed is None else (example.seed,)
    world = start = start_of(example, sim, *seeds)
    result, params = ExampleResult(example), dict(example.params)
    now = 0
    for stop in (*(range(1, example.steps) if example.always else ()), example.steps):
        world = sim.step(world, steps=stop - now, params=params)
        now = stop
        problem = next(_problems(example, world, stop), None)
        if problem is not None:
            index, words, field = problem
            after = _rows(world.sim.kind.to_numpy(world.ids)[index], example, sim.ruleset)
            drawn = field_rows(field, world, index) if field else ()
            result = ExampleResult(example, words, seeds[index], stop, after, field, drawn)
            break
    if seen is not None:
        seen(world)
    if example.often and result.passed:
        first = start.select(slice(0, 1))
        words = chance_problem(first, example, seeds[0])
        result = ExampleResult(example, words, seeds[0], example.steps) if words else result
    return result


def _problems(example: Example, world: World, step: int) -> Iterator[tuple[int, str, str]]:
    """The world that is wrong after a step, how, and the field that is not as expected, if one is."""
    for condition in example.always if step else ():
        fails = ~reference.evaluate(condition, world_context(world, example, condition))
        if fails.any():
            index, row, column = (int(part[0]) for part in np.nonzero(fails))
            words = one_line(condition.span) if condition.span else "a condition"
            yield index, f"`{words}` does not hold at row {row}, column {column}", ""
    if step < example.steps:
        return
    ids = {**_ids(example, world.sim.ruleset), ANYTHING: -1}
    wanted = np.array([[ids[char] for char in row] for row in example.expect or ()], np.int16)
    if wanted.size:
        differs = (world.sim.kind.to_numpy(world.ids) != wanted) & (wanted >= 0)
        if differs.any():
            index, row, column = (int(part[0]) for part in np.nonzero(differs))
            actual, expected = int(world.ids[index, row, column]), int(wanted[row, column])
            names = {element.id: element.name for element in world.sim.ruleset.elements}
            yield index, f"row {row}, column {column} is `{names[actual]}`, not `{names[expected]}`", ""
    for grid in example.expect_fields:
        problem = field_problem(grid, world)
        if problem is not None:
            yield problem[0], f"`{grid.name}` in {problem[1]}", grid.name


def _rows(world: NDArray[np.uint8], example: Example, ruleset: Ruleset) -> tuple[str, ...]:
    """A world in characters. Of two for the same element, the one that the test itself uses is taken."""
    used = "".join([*example.given, *(example.expect or ())])
    characters: dict[int, str] = {}
    for char, number in sorted(_ids(example, ruleset).items(), key=lambda pair: pair[0] not in used):
        characters.setdefault(number, char)
    return tuple("".join(characters[number] for number in row) for row in world.tolist())


def field_problem(grid: FieldGrid, world: World) -> tuple[int, str] | None:
    """The first of some worlds that is not as the grid says: its number, and `row 1, column 2 is 3, not 4`."""
    slot = world.sim.slot_by_name[grid.name]
    to_numpy = world.sim.kind.to_numpy
    values, fresh = (to_numpy(start.state[grid.name]) for start in (world, world.sim.world(world.ids)))
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
                ends = ends if values.ndim == 4 else ends[:, 0]
                low[..., row, column], high[..., row, column] = ends
    wrong = (values < low) | (values > high)
    wrong = (wrong.any(axis=1) if wrong.ndim == 4 else wrong) & counts
    if not wrong.any():
        return None
    index, row, column = (int(part[0]) for part in np.nonzero(wrong))
    here = (index, ..., row, column)
    wanted = _wanted(world.sim.ruleset, slot.kind, grid.cells[row][column], fresh[here])
    return (
        index,
        f"row {row}, column {column} is {_word(world.sim.ruleset, slot.kind, values[here])}, not {wanted}",
    )


def field_rows(name: str, world: World, index: int) -> tuple[str, ...]:
    """A field of one world as tests draw it: rows of words, in columns. Floats with all their digits."""
    values = world.sim.kind.to_numpy(world.state[name])[index]
    words = field_words(world.sim.ruleset, world.sim.slot_by_name[name].kind, values)
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
    """The expected value of a cell, a range, or its default."""
    if not cell:
        return f"{_word(rules, kind, fresh)}, its default"
    if kind.name not in ("int", "real", "vec2"):
        return _word(rules, kind, np.asarray(cell[0][0]))
    return ",".join(
        show_number(low) if low == high else f"{show_number(low)}..{show_number(high)}" for low, high in cell
    )


# Chances, compared with counts: many copies of a world, each with its own random numbers. Chernoff's bound judges a count.
# It needs no table and holds for any number of trials: that n trials of a chance p come out at a share q or farther
# away has a probability of at most exp(−n·D(q‖p)) on each side, where D is the divergence of the two. A correct rule
# fails with a probability below `ERROR_RATE`; seeds are fixed, so that a test which passes once passes always.

ERROR_RATE = 1e-6
"""How likely a correct chance fails a test, at most; and how likely one passes that is off by `OFF`."""

OFF = 0.25
"""How far a chance may be off, as a part of itself or of what it lacks to 100 %, before it is sure to be noticed."""

RARE = 0.001
"""The share of exceptions from 0 % or 100 % that is sure to be noticed."""

MOST_WORK = 1 << 25
"""Cells times steps that a test may cost. A chance that would need more is tested less sharply."""

CHUNK = 1 << 19
"""Cells that run at once."""


def divergence(share: float, chance: float) -> float:
    """The Kullback-Leibler divergence D(share‖chance) of two chances, in nats for each trial."""
    total = 0.0
    for a, b in ((share, chance), (1 - share, 1 - chance)):
        if a > 0:
            if b <= 0:
                return float("inf")
            total += a * log(a / b)
    return total


def is_unlikely(hits: int, trials: int, chance: float) -> bool:
    """True if chance alone gives a count like this, or one farther off, less than once in 1 / ERROR_RATE times."""
    return trials * divergence(hits / trials, chance) > log(2 / ERROR_RATE)


def trials_for(chance: float) -> int:
    """The number of trials needed to distinguish a chance from one that is off by OFF, with both errors below
    ERROR_RATE."""
    small = min(chance, 1 - chance)
    if small <= 0:
        return ceil(log(1 / ERROR_RATE) / RARE)
    needed = []
    for other in (chance + OFF * small, chance - OFF * small):
        hits, misses = log(chance / other), log((1 - chance) / (1 - other))
        middle = misses / (misses - hits)  # the share that is equally unlike both
        needed.append(ceil(log(2 / ERROR_RATE) / divergence(middle, chance)))
    return max(needed)


def chance_problem(start: World, example: Example, seed: int) -> str:
    """A sentence about the first claim of a test that the counts contradict; empty if there is none.

    All copies of the one world `start` have the same seed, and each its own index.
    """
    steps, claims = example.steps, example.often
    chosen = [
        (claim, reference.evaluate(claim.before, world_context(start, example, claim.before))[0])
        for claim in claims
    ]
    for claim, cells in chosen:
        if not cells.any():
            return f"no cell of the start world is as `{one_line(claim.span)}` says"
    cells_of_one = prod(start.shape)
    most = max(1, MOST_WORK // (cells_of_one * max(steps, 1)))
    copies = min(most, max(ceil(trials_for(float(c.chance)) / int(cells.sum())) for c, cells in chosen))
    hits = [0] * len(chosen)
    chunk, put = max(1, CHUNK // cells_of_one), start.sim.kind.put
    for first in range(0, copies, chunk):
        index = [*range(first, min(first + chunk, copies))]  # so that each copy has its own random numbers
        world = start.select(put([0] * len(index), "int64"))
        world = replace(world, index=put(index, "int64"), seed=put([seed] * len(index), "int64"))
        world = world.sim.step(world, steps=steps, params=dict(example.params))
        at = world_context(world, example, *(claim.after for claim in claims))
        for number, (claim, cells) in enumerate(chosen):
            hits[number] += int(reference.evaluate(claim.after, at)[:, cells].sum())
    for (claim, cells), hits_of_claim in zip(chosen, hits, strict=True):
        trials = copies * int(cells.sum())
        if is_unlikely(hits_of_claim, trials, float(claim.chance)):
            return (
                f"`{one_line(claim.span)}` came true {hits_of_claim:,} times in {trials:,}, {100 * hits_of_claim / trials:.3g} %,"
                f" not {100 * float(claim.chance):g} %: this would happen by chance less than once in a million runs"
            )
    return ""


def world_context(world: World, example: Example, *conditions: Expr) -> reference.Context:
    """The values that conditions of a test read: a world's state as the oracle holds it, parameters, the clock."""
    ruleset, to_numpy = world.sim.ruleset, world.sim.kind.to_numpy
    read = {
        part.value
        for condition in conditions
        for part in condition.walk()
        if part.op in ("field", "property")
    }
    names = [name for name in world.state if name == "element" or name in read]
    state = reference.widen(ruleset, {name: to_numpy(world.state[name]) for name in names})
    clock = reference.Clock(to_numpy(world.seed), to_numpy(world.index), to_numpy(world.step))
    params = reference.parameters(ruleset, len(world), dict(example.params))
    return reference.Context(ruleset, state, params, {}, clock)
