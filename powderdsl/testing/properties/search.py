"""Proves a ruleset's properties if possible, and tests the others on random worlds."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain
from math import inf
from time import monotonic
from typing import Any, Self

from powderdsl.analysis.ledger import ledger
from powderdsl.analysis.proofs import prove
from powderdsl.arrays import np
from powderdsl.diagnostics import Diagnostic, Label, Reporter
from powderdsl.model.check import select_packs
from powderdsl.model.composition.added_packs import Cause, ScopeDifference
from powderdsl.model.text import place_of
from powderdsl.model.types import Never, Ruleset, Symmetric
from powderdsl.prover.verdicts import judgments
from powderdsl.simulation.draw import shown_fields
from powderdsl.system.cache import persistent
from powderdsl.testing.generators.cases import Array, Start
from powderdsl.testing.properties.blame import culprits, difference, translated
from powderdsl.testing.properties.breaks import (
    Agreement,
    Alike,
    Breaks,
    Tested,
    breaks,
    find_breaks,
    is_paired,
    steps_for,
)
from powderdsl.testing.properties.models import starts
from powderdsl.testing.properties.outcomes import Counterexample, Property, Result, counterexample_lines
from powderdsl.testing.properties.running import LARGE, Oracle, Runs, State, join_starts, random_samples

AUTOMATIC = "automatic"

STEPS = (3, 3, 3, 10)
"""How many steps batches run, one after the other."""

COPIES = 1024
"""How often a world runs where only frequencies can be compared."""

WORK = 500_000_000
"""Work for making worlds small, ten seconds or so: most need a hundredth of it."""

PROOF = 60.0
"""Seconds of work for proofs: twice as much as the largest shipped ruleset needs."""


@dataclass(frozen=True)
class SearchPlan:
    """The extent of a search: the number of random worlds, the time limit in seconds, the first seed."""

    examples: int = 1000
    seconds: float = 60.0
    seed: int = 0
    proof: float = PROOF
    """Seconds of work for proofs by induction, counted; 0 for none."""


FEW: Mapping[type, int] = {Agreement: 2, Alike: 2, Never: 8}
"""Batches for claims that are expensive to check: by the oracle, in many copies, over many steps."""


@dataclass
class InvariantSearch:
    """Tests the properties of one ruleset; worlds may be brought from outside too."""

    runner: Runs
    plan: SearchPlan
    trials: list[Result] = field(default_factory=list)
    few: Mapping[type, int] = field(default_factory=lambda: FEW)

    @classmethod
    def of(cls, runner: Runs, plan: SearchPlan, texts: Collection[str] | None = None) -> Self:
        """Prove what can be proven; the rest is to be tried. `texts`: the only claims that matter."""
        entries, search = ledger(runner.ruleset), cls(runner, plan)
        for prop in properties_of(runner.ruleset):
            if texts is not None and prop.text not in texts:
                continue
            if prop.owner == AUTOMATIC:
                search.trials += [] if isinstance(runner, Oracle) else [Result(prop)]  # it agrees with itself
                continue
            proof = prove(prop.claim, runner.ruleset, entries, prop.without)  # type: ignore[arg-type]
            if proof is None:
                search.trials.append(Result(prop))
            else:
                condition = f", given {proof.given}" if proof.given else ""
                search.trials.append(Result(prop, proof.reason + condition, proof.by))
        search.prove()
        return search

    def prove(self) -> None:
        """Prove by induction what the ledger leaves open. What may be broken is tried on worlds that show how, if they can."""
        trials = [trial for trial in self.undecided if trial.prop.owner != AUTOMATIC]
        claims = [(trial.prop.claim, trial.prop.without) for trial in trials]
        if not claims or not self.plan.proof:
            return
        ruleset, seconds = self.runner.ruleset, self.plan.proof
        results = persistent(
            f"proofs of {ruleset.name}",
            repr((ruleset.text_key, seconds, [trial.prop.text for trial in trials])),
            lambda: judgments(ruleset, claims, seconds),  # type: ignore[arg-type]
        )
        for trial, judgment in zip(trials, results, strict=True):
            trial.proof, trial.reason = "induction" if judgment.is_proven else "", judgment.reason
            if judgment.model is not None:
                search, undrawn = replace(self, trials=[trial]), replace(ruleset, streams=())
                for sample, _, steps in starts(judgment.model, undrawn):
                    search.try_sample(sample, steps)
                    if trial.sample is not None:
                        break

    @property
    def undecided(self) -> list[Result]:
        """The trials of properties that are neither proven nor broken."""
        return [trial for trial in self.trials if not trial.proof and trial.sample is None]

    def only(self, texts: Collection[str]) -> Self:
        """The same search for some properties alone that are not proven."""
        trials = [trial for trial in self.trials if not trial.proof and trial.prop.text in texts]
        return replace(self, trials=list(map(replace, trials)))

    def try_random(self) -> None:
        """Try random worlds up to their number or the time limit."""
        until = monotonic() + self.plan.seconds
        for number, sample in enumerate(
            random_samples(self.runner.ruleset, self.plan.seed, self.plan.examples)
        ):
            if monotonic() > until or not self.undecided:
                return
            self.try_sample(sample, STEPS[number % len(STEPS)])

    def try_sample(self, sample: Start, steps: int) -> None:
        """Check all properties that are not broken yet on some worlds. Those that start and run alike share a run."""
        ruleset, runs = self.runner.ruleset, dict[frozenset[int], list[State]]()
        for trial in self.undecided:
            claim, without = trial.prop.claim, trial.prop.without
            start, count = sample.without(without, ruleset), steps_for(claim, steps)
            if not is_paired(claim) and count == steps:
                if without not in runs:
                    runs[without] = self.runner.states(start, steps)
                self._note(trial, start, find_breaks(claim, ruleset, start, runs[without]))
                continue
            done = trial.batches >= self.few.get(type(claim), inf)
            if done and not (isinstance(claim, Agreement) and start.shape == LARGE):
                continue
            if isinstance(claim, Alike):
                if isinstance(self.runner, Oracle):
                    continue  # it takes too long for thousands of worlds
                start = start.select(slice(0, 4))
            self._note(trial, start, breaks(claim, self.runner, start, steps_for(claim, min(steps, 3))))

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
            work = Work(self.runner.ruleset, WORK // len(broken))
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
            texts = [trial.prop.text for trial, _ in some]
            search = self.of(self.runner.of(alone), self.plan, texts)
            for _, world in some:
                sample = translated(world.sample, ruleset, alone)
                if sample is not None:
                    search.try_sample(sample, world.steps)
            search.try_random()
            still = {trial.prop.text for trial in search.trials if trial.sample is not None}
            proven = {trial.prop.text for trial in search.trials if trial.proof}
            for trial, world in some:
                if trial.prop.text not in still:
                    trial.reason = "which is proven" if trial.prop.text in proven else "as far as was tried"
                    trial.difference = difference(trial.prop, ruleset, world)


def counterexample(claim: Tested, runner: Runs, sample: Start, steps: int) -> Counterexample:
    """A world that breaks a claim, unreduced, and the rules that broke it."""
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
        Property(Agreement(), "the backend gives what the reference gives", AUTOMATIC, None),
    ]
    unique: dict[str, Property] = {}
    for prop in properties:  # of two that say the same, the one that says it of more packs
        if prop.text not in unique or len(prop.scope) > len(unique[prop.text].scope):
            unique[prop.text] = prop
    return [prop for prop in properties if unique[prop.text] is prop]


# False invariants: `powderdsl check` reports each with the rule and a small world, before anything is trained. The worlds run
# on the oracle, without torch.

QUICK = 256
"""Random worlds that are tried, and a few larger ones: enough for frequent mistakes."""


def refuted(ruleset: Ruleset, results: Sequence[Result]) -> tuple[Diagnostic, ...]:
    """An error for each invariant that a world breaks, a note for each that only added packs break."""
    reporter = Reporter()
    for result in results:
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
    result: Result, difference: ScopeDifference, world: Sequence[str], reporter: Reporter
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
        notes=[f"the packs that it speaks of keep it, {result.reason}", *world],
    )


def quick_results(ruleset: Ruleset, proof: float = PROOF) -> list[Result]:
    """Judge each invariant by a proof or a few worlds; a world that breaks an invariant is made small.

    The same rules give the same worlds. `proof`: as in SearchPlan.
    """
    search = InvariantSearch.of(Oracle(ruleset), SearchPlan(QUICK, inf, proof=proof))
    search.try_random()
    return search.finish()


# Worlds made small: fewer steps, rows and columns, fewer things in them
#
# All smaller worlds of one kind are tried in one batch, each with some seeds: where chance decides, another seed often does
# for a smaller world what the first one did for the larger.

SEEDS = 24
"""How many seeds each smaller world is tried with, its own first."""

MAX_BATCH = 1024

RULE = 15_000
"""The cost of a rule in each step of a batch, in cells."""


@dataclass
class Work:
    """Work that is left, counted in cells that rules look at: a limit in seconds would end elsewhere in each run."""

    ruleset: Ruleset
    left: int

    def spend(self, batch: Start, steps: int) -> None:
        rules = 1 + sum(len(substep.rules) for decl in self.ruleset.passes for substep in decl.substeps)
        self.left -= rules * steps * (RULE + batch.ids.size)


Group = Callable[[Start], list[Start]]
"""Makes smaller worlds of one kind."""

Judge = Callable[[Start, int], Array]
"""After which step each world of a sample, run for that number of steps, is accepted: int [B], 0 if it is not."""


def shrink(
    claim: Tested, runs: Runs, sample: Start, steps: int, work: Work, without: frozenset[int]
) -> tuple[Start, int]:
    """The smallest world found that still breaks the claim, and after how many steps. `sample` is one world.

    It ends when no smaller world breaks the claim, or when the work is used up: a claim gives the same world each time.
    Worlds start without the elements `without`.
    """
    tries = 1 if isinstance(claim, Agreement | Alike) or not runs.ruleset.streams else SEEDS
    sample, steps = _later(claim, runs, sample, steps, without)
    sample, steps = shrink_while(
        lambda some, most: breaks(claim, runs, some, most).first, sample, steps, tries, work
    )
    if not runs.ruleset.streams:
        sample = replace(sample, seed=np.zeros_like(sample.seed))
    return sample, steps


def shrink_while(judge: Judge, sample: Start, steps: int, tries: int, work: Work) -> tuple[Start, int]:
    """The smallest world found for which the judge still says yes, and after how many steps.

    Each smaller world is tried with that many seeds, its own first. When the work is used up, the search ends, even if
    something smaller might be found.
    """
    multiple = work.ruleset.side_multiple

    def find(candidates: list[Start]) -> Start | None:
        nonlocal steps
        allowed = [start for start in candidates if all(side % multiple == 0 for side in start.shape)]
        judged = _first(judge, allowed, steps, tries, work) if work.left > 0 else None
        if judged is None:
            return None
        smaller, steps = judged
        return smaller

    sample = smallest(sample, find)
    result = _first(judge, _plain_seed(sample), steps, 1, work) if tries > 1 else None
    return result or (sample, steps)


def smallest(start: Start, find: Callable[[list[Start]], Start | None]) -> Start:
    """The smallest start worlds that can be reached by removing one thing at a time.

    `find`: one of some smaller starts that will do as well, or None.
    """
    while True:
        smaller = start
        for group in _GROUPS:
            while (candidate := find(group(smaller))) is not None:
                smaller = candidate
        if smaller is start:
            return start
        start = smaller


def _later(
    claim: Tested, runs: Runs, sample: Start, steps: int, without: frozenset[int]
) -> tuple[Start, int]:
    """The world as it was one step before it broke the claim, if it does so from there."""
    if is_paired(claim) or steps < 2 or steps_for(claim, steps) > steps:
        return sample, steps
    before = dict(runs.states(sample, steps - 1)[-1])
    late = replace(sample, ids=before.pop("element"), step=sample.step + steps - 1, fields=before)
    other = late.without(without, runs.ruleset)
    same = [np.array_equal(late.ids, other.ids)]
    same += [np.array_equal(values, other.fields[name]) for name, values in late.fields.items()]
    return (late, 1) if all(same) and breaks(claim, runs, late, 1).first.any() else (sample, steps)


def _first(
    judge: Judge, candidates: list[Start], steps: int, tries: int, work: Work
) -> tuple[Start, int] | None:
    """The first of these worlds of one shape that the judge accepts, with the seed that does it soonest."""
    most = max(MAX_BATCH // tries, 1)
    for at in range(0, len(candidates), most):
        some = [
            replace(start, seed=np.array([number - 1])) if number else start
            for start in candidates[at : at + most]
            for number in range(tries)
        ]
        batch = join_starts(some, work.ruleset)
        work.spend(batch, steps)
        first = judge(batch, steps)
        broken = np.nonzero(first)[0]
        if len(broken):
            best = min(broken.tolist(), key=lambda i: (i // tries, first[i], i))
            return some[best], int(first[best])
    return None


# Smaller worlds, in the order in which they are tried


def _single(sample: Start) -> list[Start]:
    """One world of several."""
    return [sample.one(world) for world in range(len(sample))] if len(sample) > 1 else []


def _fresh(sample: Start) -> list[Start]:
    """Worlds with fields, parameters and the clock as in fresh ones: all of them, then one of them."""
    differs = {"fields": sample.fields, "params": sample.params, "step": sample.step.any()}
    usual: dict[str, Any] = {"fields": {}, "params": {}, "step": np.zeros_like(sample.step)}
    parts = [{name: usual[name]} for name in differs if differs[name]]
    together = dict(chain.from_iterable(part.items() for part in parts))
    return [replace(sample, **part) for part in ([together, *parts] if parts else [])]


def _absent_fields(sample: Start) -> list[Start]:
    """Worlds with one field as in fresh cells."""
    return [
        replace(sample, fields={name: values for name, values in sample.fields.items() if name != absent})
        for absent in sample.fields
    ]


def _plain_seed(sample: Start) -> list[Start]:
    """Worlds with a seed that is easy to write."""
    if 0 <= int(sample.seed[0]) < SEEDS:
        return []
    return [replace(sample, seed=np.array([number])) for number in range(SEEDS)]


def _parts(axis: int, halves: bool, sample: Start) -> list[Start]:
    """Worlds with half of the rows (axis 0) or columns (axis 1), or with one less."""
    size = sample.shape[axis]
    if size < (4 if halves else 2):
        return []
    half = size // 2
    if halves:
        rests = [[*range(at, at + half)] for at in range(size - half + 1)]
    else:
        rests = [[at for at in range(size) if at != gone] for gone in range(size - 1, -1, -1)]
    # Rows and columns are the last axes of every array.
    places = [(..., rest, slice(None)) if axis == 0 else (..., rest) for rest in rests]
    return [
        replace(
            sample,
            ids=sample.ids[cells],
            fields={name: values[cells] for name, values in sample.fields.items()},
        )
        for cells in places
    ]


def _fewer_kinds(sample: Start) -> list[Start]:
    """All cells of one element replaced by the lowest that is there."""
    ground = sample.ids.min()
    return [
        replace(sample, ids=np.where(sample.ids == kind, ground, sample.ids))
        for kind in np.unique(sample.ids)
        if kind != ground
    ]


def _fewer_values(sample: Start) -> list[Start]:
    """One cell replaced by the lowest element that is there, or one value of a field by 0."""
    smaller = []
    for name, values in {"": sample.ids, **sample.fields}.items():
        ground = 0 if name else sample.ids.min()
        places = (axis.tolist() for axis in np.nonzero(values != ground))
        for place in zip(*places, strict=True):
            fewer = values.copy()
            fewer[place] = ground
            part = {"fields": {**sample.fields, name: fewer}} if name else {"ids": fewer}
            smaller.append(replace(sample, **part))
    return smaller


_GROUPS: tuple[Group, ...] = (
    _single,
    _fresh,
    partial(_parts, 0, True),
    partial(_parts, 1, True),
    partial(_parts, 0, False),
    partial(_parts, 1, False),
    _fewer_kinds,
    _fewer_values,
    _absent_fields,
)
