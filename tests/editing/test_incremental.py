"""What is kept between two keys changes no answer."""

from __future__ import annotations

import random
from functools import _lru_cache_wrapper
from pathlib import Path

import pytest

from powderdsl import compiler
from powderdsl.diagnostics import Diagnostic
from powderdsl.editing.workspace import Workspace
from powderdsl.model.logic import satisfy
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
    ("text", "beside", "edits"),
    [(PACK, "", 240), pytest.param(universe_text(7), "powderworld", 500, marks=pytest.mark.slow)],
)
def test_edits_after_edits_have_the_mistakes_of_a_first_check(
    folder: Path, monkeypatch: pytest.MonkeyPatch, text: str, beside: str, edits: int
) -> None:
    monkeypatch.setattr(cache, "STORED", False)
    assert len(KEPT) >= 6
    files, path, draw, now = Workspace(beside), folder / "slime.yaml", random.Random(1), text
    for number in range(edits):
        now = broken(now, draw) if number % 5 else text
        files.open(path, now)
        found = files.check(path)
        if number % 20 == 19:
            for kept in KEPT:
                kept.cache_clear()
            assert seen(files.check(path)) == seen(found)
    files.close(path)
