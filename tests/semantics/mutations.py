"""Puts the mistakes of tests/mutations.yaml into the shipped packs, one at a time, and says what notices them."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import yaml

import powderdsl
from powderdsl.compiler import load_with_diagnostics
from powderdsl.diagnostics import CompileError, Diagnostic, Severity
from powderdsl.model.types import Ruleset
from powderdsl.pack_tests import run_examples
from powderdsl.properties.running import Runner
from powderdsl.properties.search import Plan, Search

ROOT = Path(__file__).resolve().parents[2]
RULES = ROOT / "rules"


@dataclass(frozen=True)
class Mutation:
    """One text of a pack replaced by another; `check` is the code or `test` the start of the item that notices it."""

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
    """What noticed a mutation: `codes` of the checker, or `items` of the tests, with the counterexamples' sizes."""

    codes: tuple[str, ...] = ()
    items: tuple[str, ...] = ()
    sizes: tuple[tuple[int, int, int], ...] = ()
    """(rows, columns, steps) of the counterexamples."""
    seconds: float = 0.0


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
    """Check the mutated rules, and test them if the checker finds nothing."""
    rules = folder / "rules"
    shutil.copytree(RULES, rules)
    path = rules / f"{mutation.pack}.yaml"
    text = path.read_text(encoding="utf-8")
    assert text.count(mutation.before) == 1, f"{mutation.mistake}: {text.count(mutation.before)} places"
    path.write_text(text.replace(mutation.before, mutation.after), encoding="utf-8")
    ruleset, remarks = diagnosed(rules / f"{mutation.rules}.yaml")
    codes = tuple(sorted({one.code for one in remarks if one.severity is not Severity.NOTE}))
    if codes or ruleset is None:
        return Caught(codes)
    runner = Runner(ruleset)
    search = Search.of(runner, Plan(examples=400, seconds=20.0), declared_only=True)
    search.try_random()
    broken = [trial for trial in search.trials if trial.sample is not None]
    items = [trial.prop.text for trial in broken]
    # One world is enough to look at: the one that was expected, if it is there.
    search.trials = sorted(broken, key=lambda trial: not trial.prop.text.startswith(mutation.test))[:1]
    found = [result.counterexample for result in search.finish() if result.counterexample is not None]
    sizes = [(*one.before.shape, one.steps) for one in found]
    if not items:  # the pack's own tests; what all packs share is tested by all
        own = [one for one in ruleset.tests if mutation.pack in (one.pack, "core")]
        results = run_examples(replace(ruleset, tests=tuple(own)))
        items = [result.example.name for result in results if not result.passed]
    return Caught((), tuple(items), tuple(sizes))
