"""Finds false invariants: `powderdsl check` reports each with the rule and a small world, before anything is trained.

The ledger proves what it can. For the rest, a few small worlds run on the oracle, without torch: a world that
breaks an invariant refutes it. If no world does, nothing is proven; `powderdsl test` tries more and larger worlds.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import ClassVar

from powderdsl.analysis.changes import RuleLine
from powderdsl.analysis.ledger import Ledger
from powderdsl.arrays import np
from powderdsl.diagnostics import Diagnostic, Label, Reporter
from powderdsl.model.composition.added_packs import Cause, Difference
from powderdsl.model.text import place_of
from powderdsl.model.types import Ruleset
from powderdsl.testing.properties.breaks import Alike
from powderdsl.testing.properties.outcomes import Result, counterexample_lines
from powderdsl.testing.properties.running import Oracle, random_samples
from powderdsl.testing.properties.search import InvariantSearch, SearchPlan

WORLDS = 256
"""Small worlds that are tried, and a few larger ones: enough for frequent mistakes."""

SEED = 6
"""Of these worlds: with it, all mistakes in tests/mutations.yaml that break an invariant show."""

STEPS = 2

FOCUSED = 2
"""Batches that are tried once more with few elements."""

FEW = 4
"""A set of this many elements or more does not show what a line is about."""


def refuted(ruleset: Ruleset, ledger: Ledger) -> tuple[Diagnostic, ...]:
    """An error for each invariant that a world breaks, a note for each that only added packs break.

    The same rules give the same worlds.
    """
    reporter = Reporter()
    for result in quick_results(ruleset, ledger):
        if result.counterexample is None:
            continue
        world = [line for line in counterexample_lines(result.counterexample, ruleset) if line[:3] != "by "]
        if result.difference is not None:
            _report_difference(result, result.difference, world, reporter)
            continue
        steps = "1 step" if result.counterexample.steps == 1 else f"{result.counterexample.steps} steps"
        reporter.report(
            "PD512",
            f"this invariant is broken after {steps}",
            result.prop.span,
            "does not hold",
            secondary=[Label(span, "breaks it") for span in result.counterexample.culprits[:3]],
            notes=world,
            helps=["fix the rule, or weaken the invariant: `without SET` excludes worlds"],
        )
    return reporter.diagnostics


def _report_difference(
    result: Result, difference: Difference, world: Sequence[str], reporter: Reporter
) -> None:
    assert result.counterexample is not None
    first, *others = difference.causes
    culprits = result.counterexample.culprits

    def words(cause: Cause, breaks: str) -> str:
        return breaks if cause.span in culprits else "takes part" if cause.is_rule else cause.does

    rules = [span for span in culprits if span not in {cause.span for cause in difference.causes}]
    also = [Label(cause.span, words(cause, "and this")) for cause in others]
    reporter.report(
        "PD515",
        f"{difference.with_packs}, `{result.prop.text}` no longer holds: {place_of(first.span)}",
        first.span,
        words(first, "this breaks it"),
        secondary=[
            *also[:2],
            *(Label(span, "did it") for span in rules[:2]),
            Label(result.prop.span, f"`{result.prop.owner}` says so"),
        ],
        notes=["the packs that it speaks of keep it, as far as was tried", *world],
    )


class QuickSearch(InvariantSearch):
    """Tries a few worlds, and the first of them once more with few elements."""

    # Where mirrored numbers are used in another way only frequencies can tell: thousands of worlds.
    few: ClassVar[Mapping[type, int]] = {**InvariantSearch.few, Alike: 0}
    work: ClassVar[int] = 200_000_000  # for all the worlds that were found: some seconds

    def try_random(self) -> None:
        """Run a few worlds."""
        for number, sample in enumerate(random_samples(self.runner.ruleset, SEED, WORLDS)):
            if not self.undecided:
                return
            self.try_sample(sample, STEPS)
            for trial in self.undecided if number < FOCUSED else ():
                kinds = _concerned(self, trial.doubts)
                if kinds:
                    ids = np.array(kinds, np.uint8)[sample.ids % len(kinds)]
                    replace(self, trials=[trial]).try_sample(replace(sample, ids=ids, fields={}), STEPS)


def quick_results(ruleset: Ruleset, ledger: Ledger) -> list[Result]:
    """Judge each invariant by a proof or a few worlds; a world that breaks an invariant is made small."""
    search = QuickSearch.of(Oracle(ruleset), SearchPlan(), declared_only=True, ledger=ledger)
    search.try_random()
    return search.finish()


def _concerned(search: InvariantSearch, lines: tuple[RuleLine, ...]) -> list[int]:
    """Ids of the elements that some lines need, change or move."""
    names: set[str] = set()
    for entry in search.ledger.rules if search.ledger else ():
        if entry.rule in lines:
            names |= {name for some in entry.needs if len(some) < FEW for name in some}
            names |= {name for pair in entry.changes[:FEW] for name in pair}
    return sorted(element.id for element in search.runner.ruleset.elements if element.name in names)
