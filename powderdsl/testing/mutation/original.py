"""A composition as it is, which mutants are held against: its warnings, its tests, and what becomes of many worlds."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from powderdsl.compiler import lower, read, starting_backend
from powderdsl.diagnostics import Diagnostic, Reporter, Severity, Source
from powderdsl.ir.text import print_program
from powderdsl.model.check import check
from powderdsl.model.declarations import PackDecl, RulesetDecl
from powderdsl.model.fingerprint import fingerprint
from powderdsl.model.packs import read_file
from powderdsl.model.parameter_values import set_params
from powderdsl.model.types import Example, Ruleset
from powderdsl.simulation.simulator import Simulator, compile
from powderdsl.testing.generators.cases import Start
from powderdsl.testing.mutation.mutants import Mutant
from powderdsl.testing.mutation.operators import mutants_of
from powderdsl.testing.pack_tests.runner import run_examples
from powderdsl.testing.properties.running import run_sample
from powderdsl.testing.properties.samples import State, joined, random_samples
from powderdsl.testing.properties.search import STEPS

Settings = tuple[tuple[str, str], ...]
"""Parameters and their values as text."""

WORLDS = 1000
"""Random worlds that invariants are tried on, as many as `powderdsl test` tries."""

GENERATED = "generated "
"""How names of tests begin that the tool has written: they are counted apart from those written by hand."""


class Invalid(Exception):
    """A text that is not a rule file: a mistake of spelling, not of meaning."""


def is_generated(example: Example) -> bool:
    """Whether a test was written by the tool."""
    return example.name.startswith(GENERATED)


@dataclass(frozen=True)
class Batch:
    """Start worlds of one shape, several times: once for each set of elements that some invariant leaves out.

    `states` are the original's, at the start and after each step; `group` [B] says which set is left out.
    """

    sample: Start
    steps: int
    group: np.ndarray
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

    def mutated(self, mutant: Mutant) -> tuple[Ruleset, Counter[str]]:
        """The model with the mistake and its warnings. Raises CompileError; Invalid if it cannot even be read."""
        reporter = Reporter()
        decl = read_file(Source(mutant.source.name, mutant.text), reporter)
        if reporter.has_errors or not isinstance(decl, PackDecl):
            raise Invalid
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
            one.example.name for one in run_examples(self.ruleset, sim=self.sim) if not one.passed
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
        return tuple(dict.fromkeys([frozenset[int](), *(one.without for one in self.ruleset.invariants)]))

    @cached_property
    def samples(self) -> list[Start]:
        """The worlds that `powderdsl test` tries first."""
        return list(random_samples(self.ruleset, 0, WORLDS))

    def batches(self) -> Iterator[Batch]:
        """The samples with the original's states, which are kept: the first use runs them."""
        for number, sample in enumerate(self.samples):
            if number == len(self._batches):
                some = [sample.without(gone, self.ruleset) for gone in self.withouts]
                whole = joined(some, self.ruleset)
                steps = STEPS[number % len(STEPS)]
                states, _ = run_sample(self.sim, whole, steps)
                group = np.repeat(np.arange(len(some)), len(sample))
                self._batches.append(Batch(whole, steps, group, states))
            yield self._batches[number]


def warnings_of(diagnostics: tuple[Diagnostic, ...]) -> Counter[str]:
    """How often each warning is given, by code."""
    return Counter(one.code for one in diagnostics if one.severity is Severity.WARNING)


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
