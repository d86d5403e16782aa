"""What is kept between two keys changes no answer."""

from __future__ import annotations

import random
from functools import _lru_cache_wrapper
from pathlib import Path

import pytest

from powderdsl import compiler
from powderdsl.diagnostics import Diagnostic, Severity
from powderdsl.editing.workspace import Workspace
from powderdsl.model.declarations import PassDecl
from powderdsl.model.elaborate import Elaborator
from powderdsl.model.logic import satisfy
from powderdsl.model.types import Pass
from powderdsl.syntax import parse, yaml_tree
from powderdsl.system import cache
from powderdsl.universes import universe_text
from tests.editing.test_lsp import PACK, broken

KEPT = [
    kept
    for module in (compiler, satisfy, parse, yaml_tree)
    for kept in vars(module).values()
    if isinstance(kept, _lru_cache_wrapper) and kept.cache_parameters()["maxsize"] is not None
]
"""What holds results by value."""


def seen(found: tuple[Diagnostic, ...]) -> list[object]:
    return [
        (one.code, one.message, one.primary, one.secondary, one.notes, one.helps, one.fix) for one in found
    ]


@pytest.mark.parametrize(
    ("text", "beside", "edits", "between", "cleared"),
    [
        (PACK, "", 240, 1, 20),
        pytest.param(universe_text(7), "powderworld", 500, 5, 100, marks=pytest.mark.slow),
    ],
)
def test_edits_after_edits_have_the_mistakes_of_a_first_check(
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    text: str,
    beside: str,
    edits: int,
    between: int,
    cleared: int,
) -> None:
    """Compared after each `between` edits, and after each `cleared` without results by value."""
    monkeypatch.setattr(cache, "STORED", False)
    assert len(KEPT) >= 6
    files, path, draw, now = Workspace(beside), folder / "slime.yaml", random.Random(1), text
    for number in range(1, edits + 1):
        now = broken(now, draw) if number % 5 else text
        files.open(path, now)
        found = files.check(path)
        if number % between:
            continue
        if number % cleared == 0:
            for kept in KEPT:
                kept.cache_clear()
        first = Workspace(beside)
        assert seen(first.check(path)) == seen(found)
        model = first.rules[path].model if path in first.rules else None
        assert model is None or model == files.rules[path].model
    files.close(path)


def test_what_has_not_changed_is_not_checked_again(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    checked: set[str] = set()
    check_pass = Elaborator._pass

    def noted(self: Elaborator, name: str, decl: PassDecl) -> Pass:
        checked.add(decl.pack)
        return check_pass(self, name, decl)

    monkeypatch.setattr(Elaborator, "_pass", noted)
    files, path = Workspace("powderworld"), folder / "slime.yaml"

    def packs(text: str) -> set[str]:
        """The packs that are checked after a change."""
        checked.clear()
        files.open(path, text)
        assert not [mistake for mistake in files.check(path) if mistake.severity is Severity.ERROR]
        found = set(checked)
        first = Workspace("powderworld")
        first.check(path)
        assert files.rules[path].model == first.rules[path].model
        return found

    assert packs(PACK) > {"core", "water", "slime"}
    assert packs(PACK.replace("It creeps down", "It creeps")) == {"slime"}
    thawing = packs(PACK.replace("  slime: {id", "  slime: {tags: [thaws], id"))
    assert {"slime", "water"} <= thawing
    assert "sand" not in thawing
    assert packs(PACK) == set()
    files.close(path)
