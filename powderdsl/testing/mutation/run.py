"""Judges the mutants of a composition in several processes, and looks for a world that shows each survivor."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from powderdsl.simulation.simulator import compile
from powderdsl.system.crew import Done, work_through
from powderdsl.testing.mutation.distinguishing import distinguish
from powderdsl.testing.mutation.judging import Verdict, judge
from powderdsl.testing.mutation.mutants import Mutant
from powderdsl.testing.mutation.original import Original
from powderdsl.testing.mutation.written import GeneratedTest, written_test


@dataclass(frozen=True)
class Task:
    """A mutant by its place among all of a composition."""

    rules: str
    packs: tuple[str, ...]
    number: int
    seed: int
    worlds: bool


@dataclass(frozen=True)
class Outcome:
    """What became of a mutant. `size` is that of a world that shows a survivor: (rows, columns, steps)."""

    number: int
    verdict: Verdict
    size: tuple[int, int, int] | None = None
    slot: str = ""
    test: GeneratedTest | None = None


def sampled(mutants: list[Mutant], most: int | None, seed: int) -> list[int]:
    """Places of at most so many mutants, each pack and kind of mistake in proportion, the same for the same seed."""
    everything = list(range(len(mutants)))
    if most is None or most >= len(mutants):
        return everything
    strata: dict[tuple[str, str], list[int]] = {}
    for number in everything:
        strata.setdefault((mutants[number].pack, mutants[number].operator), []).append(number)
    random = np.random.default_rng(seed)
    ranked: list[tuple[float, int]] = []
    for numbers in strata.values():
        order = random.permutation(len(numbers))
        start = random.random()
        ranked += [
            ((rank + start) / len(numbers), numbers[place]) for rank, place in enumerate(order.tolist())
        ]
    return sorted(number for _, number in sorted(ranked)[:most])


def run_campaign(
    rules: str, packs: tuple[str, ...], numbers: list[int], jobs: int, seed: int, worlds: bool = True
) -> Generator[Outcome]:
    """Outcomes of mutants in the order in which they come.

    Nothing is cut short by a clock: `check`, proofs and searches end by work, worlds and tests have a size. So outcomes
    are the same on a slow or busy machine.

    Args:
        numbers: places of the mutants among those of `Original.mutants`.
        worlds: look for a world that shows each survivor.
    """
    _loaded.cache_clear()  # files may have changed since
    tasks = deque(Task(rules, packs, number, seed, worlds) for number in numbers)
    if jobs == 1:
        for task in tasks:
            yield work(task, lambda value: None)
        return
    for found in work_through(tasks, work, jobs):
        if isinstance(found, Done):
            yield found.result
        else:
            yield Outcome(found.task.number, Verdict("survived", "", found.reason))


@lru_cache(maxsize=1)
def _loaded(rules: str, packs: tuple[str, ...]) -> tuple[Original, list[Mutant]]:
    original = Original.of(rules)
    return original, original.mutants(frozenset(packs))


def work(task: Task, tell: Callable[[Any], None]) -> Outcome:
    """Judge one mutant."""
    original, mutants = _loaded(task.rules, task.packs)
    mutant = mutants[task.number]
    verdict = judge(original, mutant)
    if verdict.status != "survived" or not task.worlds:
        return Outcome(task.number, verdict)
    ruleset, _ = original.mutated(mutant)
    focus = focused(original, mutant)
    found = distinguish(original.sim, compile(ruleset, backend="arrays"), focus, task.seed)
    if found is None:
        return Outcome(task.number, verdict)
    rows, columns = found.sample.shape
    test = written_test(mutant, found, original.sim, original.packs)
    return Outcome(task.number, verdict, (rows, columns, found.steps), found.slot, test)


def focused(original: Original, mutant: Mutant) -> tuple[int, ...]:
    """Elements that a mutant is likely to be about: those that its lines name, by themselves, a tag or a set."""
    import re

    words = set(re.findall(r"\w+", mutant.diff))
    tags = words & {tag.name.text for pack in original.packs for tag in pack.tags}
    own = {element.name for element in original.ruleset.elements if element.pack == mutant.pack}
    return tuple(
        element.id
        for element in original.ruleset.elements
        if element.name in words or element.tags & tags or element.name in own
    )
