"""Makes a world that breaks a claim small: fewer steps, rows and columns, fewer things in it.

All smaller worlds of one kind are tried in one batch, each with some seeds: where chance decides, another seed often
does for a smaller world what the first one did for the larger.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from powderdsl.model.types import Ruleset
from powderdsl.testing.properties.breaks import Agreement, Alike, Runs, Tested, breaks, is_paired, steps_for
from powderdsl.testing.properties.samples import Array, Sample

SEEDS = 24
"""How many seeds each smaller world is tried with, its own first."""

MAX_BATCH = 1024

WORK = 500_000_000
"""Work for one world, ten seconds or so: most need a hundredth of it."""

RULE = 15_000
"""What a rule costs in each step of a batch, in cells that it looks at."""


@dataclass
class Work:
    """Work that is left, counted in cells that rules look at: a limit in seconds would end elsewhere in each run."""

    rules: int
    left: int
    side_multiple: int = 1
    """Worlds whose sides are not multiples of it are not tried: the rules do not allow them."""

    @classmethod
    def of(cls, ruleset: Ruleset, left: int = WORK) -> Work:
        """So much work with the rules of a ruleset."""
        rules = 1 + sum(len(moment.rules) for one in ruleset.passes for moment in one.moments)
        return cls(rules, left, ruleset.side_multiple)

    def allows(self, sample: Sample) -> bool:
        return all(side % self.side_multiple == 0 for side in sample.shape)

    def spend(self, batch: Sample, steps: int) -> None:
        self.left -= self.rules * steps * (RULE + batch.ids.size)


Judge = Callable[[Sample, int], Array]
"""After which step each world of a sample, run for so many steps, is what is looked for: int [B], 0 if it is not."""


def shrink(
    claim: Tested,
    runs: Runs,
    sample: Sample,
    steps: int,
    work: Work | None = None,
    without: frozenset[int] = frozenset(),
) -> tuple[Sample, int]:
    """The smallest world found that still breaks the claim, and after how many steps. `sample` is one world.

    It ends when no smaller world breaks the claim, or when the work is used up: a claim gives the same world each time.
    Worlds start without the elements `without`.
    """
    work = Work.of(runs.ruleset) if work is None else work
    tries = 1 if isinstance(claim, Agreement | Alike) or not runs.ruleset.streams else SEEDS
    sample, steps = _later(claim, runs, sample, steps, without)
    sample, steps = shrink_while(
        lambda some, most: breaks(claim, runs, some, most).first, sample, steps, tries, work
    )
    if not runs.ruleset.streams:
        sample = replace(sample, seeds=np.zeros_like(sample.seeds))
    return sample, steps


def shrink_while(judge: Judge, sample: Sample, steps: int, tries: int, work: Work) -> tuple[Sample, int]:
    """The smallest world found for which the judge still says yes, and after how many steps.

    Args:
        tries: with how many seeds each smaller world is tried, its own first.
        work: when it is used up, the search ends, even if something smaller might be found.
    """
    while work.left > 0:
        smaller = sample
        for group in _GROUPS:
            while work.left > 0:
                candidates = [one for one in group(smaller) if work.allows(one)]
                found = _first(judge, candidates, steps, tries, work)
                if found is None:
                    break
                smaller, steps = found
        for name in smaller.fields if work.left > 0 else ():  # without it, it is as in fresh cells
            rest = {other: values for other, values in smaller.fields.items() if other != name}
            found = _first(judge, [replace(smaller, fields=rest)], steps, tries, work)
            if found is not None:
                smaller, steps = found
        if smaller is sample:
            break
        sample = smaller
    found = _first(judge, _plain_seed(sample), steps, 1, work) if tries > 1 else None
    return found or (sample, steps)


def _later(
    claim: Tested, runs: Runs, sample: Sample, steps: int, without: frozenset[int]
) -> tuple[Sample, int]:
    """The world as it was one step before it broke the claim, if it does so from there."""
    if is_paired(claim) or steps < 2 or steps_for(claim, steps) > steps:
        return sample, steps
    before = dict(runs.states(sample, steps - 1)[-1])
    late = replace(sample, ids=before.pop("element"), clock=sample.clock + steps - 1, fields=before)
    if _holds(late, without, runs.ruleset):
        return sample, steps
    return (late, 1) if breaks(claim, runs, late, 1).first.any() else (sample, steps)


def _holds(sample: Sample, elements: frozenset[int], ruleset: Ruleset) -> bool:
    """Whether some of these elements are there, in cells or in fields."""
    other = sample.without(elements, ruleset)
    same = [np.array_equal(sample.ids, other.ids)]
    same += [np.array_equal(values, other.fields[name]) for name, values in sample.fields.items()]
    return not all(same)


def _first(
    judge: Judge, candidates: list[Sample], steps: int, tries: int, work: Work
) -> tuple[Sample, int] | None:
    """The first of these worlds of one shape that the judge accepts, with the seed that does it soonest."""
    most = max(MAX_BATCH // tries, 1)
    for start in range(0, len(candidates), most):
        some = candidates[start : start + most]
        batch = _together([_seeded(one, number) for one in some for number in range(tries)])
        work.spend(batch, steps)
        first = judge(batch, steps)
        broken = np.nonzero(first)[0]
        if len(broken):
            best = min(broken.tolist(), key=lambda i: (i // tries, first[i], i))
            return batch.one(best), int(first[best])
    return None


def _seeded(sample: Sample, number: int) -> Sample:
    return replace(sample, seeds=np.array([number - 1])) if number else sample


def _together(samples: list[Sample]) -> Sample:
    """Worlds of one shape that have the same fields, as one batch."""
    first = samples[0]
    return Sample(
        np.concatenate([one.ids for one in samples]),
        np.concatenate([one.seeds for one in samples]),
        np.concatenate([one.clock for one in samples]),
        {name: np.concatenate([one.fields[name] for one in samples]) for name in first.fields},
        {name: np.concatenate([one.params[name] for one in samples]) for name in first.params},
    )


# Smaller worlds, in the order in which they are tried


def _plain(sample: Sample) -> list[Sample]:
    """Without its fields and parameters, at the first step."""
    if sample.fields or sample.params or sample.clock.any():
        return [replace(sample, fields={}, params={}, clock=np.zeros(1, np.int64))]
    return []


def _fresh(sample: Sample) -> list[Sample]:
    return [replace(sample, fields={})] if sample.fields else []


def _usual(sample: Sample) -> list[Sample]:
    return [replace(sample, params={})] if sample.params else []


def _fewer_fields(sample: Sample) -> list[Sample]:
    """With one field that is 0 everywhere."""
    return [
        replace(sample, fields={**sample.fields, name: np.zeros_like(values)})
        for name, values in sample.fields.items()
        if values.any()
    ]


def _fewer_values(sample: Sample) -> list[Sample]:
    """With one value of a field that is 0."""
    found = []
    for name, values in sample.fields.items():
        for place in np.argwhere(values).tolist():
            fewer = values.copy()
            fewer[tuple(place)] = 0
            found.append(replace(sample, fields={**sample.fields, name: fewer}))
    return found


def _plain_seed(sample: Sample) -> list[Sample]:
    """With a seed that is easy to write."""
    if 0 <= int(sample.seeds[0]) < SEEDS:
        return []
    return [replace(sample, seeds=np.array([number])) for number in range(SEEDS)]


def _early(sample: Sample) -> list[Sample]:
    return [replace(sample, clock=np.zeros(1, np.int64))] if sample.clock.any() else []


def _parts(axis: int, halves: bool) -> Callable[[Sample], list[Sample]]:
    """Worlds with half of the rows (axis 0) or columns (axis 1), or with one less."""

    def group(sample: Sample) -> list[Sample]:
        size = sample.shape[axis]
        if size < 2 or (halves and size < 4):
            return []
        everything = np.arange(size)
        if halves:
            half = size // 2
            kept = [everything[at : at + half] for at in range(size - half + 1)]
        else:
            kept = [np.delete(everything, gone) for gone in range(size - 1, -1, -1)]
        return [_cut(sample, axis, keep) for keep in kept]

    return group


def _cut(sample: Sample, axis: int, keep: np.ndarray) -> Sample:
    place = axis - 2  # rows and columns are the last axes of every array
    return replace(
        sample,
        ids=np.take(sample.ids, keep, place),
        fields={name: np.take(values, keep, place) for name, values in sample.fields.items()},
    )


def _fewer_kinds(sample: Sample) -> list[Sample]:
    """All cells of one element replaced by the lowest that is there."""
    ground = sample.ids.min()
    return [
        replace(sample, ids=np.where(sample.ids == kind, ground, sample.ids))
        for kind in np.unique(sample.ids)
        if kind != ground
    ]


def _fewer_cells(sample: Sample) -> list[Sample]:
    """One cell replaced by the lowest element that is there."""
    ground = sample.ids.min()
    found = []
    for row, column in np.argwhere(sample.ids[0] != ground).tolist():
        ids = sample.ids.copy()
        ids[0, row, column] = ground
        found.append(replace(sample, ids=ids))
    return found


_GROUPS: tuple[Callable[[Sample], list[Sample]], ...] = (
    _plain,
    _parts(0, True),
    _parts(1, True),
    _parts(0, False),
    _parts(1, False),
    _fresh,
    _usual,
    _early,
    _fewer_fields,
    _fewer_kinds,
    _fewer_cells,
    _fewer_values,
)
