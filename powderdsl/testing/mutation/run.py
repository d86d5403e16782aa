"""Judges the mutants of a composition in several processes, looks for a world that shows each survivor, and counts."""

from __future__ import annotations

import os
import re
import signal
from collections import Counter
from collections.abc import Generator, Iterable
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import lru_cache
from multiprocessing import Pipe, get_context
from multiprocessing.connection import Connection, wait
from threading import Thread

import numpy as np

from powderdsl.compiler import starting_backend
from powderdsl.simulation.simulator import compile
from powderdsl.testing.mutation.distinguishing import distinguish
from powderdsl.testing.mutation.judging import NOTICED, Verdict, judge
from powderdsl.testing.mutation.mutants import Mutant
from powderdsl.testing.mutation.original import Original, Settings
from powderdsl.testing.mutation.written import GeneratedTest, written_test

COUNTED = ("mutants", "equivalent", "killed", *NOTICED, "survived")
"""Keys of a tally. `killed` is the sum of what noticed them; texts that are not rule files are not counted."""


@dataclass(frozen=True)
class Task:
    """A mutant by its place among all of a composition."""

    rules: str
    settings: Settings
    packs: tuple[str, ...]
    number: int
    seed: int
    worlds: bool


@dataclass(frozen=True)
class Outcome:
    """The verdict on a mutant. `size` is that of a world that shows a survivor: (rows, columns, steps)."""

    number: int
    verdict: Verdict
    size: tuple[int, int, int] | None = None
    slot: str = ""
    test: GeneratedTest | None = None


def sampled(mutants: list[Mutant], most: int | None, seed: int) -> list[int]:
    """Places of at most `most` mutants, each pack and kind of mistake in proportion, the same for the same seed."""
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
    rules: str,
    packs: tuple[str, ...],
    numbers: list[int],
    jobs: int,
    seed: int,
    worlds: bool = True,
    settings: Settings = (),
) -> Generator[Outcome]:
    """Outcomes of mutants in the order in which they come.

    Nothing is cut short by a clock: `check`, proofs and searches end by work, worlds and tests have a size. So outcomes
    are the same on a slow or busy machine.

    Args:
        numbers: places of the mutants among those of `Original.mutants`.
        worlds: look for a world that shows each survivor.
        settings: other values for parameters.

    Raises:
        OSError: a process was killed, as where memory is short.
    """
    _loaded.cache_clear()  # files may have changed since
    tasks = [Task(rules, settings, packs, number, seed, worlds) for number in numbers]
    if jobs == 1:
        yield from map(work, tasks)
        return
    lifeline, ours = Pipe(duplex=False)
    # A fork of a process with threads of torch's may hang.
    pool = ProcessPoolExecutor(jobs, get_context("spawn"), _begin_process, (lifeline,))
    try:
        for done in as_completed([pool.submit(work, task) for task in tasks]):
            yield done.result()
    except BrokenProcessPool:
        raise OSError("a process that judged mutants was killed; fewer `--jobs` need less memory") from None
    finally:
        ours.close()
        pool.shutdown(cancel_futures=True)


def _begin_process(lifeline: Connection) -> None:
    """Ignore Ctrl-C, which is for the process that started this one, and end when that ends or closes the pipe."""

    def watch() -> None:
        wait([lifeline])
        os._exit(1)

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    Thread(target=watch, daemon=True).start()


@lru_cache(maxsize=1)
def _loaded(rules: str, settings: Settings, packs: tuple[str, ...]) -> tuple[Original, list[Mutant]]:
    original = Original.of(rules, settings)
    return original, original.mutants(frozenset(packs))


def work(task: Task) -> Outcome:
    """Judge one mutant."""
    original, mutants = _loaded(task.rules, task.settings, task.packs)
    mutant = mutants[task.number]
    verdict = judge(original, mutant)
    if verdict.status != "survived" or not task.worlds:
        return Outcome(task.number, verdict)
    ruleset, _ = original.mutated(mutant)
    focus = focused(original, mutant)
    found = distinguish(original.sim, compile(ruleset, backend=starting_backend("cpu")), focus, task.seed)
    if found is None:
        return Outcome(task.number, verdict)
    rows, columns = found.sample.shape
    test = written_test(mutant, found, original.sim, original.packs)
    return Outcome(task.number, verdict, (rows, columns, found.steps), found.slot, test)


def focused(original: Original, mutant: Mutant) -> tuple[int, ...]:
    """Elements that a mutant is likely to be about: its lines name them, one of their tags or a set."""
    words = set(re.findall(r"\w+", mutant.diff))
    tags = words & {tag.name.text for pack in original.packs for tag in pack.tags}
    own = {element.name for element in original.ruleset.elements if element.pack == mutant.pack}
    return tuple(
        element.id
        for element in original.ruleset.elements
        if element.name in words or element.tags & tags or element.name in own
    )


def tally(outcomes: Iterable[Outcome]) -> dict[str, int]:
    """Numbers of mutants by COUNTED."""
    counts: Counter[str] = Counter()
    for outcome in outcomes:
        verdict = outcome.verdict
        if verdict.status != "invalid":
            counts["mutants"] += 1
            counts[verdict.status] += 1
            counts[verdict.by if verdict.status == "killed" else ""] += 1
    return {key: counts[key] for key in COUNTED}


def noticed_share(counts: dict[str, int]) -> float:
    """The part of the mutants that are not proven equivalent which something notices; 1 if there are none."""
    real = counts["mutants"] - counts["equivalent"]
    return counts["killed"] / real if real else 1.0


def by_hand_share(counts: dict[str, int]) -> float:
    """Of the mutants that invariants and tests notice, the part that those written by hand notice; 1 if there are none."""
    tested = counts["invariant"] + counts["test"] + counts["generated"]
    return (tested - counts["generated"]) / tested if tested else 1.0
