"""Counts over judged mutants: how many there were, and what noticed them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

from powderdsl.testing.mutation.judging import NOTICED
from powderdsl.testing.mutation.run import Outcome

COUNTED = ("mutants", "equivalent", "killed", *NOTICED, "survived")
"""Keys of a tally. `killed` is the sum of what noticed them; texts that are not rule files are not counted."""


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
    """Of the mutants that invariants and tests notice, the part for which those written by hand do; 1 if there are none."""
    tested = counts["invariant"] + counts["test"] + counts["generated"]
    return (tested - counts["generated"]) / tested if tested else 1.0
