"""`powderdsl prove`: its answers, exit codes and JSON, and words that are no rules or no claim."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.cli.commands import powderdsl

ANT = """\
pack: ant
streams: {luck: {bits: 32}}
elements:
  air: {id: 0, color: "#F8F9FA", glyph: "."}
  ant: {id: 1, color: "#264653", glyph: a}
fields: {heat: {type: real(0..9), at: place}}
passes:
  go: {do: "ant -> air if CONDITION"}
invariants:
  - count(ant) never rises
"""


def written(folder: Path, name: str, condition: str) -> Path:
    path = folder / name
    path.write_text(ANT.replace("CONDITION", condition), "utf-8")
    return path


def test_each_status_has_its_exit_code(tmp_path):
    first = written(tmp_path, "a.yaml", "count(ant) > 3 and luck < 50%")
    same = written(tmp_path, "b.yaml", "luck < 50% and not count(ant) <= 3")
    other = written(tmp_path, "c.yaml", "count(ant) > 4 and luck < 50%")
    assert powderdsl("prove", first, "==", same, exits=0).stdout.startswith("equal: ")
    assert powderdsl("prove", f"{first}:go", "==", f"{same}:go", exits=0).stdout.startswith("equal: ")
    answer = powderdsl("prove", first, "==", other, exits=1).stdout
    assert answer.startswith("differ: ")
    assert "in element, after 1 step with seed" in answer
    data = json.loads(powderdsl("prove", first, "==", other, "--json", exits=1).stdout)
    assert data["status"] == "differ"
    assert data["first"] != data["second"]
    assert data["draws"] == {}


def test_sums_of_floats_stay_undecided(tmp_path):
    """That a square is not negative is not known of floats, and no world shows otherwise."""
    first = written(tmp_path, "a.yaml", "heat * heat >= 0")
    second = written(tmp_path, "b.yaml", "heat >= 0")
    answer = powderdsl("prove", first, "==", second, exits=1).stdout
    assert answer == f"undecided: {first} == {second} (pass `go` may differ)\n"


def test_draws_that_no_seed_gives_are_shown(tmp_path):
    first = written(tmp_path, "a.yaml", "luck < 0.5")
    second = written(tmp_path, "b.yaml", "luck < 0.50000000024")
    answer = powderdsl("prove", first, "==", second, exits=1).stdout
    assert "in element, after 1 step with these draws" in answer
    assert "draws of luck: [[0.5" in answer
    data = json.loads(powderdsl("prove", first, "==", second, "--json", exits=1).stdout)
    assert data["draws"] == {"luck": [[0.5 + 2.0**-33]]}


def test_claims_are_proven_or_refuted(tmp_path):
    path = written(tmp_path, "a.yaml", "count(ant) > 3")
    assert powderdsl("prove", path, "count(ant)", "never", "rises", exits=0).stdout.startswith("proven")
    assert powderdsl("prove", path, "ant never changes", exits=1).stdout.startswith("BROKEN")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["life:melt", "==", "life"], "no pass `melt` in life: it has generation"),
        (["life", "==", "lives"], "no pack or ruleset `lives`"),
        (["life", "=="], "write two rulesets: A == B"),
        (["life", "==", "life", "==", "life"], "write two rulesets: A == B"),
        (["life"], "write `A == B`, or rules and a claim"),
        (["life:", "==", "life"], "no pack or ruleset `life:`"),
        (["\udce4", "==", "life"], "no pack or ruleset"),
    ],
)
def test_sides_that_are_no_rules(words, message):
    assert message in powderdsl("prove", *words, exits=2).stderr


@pytest.mark.parametrize(
    ("claim", "place"),
    [
        ("never (live", "the line ends too early"),
        ("never zzz", "unknown name `zzz`"),
        ("never live\n  - never dead_cell", "unexpected `never`"),
        ("never live\ntests: []", "expected one line, found a mapping"),
        ('never "live"', 'unexpected character `"`'),
        ("never 'live", "unexpected character `'`"),
        ("# never live", "the line ends too early"),
        ("never live: no", "expected one line, found a mapping"),
        ("{a: b}", "expected one line, found a mapping"),
        ("[never live]", "expected one line, found a list"),
        ("&a never live", "the anchor `&a` is not allowed"),
        ("!!python/object:os.system x", "is not allowed"),
        ("x" * 100_000, "a line of 100,000 characters"),
        ("never " + "(" * 1_900, "the line ends too early"),
        ("never live\0", "U+0000"),
        ("never \udce4", "U+DCE4"),
        ("live never changes ☃", "unexpected character `☃`"),
        ("never live for 99999999999 steps", "lies outside 1..1000"),
        ("never (1 / 0 > 2)", "division by zero"),
        ("", "the line ends too early"),
    ],
)  # fmt: skip
def test_claims_that_are_none(claim, place):
    """The place in the claim is shown, however it is written."""
    answer = powderdsl("prove", "life", claim, exits=2).stderr
    assert place in answer
    assert "--> command_line:4:" in answer
