"""Violations of claims by worlds: after which step, and in which cell."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import reduce
from itertools import pairwise
from operator import or_
from random import Random

from powderdsl.analysis.ledger import TREND_BREAKS
from powderdsl.arrays import np
from powderdsl.model import reference
from powderdsl.model.state import property_values, slots
from powderdsl.model.types import Bounded, Claim, Expr, Local, Never, Ruleset, Symmetric, Total, Unchanging
from powderdsl.testing.generators.cases import Array, Start, fresh
from powderdsl.testing.properties.running import (
    Oracle,
    Runs,
    State,
    context,
    differences,
    turned_back,
    turned_cells,
    turned_sample,
    turned_state,
)


@dataclass(frozen=True)
class Agreement:
    """The backend gives what the reference gives."""


@dataclass(frozen=True)
class Alike:
    """A turned world gives the same results, equally often. Each world runs `copies` times, with other seeds."""

    turn: str
    copies: int


Tested = Claim | Agreement | Alike

SIGMAS = 6.0
"""How many standard deviations two frequencies may differ: by chance, more happens once in 500 million times."""


@dataclass(frozen=True)
class Breaks:
    """`first` [B]: the step after which a world breaks the claim, or 0; `cell` [B, 2]: where it breaks.

    `counts` [B]: True if the world tests the claim. A world that violates the claim at the start does not.
    """

    first: Array
    cell: Array
    counts: Array


def steps_for(claim: Tested, usual: int) -> int:
    """Return the number of steps that a test of the claim runs."""
    match claim:
        case Never():
            return usual if claim.steps == 1 else claim.steps
        case Local() | Symmetric() | Alike():
            return 1
    return usual


def breaks(claim: Tested, runs: Runs, sample: Start, steps: int) -> Breaks:
    """Run the worlds and return where they break the claim."""
    match claim:
        case Local():
            other, mask = vary_one_cell(runs.ruleset, sample)
            first, second = (runs.states(start, 1)[-1] for start in (sample, other))
            return _breaks_of([differences(first, second) & ~cells_within(mask, claim.radius)])
        case Symmetric():
            return _breaks_of([_symmetric(claim, runs, sample)])
        case Alike():
            return _breaks_of([_alike(claim, runs, sample)])
        case Agreement():
            pairs = zip(runs.states(sample, steps), Oracle(runs.ruleset).states(sample, steps), strict=True)
            return _breaks_of([differences(a, b) for a, b in pairs][1:])
    return find_breaks(claim, runs.ruleset, sample, runs.states(sample, steps))


def is_paired(claim: Tested) -> bool:
    """True if a test of the claim compares several runs of the worlds."""
    return isinstance(claim, Local | Symmetric | Alike | Agreement)


def find_breaks(claim: Tested, ruleset: Ruleset, sample: Start, states: list[State]) -> Breaks:
    """Return where worlds with these states break a claim that needs one run only."""
    ids = [state["element"] for state in states]

    def evaluated(expr: Expr) -> list[Array]:
        contexts = (context(ruleset, state, sample, step) for step, state in enumerate(states))
        return [reference.evaluate(expr, at) for at in contexts]

    match claim:
        case Unchanging():
            protected = sorted(claim.ids)
            return _breaks_of([np.isin(old, protected) & (old != new) for old, new in pairwise(ids)])
        case Total():
            wrong, masks = TREND_BREAKS[claim.trend], []
            for old, new in pairwise(values.astype(np.int64) for values in evaluated(claim.value)):
                masks.append(wrong((new - old).sum((1, 2)), 0)[:, None, None] & wrong(new, old))
            return _breaks_of(masks)
        case Never() if claim.steps > 1:
            run, masks = np.zeros(ids[0].shape, np.int64), []
            for holds in evaluated(claim.condition)[1:]:
                run = np.where(holds, run + 1, 0)
                masks.append(run >= claim.steps)
            return _breaks_of(masks)
        case Never():
            return _never(evaluated(claim.condition))
        case Bounded():
            if claim.field in states[0]:
                fields = [state[claim.field] for state in states]
            else:
                table = np.array(property_values(ruleset, claim.field), np.float64)
                fields = [table[cells] for cells in ids]
            outside = [np.asarray((values < claim.lo) | (values > claim.hi)) for values in fields]
            return _never([np.asarray(mask.any(1)) if mask.ndim == 4 else mask for mask in outside])
    raise TypeError(f"{type(claim).__name__} needs more than one run")


def _never(holds: list[Array]) -> Breaks:
    """Breaks by something forbidden that holds nowhere at first: a world that starts with it does not count."""
    return _breaks_of(holds[1:], np.asarray(~holds[0].any((1, 2))))


def _breaks_of(by_step: list[Array], counts: Array | None = None) -> Breaks:
    """The breaks in bool [B, H, W] for each step, which says what is broken after it."""
    masks = np.stack(by_step)
    batch, _, width = masks.shape[1:]
    counts = np.ones(batch, bool) if counts is None else counts
    broken = masks.reshape(len(masks), batch, -1).any(2) & counts
    first = np.where(broken.any(0), broken.argmax(0) + 1, 0)
    at_first = masks[np.maximum(first - 1, 0), np.arange(batch)].reshape(batch, -1).argmax(1)
    return Breaks(first, np.stack([at_first // width, at_first % width], 1), counts)


# Claims about two runs


def vary_one_cell(ruleset: Ruleset, sample: Start) -> tuple[Start, Array]:
    """Copies of worlds with another fresh element in one cell each, by their seeds; and these cells: bool [B, H, W]."""
    height, width = sample.shape
    known = np.array([element.id for element in ruleset.elements])
    worlds = np.arange(len(sample))
    row, column = sample.seed % height, sample.seed // 7 % width
    mask = np.zeros(sample.ids.shape, bool)
    mask[worlds, row, column] = True
    old = np.searchsorted(known, sample.ids[worlds, row, column])
    other = known[(old + 1 + sample.seed // 3 % max(len(known) - 1, 1)) % len(known)]
    ids = sample.ids.copy()
    ids[worlds, row, column] = other
    table = {slot.name: slot for slot in slots(ruleset)}
    fields = {}
    for name, values in sample.fields.items():
        usual = fresh(ruleset, table[name], ids)
        fields[name] = np.where(mask[:, None] if values.ndim == 4 else mask, usual, values)
    return replace(sample, ids=ids, fields=fields), mask


def cells_within(mask: Array, radius: int) -> Array:
    """Cells within `radius` rows and columns of a mask [B, H, W], across the edges too."""
    for axis in (1, 2):
        reach = min(radius, mask.shape[axis] // 2)
        mask = reduce(or_, [np.roll(mask, shift, axis) for shift in range(-reach, reach + 1)])
    return mask


def draws_for(ruleset: Ruleset, sample: Start) -> dict[str, Array]:
    """Draws for all streams, by the worlds' seeds: float64 [B, H, W]."""
    height, width = sample.shape
    draws = {}
    for number, stream in enumerate(ruleset.streams):
        random = [Random(f"{seed} {number}") for seed in sample.seed.tolist()]
        cells = [[generator.random() for _ in range(height * width)] for generator in random]
        draws[stream.name] = np.array(cells).reshape(-1, height, width)
    return draws


def _symmetric(claim: Symmetric, runs: Runs, sample: Start) -> Array:
    draws = draws_for(runs.ruleset, sample)
    turned_draws = {name: turned_cells(values, claim.turn) for name, values in draws.items()}
    first = runs.states(sample, 1, draws)[-1]
    second = runs.states(turned_sample(runs.ruleset, sample, claim.turn), 1, turned_draws)[-1]
    return turned_back(differences(turned_state(runs.ruleset, first, claim.turn), second), claim.turn)


def _alike(claim: Alike, runs: Runs, sample: Start) -> Array:
    masks = []
    for world in range(len(sample)):
        start = sample.one(world).repeated(claim.copies)
        seeds = int(sample.seed[world]) + np.arange(claim.copies)
        first = runs.states(replace(start, seed=seeds), 1)[-1]["element"]
        turned = turned_sample(runs.ruleset, replace(start, seed=seeds + claim.copies), claim.turn)
        second = runs.states(turned, 1)[-1]["element"]
        mask = np.zeros(second.shape[1:], bool)
        for element in runs.ruleset.elements:
            a = turned_cells(first == element.id, claim.turn).sum(0).astype(np.float64) / claim.copies
            b = (second == element.id).sum(0).astype(np.float64) / claim.copies
            mean = (a + b) / 2
            margin = SIGMAS * np.sqrt(2 * mean * (1 - mean) / claim.copies) + 1e-9
            mask = mask | (np.abs(a - b) > margin)
        masks.append(turned_back(mask, claim.turn))
    return np.stack(masks)
