"""The smallest world found on which two compositions differ, and after how many steps: thousands at once, then smaller.

Worlds start fresh, as a pack's test draws them: elements alone, at the first step, with the usual parameters.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from powderdsl.model.reactions import unchanging_ids
from powderdsl.model.types import Ruleset
from powderdsl.properties.running import run_sample
from powderdsl.properties.samples import Array, Sample, State, random_samples
from powderdsl.properties.shrink import Work, shrink_while
from powderdsl.simulator import Simulator

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
"""Work for making a world smaller, see `properties.shrink`."""


@dataclass(frozen=True)
class Distinction:
    """One world on which two compositions differ after some steps: in `slot`, if not already in elements.

    `first` and `second` are the states after the last step.
    """

    sample: Sample
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
    for names, samples in _searches(first, second, focus, seed):
        for sample, steps in samples:
            when = differs_after(first, second, sample, steps, names)
            found = np.nonzero(when)[0]
            if len(found):
                best = int(found[when[found].argmin()])
                return _small(first, second, sample.one(best), int(when[best]), names)
    return None


def _searches(
    first: Simulator, second: Simulator, focus: Sequence[int], seed: int
) -> Iterator[tuple[tuple[str, ...], Iterator[tuple[Sample, int]]]]:
    """What is looked at, and in which worlds: elements in fresh ones, then all that both hold, then in any worlds."""
    yield ("element",), fresh_samples(first.ruleset, focus, seed)
    shared = {slot.name: slot for slot in second.slots}
    names = tuple(slot.name for slot in first.slots if slot.name in shared)
    if len(names) == 1:
        return
    yield names, fresh_samples(first.ruleset, focus, seed)
    if all(slot == shared.get(slot.name) for slot in first.slots):
        yield names, _fielded_samples(first.ruleset, seed)


def _fielded_samples(ruleset: Ruleset, seed: int) -> Iterator[tuple[Sample, int]]:
    """Worlds whose fields hold anything that they can, at the first step, with the usual parameters."""
    for sample in random_samples(ruleset, seed, FIELDED):
        yield replace(sample, params={}, clock=np.zeros_like(sample.clock)), 2


def _small(
    first: Simulator, second: Simulator, sample: Sample, steps: int, names: tuple[str, ...]
) -> Distinction:
    def judge(some: Sample, most: int) -> Array:
        return differs_after(first, second, some, most, names)

    tries = SEEDS if first.ruleset.streams or second.ruleset.streams else 1
    small, steps = shrink_while(judge, sample, steps, tries, Work.of(first.ruleset, WORK))
    if tries == 1:
        small = replace(small, seeds=np.zeros_like(small.seeds))
    one, other = (run_sample(sim, small, steps)[0][-1] for sim in (first, second))
    slot = next(name for name in names if (one[name] != other[name]).any())
    return Distinction(small, steps, slot, one, other)


def differs_after(
    first: Simulator, second: Simulator, sample: Sample, steps: int, names: Sequence[str]
) -> Array:
    """After which step each world differs in one of these slots, 0 if it does not: int [B]."""
    one, _ = run_sample(first, sample, steps)
    other, _ = run_sample(second, sample, steps)
    when = np.zeros(len(sample), np.int64)
    for step in range(steps, 0, -1):
        for name in names:
            wrong = (one[step][name] != other[step][name]).reshape(len(sample), -1).any(1)
            when[wrong] = step
    return when


def fresh_samples(ruleset: Ruleset, focus: Sequence[int], seed: int) -> Iterator[tuple[Sample, int]]:
    """Worlds and how many steps they run, small ones first."""
    known = [element.id for element in ruleset.elements]
    frames = sorted(unchanging_ids(ruleset))
    for number, (rows, columns, worlds, steps) in enumerate(ROUNDS):
        random = np.random.default_rng([seed, number])
        ids = np.empty((worlds, rows, columns), np.uint8)
        for group in range(0, worlds, GROUP):
            palette = _palette(known, focus, KINDS[group // GROUP % len(KINDS)], random)
            ids[group : group + GROUP] = random.choice(palette, (GROUP, rows, columns))
        if frames and min(rows, columns) > 2:
            framed = ids[worlds // 2 :]
            framed[:, [0, -1], :] = frames[0]
            framed[:, :, [0, -1]] = frames[0]
        yield Sample(ids, np.arange(worlds, dtype=np.int64), np.zeros(worlds, np.int64)), steps


def _palette(known: list[int], focus: Sequence[int], kinds: int, random: np.random.Generator) -> list[int]:
    some = random.permutation(np.array(known, np.int64)).tolist()
    if len(focus) and random.random() < 0.8:
        kept = random.permutation(np.array(focus, np.int64)).tolist()[: max(1, kinds - 1)]
        some = [*kept, *(one for one in some if one not in kept)]
    return some[:kinds]
