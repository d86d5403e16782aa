"""The smallest world found on which two compositions differ, and after how many steps: thousands at once, then smaller.

Worlds start fresh, as a pack's test draws them: elements alone, at the first step, with the usual parameters.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from powderdsl.analysis.reactions import unchanging_ids
from powderdsl.model.state import fitting
from powderdsl.model.types import Ruleset
from powderdsl.simulation.simulator import Simulator
from powderdsl.testing.generators.cases import Array, Start
from powderdsl.testing.properties.running import first_difference, run_sample
from powderdsl.testing.properties.samples import State, random_samples
from powderdsl.testing.properties.shrink import Work, shrink_while

ROUNDS = (
    # rows, columns, worlds, steps
    (3, 3, 1024, 2),
    (3, 4, 1024, 4),
    (5, 4, 1024, 8),
    (2, 2, 512, 4),
    (1, 6, 512, 6),
    (6, 6, 1024, 12),
    (5, 7, 1024, 24),
    (8, 8, 512, 48),
)
"""Batches of worlds that are tried one after the other, small and short ones first."""

KINDS = (2, 3, 2, 4, 3, 6)
"""How many elements the worlds of a group are made of."""

FIELDED = 768
"""Worlds with fields that are not fresh."""

GROUP = 8
"""Worlds that are made of the same elements."""

SEEDS = 16
"""With how many seeds a smaller world is tried."""

WORK = 1_000_000_000
"""Work for making a world smaller, see `testing.properties.shrink`."""


@dataclass(frozen=True)
class Distinction:
    """One world on which two compositions differ after some steps: in `slot`, if not already in elements.

    `first` and `second` are the states after the last step.
    """

    sample: Start
    steps: int
    slot: str
    first: State
    second: State


def distinguish(
    first: Simulator, second: Simulator, focus: Sequence[int] = (), seed: int = 0
) -> Distinction | None:
    """A small world on which two simulators differ, or None if none was found.

    Args:
        focus: ids of elements that are likely to matter: they are in most of the worlds.
        seed: other worlds for another seed, the same for the same.
    """
    names = _shared(first, second)
    only_fields: tuple[Start, int] | None = None
    for sample, steps in fresh_samples(first.ruleset, focus, seed):
        one, other = (run_sample(sim, sample, steps)[0] for sim in (first, second))
        found = _soonest(first_difference(one, other, ("element",)))
        if found is not None:
            return _small(first, second, sample.one(found[0]), found[1], ("element",))
        found = _soonest(first_difference(one, other, names))
        if found is not None and only_fields is None:
            only_fields = sample.one(found[0]), found[1]
    if only_fields is None and len(names) > 1 and set(first.slots) == set(second.slots):
        only_fields = _with_fields(first, second, names, seed)
    return None if only_fields is None else _small(first, second, *only_fields, names)


def _shared(first: Simulator, second: Simulator) -> tuple[str, ...]:
    """The slots that both have, elements first."""
    known = {slot.name for slot in second.slots}
    return tuple(slot.name for slot in first.slots if slot.name in known)


def _soonest(when: Array) -> tuple[int, int] | None:
    """The world that differs soonest, and after how many steps."""
    found = np.nonzero(when)[0]
    if not len(found):
        return None
    best = int(found[when[found].argmin()])
    return best, int(when[best])


def _with_fields(
    first: Simulator, second: Simulator, names: tuple[str, ...], seed: int
) -> tuple[Start, int] | None:
    """A world that differs, of those whose fields hold anything that they can, with the usual parameters."""
    for drawn in random_samples(first.ruleset, seed, FIELDED):
        sample = replace(drawn, params={}, step=np.zeros_like(drawn.step))
        found = _soonest(differs_after(first, second, sample, 2, names))
        if found is not None:
            return sample.one(found[0]), found[1]
    return None


def _small(
    first: Simulator, second: Simulator, sample: Start, steps: int, names: tuple[str, ...]
) -> Distinction:
    def judge(some: Start, most: int) -> Array:
        return differs_after(first, second, some, most, names)

    tries = SEEDS if first.ruleset.streams or second.ruleset.streams else 1
    small, steps = shrink_while(judge, sample, steps, tries, Work(first.ruleset, WORK))
    if tries == 1:
        small = replace(small, seed=np.zeros_like(small.seed))
    one, other = (run_sample(sim, small, steps)[0][-1] for sim in (first, second))
    slot = next(name for name in names if (one[name] != other[name]).any())
    return Distinction(small, steps, slot, one, other)


def differs_after(
    first: Simulator, second: Simulator, sample: Start, steps: int, names: Sequence[str]
) -> Array:
    """After which step each world differs in one of these slots, 0 if it does not: int [B]."""
    one, other = (run_sample(sim, sample, steps)[0] for sim in (first, second))
    return first_difference(one, other, names)


def fresh_samples(ruleset: Ruleset, focus: Sequence[int], seed: int) -> Iterator[tuple[Start, int]]:
    """Worlds and how many steps they run, small ones first."""
    known = [element.id for element in ruleset.elements]
    frames = sorted(unchanging_ids(ruleset))
    for number, (least_rows, least_columns, worlds, steps) in enumerate(ROUNDS):
        rows, columns = fitting(ruleset, least_rows), fitting(ruleset, least_columns)
        random = np.random.default_rng([seed, number])
        ids = np.empty((worlds, rows, columns), np.uint8)
        for group in range(0, worlds, GROUP):
            palette = _palette(known, focus, KINDS[group // GROUP % len(KINDS)], random)
            ids[group : group + GROUP] = random.choice(palette, (GROUP, rows, columns))
        if frames and min(rows, columns) > 2:
            framed = ids[worlds // 2 :]
            framed[:, [0, -1], :] = frames[0]
            framed[:, :, [0, -1]] = frames[0]
        yield Start.fresh(ids).seeded(), steps


def _palette(known: list[int], focus: Sequence[int], kinds: int, random: np.random.Generator) -> list[int]:
    some = random.permutation(np.array(known, np.int64)).tolist()
    if len(focus) and random.random() < 0.8:
        kept = random.permutation(np.array(focus, np.int64)).tolist()[: max(1, kinds - 1)]
        some = [*kept, *(one for one in some if one not in kept)]
    return some[:kinds]
