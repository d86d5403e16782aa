"""Rulesets that extend others, and what loaded rules are called."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import pytest

import powderdsl as library
from powderdsl.compiler import MAX_BASES, load_with_diagnostics
from powderdsl.diagnostics import Severity
from tests.cli.commands import PACK, powderdsl
from tests.refusals import refusal

MEADOW = "ruleset: meadow\nextends: powderworld\nwithout: gas\npacks: grit\nparams: {water.melt: 10%}\n"


@pytest.fixture(autouse=True)
def _folder(folder: Path) -> None:
    write(grit=PACK, meadow=MEADOW)


def write(**files: str) -> None:
    for name, text in files.items():
        Path(f"{name}.yaml").write_text(text, encoding="utf-8")


def errors_of(rules: str) -> list[tuple[str, str, int]]:
    """Code, file and line of each error, or code and nothing."""
    spans = [(one.code, one.primary.span) for one in refusal(library.load, rules)]
    return [(code, span.source.name, span.line) if span else (code, "", 0) for code, span in spans]


# What is inherited


def test_a_ruleset_has_the_packs_parameters_and_channels_of_its_base() -> None:
    base, found = library.load("powderworld"), library.load("meadow.yaml")
    assert found.packs == (*(pack for pack in base.packs if pack != "gas"), "grit")
    assert {one.name: one.default for one in found.params}["water.melt"] == Fraction(1, 10)
    assert {one.name: one.id for one in found.elements if one.pack != "grit"}.items() <= {
        one.name: one.id for one in base.elements
    }.items()
    wanted = [channel.name for channel in base.matrix]
    wanted[base.elements[4].id] = ""  # the place of what is left out stays vacant
    assert [channel.name for channel in found.matrix][: len(wanted)] == wanted


def test_what_a_ruleset_says_itself_counts_more() -> None:
    own = "matrix: [elements, density]\nparams: {water.melt: 20%}\n"
    write(small=f"ruleset: small\nextends: meadow\n{own}")
    found = library.load("small.yaml")
    assert [channel.name for channel in found.matrix if channel.id is None] == ["density"]
    assert {one.name: one.default for one in found.params}["water.melt"] == Fraction(1, 5)
    assert found.packs == library.load("meadow.yaml").packs


def test_names_are_inherited() -> None:
    write(named="ruleset: named\npacks: [core, grit]\nrename: {grit.grit: gravel}\n")
    write(again="ruleset: again\nextends: named\n")
    assert library.load("again.yaml").element("gravel") is not None


def test_a_pack_of_ones_own_takes_the_place_of_one_of_the_base() -> None:
    own = PACK.replace("pack: grit", "pack: gas").replace("grit: {id: 200,", "grit: {")
    write(gas=own, dusty="ruleset: dusty\nextends: powderworld\nwithout: gas\npacks: gas\n")
    found = library.load("dusty.yaml")
    assert found.element("gas.grit") is not None
    assert found.name == "dusty"


def test_the_invariants_of_the_base_speak_of_the_base() -> None:
    write(grit=PACK + "also: {wood: {tags: fluid, gravity: yes}}\n")
    write(meadow=MEADOW + "invariants: [count(wall) is constant]\n")
    found = library.load("meadow.yaml")
    scopes = {one.pack: one.scope for one in found.invariants}
    assert scopes["meadow"] == found.packs
    assert scopes["core"] == scopes["powderworld"] == tuple(pack for pack in found.packs if pack != "grit")


def test_leaving_a_pack_out_leaves_its_parameters_out() -> None:
    write(wet="ruleset: wet\npacks: [core, sand, water]\nparams: {water.melt: 50%}\n")
    assert library.load("wet.yaml-water").packs == ("core", "sand")


def test_lines_of_a_ruleset_about_what_is_left_out_sleep() -> None:
    lines = "matrix: [elements, density, whiff]\ninvariants: [count(grit) never rises, wall never changes]\n"
    write(grit=PACK + "fields: {whiff: {type: 0..9, at: place}}\n")
    write(airy=f"ruleset: airy\npacks: [core, grit]\n{lines}")
    write(still="ruleset: still\nextends: airy\nwithout: grit\n")
    for rules in ("airy.yaml-grit", "still.yaml"):
        found = library.load(rules)
        assert [one.span.text for one in found.invariants if one.pack == "airy"] == ["wall never changes"]
        assert (found.matrix[-1].name, found.matrix[-1].source) == ("whiff", "")
    assert len([one for one in library.load("airy.yaml").invariants if one.pack == "airy"]) == 2


# What is wrong


def test_a_circle_of_rulesets_is_an_error_with_its_place() -> None:
    write(one="ruleset: one\nextends: two\n", two="ruleset: two\nextends: one\n")
    assert errors_of("one.yaml") == [("PD314", "two.yaml", 2)]


def test_rulesets_in_a_row_are_bounded() -> None:
    write(**{f"r{n}": f"ruleset: r{n}\nextends: r{n + 1}\n" for n in range(MAX_BASES + 2)})
    write(**{f"r{MAX_BASES + 2}": "ruleset: last\npacks: core\n"})
    assert errors_of("r0.yaml") == [("PD508", f"r{MAX_BASES}.yaml", 2)]
    assert library.load("r2.yaml").packs == ("core",)


@pytest.mark.parametrize(
    ("text", "code", "line"),
    [
        ("extends: powderworld\nwithout: [gas, gass]", "PD304", 3),
        ("extends: sand", "PD304", 2),
        ("extends: nothing_there", "PD304", 2),
        ("extends: ../meadow", "PD304", 2),
        ("extends: [powderworld, meadow]", "PD107", 2),
        ("packs: core\nwithout: sand", "PD304", 3),
        ("packs: [core, powderworld]", "PD304", 2),
        ("about: no packs", "PD109", 1),
    ],
)
def test_mistakes_have_a_place(text: str, code: str, line: int) -> None:
    write(wrong=f"ruleset: wrong\n{text}\n")
    assert errors_of("wrong.yaml") == [(code, "wrong.yaml", line)]


# Names


@pytest.mark.parametrize(
    ("rules", "name"),
    [
        ("powderworld", "powderworld"),
        ("powderworld-gas-acid", "powderworld-gas-acid"),
        ("powderworld-gas+grit.yaml", "powderworld-gas+grit"),
        ("core+sand+grit.yaml", "core+sand+grit"),
        ("meadow.yaml", "meadow"),
        ("meadow.yaml-acid+gas", "meadow-acid+gas"),
        ("powderworld+meadow.yaml", "meadow+gas"),
        ("life", "life"),
    ],
)
def test_names_say_what_is_loaded(rules: str, name: str) -> None:
    assert library.load(rules).name == name


@pytest.mark.slow
def test_commands_say_what_is_loaded() -> None:
    rules = "powderworld-gas+grit.yaml"
    for words in (("check", rules, "--ledger", "--quick"), ("run", rules, "--steps", "1"), ("show", rules)):
        output = powderdsl(*words).output
        assert "powderworld-gas+grit:" in output
        assert "powderworld:" not in output


# Warnings that only added packs bring about

POOL = """pack: pool
tags: {wet: dries beside mud}
elements:
  mud: {color: "#806040"}
  reed: {color: "#30A030"}
  pond: {color: "#3030A0", tags: wet}
passes:
  dry:
    conflicts: first_wins
    do:
      - wet -> mud if above is mud
      - reed -> pond if above is mud
invariants:
  - count(mud) never falls without wet
"""


def test_warnings_about_a_pack_that_others_bring_about_are_notes() -> None:
    write(pool=POOL, soak="pack: soak\nneeds: pool\nalso: {reed: wet, mud: wet}\n")
    assert all(one.severity is Severity.NOTE for one in load_with_diagnostics("pool.yaml")[1])
    _, remarks = load_with_diagnostics("pool.yaml+soak.yaml")
    told = {one.message for one in remarks if one.code == "PD515"}
    assert told == {
        "with `soak`, this rule is always overruled: pool.yaml:12",
        "with `soak`, `count(mud) never falls without wet` can no longer hold",
    }
    powderdsl("check", "pool.yaml+soak.yaml", "--warnings-as-errors", exits=0)


def test_warnings_that_a_pack_deserves_stay_warnings() -> None:
    write(pool=POOL.replace('reed: {color: "#30A030"}', 'reed: {color: "#30A030", tags: wet}'))
    _, remarks = load_with_diagnostics("core+pool.yaml+grit.yaml")
    assert [one.code for one in remarks if one.severity is Severity.WARNING] == ["PD514"]


def test_rules_are_equal_wherever_they_stand_in_their_file() -> None:
    model = library.load("core+grit.yaml")
    Path("grit.yaml").write_text("# a comment\n\n" + Path("grit.yaml").read_text())
    moved = library.load("core+grit.yaml")
    assert model.tests
    assert model.invariants
    assert (model.tests, model.invariants, model.passes) == (moved.tests, moved.invariants, moved.passes)
    assert repr(model.tests) == repr(moved.tests)
    assert model.text_key != moved.text_key  # messages name places
