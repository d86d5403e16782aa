"""Which invariants are false: `powderdsl check` says so with the rule and a small world, before anything is trained.

The ledger proves what it can. For what is left, a few small worlds run on the oracle, without torch: a world that
breaks an invariant refutes it. That none does says nothing; `powderdsl test` tries more and larger ones.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from powderdsl.diagnostics import Diagnostic, Label, Reporter
from powderdsl.ledgers.book import Ledger
from powderdsl.ledgers.changes import RuleLine
from powderdsl.model.types import Ruleset
from powderdsl.properties.blame import Oracle
from powderdsl.properties.breaks import Alike
from powderdsl.properties.outcomes import Counterexample, Property, counterexample_lines
from powderdsl.properties.samples import Sample, random_samples
from powderdsl.properties.search import Plan, Search, counterexample
from powderdsl.properties.shrink import Work

WORLDS = 256
"""Small worlds that are tried, and a few larger ones: enough for mistakes that happen often."""

STEPS = 2

FOCUSED = 2
"""Batches that are tried once more with few elements."""

FEW = 4
"""More elements than these say nothing about what a line is about."""

WORK = 200_000_000
"""Work for making all the worlds that were found smaller: some seconds."""


@dataclass(frozen=True)
class Broken:
    """An invariant that is false, and a world that shows it."""

    prop: Property
    found: Counterexample


def refuted(ruleset: Ruleset, ledger: Ledger) -> tuple[Diagnostic, ...]:
    """An error for each invariant that a world breaks. The same rules give the same worlds."""
    reporter = Reporter()
    for one in broken_invariants(ruleset, ledger):
        steps = "1 step" if one.found.steps == 1 else f"{one.found.steps} steps"
        world = [line for line in counterexample_lines(one.found, ruleset) if not line.startswith("by ")]
        reporter.report(
            "PD512",
            f"this invariant is broken after {steps}",
            one.prop.span,
            "does not hold",
            secondary=[Label(span, "breaks it") for span in one.found.culprits[:3]],
            notes=world,
            helps=["mend the rule, or say less: `without SET` leaves worlds out"],
        )
    return reporter.diagnostics


def broken_invariants(ruleset: Ruleset, ledger: Ledger) -> list[Broken]:
    """The invariants that a few worlds break, each with a world that was made small."""
    oracle = Oracle(ruleset, ruleset.passes)
    search = Search.of(oracle, Plan(), declared_only=True, ledger=ledger)
    for number, sample in enumerate(random_samples(ruleset, 0, WORLDS)):
        # Where mirrored numbers are used in another way only frequencies can tell: thousands of worlds.
        search.trials = [trial for trial in search.trials if not isinstance(trial.claim, Alike)]
        search.try_sample(sample, STEPS)
        if number < FOCUSED:
            _try_focused(search, sample)
    broken = [trial for trial in search.trials if trial.sample is not None]
    return [
        Broken(
            one.prop,
            counterexample(one.claim, oracle, one.sample, one.steps, Work.of(ruleset, WORK // len(broken))),
        )
        for one in broken
        if one.sample is not None
    ]


def _try_focused(search: Search, sample: Sample) -> None:
    """Try the same worlds with only those elements that the lines in the way of a proof are about."""
    for trial in search.trials:
        kinds = _concerned(search, trial.doubts)
        if kinds and trial.sample is None:
            ids = np.array(kinds, np.uint8)[sample.ids % len(kinds)]
            few = replace(sample, ids=ids, fields={})
            Search(search.runner, search.plan, search.ledger, {}, [trial]).try_sample(few, STEPS)


def _concerned(search: Search, lines: tuple[RuleLine, ...]) -> list[int]:
    """Ids of the elements that some lines need, change or move."""
    names: set[str] = set()
    for entry in search.ledger.rules:
        if entry.rule in lines:
            names |= {name for some in entry.needs if len(some) < FEW for name in some}
            names |= {name for pair in entry.changes[:FEW] for name in pair}
    return sorted(one.id for one in search.runner.ruleset.elements if one.name in names)
