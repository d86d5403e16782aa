"""Packs that provide others, passes that override others, and what rulesets say about elements of their packs."""

from __future__ import annotations

from pathlib import Path

import pytest

import powderdsl
from powderdsl.compiler import load_with_diagnostics
from powderdsl.diagnostics import CompileError

GROUND = """
pack: NAME
MORE
properties:
  weight: 0..9
elements:
  sky: {id: 0, color: "#F8F9FA", glyph: "."}
  soil: {id: 1, color: "#6F4E37", weight: 7}
passes:
  settle: {do: WHAT}
"""

SEED = """
pack: seed
needs: ground
elements:
  seed: {color: "#2A9D8F", weight: 2, glyph: s}
passes:
  sprout: {after: settle, do: ground.sky -> seed if left is seed}
"""


@pytest.fixture(autouse=True)
def _packs(folder: Path) -> None:
    for name, more, what in (
        ("ground", "about: firm", "soil -> sky if above is soil"),
        ("moor", "provides: ground", "soil -> sky if below is soil"),
        ("dune", "provides: ground", "soil -> sky if left is soil"),
    ):
        text = GROUND.replace("NAME", name).replace("MORE", more).replace("WHAT", what)
        Path(f"{name}.yaml").write_text(text)
    Path("seed.yaml").write_text(SEED)


def codes(*names: str) -> list[str]:
    """Codes of everything that is reported about some rules, errors included."""
    try:
        return [one.code for one in load_with_diagnostics(*names)[1]]
    except CompileError as error:
        return [one.code for one in error.diagnostics]


def stepped(rules: str, ids: list[list[int]]) -> list[list[int]]:
    """The ids after a step on the oracle."""
    sim = powderdsl.compile(powderdsl.load(rules), backend="reference")
    return sim.step(sim.world([ids])).ids[0].tolist()


# Packs that provide others


@pytest.mark.parametrize("ground", ["ground", "moor", "dune"])
def test_a_pack_stands_in_where_another_is_needed(ground: str) -> None:
    rules = powderdsl.load(f"{ground}.yaml+seed.yaml")
    seed = rules.element("seed")
    assert stepped(f"{ground}.yaml+seed.yaml", [[seed.id, 0, 0]])[0] == [seed.id, seed.id, 0]
    assert [one.name for one in rules.passes] == ["settle", "sprout"]
    assert rules.palette == (f"{ground}.sky", f"{ground}.soil", "seed.seed")


@pytest.mark.parametrize("first", ["ground.yaml+moor.yaml", "moor.yaml+dune.yaml"])
def test_exactly_one_pack_provides_another(first: str) -> None:
    assert "PD306" in codes(f"{first}+seed.yaml")


# Passes that override


def test_a_pass_replaces_another_in_its_place() -> None:
    Path("flood.yaml").write_text(
        "pack: flood\nneeds: ground\nparams: {wet: 100%}\npasses:\n  settle:\n    override: yes\n"
        "    do: soil -> sky with chance wet\n  late: {after: sprout?, do: sky -> soil if left is sky}\n"
    )
    rules = powderdsl.load("ground.yaml+seed.yaml+flood.yaml")
    passes = {one.name: one.pack for one in rules.passes}
    assert [*passes.items()] == [("settle", "flood"), ("sprout", "seed"), ("late", "flood")]
    assert stepped("ground.yaml+flood.yaml", [[1, 1], [0, 1]]) == [[1, 1], [1, 1]]


def test_the_place_in_the_order_is_that_of_both() -> None:
    Path("first.yaml").write_text(
        "pack: first\nneeds: ground\npasses:\n  dawn: {after: settle?, do: soil -> sky if left is sky}\n"
    )
    Path("second.yaml").write_text(
        "pack: second\nneeds: seed\npasses:\n  settle: {override: yes, after: sprout2?, do: soil -> sky}\n"
        "  sprout2: {do: sky -> soil if right is soil}\n"
    )
    rules = powderdsl.load("ground.yaml+first.yaml+seed.yaml+second.yaml")
    assert [one.name for one in rules.passes] == ["sprout2", "settle", "dawn", "sprout"]


@pytest.mark.parametrize(
    ("passes", "code"),
    [
        ("dusk: {override: yes, do: soil -> sky}", "PD301"),  # there is nothing to override
        ("settle: {do: soil -> sky}", "PD302"),  # it does not say that it overrides
    ],
)
def test_a_pass_overrides_what_exists_and_says_so(passes: str, code: str) -> None:
    Path("again.yaml").write_text(f"pack: again\nneeds: ground\npasses: {{{passes}}}\n")
    assert code in codes("ground.yaml+again.yaml")


# What rulesets say


def ruleset(also: str) -> str:
    Path("field.yaml").write_text(f"ruleset: field\npacks: [ground, seed]\nalso:\n{also}\n")
    return "field.yaml"


def weights(rules: str) -> tuple[object, ...]:
    """The weight of each element, by id."""
    return powderdsl.load(rules).property("weight").values


def test_a_ruleset_gives_values_tags_and_colors_without_a_warning() -> None:
    Path("ground.yaml").write_text(
        Path("ground.yaml").read_text().replace("properties:", "tags: {dry: no rain}\nproperties:")
    )
    name = ruleset('  seed: {weight: 5, tags: dry, color: "#102030"}\n  soil: {weight: 1}')
    rules, remarks = load_with_diagnostics(name)
    seed = rules.element("seed")
    assert weights(name) == (0, 1, 5)
    assert (seed.color, seed.tags) == ("#102030", frozenset({"dry"}))
    assert not {one.code for one in remarks} & {"PD316", "PD317"}


def test_whoever_is_loaded_last_has_the_last_word() -> None:
    name = ruleset("  soil: {weight: 1}\n  seed: {weight: 6}")
    assert weights(f"{name}-seed")[1] == 1
    Path("lead.yaml").write_text("pack: lead\nneeds: ground\nalso: {soil: {weight: 9}}\n")
    assert weights(f"{name}+lead.yaml")[1] == 9
    assert "PD317" in codes(f"{name}+lead.yaml")
    Path("meadow.yaml").write_text("ruleset: meadow\nextends: field\nalso: {soil: {weight: 3}}\n")
    assert weights("meadow.yaml") == (0, 3, 6)


@pytest.mark.parametrize(
    ("also", "code"),
    [
        ("  sed: {weight: 5}", "PD301"),
        ("  seed: {wieght: 5}", "PD108"),
        ("  seed: {weight: 50}", "PD402"),
        ("  seed: dirt", "PD301"),
        ("  seed: {color: red}", "PD110"),
    ],
)
def test_mistakes_of_a_ruleset_are_reported(also: str, code: str) -> None:
    assert code in codes(ruleset(also))
