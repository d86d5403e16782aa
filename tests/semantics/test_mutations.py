"""Mistakes put into the shipped packs, one at a time, are noticed: most by `check`, the others by tests of packs."""

from __future__ import annotations

import shutil
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
import yaml

import powderdsl
from powderdsl.compiler import load_with_diagnostics
from powderdsl.diagnostics import CompileError, Severity
from powderdsl.model.text import one_line
from powderdsl.model.types import Ruleset
from powderdsl.testing.pack_tests.runner import run_examples
from powderdsl.testing.properties.search import quick_results

ROOT = Path(__file__).resolve().parents[2]
ROWS: list[dict[str, str]] = yaml.load(
    (ROOT / "tests" / "mutations.yaml").read_text("utf-8"), yaml.CBaseLoader
)
MAX_CELLS, MAX_STEPS = 9, 2
"""How large a world that shows a mistake may be."""


def rows_with(key: str) -> list:  # type: ignore[type-arg]
    """Parameters: all mistakes in `make test-all`, and those in one pack in `make test`."""
    return [
        pytest.param(
            row,
            id=f"{row['pack']}: {row['mistake']}",
            marks=[] if row["pack"] == "water" else pytest.mark.slow,
        )
        for row in ROWS
        if key in row
    ]


@cache
def paper_packs() -> tuple[str, ...]:
    return powderdsl.load("powderworld").packs


def mutated(row: dict[str, str], folder: Path) -> tuple[Ruleset | None, set[str]]:
    """The ruleset of a pack with the mistake in it, or None, and the codes of errors and warnings."""
    rules = folder / "rules"
    shutil.copytree(ROOT / "rules", rules)
    path = rules / f"{row['pack']}.yaml"
    text = path.read_text(encoding="utf-8")
    assert text.count(row["from"]) == 1
    path.write_text(text.replace(row["from"], row["to"]), encoding="utf-8")
    name = "powderworld" if row["pack"] in paper_packs() else row["pack"]
    try:
        ruleset, diagnostics = load_with_diagnostics(rules / f"{name}.yaml")
    except CompileError as error:
        ruleset, diagnostics = None, error.diagnostics
    return ruleset, {one.code for one in diagnostics if one.severity is not Severity.NOTE}


@pytest.mark.parametrize("row", rows_with("check"))
def test_the_checker_notices(row: dict[str, str], tmp_path: Path) -> None:
    ruleset, codes = mutated(row, tmp_path)
    code, _, statement = row["check"].partition(": ")
    if not statement:
        assert code in codes
        return
    assert not codes
    invariants = tuple(one for one in ruleset.invariants if one_line(one.span) == statement)
    (result,) = quick_results(replace(ruleset, invariants=invariants))
    assert not result.holds
    rows, columns = result.counterexample.sample.shape
    assert rows * columns <= MAX_CELLS
    assert result.counterexample.steps <= MAX_STEPS


@pytest.mark.parametrize("row", rows_with("test"))
def test_tests_of_packs_notice(row: dict[str, str], tmp_path: Path) -> None:
    ruleset, codes = mutated(row, tmp_path)
    assert not codes
    expected = tuple(one for one in ruleset.tests if one.name.startswith(row["test"]))
    assert not all(result.passed for result in run_examples(replace(ruleset, tests=expected)))


def test_there_are_mistakes_in_every_pack() -> None:
    assert len({(row["pack"], row["from"], row["to"]) for row in ROWS}) == len(ROWS)
    assert {row["pack"] for row in ROWS} >= {*paper_packs()}
