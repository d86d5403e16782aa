"""Packs that a reader wrote from docs/short.md alone still load and pass their tests."""

from __future__ import annotations

from pathlib import Path

import pytest

from powderdsl.compiler import load
from powderdsl.testing.pack_tests.runner import run_examples

ROOT = Path(__file__).resolve().parents[2]
PACKS = sorted((ROOT / "tests" / "data" / "brief").glob("*.yaml"))


def test_there_are_ten_and_the_page_is_brief() -> None:
    assert len(PACKS) == 10
    assert len((ROOT / "docs" / "short.md").read_text(encoding="utf-8").split()) < 2000


@pytest.mark.parametrize("path", PACKS, ids=lambda path: path.stem)
def test_what_a_reader_wrote_passes(path: Path) -> None:
    results = run_examples(load(str(path)))
    assert len(results) >= 2
    assert [result.example.name for result in results if not result.passed] == []
