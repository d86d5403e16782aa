"""`powderdsl universe`."""

from __future__ import annotations

from pathlib import Path

import pytest

from powderdsl.universes import MAX_SEED, universe_text
from tests.cli.commands import powderdsl


def test_it_prints_the_pack_and_then_what_is_found_out() -> None:
    result = powderdsl("universe", 7, exits=0)
    assert result.stdout == universe_text(7)
    assert "claims proven" in result.stderr
    assert "fault" not in result.stderr


def test_the_laws_in_words() -> None:
    result = powderdsl("universe", MAX_SEED, "--about", "--quick", exits=0)
    assert len(result.stdout.splitlines()) > 8
    assert " dissolves " in result.stdout
    assert result.stderr == ""


def test_the_written_pack_is_checked_like_any_other(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    assert powderdsl("universe", 12, "--quick", "--out", path, exits=0).stdout == ""
    assert path.read_text(encoding="utf-8") == universe_text(12)
    assert "no errors" in powderdsl("check", path, "--quick", "--warnings-as-errors", exits=0).stdout


@pytest.mark.parametrize(
    "word", ["abc", str(MAX_SEED + 1), "99999999999999", "1.5", "\N{ARABIC-INDIC DIGIT THREE}"]
)
def test_seeds_that_are_none(word: str) -> None:
    assert "SEED" in powderdsl("universe", word, exits=2).stderr


def test_rules_in_a_proof_are_not_taken_for_a_pass() -> None:
    assert powderdsl("prove", "universe:7 == universe:7", exits=0).stdout.startswith("equal")
    powderdsl("prove", "universe:7:fading == universe:7:fading", exits=0)
