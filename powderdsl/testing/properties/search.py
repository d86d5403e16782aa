"""Proves what can be proven of a ruleset's properties, and tests the rest on random worlds."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from time import monotonic

from powderdsl.analysis.changes import RuleLine
from powderdsl.analysis.ledger import Ledger, NotProven, Proven
from powderdsl.analysis.ledger import ledger as make_ledger
from powderdsl.analysis.proofs import prove
from powderdsl.arrays import np
from powderdsl.model.expressions.operands import ELEMENT_HERE, member
from powderdsl.model.restrict import restricted
from powderdsl.model.text import one_line
from powderdsl.model.types import Never, Ruleset, Symmetric, Total
from powderdsl.simulation.draw import shown_fields
from powderdsl.testing.generators.cases import Start
from powderdsl.testing.properties.blame import Oracle, culprits, difference, translated
from powderdsl.testing.properties.breaks import (
    Agreement,
    Alike,
    Breaks,
    KnownIds,
    Runs,
    Tested,
    breaks,
    is_paired,
    look,
    steps_for,
)
from powderdsl.testing.properties.outcomes import Counterexample, Property, Result
from powderdsl.testing.properties.running import LARGE, Runner, random_samples
from powderdsl.testing.properties.shrink import Work, shrink

AUTOMATIC = "automatic"

STEPS = (3, 3, 3, 10)
"""How many steps batches run, one after the other."""

COPIES = 1024
"""How often a world runs where only frequencies can be compared."""

FEW = {Agreement: 2, Alike: 2, Never: 8}
"""Batches for claims that are expensive to check: by the oracle, in many copies, over many steps."""


@dataclass(frozen=True)
class SearchPlan:
    """How much is tested: the number of random worlds, the time limit in seconds, the first seed."""

    examples: int = 1000
    seconds: float = 60.0
    seed: int = 0


@dataclass
class _Trial:
    """A property that is being tested."""

    prop: Property
    note: str
    doubts: tuple[RuleLine, ...] = ()
    """The lines that stand in the way of a proof."""
    worlds: int = 0
    batches: int = 0
    sample: Start | None = None
    steps: int = 0

    @property
    def claim(self) -> Tested:
        return self.prop.claim


@dataclass
class InvariantSearch:
    """Tests the properties of one ruleset; worlds may be brought from outside too."""

    runner: Runs
    plan: SearchPlan
    ledger: Ledger
    results: dict[str, Result] = field(default_factory=dict)
    trials: list[_Trial] = field(default_factory=list)

    @classmethod
    def of(
        cls, runner: Runs, plan: SearchPlan, declared_only: bool = False, ledger: Ledger | None = None
    ) -> InvariantSearch:
        """Prove what can be proven; the rest is to be tried. `declared_only`: leave out what no pack claims.

        `ledger`: that of the rules, if it is known already.
        """
        ledger = ledger or make_ledger(runner.ruleset)
        search = cls(runner, plan, ledger)
        for one in properties_of(runner.ruleset, ledger):
            declared = one.owner != AUTOMATIC
            if declared_only and not declared:
                continue
            verdict = prove(one.claim, runner.ruleset, ledger, one.without) if declared else NotProven("")  # type: ignore[arg-type]
            if isinstance(verdict, Proven):
                given = f", given {verdict.given}" if verdict.given else ""
                search.results[one.text] = Result(one, "proven", 0, verdict.reason + given)
            else:
                search.trials.append(_Trial(one, "", verdict.rules))
        return search

    def only(self, text: str) -> InvariantSearch:
        """The same search for one property alone; for none if it is proven."""
        trials = [replace(trial) for trial in self.trials if trial.prop.text == text]
        return InvariantSearch(self.runner, self.plan, self.ledger, {}, trials)

    def try_random(self) -> None:
        """Try random worlds until there are enough of them, or time is up."""
        until = monotonic() + self.plan.seconds
        for number, sample in enumerate(
            random_samples(self.runner.ruleset, self.plan.seed, self.plan.examples)
        ):
            if monotonic() > until:
                return
            self.try_sample(sample, STEPS[number % len(STEPS)])

    def try_sample(self, sample: Start, steps: int) -> None:
        """Check all properties that are not broken yet on some worlds."""
        waiting: dict[frozenset[int], list[_Trial]] = {}
        for trial in self.trials:
            if trial.sample is None:
                waiting.setdefault(trial.prop.without, []).append(trial)
        for without, trials in waiting.items():
            self._try_without(trials, sample.without(without, self.runner.ruleset), steps)

    def _try_without(self, trials: list[_Trial], sample: Start, steps: int) -> None:
        """Properties that demand the same of a start world: one run does for most of them."""
        shared = [t for t in trials if not is_paired(t.claim) and steps_for(t.claim, steps) == steps]
        if shared:
            states = self.runner.states(sample, steps)
            for trial in shared:
                self._note(trial, sample, look(trial.claim, self.runner.ruleset, sample, states))
        for trial in trials:
            if trial in shared:
                continue
            most = FEW.get(type(trial.claim))
            large = isinstance(trial.claim, Agreement) and sample.shape == LARGE
            if most is not None and trial.batches >= most and not large:
                continue
            some = sample.select(slice(0, 4)) if isinstance(trial.claim, Alike) else sample
            ran = steps_for(trial.claim, min(steps, 3))
            self._note(trial, some, breaks(trial.claim, self.runner, some, ran))

    def _note(self, trial: _Trial, sample: Start, found: Breaks) -> None:
        trial.batches += 1
        trial.worlds += int(found.counts.sum())
        broken = np.nonzero(found.first)[0]
        if not len(broken):
            return
        first = min(broken.tolist(), key=lambda world: int(found.first[world]))
        if isinstance(trial.claim, Symmetric) and self.runner.ruleset.streams:
            # The same numbers may be used in another way: then worlds agree in how often things happen.
            turn = trial.claim.turn
            trial.prop = replace(trial.prop, claim=Alike(turn, COPIES))
            trial.note, trial.batches, trial.worlds = "in how often things happen", 0, 0
            return
        trial.sample, trial.steps = sample.one(first), int(found.first[first])

    def finish(self) -> list[Result]:
        """Make what was found small and name the rules; the results in the order of the properties."""
        for trial in self.trials:
            if trial.sample is None:
                status = "tested" if trial.worlds else "untested"
                note = trial.note if trial.worlds else "no random world starts as it demands"
                self.results[trial.prop.text] = Result(trial.prop, status, trial.worlds, note)
            else:
                gone = trial.prop.without
                example = counterexample(trial.claim, self.runner, trial.sample, trial.steps, without=gone)
                self.results[trial.prop.text] = Result(
                    trial.prop, "broken", trial.worlds, trial.note, example
                )
        broken = [result for result in self.results.values() if result.status == "broken"]
        for result in told_apart(broken, self.runner, self.plan):
            self.results[result.prop.text] = result
        order = [one.text for one in properties_of(self.runner.ruleset, self.ledger)]
        return sorted(self.results.values(), key=lambda result: order.index(result.prop.text))


def told_apart(
    broken: Sequence[Result],
    runner: Runs,
    plan: SearchPlan,
    attempt: Callable[[InvariantSearch], object] = InvariantSearch.try_random,
) -> list[Result]:
    """The same results; an invariant that holds in its scope, without added packs, is marked as different.

    Args:
        attempt: runs worlds in a search on the rules of a scope.
    """
    ruleset = runner.ruleset
    scopes: dict[tuple[str, ...], list[Result]] = {}
    for result in broken:
        if result.prop.scope and ruleset.added_to(result.prop.scope):
            scopes.setdefault(result.prop.scope, []).append(result)
    differ: set[str] = set()
    for scope, results in scopes.items():
        alone = restricted(ruleset, scope)
        if alone is not None:
            search = trials_alone(alone, ruleset, results, plan, runner)
            if search.trials:
                attempt(search)
            false = {trial.prop.text for trial in search.trials if trial.sample is not None}
            differ |= {one.prop.text for one in results} - false
    return [
        replace(one, status="differs", difference=difference(one.prop, ruleset, one.counterexample))
        if one.prop.text in differ and one.counterexample is not None
        else one
        for one in broken
    ]


def trials_alone(
    alone: Ruleset, ruleset: Ruleset, results: Sequence[Result], plan: SearchPlan, runner: Runs
) -> InvariantSearch:
    """A search for what breaks some invariants on the rules of their scope; the worlds that were found come first."""
    search = InvariantSearch.of(Oracle(alone, alone.passes), plan, declared_only=True)
    texts = {result.prop.text for result in results}
    trials = [trial for trial in search.trials if trial.prop.text in texts]
    if trials and isinstance(runner, Runner):
        search = replace(search, runner=Runner(alone, runner.backend))
    search = replace(search, trials=trials)
    for result in results if trials else ():
        found = result.counterexample
        sample = translated(found.sample, ruleset, alone) if found else None
        if found is not None and sample is not None:
            search.try_sample(sample, found.steps)
    return search


def counterexample(
    claim: Tested,
    runner: Runs,
    sample: Start,
    steps: int,
    work: Work | None = None,
    without: frozenset[int] = frozenset(),
) -> Counterexample:
    """A world that breaks a claim, as small as the work allows. It starts without the elements `without`."""
    return as_it_is(claim, runner, *shrink(claim, runner, sample, steps, work, without))


def as_it_is(claim: Tested, runner: Runs, small: Start, steps: int) -> Counterexample:
    """A world that breaks a claim, and the rules that did it."""
    cell = breaks(claim, runner, small, steps).cell[0]
    states = runner.states(small, steps)
    names = shown_fields(runner.ruleset)
    before, after = ({name: state[name][0] for name in names} for state in (states[0], states[-1]))
    return Counterexample(
        small,
        steps,
        states[0]["element"][0],
        states[-1]["element"][0],
        (int(cell[0]), int(cell[1])),
        culprits(claim, runner.ruleset, small, steps),
        (before, after),
    )


def properties_of(ruleset: Ruleset, ledger: Ledger) -> list[Property]:
    """The declared invariants, then what every ruleset must fulfill."""
    found = [
        Property(i.claim, one_line(i.span), i.pack, i.span, i.without, i.scope) for i in ruleset.invariants
    ]
    found += [
        Property(KnownIds(), "cells hold elements that the ruleset has", AUTOMATIC, None),
        Property(Agreement(), "the backend gives what the reference gives", AUTOMATIC, None),
    ]
    found += [Property(claim, text, AUTOMATIC, None) for claim, text in _ledger_claims(ruleset, ledger)]
    unique: dict[str, Property] = {}
    for one in found:  # of two that say the same, the one that says it of more packs
        if one.text not in unique or len(one.scope) > len(unique[one.text].scope):
            unique[one.text] = one
    return [one for one in found if unique[one.text] is one]


def find_property(ruleset: Ruleset, text: str) -> Property | None:
    """The property that is known by these words."""
    return next((one for one in properties_of(ruleset, make_ledger(ruleset)) if one.text == text), None)


def _ledger_claims(ruleset: Ruleset, ledger: Ledger) -> Iterator[tuple[Total, str]]:
    """The sums that the ledger decides, as claims: a world that breaks one shows a bug in powderdsl."""
    ids = {element.name: element.id for element in ruleset.elements}
    for trend, sums in ledger.sums.items():
        for names in sums:
            if len(names) == len(ledger.elements):
                continue
            numbers = tuple(sorted(ids[name] for name in names))
            verb = "is constant" if trend == "constant" else trend
            yield (
                Total(member(ELEMENT_HERE, numbers), trend, frozenset(numbers)),
                f"count({', '.join(names)}) {verb}",
            )
