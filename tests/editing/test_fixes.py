"""`check --fix`, and fixes in JSON."""

from __future__ import annotations

import json
from pathlib import Path

from tests.cli.commands import PACK, powderdsl

WRONG = (
    PACK.replace("interact", "interakt").replace("elements:", "elemnts:").replace("after: flow", "after: flw")
)


def test_misspelled_words_are_corrected_until_nothing_is_left(folder: Path) -> None:
    path = folder / "grit.yaml"
    path.write_text(WRONG)
    out = powderdsl("check", path, "--fix", "--quick", exits=0).stdout
    assert path.read_text() == PACK
    assert "`elemnts` is now `elements`" in out
    assert "no errors" in out


def test_files_that_fixes_do_not_help_stay_as_they_are(folder: Path) -> None:
    path = folder / "grit.yaml"
    for text in (PACK, PACK.replace("color:", "kolour:").replace("grit -> empty", "grit ->")):
        path.write_text(text)
        powderdsl("check", path, "--fix", "--quick")
        assert path.read_text() in (text, text.replace("kolour", "color"))
    powderdsl("check", "sand", "--fix", exits=0)


def test_json_has_the_place_and_the_text(folder: Path) -> None:
    path = folder / "grit.yaml"
    path.write_text(PACK.replace("-> empty", "-> emtpy"))
    (mistake,) = json.loads(powderdsl("check", path, "--quick", "--json", exits=2).stdout)
    assert mistake["fix"]["text"] == "empty"
    assert mistake["fix"]["span"] == mistake["primary"]["span"]
    path.write_text(PACK.replace("density: 4", "density: lots"))
    mistakes = json.loads(powderdsl("check", path, "--quick", "--json", exits=2).stdout)
    assert [mistake["fix"] for mistake in mistakes] == [None] * len(mistakes)
