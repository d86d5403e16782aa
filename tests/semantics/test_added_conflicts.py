"""Rules that meet only because of an added pack: the first one holds, and the pack's own line is named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import powderdsl
from powderdsl.compiler import load_with_diagnostics
from powderdsl.diagnostics import Diagnostic
from powderdsl.model.types import Ruleset
from powderdsl.testing.generators.cases import Choices, random_start
from tests.refusals import refusal

TREES = """\
pack: trees
tags: {wet: turns to mud, hot: turns to ash, loose: changes places}
fields: {age: {type: 0..9, at: element}}
elements:
  air: {id: 0, color: "#FFFFFF", glyph: "."}
  mud: {id: 1, color: "#806040"}
  ash: {id: 2, color: "#606060"}
  pond: {id: 3, color: "#3060A0", tags: wet}
  coal: {id: 4, color: "#303030", tags: [hot, loose]}
"""
CHANGE = """\
passes:
  change:
    do:
      - wet -> mud if above is air
      - hot -> ash if above is air
"""
GEYSER = """\
pack: geyser
needs: trees
elements:
  geyser: {color: "#A0C0FF", tags: [wet, hot]}
"""


pytestmark = pytest.mark.usefixtures("folder")


def load(passes: str, added: str, trees: str = TREES) -> tuple[Ruleset, list[Diagnostic]]:
    Path("trees.yaml").write_text(trees + passes)
    Path("added.yaml").write_text(added)
    ruleset, found = load_with_diagnostics("trees.yaml+added.yaml")
    return ruleset, [one for one in found if one.code == "PD517"]


def refused(passes: str, added: str, trees: str = TREES) -> tuple[Diagnostic, ...]:
    return refusal(load, passes, added, trees)


def under_caret(one: Diagnostic) -> tuple[str, str]:
    span = one.primary.span
    return Path(span.source.name).name, span.text


def test_the_rule_that_stands_first_holds() -> None:
    ruleset, (warning,) = load(CHANGE, GEYSER)
    assert under_caret(warning) == ("added.yaml", "wet")
    assert [label.span.text for label in warning.secondary if label.span] == [
        "hot",
        "wet -> mud",
        "hot -> ash",
    ]
    sim = powderdsl.compile(ruleset, backend="reference")
    world = sim.world([[[0, 0, 0], [ruleset.element("geyser").id, 3, 4]]])
    assert sim.step(world).ids[0, 1].tolist() == [1, 1, 2]


def test_other_worlds_run_as_before(torch) -> None:  # type: ignore[no-untyped-def]
    """Where none of the added pack's elements stand, a step is that of the packs alone."""
    swaps = CHANGE.replace(
        "hot -> ash if above is air", "loose swaps below if below is (air, wet) and not (wet or above is wet)"
    )
    for passes in (CHANGE, swaps):
        ruleset, found = load(passes, GEYSER.replace("hot", "hot, loose"))
        alone = powderdsl.load("trees.yaml")
        one, other = (powderdsl.compile(rules, backend="reference") for rules in (ruleset, alone))
        start = random_start(alone, Choices.seeded(3), (8, 20, 20))
        ids = np.asarray(start.world(other).ids)
        pair = [sim.step(sim.world(ids, seed=5), steps=4).ids for sim in (one, other)]
        assert torch.equal(*pair)
        assert found or passes is swaps


def test_of_two_assignments_the_last_holds() -> None:
    passes = "passes:\n  count:\n    do:\n      - age := 3 where wet\n      - age := 5 where hot\n"
    ruleset, (warning,) = load(passes, GEYSER)
    assert any("the last assignment wins" in one for one in warning.notes)
    sim = powderdsl.compile(ruleset, backend="reference")
    world = sim.world([[[ruleset.element("geyser").id, 3, 4, 0]]])
    assert sim.step(world)["age"][0, 0].tolist() == [5, 3, 5, 0]


def test_packs_that_know_each_other_conflict_as_before() -> None:
    both = TREES.replace("tags: wet}", "tags: [wet, hot]}")
    assert [one.code for one in refused(CHANGE, GEYSER, both)][:1] == ["PD502"]
    knows = CHANGE + "      - geyser? -> ash if below is geyser?\n"
    assert {one.code for one in refused(knows, GEYSER)} >= {"PD502"}
    load(CHANGE, GEYSER)
    Path("geyser.yaml").write_text(GEYSER)
    Path("grove.yaml").write_text("ruleset: grove\npacks: [trees, geyser]\n")
    assert "PD502" in {one.code for one in refusal(powderdsl.load, "grove.yaml")}


def test_where_a_policy_would_change_more_the_tag_is_an_error() -> None:
    moving = CHANGE.replace(
        "hot -> ash if above is air", "hot moves below leaving air if below is air and above is air"
    )
    errors = [one for one in refused(moving, GEYSER) if one.code == "PD501"]
    assert [under_caret(one) for one in errors] == [("added.yaml", "wet")]
    assert any("remove `wet` or `hot`" in one for one in errors[0].helps)
    effects = CHANGE.replace(
        "wet -> mud if above is air",
        "wet -> mud if above is air, then age += 1\n      - wet -> mud if below is air, then age += 1",
    )
    errors = [one for one in refused(effects, GEYSER) if one.code == "PD502"]
    assert {under_caret(one) for one in errors} == {("added.yaml", "wet")}


def test_a_value_of_an_added_pack() -> None:
    trees = TREES.replace("fields:", "properties: {heat: 0..9}\nfields:")
    passes = CHANGE.replace("hot ->", "heat > 5 ->")
    for added, caret, words in (
        ("also:\n  pond: {heat: 7}\n", "heat", "adds the value `heat` to `pond`"),
        (
            'elements:\n  lye: {color: "#A0C0FF", heat: 7}\nalso:\n  lye: wet\n',
            "wet",
            "adds the tag `wet` to `lye`",
        ),
    ):
        _, (warning,) = load(passes, f"pack: kiln\nneeds: trees\n{added}", trees)
        assert under_caret(warning) == ("added.yaml", caret)
        assert words in warning.message
    _, (warning,) = load(
        CHANGE.replace("wet ->", "any but (mud, ash, coal) ->"),
        "pack: kiln\nneeds: trees\nalso: {air: hot}\n",
    )
    assert under_caret(warning) == ("added.yaml", "hot")
    either = CHANGE.replace("wet ->", "any but (air, mud, ash, coal, pond) ->").replace(
        "hot ->", "any but (air, mud, ash, coal, pond) ->"
    )
    _, (warning,) = load(either, 'pack: kiln\nneeds: trees\nelements: {lye: {color: "#A0C0FF"}}\n')
    assert under_caret(warning) == ("added.yaml", "lye")
