"""Finds false invariants: `powderdsl check` reports each with the rule and a small world, before anything is trained.

The ledger proves what it can. For the rest, a few small worlds run on the oracle, without torch: a world that
breaks an invariant refutes it. If no world does, nothing is proven; `powderdsl test` tries more and larger worlds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from powderdsl.analysis.changes import RuleLine
from powderdsl.analysis.ledger import Ledger
from powderdsl.arrays import np
from powderdsl.diagnostics import Diagnostic, Label, Reporter
from powderdsl.model.restrict import Cause, Difference
from powderdsl.model.text import place_of
from powderdsl.model.types import Ruleset
from powderdsl.testing.generators.cases import Start
from powderdsl.testing.properties.blame import Oracle
from powderdsl.testing.properties.breaks import Alike
from powderdsl.testing.properties.outcomes import Result, counterexample_lines
from powderdsl.testing.properties.running import random_samples
from powderdsl.testing.properties.search import (
    InvariantSearch,
    SearchPlan,
    counterexample,
    told_apart,
)
from powderdsl.testing.properties.shrink import Work

WORLDS = 256
"""Small worlds that are tried, and a few larger ones: enough for frequent mistakes."""

STEPS = 2

FOCUSED = 2
"""Batches that are tried once more with few elements."""

FEW = 4
"""A set of this many elements or more does not show what a line is about."""

WORK = 200_000_000
"""Work for making all the worlds that were found smaller: some seconds."""


def refuted(ruleset: Ruleset, ledger: Ledger) -> tuple[Diagnostic, ...]:
    """An error for each invariant that a world breaks, a note for each that only added packs break.

    The same rules give the same worlds.
    """
    reporter = Reporter()
    for one in broken_invariants(ruleset, ledger):
        assert one.counterexample is not None
        world = [line for line in counterexample_lines(one.counterexample, ruleset) if line[:3] != "by "]
        if one.difference is not None:
            _report_difference(one, one.difference, world, reporter)
            continue
        steps = "1 step" if one.counterexample.steps == 1 else f"{one.counterexample.steps} steps"
        reporter.report(
            "PD512",
            f"this invariant is broken after {steps}",
            one.prop.span,
            "does not hold",
            secondary=[Label(span, "breaks it") for span in one.counterexample.culprits[:3]],
            notes=world,
            helps=["fix the rule, or weaken the invariant: `without SET` excludes worlds"],
        )
    return reporter.diagnostics


def _report_difference(one: Result, found: Difference, world: Sequence[str], reporter: Reporter) -> None:
    assert one.counterexample is not None
    first, *others = found.causes
    culprits = one.counterexample.culprits

    def words(cause: Cause, breaks: str) -> str:
        return breaks if cause.span in culprits else "takes part" if cause.is_rule else cause.does

    rules = [span for span in culprits if span not in {cause.span for cause in found.causes}]
    also = [Label(cause.span, words(cause, "and this")) for cause in others]
    reporter.report(
        "PD515",
        f"{found.with_packs}, `{one.prop.text}` no longer holds: {place_of(first.span)}",
        first.span,
        words(first, "this breaks it"),
        secondary=[
            *also[:2],
            *(Label(span, "did it") for span in rules[:2]),
            Label(one.prop.span, f"`{one.prop.owner}` says so"),
        ],
        notes=["the packs that it speaks of keep it, as far as was tried", *world],
    )


def broken_invariants(ruleset: Ruleset, ledger: Ledger) -> list[Result]:
    """The invariants that a few worlds break, each with a world that was made small."""
    oracle = Oracle(ruleset, ruleset.passes)
    search = InvariantSearch.of(oracle, SearchPlan(), declared_only=True, ledger=ledger)
    _try_worlds(search)
    broken = [trial for trial in search.trials if trial.sample is not None]
    found = []
    for trial in broken:
        assert trial.sample is not None
        work, gone = Work(ruleset, WORK // len(broken)), trial.prop.without
        small = counterexample(trial.claim, oracle, trial.sample, trial.steps, work, gone)
        found.append(Result(trial.prop, "broken", trial.worlds, "", small))
    return told_apart(found, oracle, SearchPlan(), _try_worlds)


def _try_worlds(search: InvariantSearch) -> None:
    """Run a few worlds."""
    for number, sample in enumerate(random_samples(search.runner.ruleset, 0, WORLDS)):
        # Where mirrored numbers are used in another way only frequencies can tell: thousands of worlds.
        search.trials = [trial for trial in search.trials if not isinstance(trial.claim, Alike)]
        if not search.trials:
            break
        search.try_sample(sample, STEPS)
        if number < FOCUSED:
            _try_focused(search, sample)


def _try_focused(search: InvariantSearch, sample: Start) -> None:
    """Try the same worlds with only those elements that the lines in the way of a proof are about."""
    for trial in search.trials:
        kinds = _concerned(search, trial.doubts)
        if kinds and trial.sample is None:
            ids = np.array(kinds, np.uint8)[sample.ids % len(kinds)]
            few = replace(sample, ids=ids, fields={})
            InvariantSearch(search.runner, search.plan, search.ledger, {}, [trial]).try_sample(few, STEPS)


def _concerned(search: InvariantSearch, lines: tuple[RuleLine, ...]) -> list[int]:
    """Ids of the elements that some lines need, change or move."""
    names: set[str] = set()
    for entry in search.ledger.rules:
        if entry.rule in lines:
            names |= {name for some in entry.needs if len(some) < FEW for name in some}
            names |= {name for pair in entry.changes[:FEW] for name in pair}
    return sorted(one.id for one in search.runner.ruleset.elements if one.name in names)
