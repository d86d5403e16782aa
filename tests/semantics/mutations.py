"""Puts the mistakes of tests/mutations.yaml into the shipped packs, one at a time, and says what notices them."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import yaml

import powderdsl
from powderdsl.analysis.ledger import ledger
from powderdsl.compiler import load_with_diagnostics
from powderdsl.diagnostics import CompileError, Diagnostic, Severity
from powderdsl.model.text import one_line
from powderdsl.model.types import Ruleset
from powderdsl.testing.pack_tests.runner import run_examples
from powderdsl.testing.properties.refute import quick_results

ROOT = Path(__file__).resolve().parents[2]
RULES = ROOT / "rules"


@dataclass(frozen=True)
class Mutation:
    """One text of a pack replaced by another, and what notices it.

    `check` is a code, for PD512 with the invariant after a colon; `test` is how the name of a pack's test begins.
    """

    pack: str
    mistake: str
    before: str
    after: str
    check: str = ""
    test: str = ""

    @property
    def rules(self) -> str:
        """The ruleset that the pack is tried in: the one it belongs to, or the pack alone."""
        return "powderworld" if self.pack in paper_packs() else self.pack


@dataclass(frozen=True)
class Caught:
    """What noticed a mutation: `codes` of the checker, or `tests` of packs; (rows, columns, steps) of a world shown."""

    codes: tuple[str, ...] = ()
    tests: tuple[str, ...] = ()
    size: tuple[int, int, int] | None = None


@cache
def paper_packs() -> tuple[str, ...]:
    return powderdsl.load("powderworld").packs


def mutations() -> list[Mutation]:
    rows = yaml.load((ROOT / "tests" / "mutations.yaml").read_text(encoding="utf-8"), yaml.CBaseLoader)
    return [
        Mutation(
            row["pack"], row["mistake"], row["from"], row["to"], row.get("check", ""), row.get("test", "")
        )
        for row in rows
    ]


def diagnosed(path: Path) -> tuple[Ruleset | None, tuple[Diagnostic, ...]]:
    try:
        return load_with_diagnostics(path)
    except CompileError as error:
        return None, error.diagnostics


def try_mutation(mutation: Mutation, folder: Path) -> Caught:
    """Load the mutated rules, then try their invariants as `powderdsl check` does, or run their tests.

    Of the invariants and tests only those run that are expected to notice, for they take most of the time.
    """
    ruleset, remarks = diagnosed(mutated(mutation, folder) / f"{mutation.rules}.yaml")
    codes = tuple(sorted({one.code for one in remarks if one.severity is not Severity.NOTE}))
    statement = mutation.check.partition(": ")[2]
    if codes or ruleset is None:
        return Caught(codes)
    if mutation.test:
        named = tuple(one for one in ruleset.tests if one.name.startswith(mutation.test))
        results = run_examples(replace(ruleset, tests=named))
        return Caught((), tuple(result.example.name for result in results if not result.passed))
    some = tuple(one for one in ruleset.invariants if not statement or one_line(one.span) == statement)
    broken = quick_results(replace(ruleset, invariants=some), ledger(ruleset))
    worlds = [one.counterexample for one in broken if one.counterexample and not one.holds]
    sizes = [(*world.sample.shape, world.steps) for world in worlds]
    return Caught(("PD512",), (), sizes[0]) if sizes else Caught()


def mutated(mutation: Mutation, folder: Path) -> Path:
    """A copy of the shipped rules with the mistake in it."""
    rules = folder / "rules"
    shutil.copytree(RULES, rules)
    path = rules / f"{mutation.pack}.yaml"
    text = path.read_text(encoding="utf-8")
    assert text.count(mutation.before) == 1, f"{mutation.mistake}: {text.count(mutation.before)} places"
    path.write_text(text.replace(mutation.before, mutation.after), encoding="utf-8")
    return rules
