"""Proves what can be proven of a ruleset's properties, and tests the rest on random worlds."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from time import monotonic
from typing import ClassVar, Self

from powderdsl.analysis.ledger import Ledger, Proven
from powderdsl.analysis.ledger import ledger as make_ledger
from powderdsl.analysis.proofs import prove
from powderdsl.arrays import np
from powderdsl.model.check import select_packs
from powderdsl.model.types import Never, Ruleset, Symmetric
from powderdsl.simulation.draw import shown_fields
from powderdsl.testing.generators.cases import Start
from powderdsl.testing.properties.blame import culprits, difference, translated
from powderdsl.testing.properties.breaks import (
    Agreement,
    Alike,
    Breaks,
    KnownIds,
    Tested,
    breaks,
    find_breaks,
    is_paired,
    steps_for,
)
from powderdsl.testing.properties.outcomes import Counterexample, Property, Result
from powderdsl.testing.properties.running import LARGE, Runs, random_samples
from powderdsl.testing.properties.shrink import WORK, Work, shrink

AUTOMATIC = "automatic"

STEPS = (3, 3, 3, 10)
"""How many steps batches run, one after the other."""

COPIES = 1024
"""How often a world runs where only frequencies can be compared."""


@dataclass(frozen=True)
class SearchPlan:
    """The extent of a search: the number of random worlds, the time limit in seconds, the first seed."""

    examples: int = 1000
    seconds: float = 60.0
    seed: int = 0


@dataclass
class InvariantSearch:
    """Tests the properties of one ruleset; worlds may be brought from outside too."""

    runner: Runs
    plan: SearchPlan
    trials: list[Result] = field(default_factory=list)
    ledger: Ledger | None = None

    few: ClassVar[Mapping[type, int]] = {Agreement: 2, Alike: 2, Never: 8}
    """Batches for claims that are expensive to check: by the oracle, in many copies, over many steps."""
    work: ClassVar[int] = WORK
    """Work for making a world small."""

    @classmethod
    def of(
        cls,
        runner: Runs,
        plan: SearchPlan,
        declared_only: bool = False,
        ledger: Ledger | None = None,
    ) -> Self:
        """Prove what can be proven; the rest is to be tried. `declared_only`: leave out what no pack claims.

        `ledger`: that of the rules, if it is known already.
        """
        ledger = ledger or make_ledger(runner.ruleset)
        search = cls(runner, plan, ledger=ledger)
        for prop in properties_of(runner.ruleset):
            if prop.owner == AUTOMATIC:
                search.trials += [] if declared_only else [Result(prop)]
                continue
            verdict = prove(prop.claim, runner.ruleset, ledger, prop.without)  # type: ignore[arg-type]
            if isinstance(verdict, Proven):
                condition = f", given {verdict.given}" if verdict.given else ""
                search.trials.append(Result(prop, verdict.reason + condition, is_proven=True))
            else:
                search.trials.append(Result(prop, doubts=verdict.rules))
        return search

    @property
    def undecided(self) -> list[Result]:
        """The trials of properties that are neither proven nor broken."""
        return [trial for trial in self.trials if not trial.is_proven and trial.sample is None]

    def only(self, texts: Collection[str]) -> Self:
        """The same search for some properties alone that are not proven."""
        return replace(self, trials=[replace(trial) for trial in self.undecided if trial.prop.text in texts])

    def try_random(self) -> None:
        """Try random worlds until there are enough of them, or time is up."""
        until = monotonic() + self.plan.seconds
        for number, sample in enumerate(
            random_samples(self.runner.ruleset, self.plan.seed, self.plan.examples)
        ):
            if monotonic() > until or not self.undecided:
                return
            self.try_sample(sample, STEPS[number % len(STEPS)])

    def try_sample(self, sample: Start, steps: int) -> None:
        """Check all properties that are not broken yet on some worlds."""
        waiting: dict[frozenset[int], list[Result]] = {}
        for trial in self.undecided:
            waiting.setdefault(trial.prop.without, []).append(trial)
        for without, trials in waiting.items():
            self._try_without(trials, sample.without(without, self.runner.ruleset), steps)

    def _try_without(self, trials: list[Result], sample: Start, steps: int) -> None:
        """Properties that demand the same of a start world: one run does for most of them."""
        shared = [
            t for t in trials if not is_paired(t.prop.claim) and steps_for(t.prop.claim, steps) == steps
        ]
        if shared:
            states = self.runner.states(sample, steps)
            for trial in shared:
                self._note(trial, sample, find_breaks(trial.prop.claim, self.runner.ruleset, sample, states))
        for trial in trials:
            if trial in shared:
                continue
            most = self.few.get(type(trial.prop.claim))
            large = isinstance(trial.prop.claim, Agreement) and sample.shape == LARGE
            if most is not None and trial.batches >= most and not large:
                continue
            some = sample.select(slice(0, 4)) if isinstance(trial.prop.claim, Alike) else sample
            ran = steps_for(trial.prop.claim, min(steps, 3))
            self._note(trial, some, breaks(trial.prop.claim, self.runner, some, ran))

    def _note(self, trial: Result, sample: Start, breaks: Breaks) -> None:
        trial.batches += 1
        trial.worlds += int(breaks.counts.sum())
        broken = np.nonzero(breaks.first)[0]
        if not len(broken):
            return
        first = min(broken.tolist(), key=lambda world: int(breaks.first[world]))
        if isinstance(trial.prop.claim, Symmetric) and self.runner.ruleset.streams:
            # The same numbers may be used in another way: then worlds agree in how often things happen.
            turn = trial.prop.claim.turn
            trial.prop = replace(trial.prop, claim=Alike(turn, COPIES))
            trial.reason, trial.batches, trial.worlds = "in how often things happen", 0, 0
            return
        trial.sample, trial.steps = sample.one(first), int(breaks.first[first])

    def finish(self) -> list[Result]:
        """Make what was found small and name the rules; the results in the order of the properties."""
        broken = {trial.prop.text: trial for trial in self.trials if trial.sample is not None}
        for trial in broken.values():
            assert trial.sample is not None
            work = Work(self.runner.ruleset, self.work // len(broken))
            small = shrink(trial.prop.claim, self.runner, trial.sample, trial.steps, work, trial.prop.without)
            trial.counterexample = counterexample(trial.prop.claim, self.runner, *small)
        self.report_differences()
        return self.trials

    def report_differences(self) -> None:
        """Reports how added packs break each broken invariant that holds in its scope without them."""
        ruleset = self.runner.ruleset
        broken = [(trial, trial.counterexample) for trial in self.trials if trial.counterexample is not None]
        for scope in dict.fromkeys(trial.prop.scope for trial, _ in broken):
            alone = select_packs(ruleset, scope) if scope and ruleset.added_to(scope) else None
            if alone is None:
                continue
            some = [(trial, world) for trial, world in broken if trial.prop.scope == scope]
            search = self.of(self.runner.of(alone), self.plan, declared_only=True)
            search = search.only([trial.prop.text for trial, _ in some])
            for _, world in some:
                sample = translated(world.sample, ruleset, alone)
                if sample is not None:
                    search.try_sample(sample, world.steps)
            search.try_random()
            still = {trial.prop.text for trial in search.trials if trial.sample is not None}
            for trial, world in some:
                if trial.prop.text not in still:
                    trial.difference = difference(trial.prop, ruleset, world)


def counterexample(claim: Tested, runner: Runs, sample: Start, steps: int) -> Counterexample:
    """A world that breaks a claim, as it is, and the rules that did it."""
    cell = breaks(claim, runner, sample, steps).cell[0]
    states = runner.states(sample, steps)
    names = ("element", *shown_fields(runner.ruleset))
    before, after = ({name: state[name][0] for name in names} for state in (states[0], states[-1]))
    lines = culprits(claim, runner.ruleset, sample, steps)
    return Counterexample(sample, steps, before, after, (int(cell[0]), int(cell[1])), lines)


def properties_of(ruleset: Ruleset) -> list[Property]:
    """The declared invariants, then what every ruleset must fulfill."""
    properties = [
        *map(Property.of, ruleset.invariants),
        Property(KnownIds(), "cells hold elements that the ruleset has", AUTOMATIC, None),
        Property(Agreement(), "the backend gives what the reference gives", AUTOMATIC, None),
    ]
    unique: dict[str, Property] = {}
    for prop in properties:  # of two that say the same, the one that says it of more packs
        if prop.text not in unique or len(prop.scope) > len(unique[prop.text].scope):
            unique[prop.text] = prop
    return [prop for prop in properties if unique[prop.text] is prop]
