"""Judges mutants: by the checker, by the invariants on random worlds, and by the tests of packs.

The original composition is loaded and run once, and mutants are compared with it. Several processes judge.
"""

from __future__ import annotations

import os
import re
import signal
from collections import Counter
from collections.abc import Generator, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache, partial
from itertools import product
from multiprocessing import active_children, get_context, parent_process
from threading import Thread

import numpy as np

from powderdsl.analysis.proofs import horizon
from powderdsl.compiler import lower, read
from powderdsl.diagnostics import CompileError, Diagnostic, Reporter, Severity, Source
from powderdsl.ir.text import print_program
from powderdsl.model.check import check
from powderdsl.model.declarations import PackDecl, RulesetDecl
from powderdsl.model.definitions import set_params
from powderdsl.model.packs import read_file
from powderdsl.model.state import slots
from powderdsl.model.text import one_line
from powderdsl.model.types import Example, Invariant, Local, Ruleset, Symmetric
from powderdsl.simulation.programs import starting_backend
from powderdsl.simulation.simulator import Simulator, compile
from powderdsl.system.fingerprint import fingerprint
from powderdsl.system.interrupts import delay_signal
from powderdsl.testing.generators.cases import Array, Start
from powderdsl.testing.mutation.mutants import Mutant
from powderdsl.testing.mutation.operators import mutants_of
from powderdsl.testing.mutation.written import GENERATED, GeneratedTest, distinguish, written_test
from powderdsl.testing.pack_tests.runner import run_examples
from powderdsl.testing.properties.breaks import breaks, find_breaks, is_paired, steps_for
from powderdsl.testing.properties.running import Runner, State, first_difference, random_samples, run_sample
from powderdsl.testing.properties.search import STEPS

Settings = tuple[tuple[str, str], ...]
"""Parameters and their values as text."""

WORLDS = 1000
"""Random worlds that invariants are tried on, as many as `powderdsl test` tries."""


def is_generated(example: Example) -> bool:
    """True if a test was written by the tool."""
    return example.name.startswith(GENERATED)


@dataclass(frozen=True)
class Batch:
    """Start worlds of one shape `without` some elements; `states`: the original's, at the start and after each step."""

    sample: Start
    steps: int
    without: frozenset[int]
    states: list[State]


@dataclass(eq=False)
class Original:
    """A composition, loaded once for all its mutants."""

    rules: str
    settings: Settings
    packs: list[PackDecl]
    declaration: RulesetDecl | None
    ruleset: Ruleset
    warnings: Counter[str]
    _batches: list[Batch] = field(default_factory=list)

    @classmethod
    def of(cls, rules: str, settings: Settings = ()) -> Original:
        """Load it, with other values for parameters. Raises CompileError."""
        reporter = Reporter()
        packs, declaration = read([rules], reporter)
        reporter.raise_if_errors()
        ruleset = set_params(check(packs, declaration, reporter), dict(settings), reporter)
        reporter.raise_if_errors()
        return cls(rules, settings, packs, declaration, ruleset, warnings_of(reporter.diagnostics))

    def mutants(self, only: frozenset[str] = frozenset()) -> list[Mutant]:
        """The mutants of all packs, or of some, in the order of the packs and their files."""
        return [
            mutant
            for pack in self.packs
            if not only or pack.name.text in only
            for mutant in mutants_of(pack, self.packs)
        ]

    def mutated(self, mutant: Mutant) -> tuple[Ruleset, Counter[str]] | None:
        """The model with the mistake and its warnings. None if its text is no rule file; raises CompileError."""
        reporter = Reporter()
        decl = read_file(Source(mutant.source.name, mutant.text), reporter)
        if reporter.has_errors or not isinstance(decl, PackDecl):
            return None
        packs = [decl if pack.name.text == mutant.pack else pack for pack in self.packs]
        ruleset = set_params(check(packs, self.declaration, reporter), dict(self.settings), reporter)
        reporter.raise_if_errors()
        return ruleset, warnings_of(reporter.diagnostics)

    @cached_property
    def sim(self) -> Simulator:
        return compile(self.ruleset, backend=starting_backend("cpu"))

    @cached_property
    def failing(self) -> frozenset[str]:
        """Names of tests that fail without any mistake: their failing says nothing."""
        return frozenset(
            result.example.name for result in run_examples(self.ruleset, sim=self.sim) if not result.passed
        )

    @cached_property
    def meaning(self) -> str:
        return meaning(self.ruleset)

    @cached_property
    def lowered(self) -> str:
        return lowered(self.ruleset)

    @cached_property
    def withouts(self) -> tuple[frozenset[int], ...]:
        """The sets of elements that invariants leave out; the empty one comes first."""
        return tuple(
            dict.fromkeys([frozenset[int](), *(invariant.without for invariant in self.ruleset.invariants)])
        )

    @cached_property
    def samples(self) -> list[Start]:
        """The worlds that `powderdsl test` tries first."""
        return list(random_samples(self.ruleset, 0, WORLDS))

    @cached_property
    def broken(self) -> list[Invariant]:
        """Invariants that it breaks itself: what more packs change says nothing about a mutant."""
        return [
            invariant
            for invariant in self.ruleset.invariants
            if _is_broken(invariant, self, self.sim)
            or any(_broken_in(batch, self.ruleset, [invariant], batch.states) for batch in self.batches())
        ]

    def batches(self) -> Iterator[Batch]:
        """The samples without each set with the original's states, which are kept: the first use runs them."""
        for place, (number, gone) in enumerate(product(range(len(self.samples)), self.withouts)):
            if place == len(self._batches):
                sample, steps = self.samples[number].without(gone, self.ruleset), STEPS[number % len(STEPS)]
                self._batches.append(Batch(sample, steps, gone, run_sample(self.sim, sample, steps)[0]))
            yield self._batches[place]


def warnings_of(diagnostics: tuple[Diagnostic, ...]) -> Counter[str]:
    """Count the warnings of each code."""
    return Counter(diagnostic.code for diagnostic in diagnostics if diagnostic.severity is Severity.WARNING)


def meaning(ruleset: Ruleset) -> str:
    """A fingerprint of the model: compositions with the same one turn every world into the same."""
    return fingerprint(replace(ruleset, tests=(), invariants=(), about=""))


def lowered(ruleset: Ruleset) -> str:
    """The optimized program as text, with all that it reads: equal texts compute equal worlds."""
    lines = [line.partition("#")[0] for line in print_program(lower(ruleset)).splitlines()]
    fixed = (
        [(e.name, e.id) for e in ruleset.elements],
        [(p.name, p.values, sorted(p.stored)) for p in ruleset.properties],
        [
            (f.name, f.kind, f.default, f.at, f.resets, sorted(f.of) if f.of is not None else None)
            for f in ruleset.fields
        ],
        [(p.name, p.kind, p.default) for p in ruleset.params],
    )
    return "\n".join([*lines, repr(fixed)])


# Verdicts

NOTICED = ("check", "invariant", "test", "generated")
"""The checks that may notice a mutant. `test`: tests written by hand; the quick ones run before invariants."""

AT_ONCE = "torch"
"""Runs the quick tests and the random worlds, which have many widths: others compile for each width."""

FEW_STEPS = 20
"""Tests of at most this many steps run before longer ones."""

PAIRED = 6
"""Batches on which invariants are tried that need more than one run of a world."""


@dataclass(frozen=True)
class Verdict:
    """The verdict on a mutant.

    `status` is ``killed``, ``survived``, ``equivalent`` (the same model or program) or ``invalid`` (not a rule file); `by`
    is one of NOTICED or what is the same; `detail` is a code, an invariant's words or a test's name. `test` shows a survivor, by a world
    that differs in the slot `differs_in`.
    """

    status: str
    by: str = ""
    detail: str = ""
    differs_in: str | None = None
    test: GeneratedTest | None = None


def judge(original: Original, mutant: Mutant) -> Verdict:
    """Hold a mutant against everything that its composition says about itself, cheapest first."""
    try:
        mutated = original.mutated(mutant)
    except CompileError as error:
        return Verdict("killed", "check", error.diagnostics[0].code)
    if mutated is None:
        return Verdict("invalid")
    ruleset, warnings = mutated
    new = warnings - original.warnings
    if new:
        return Verdict("killed", "check", min(new))
    if meaning(ruleset) == original.meaning:
        return Verdict("equivalent", "the same model")
    sim = compile(ruleset, backend=AT_ONCE)
    failed = failed_test(original, sim, mutant.pack, quick=True)
    if failed is None:
        broken = broken_invariant(original, sim)
        if broken is not None:
            return Verdict("killed", "invariant", one_line(broken.span))
        sim = compile(ruleset, backend=starting_backend("cpu"))
        failed = failed_test(original, sim, mutant.pack, quick=False)
    if failed is not None:
        by = "generated" if is_generated(failed) else "test"
        return Verdict("killed", by, f"{failed.pack}: {failed.name}")
    if lowered(ruleset) == original.lowered:  # after the tests: few mutants come this far
        return Verdict("equivalent", "the same program")
    return Verdict("survived")


# Tests


def failed_test(original: Original, sim: Simulator, pack: str, *, quick: bool) -> Example | None:
    """A test that the original passes and the mutant fails: one written by hand, if there is one.

    `quick`: only tests that cost less than invariants; otherwise only the others. Exact ones run before counted ones,
    each of which runs many worlds, those of the mutated pack before others, short ones before long ones.
    """

    def cost(example: Example) -> tuple[bool, bool, bool, bool]:
        return is_generated(example), bool(example.often), example.steps > FEW_STEPS, example.pack != pack

    for example in sorted(sim.ruleset.tests, key=cost):
        if (not any(cost(example)[:3])) == quick and example.name not in original.failing:
            alone = replace(example, scope=())  # which added packs make a test fail does not matter here
            (result,) = run_examples(replace(sim.ruleset, tests=(alone,)), sim=sim)
            if not result.passed:
                return example
    return None


# Invariants


def broken_invariant(original: Original, sim: Simulator) -> Invariant | None:
    """An invariant of the mutant that some world breaks.

    Worlds that end as in the original are skipped, unless elements have other properties or tags.
    """
    ruleset = sim.ruleset
    alike = _declared(ruleset) == _declared(original.ruleset)
    broken_before = {invariant.span.text for invariant in original.broken}
    invariants = [invariant for invariant in ruleset.invariants if invariant.span.text not in broken_before]
    params = [[param.name for param in rules.params] for rules in (original.ruleset, ruleset)]
    comparable = slots(original.ruleset) == slots(ruleset) and params[0] == params[1]
    for batch in original.batches() if invariants and comparable else ():
        states, _ = run_sample(sim, batch.sample, batch.steps)
        differs = first_difference(batch.states, states) > 0
        broken = _broken_in(batch, ruleset, invariants, states, differs if alike else None)
        if broken is not None:
            return broken
    return next((invariant for invariant in invariants if _is_broken(invariant, original, sim)), None)


def _declared(ruleset: Ruleset) -> tuple[object, ...]:
    """Properties and tags of elements: conditions read them, and no world holds them."""
    return (
        [(prop.name, prop.values) for prop in ruleset.properties],
        [(element.name, element.tags) for element in ruleset.elements],
    )


def _is_broken(invariant: Invariant, original: Original, sim: Simulator) -> bool:
    """True if some world breaks an invariant that compares several runs."""
    ruleset, claim = sim.ruleset, invariant.claim
    if not is_paired(claim) or (isinstance(claim, Local) and horizon(ruleset) <= claim.radius):
        return False
    if isinstance(claim, Symmetric) and ruleset.streams:
        return False  # the same draws may be used in another way, and frequencies take thousands of worlds
    runs = Runner(ruleset, sim=sim)
    samples = (sample.without(invariant.without, ruleset) for sample in original.samples[:PAIRED])
    return any(bool(breaks(claim, runs, sample, 1).first.any()) for sample in samples)


def _broken_in(
    batch: Batch,
    ruleset: Ruleset,
    invariants: list[Invariant],
    states: list[State],
    asked: Array | None = None,
) -> Invariant | None:
    """The first of some invariants of one run that a world breaks; only those `asked`, bool [B], if that is given."""
    sample = batch.sample
    if asked is not None:
        sample = sample.select(asked)
        states = [{name: values[asked] for name, values in state.items()} for state in states]
    for invariant in invariants if len(sample) else ():
        fits = invariant.without == batch.without and steps_for(invariant.claim, batch.steps) <= batch.steps
        if (
            fits
            and not is_paired(invariant.claim)
            and find_breaks(invariant.claim, ruleset, sample, states).first.any()
        ):
            return invariant
    return None


# Campaigns

COUNTED = ("mutants", "equivalent", "killed", *NOTICED, "survived")
"""Keys of a tally. `killed` is the sum of what noticed them; texts that are not rule files are not counted."""


def sampled(mutants: list[Mutant], most: int | None, seed: int) -> list[int]:
    """Places of at most `most` mutants, each pack and kind of mistake in proportion, the same for the same seed."""
    strata: dict[tuple[str, str], list[int]] = {}
    for number, mutant in enumerate(mutants):
        strata.setdefault((mutant.pack, mutant.operator), []).append(number)
    random = np.random.default_rng(seed)
    ranked: list[tuple[float, int]] = []
    for numbers in strata.values():
        shares = (np.arange(len(numbers)) + random.random()) / len(numbers)
        ranked += zip(shares.tolist(), random.permutation(numbers).tolist(), strict=True)
    return sorted(number for _, number in sorted(ranked)[:most])


def run_campaign(
    rules: str,
    packs: tuple[str, ...],
    numbers: list[int],
    jobs: int,
    seed: int,
    worlds: bool = True,
    settings: Settings = (),
) -> Generator[tuple[int, Verdict]]:
    """Yield numbers of mutants with their verdicts as they are judged.

    Nothing is cut short by a clock: `check` and searches end by work, so verdicts are the same on a slow or busy machine.

    Args:
        numbers: places of the mutants among those of `Original.mutants`.
        worlds: look for a world that shows each survivor.
        settings: other values for parameters.

    Raises:
        OSError: a process was killed, as where memory is short.
    """
    _loaded.cache_clear()  # files may have changed since
    judged = partial(work, rules, settings, packs, seed, worlds)
    if jobs == 1:
        yield from map(judged, numbers)
        return
    # A fork of a process with threads of torch's may hang.
    pool = ProcessPoolExecutor(jobs, get_context("spawn"), _begin_process)
    try:
        with delay_signal():  # a process whose start is cut short ends with a traceback
            results = [pool.submit(judged, number) for number in numbers]
        for result in as_completed(results):
            yield result.result()
    except BrokenProcessPool:
        raise OSError("a process that judged mutants was killed; fewer `--jobs` need less memory") from None
    finally:
        for process in active_children():
            process.terminate()
        pool.shutdown(cancel_futures=True)


def _begin_process() -> None:
    """Ignore Ctrl-C, which is for the process that started this one, and end when that ends."""
    parent = parent_process()
    assert parent is not None

    def end_with_parent() -> None:
        parent.join()
        os._exit(1)

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    Thread(target=end_with_parent, daemon=True).start()


@lru_cache(maxsize=1)
def _loaded(rules: str, settings: Settings, packs: tuple[str, ...]) -> tuple[Original, list[Mutant]]:
    original = Original.of(rules, settings)
    return original, original.mutants(frozenset(packs))


def work(
    rules: str, settings: Settings, packs: tuple[str, ...], seed: int, worlds: bool, number: int
) -> tuple[int, Verdict]:
    """Judge the mutant of this number among all of a composition."""
    original, mutants = _loaded(rules, settings, packs)
    mutant = mutants[number]
    verdict = judge(original, mutant)
    if verdict.status != "survived" or not worlds:
        return number, verdict
    mutated = original.mutated(mutant)
    assert mutated is not None
    sim = compile(mutated[0], backend=starting_backend("cpu"))
    world = distinguish(original.sim, sim, focused(original, mutant), seed)
    if world is None:
        return number, verdict
    test = written_test(mutant, world, original.sim, original.packs)
    return number, replace(verdict, differs_in=world.slot, test=test)


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


def tally(verdicts: Iterable[Verdict]) -> dict[str, int]:
    """Numbers of mutants by COUNTED."""
    valid = [verdict for verdict in verdicts if verdict.status != "invalid"]
    counts = Counter(verdict.status for verdict in valid)
    counts += Counter(verdict.by for verdict in valid if verdict.status == "killed")
    return {key: counts[key] for key in COUNTED} | {"mutants": len(valid)}


def noticed_share(counts: dict[str, int]) -> float:
    """The share of noticed mutants among those that are not equivalent; 1 if there are none."""
    different = counts["mutants"] - counts["equivalent"]
    return counts["killed"] / different if different else 1.0


def handwritten_share(counts: dict[str, int]) -> float:
    """Of the mutants that invariants and tests notice, the part that those written by hand notice; 1 if there are none."""
    tested = counts["invariant"] + counts["test"] + counts["generated"]
    return (tested - counts["generated"]) / tested if tested else 1.0
