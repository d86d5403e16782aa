"""Makes a world that breaks a claim small: fewer steps, rows and columns, fewer things in it.

All smaller worlds of one kind are tried in one batch, each with some seeds: where chance decides, another seed often
does for a smaller world what the first one did for the larger.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from typing import Any

from powderdsl.arrays import np
from powderdsl.model.types import Ruleset
from powderdsl.testing.generators.cases import Array, Start
from powderdsl.testing.properties.breaks import Agreement, Alike, Tested, breaks, is_paired, steps_for
from powderdsl.testing.properties.running import Runs, join_starts

SEEDS = 24
"""How many seeds each smaller world is tried with, its own first."""

MAX_BATCH = 1024

WORK = 500_000_000
"""Work for all the worlds of a search, ten seconds or so: most need a hundredth of it."""

RULE = 15_000
"""The cost of a rule in each step of a batch, in cells."""


@dataclass
class Work:
    """Work that is left, counted in cells that rules look at: a limit in seconds would end elsewhere in each run."""

    ruleset: Ruleset
    left: int

    def spend(self, batch: Start, steps: int) -> None:
        rules = 1 + sum(len(moment.rules) for decl in self.ruleset.passes for moment in decl.moments)
        self.left -= rules * steps * (RULE + batch.ids.size)


Group = Callable[[Start], list[Start]]
"""Makes smaller worlds of one kind."""

Judge = Callable[[Start, int], Array]
"""After which step each world of a sample, run for that number of steps, is accepted: int [B], 0 if it is not."""


def shrink(
    claim: Tested,
    runs: Runs,
    sample: Start,
    steps: int,
    work: Work,
    without: frozenset[int],
) -> tuple[Start, int]:
    """The smallest world found that still breaks the claim, and after how many steps. `sample` is one world.

    It ends when no smaller world breaks the claim, or when the work is used up: a claim gives the same world each time.
    Worlds start without the elements `without`.
    """
    tries = 1 if isinstance(claim, Agreement | Alike) or not runs.ruleset.streams else SEEDS
    sample, steps = _later(claim, runs, sample, steps, without)
    sample, steps = shrink_while(
        lambda some, most: breaks(claim, runs, some, most).first, sample, steps, tries, work
    )
    if not runs.ruleset.streams:
        sample = replace(sample, seed=np.zeros_like(sample.seed))
    return sample, steps


def shrink_while(judge: Judge, sample: Start, steps: int, tries: int, work: Work) -> tuple[Start, int]:
    """The smallest world found for which the judge still says yes, and after how many steps.

    Args:
        tries: with how many seeds each smaller world is tried, its own first.
        work: when it is used up, the search ends, even if something smaller might be found.
    """
    multiple = work.ruleset.side_multiple

    def find(candidates: list[Start]) -> Start | None:
        nonlocal steps
        allowed = [start for start in candidates if all(side % multiple == 0 for side in start.shape)]
        judged = _first(judge, allowed, steps, tries, work) if work.left > 0 else None
        if judged is None:
            return None
        smaller, steps = judged
        return smaller

    sample = smallest(sample, find)
    result = _first(judge, _plain_seed(sample), steps, 1, work) if tries > 1 else None
    return result or (sample, steps)


def smallest(start: Start, find: Callable[[list[Start]], Start | None]) -> Start:
    """The smallest start worlds that can be reached by removing one thing at a time.

    Args:
        find: one of some smaller starts that will do as well, or None.
    """
    while True:
        smaller = start
        for group in _GROUPS:
            while (candidate := find(group(smaller))) is not None:
                smaller = candidate
        if smaller is start:
            return start
        start = smaller


def _later(
    claim: Tested, runs: Runs, sample: Start, steps: int, without: frozenset[int]
) -> tuple[Start, int]:
    """The world as it was one step before it broke the claim, if it does so from there."""
    if is_paired(claim) or steps < 2 or steps_for(claim, steps) > steps:
        return sample, steps
    before = dict(runs.states(sample, steps - 1)[-1])
    late = replace(sample, ids=before.pop("element"), step=sample.step + steps - 1, fields=before)
    other = late.without(without, runs.ruleset)
    same = [np.array_equal(late.ids, other.ids)]
    same += [np.array_equal(values, other.fields[name]) for name, values in late.fields.items()]
    return (late, 1) if all(same) and breaks(claim, runs, late, 1).first.any() else (sample, steps)


def _first(
    judge: Judge, candidates: list[Start], steps: int, tries: int, work: Work
) -> tuple[Start, int] | None:
    """The first of these worlds of one shape that the judge accepts, with the seed that does it soonest."""
    most = max(MAX_BATCH // tries, 1)
    for at in range(0, len(candidates), most):
        some = [
            replace(start, seed=np.array([number - 1])) if number else start
            for start in candidates[at : at + most]
            for number in range(tries)
        ]
        batch = join_starts(some, work.ruleset)
        work.spend(batch, steps)
        first = judge(batch, steps)
        broken = np.nonzero(first)[0]
        if len(broken):
            best = min(broken.tolist(), key=lambda i: (i // tries, first[i], i))
            return some[best], int(first[best])
    return None


# Smaller worlds, in the order in which they are tried


def _single(sample: Start) -> list[Start]:
    """One world of several."""
    return [sample.one(world) for world in range(len(sample))] if len(sample) > 1 else []


def _fresh(sample: Start) -> list[Start]:
    """Worlds with fields, parameters and the clock as in fresh ones: all of them, then one of them."""
    differs = {"fields": sample.fields, "params": sample.params, "step": sample.step.any()}
    usual: dict[str, Any] = {"fields": {}, "params": {}, "step": np.zeros_like(sample.step)}
    parts = [{name: usual[name]} for name in differs if differs[name]]
    together = dict(chain.from_iterable(part.items() for part in parts))
    return [replace(sample, **part) for part in ([together, *parts] if parts else [])]


def _absent_fields(sample: Start) -> list[Start]:
    """Worlds with one field as in fresh cells."""
    return [
        replace(sample, fields={name: values for name, values in sample.fields.items() if name != absent})
        for absent in sample.fields
    ]


def _plain_seed(sample: Start) -> list[Start]:
    """Worlds with a seed that is easy to write."""
    if 0 <= int(sample.seed[0]) < SEEDS:
        return []
    return [replace(sample, seed=np.array([number])) for number in range(SEEDS)]


def _parts(axis: int, halves: bool, sample: Start) -> list[Start]:
    """Worlds with half of the rows (axis 0) or columns (axis 1), or with one less."""
    size = sample.shape[axis]
    if size < (4 if halves else 2):
        return []
    half = size // 2
    if halves:
        rests = [[*range(at, at + half)] for at in range(size - half + 1)]
    else:
        rests = [[at for at in range(size) if at != gone] for gone in range(size - 1, -1, -1)]
    # Rows and columns are the last axes of every array.
    places = [(..., rest, slice(None)) if axis == 0 else (..., rest) for rest in rests]
    return [
        replace(
            sample,
            ids=sample.ids[cells],
            fields={name: values[cells] for name, values in sample.fields.items()},
        )
        for cells in places
    ]


def _fewer_kinds(sample: Start) -> list[Start]:
    """All cells of one element replaced by the lowest that is there."""
    ground = sample.ids.min()
    return [
        replace(sample, ids=np.where(sample.ids == kind, ground, sample.ids))
        for kind in np.unique(sample.ids)
        if kind != ground
    ]


def _fewer_values(sample: Start) -> list[Start]:
    """One cell replaced by the lowest element that is there, or one value of a field by 0."""
    smaller = []
    for name, values in {"": sample.ids, **sample.fields}.items():
        ground = 0 if name else sample.ids.min()
        places = (axis.tolist() for axis in np.nonzero(values != ground))
        for place in zip(*places, strict=True):
            fewer = values.copy()
            fewer[place] = ground
            part = {"fields": {**sample.fields, name: fewer}} if name else {"ids": fewer}
            smaller.append(replace(sample, **part))
    return smaller


_GROUPS: tuple[Group, ...] = (
    _single,
    _fresh,
    partial(_parts, 0, True),
    partial(_parts, 1, True),
    partial(_parts, 0, False),
    partial(_parts, 1, False),
    _fewer_kinds,
    _fewer_values,
    _absent_fields,
)
