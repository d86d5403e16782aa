"""Judges mutants: by the checker, by the invariants on random worlds, and by the tests of packs.

The original composition is loaded and run once, and mutants are compared with it. Several processes judge.
"""

from __future__ import annotations

import hashlib
import os
import re
import signal
from collections import Counter
from collections.abc import Collection, Generator, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache, partial
from itertools import cycle
from math import inf
from multiprocessing import active_children, get_context, parent_process
from pathlib import Path
from string import ascii_letters
from textwrap import indent
from threading import Thread
from typing import Any

import numpy as np

from powderdsl.analysis.proofs import horizon
from powderdsl.compiler import lower, read
from powderdsl.diagnostics import CompileError, Diagnostic, Reporter, Severity, Source
from powderdsl.ir.text import structure
from powderdsl.model.check import check
from powderdsl.model.composition.names import needs_of, with_stand_ins
from powderdsl.model.declarations import PackDecl, RulesetDecl, read_file
from powderdsl.model.definitions import set_params
from powderdsl.model.text import show_value
from powderdsl.model.types import Element, Example, Local, Ruleset, Symmetric
from powderdsl.simulation.programs import starting_backend
from powderdsl.simulation.simulator import Simulator, World, compile
from powderdsl.syntax.yaml_tree import Mapping as YamlMapping
from powderdsl.syntax.yaml_tree import Sequence as YamlSequence
from powderdsl.syntax.yaml_tree import parse_yaml
from powderdsl.system import cache
from powderdsl.system.cache import Memo
from powderdsl.system.interrupts import delay_signal
from powderdsl.system.writing import write_text
from powderdsl.testing.mutation.operators import Mutant, mutants_of
from powderdsl.testing.pack_tests.runner import ANYTHING, SEEDS, field_rows, run_examples
from powderdsl.testing.properties.comparison import Distinction, compare
from powderdsl.testing.properties.outcomes import Property, Result
from powderdsl.testing.properties.running import Runner, random_samples, run_sample
from powderdsl.testing.properties.search import FEW, STEPS, InvariantSearch, SearchPlan

Settings = tuple[tuple[str, str], ...]
"""Parameters and their values as text."""


@dataclass(eq=False)
class Original:
    """A composition, loaded once for all its mutants."""

    rules: str
    settings: Settings
    packs: list[PackDecl]
    declaration: RulesetDecl | None
    ruleset: Ruleset
    warnings: Counter[str]
    memo: Memo = field(default_factory=Memo)

    @classmethod
    def of(cls, rules: str, settings: Settings = ()) -> Original:
        """Load it, with other values for parameters. Raises CompileError."""
        reporter = Reporter()
        packs, declaration = read([rules], reporter)
        reporter.raise_if_errors()
        ruleset = set_params(check(packs, declaration, reporter), dict(settings), reporter)
        reporter.raise_if_errors()
        return cls(rules, settings, packs, declaration, ruleset, warnings_of(reporter.diagnostics))

    @lru_cache(maxsize=64)  # noqa: B019
    def parts(self, pack: str) -> list[Original]:
        """Smaller compositions, in which most tests of a pack run sooner: it with what it needs, and with what they name."""
        needs = needs_of(with_stand_ins(self.packs))
        homes = {element.name: element.pack for element in self.ruleset.elements}
        named, loaded = set[str](), []
        for test in self.ruleset.tests:
            if test.pack == pack:
                drawn = "".join((*test.given, *(test.expect or ())))
                named |= {homes[name] for glyph, name in test.legend if glyph in drawn}
        some = {frozenset(needs[pack]), frozenset(needs[pack]).union(*map(needs.__getitem__, named))}
        for names in sorted(some - {frozenset(needs)}, key=len):
            files = (decl.source.name for decl in self.packs if decl.name.text in names)
            with suppress(CompileError):  # as where a setting is another pack's
                loaded.append(Original.of("+".join(files), self.settings))
        return loaded

    def mutants(self, only: frozenset[str] = frozenset()) -> list[Mutant]:
        """The mutants of all packs, or of some, in the order of the packs and their files."""
        packs = [pack for pack in self.packs if not only or pack.name.text in only]
        return [mutant for pack in packs for mutant in mutants_of(pack, self.packs)]

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
        """Runs it. Simulators of mutants are made from it, and compile only the passes that differ."""
        return compile(self.ruleset, starting_backend("cpu"), tensors=False, memo=self.memo)

    @lru_cache(maxsize=1000)  # noqa: B019
    def holds(self, name: str) -> bool:
        """True if the tests of a name pass without any mistake: if they do not, their failing says nothing."""
        tests = tuple(test for test in self.ruleset.tests if test.name == name)
        return all(result.passed for result in run_examples(replace(self.ruleset, tests=tests), sim=self.sim))

    @cached_property
    def meaning(self) -> tuple[object, object]:
        return meaning_of(self.ruleset, self.memo)

    @cached_property
    def broken(self) -> frozenset[str]:
        """The words of invariants that it breaks itself: what more packs change says nothing about a mutant."""
        search = invariant_trials(self.sim)
        search.try_random()
        return frozenset(trial.prop.text for trial in search.trials if trial.sample is not None)


def warnings_of(diagnostics: tuple[Diagnostic, ...]) -> Counter[str]:
    return Counter(diagnostic.code for diagnostic in diagnostics if diagnostic.severity is Severity.WARNING)


def meaning_of(ruleset: Ruleset, memo: Memo) -> tuple[object, object]:
    """Everything that decides how a composition behaves, and what its tests and invariants say of that."""
    program, values = lower(ruleset, memo), [prop.values for prop in ruleset.properties]
    passes = [structure(pass_, places=False) for pass_ in program.passes]
    parts = program.slots, program.params, [p.default for p in ruleset.params], program.streams, passes
    return parts, (ruleset.invariants, ruleset.tests, values)


# Verdicts

NOTICED = ("check", "invariant", "test", "generated")
"""The checks that may notice a mutant. `test`: tests written by hand; most run before invariants."""

PROOF = 30.0
"""Seconds of work, counted, for a proof that a mutant is equal, of the passes that it changes."""

PAIRED = 6
"""Batches of worlds on which invariants are tried that compare several runs."""


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


def judge(original: Original, mutant: Mutant, seed: int = 0) -> Verdict:
    """Hold a mutant against all that its composition says about itself, cheapest first: tests run in parts of it before."""
    for part in original.parts(mutant.pack):
        with suppress(CompileError):  # it may be about another pack
            mutated = part.mutated(mutant)
            if not mutated or mutated[1] - part.warnings or meaning_of(mutated[0], part.memo) == part.meaning:
                break
            if failed := failed_test(part, part.sim.of(mutated[0]), mutant.pack, 0, 1):
                return failed
    try:
        mutated = original.mutated(mutant)
    except CompileError as error:
        return Verdict("killed", "check", error.diagnostics[0].code)
    if mutated is None:
        return Verdict("invalid")
    ruleset, warnings = mutated
    if new := warnings - original.warnings:
        return Verdict("killed", "check", min(new))
    meaning = meaning_of(ruleset, original.memo)
    if meaning == original.meaning:
        return Verdict("equivalent", "the same program")
    sim, focus = original.sim.of(ruleset), focused(original, mutant)
    if failed := failed_test(original, sim, mutant.pack, 0):
        return failed
    comparison = compare(original.sim, sim, PROOF, focus, seed)
    distinction = comparison.distinction
    if meaning[1] == original.meaning[1] and comparison.status == "equal":
        return Verdict("equivalent", "a proof")
    if failed := failed_test(original, sim, mutant.pack, 1):
        return failed
    # What runs many worlds notices nothing where the comparison, which runs more, has found none.
    if (distinction or meaning[1] != original.meaning[1]) and (broken := broken_invariant(original, sim)):
        return Verdict("killed", "invariant", broken.text)
    if distinction is None:
        return Verdict("equivalent", "a proof") if comparison.status == "equal" else Verdict("survived")
    if failed := failed_test(original, sim, mutant.pack, 2):
        return failed
    shown = not distinction.draws  # a test needs a seed
    test = written_test(mutant, distinction, original.sim, original.packs) if shown else None
    return Verdict("survived", differs_in=distinction.slot, test=test)


# Tests


def failed_test(original: Original, sim: Simulator, pack: str, *phases: int) -> Verdict | None:
    """The verdict of the first test of some phases that the original passes and the mutant fails, or None.

    Phase 0 has the mutated pack's tests, which fail most often; phase 1 those of other packs, and phase 2 those that
    the tool has written and those of other packs that count, each of which runs many worlds.
    """

    def cost(example: Example) -> tuple[int, bool, bool, int]:
        counted, other = bool(example.often), example.pack != pack
        late = example.name.startswith(GENERATED) or (counted and other)
        return 2 if late else int(other), example.name.startswith(GENERATED), counted, example.steps

    for example in sorted(sim.ruleset.tests, key=cost):
        if cost(example)[0] in phases:
            alone = replace(example, scope=())  # which added packs make a test fail does not matter here
            (result,) = run_examples(replace(sim.ruleset, tests=(alone,)), sim=sim)
            if not result.passed and original.holds(example.name):
                by = "generated" if example.name.startswith(GENERATED) else "test"
                return Verdict("killed", by, f"{example.pack}: {example.name}")
    return None


# Invariants


def invariant_trials(sim: Simulator, without: Collection[str] = ()) -> InvariantSearch:
    """A search that tries all invariants, proven or not, on the worlds that `powderdsl test` tries first.

    `without`: the words of those to leave out. What follows from the reach of rules is not tried. Nor are mirrors of
    rules that draw: mirrored worlds may then only be alike in thousands of runs.
    """
    ruleset, trials = sim.ruleset, []
    for prop in map(Property.of, ruleset.invariants):
        claim = prop.claim
        holds = isinstance(claim, Local) and horizon(ruleset) <= claim.radius
        drawn = isinstance(claim, Symmetric) and ruleset.streams
        if not holds and not drawn and prop.text not in without:
            trials.append(Result(prop))
    few = {**FEW, Local: PAIRED, Symmetric: PAIRED}
    return InvariantSearch(Runner(ruleset, sim=sim), SearchPlan(seconds=inf), trials, few)


def broken_invariant(original: Original, sim: Simulator) -> Property | None:
    """An invariant of the mutant that some random world breaks."""
    search = invariant_trials(sim, original.broken)
    samples = random_samples(sim.ruleset, search.plan.seed, search.plan.examples) if search.trials else ()
    for sample, steps in zip(samples, cycle(STEPS), strict=False):
        search.try_sample(sample, steps)
        for trial in search.trials:
            if trial.sample is not None:
                return trial.prop
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
    settings: Settings = (),
) -> Generator[tuple[int, Verdict]]:
    """Yield numbers of mutants with their verdicts as they are judged.

    Nothing is cut short by a clock: `check` and searches end by work, so verdicts are the same on a slow or busy machine.

    Args:
        numbers: places of the mutants among those of `Original.mutants`.
        settings: other values for parameters.

    Raises:
        OSError: a process was killed, as where memory is short.
    """
    _loaded.cache_clear()  # files may have changed since
    judged = partial(work, rules, settings, packs, seed)
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
    cache.STORED = False  # no mutant is compiled twice
    Thread(target=end_with_parent, daemon=True).start()


@lru_cache(maxsize=1)
def _loaded(rules: str, settings: Settings, packs: tuple[str, ...]) -> tuple[Original, list[Mutant]]:
    original = Original.of(rules, settings)
    return original, original.mutants(frozenset(packs))


def work(
    rules: str, settings: Settings, packs: tuple[str, ...], seed: int, number: int
) -> tuple[int, Verdict]:
    """Judge the mutant of this number among all of a composition."""
    original, mutants = _loaded(rules, settings, packs)
    return number, judge(original, mutants[number], seed)


def focused(original: Original, mutant: Mutant) -> tuple[int, ...]:
    """Elements that a mutant is likely to be about: its lines name them, one of their tags or a set."""
    words = set(re.findall(r"\w+", mutant.diff))
    tags = words & {tag.name.text for pack in original.packs for tag in pack.tags}
    return tuple(
        element.id
        for element in original.ruleset.elements
        if element.name in words or element.tags & tags or element.pack == mutant.pack
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


# A world on which a mutant differs, as a test that can be pasted into the pack, and put there with all else kept

GENERATED = "generated "
"""How names of tests begin that the tool has written: they are counted apart from those written by hand."""


@dataclass(frozen=True)
class GeneratedTest:
    """A test of a pack. `text` is an item of `tests:` without indentation."""

    pack: str
    name: str
    text: str


def written_test(
    mutant: Mutant, distinction: Distinction, sim: Simulator, packs: Sequence[PackDecl]
) -> GeneratedTest:
    """The test that the original passes and the mutant fails. `sim` runs the original.

    A test names no seed if the original does the same with all that a test runs with by itself.
    """
    ruleset = sim.ruleset
    seed: int | None = int(distinction.sample.seed[0])
    others = replace(distinction.sample.repeated(len(SEEDS)), seed=np.array(SEEDS, np.int64))
    after = run_sample(sim, others, distinction.steps)[0][-1][distinction.slot]
    if seed in SEEDS and (after == distinction.first[distinction.slot]).all():
        seed = None
    before, wanted = distinction.sample.ids[0], distinction.first["element"][0]
    there = [e for e in ruleset.elements if e.id in np.unique([*before.ravel(), *wanted.ravel()])]
    needed = needs_of(with_stand_ins(packs))[mutant.pack]
    homes = {p.name: p.pack for p in ruleset.properties} | {f.name: f.pack for f in ruleset.fields}
    maybe = {name: "?" * (pack not in needed) for name, pack in homes.items()}
    glyphs, legend = _legend(there, ruleset, packs, needed)
    digest = hashlib.sha256(re.sub(r":\d+", "", mutant.key).encode()).hexdigest()[:6]
    title = f"{GENERATED}{digest} against {mutant.operator} in {_where(mutant)}"
    lines = [f"- {title}:"]
    if legend:
        quoted = [(glyph if glyph.isalpha() else f'"{glyph}"', element) for glyph, element in legend]
        items = ", ".join(f"{glyph}: {element}" for glyph, element in quoted)
        lines.append(f"    legend: {{{items}}}")
    lines += ["    given: |", *_drawn(before, glyphs)]
    start = run_sample(sim, distinction.sample, 0)[1]
    usual = sim.world(distinction.sample.ids)
    for name in distinction.sample.fields:
        words = _words(name, start, usual.state[name][0], start.state[name][0], ".")
        if words:
            lines += ["    fields:"] if "    fields:" not in lines else []
            lines += [f"      {name}{maybe[name]}: |", *words]
    values = {
        param: distinction.sample.params.get(param.name, [param.default])[0] for param in ruleset.params
    }
    sets = [
        f"{param.name}{'?' * (param.name.partition('.')[0] not in needed)}: {show_value(ruleset, param.kind, float(value))}"
        for param, value in values.items()
        if float(value) != float(param.default)
    ]
    lines += [f"    params: {{{', '.join(sets)}}}"] if sets else []
    lines.append(f"    after: {distinction.steps} step{'' if distinction.steps == 1 else 's'}")
    if distinction.slot == "element":
        lines += ["    expect: |", *_drawn(wanted, glyphs)]
    else:
        end = run_sample(sim, distinction.sample, distinction.steps)[1]
        slot = distinction.slot
        words = _words(slot, end, distinction.first[slot][0], distinction.second[slot][0], ANYTHING)
        lines += ["    expect_fields:", f"      {slot}{maybe[slot]}: |", *words]
    if seed is not None:
        lines.append(f"    seed: {seed}")
    return GeneratedTest(mutant.pack, title, "\n".join(lines) + "\n")


def _words(field: str, world: World, first: Any, second: Any, filler: str) -> list[str]:
    """A drawing of a field, with a filler for cells in which two worlds have the same; empty if all have."""
    same = np.asarray(first == second)
    same = np.asarray(same.all(0)) if same.ndim == 3 else same
    rows = [row.split() for row in field_rows(field, world, 0)]
    rows_ = [[filler if same[y, x] else word for x, word in enumerate(words)] for y, words in enumerate(rows)]
    return [] if same.all() else ["        " + " ".join(words) for words in rows_]


def _drawn(ids: np.ndarray, glyphs: dict[int, str]) -> list[str]:
    return ["      " + " ".join(glyphs[number] for number in row) for row in ids.tolist()]


def _where(mutant: Mutant) -> str:
    """The words that were changed, as far as a name of a test can hold them."""
    old = " ".join(mutant.source.text[mutant.change.start : mutant.change.end].split())
    words = re.sub(r"[^A-Za-z0-9_ .<>=+*/()%-]", " ", old or mutant.pack)
    return " ".join(words.split())[:40].strip(" -") or mutant.pack


def _legend(
    there: Sequence[Element], ruleset: Ruleset, packs: Sequence[PackDecl], needed: Collection[str]
) -> tuple[dict[int, str], list[tuple[str, str]]]:
    """A character for each element, and those that a legend must explain.

    Characters that packs choose themselves are known wherever these are loaded; all others depend on what else is
    loaded. Elements of packs that this one does not need may be absent: the test then waits.
    """
    chosen = {f"{pack.name.text}.{decl.name.text}" for pack in packs for decl in pack.elements if decl.glyph}
    known = {e.qualified: e.glyph for e in ruleset.elements if e.pack in needed and e.qualified in chosen}
    glyphs: dict[int, str] = {}
    legend = []
    for element in sorted(there, key=lambda element: element.qualified not in known):
        if element.qualified in known and element.glyph not in glyphs.values():
            glyphs[element.id] = element.glyph
            continue
        taken = {*glyphs.values(), *known.values(), *"?\"'\\#"}
        wanted = [element.glyph, *element.name, *element.name.upper(), *ascii_letters]
        glyphs[element.id] = next(glyph for glyph in wanted if glyph not in taken)
        legend.append((glyphs[element.id], element.name if element.pack in needed else f"{element.name}?"))
    return glyphs, legend


def with_tests(source: Source, tests: Sequence[GeneratedTest]) -> str:
    """A pack's text with more tests at the end of its `tests:`; comments and all else stay as they are.

    Raises ValueError if `tests:` is written in a way that nothing can be added to, as in `tests: [...]`.
    """
    root = parse_yaml(source, Reporter())
    text = source.text if source.text.endswith("\n") or not source.text else source.text + "\n"
    node = root.get("tests") if isinstance(root, YamlMapping) else None
    if node is None:
        return text + "tests:\n" + indent("".join(test.text for test in tests), "  ")
    if not isinstance(node, YamlSequence) or source.text[node.span.start] == "[":
        raise ValueError(f"{source.name}: `tests:` is not a list with a line for each test")
    first = source.text.rfind("\n", 0, node.span.start) + 1
    margin = " " * (len(source.text[first:]) - len(source.text[first:].lstrip(" ")))
    # The list ends before the next key of the file, or at its end; blank lines and comments between stay below it.
    following = [key.span.start for key, _ in root.entries if key.span.start > node.span.start]  # type: ignore[union-attr]
    end = min(following, default=len(text))
    lines = text[:end].splitlines(keepends=True)
    while lines and (not lines[-1].strip() or lines[-1].startswith("#")):
        end -= len(lines.pop())
    return text[:end] + indent("".join(test.text for test in tests), margin) + text[end:]


def add_tests(path: Path, tests: Sequence[GeneratedTest]) -> None:
    """Write more tests into a pack's file, whole or not at all."""
    path = path.resolve()
    write_text(path, with_tests(Source(str(path), path.read_text(encoding="utf-8")), tests))
