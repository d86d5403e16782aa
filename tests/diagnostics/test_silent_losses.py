"""What a pack says and nobody hears: each such loss has a diagnostic, or a result that is written down."""

from __future__ import annotations

from pathlib import Path

import pytest

from powderdsl.compiler import load_with_diagnostics
from powderdsl.model.types import Ruleset

pytestmark = pytest.mark.usefixtures("folder")


def loaded(rules: str, **packs: str) -> tuple[Ruleset, list[tuple[str, str]]]:
    """A composition, and its remarks with codes of this page: the code and what is underlined."""
    for name, text in packs.items():
        Path(f"{name}.yaml").write_text(f"pack: {name}\n{text}", encoding="utf-8")
    ruleset, remarks = load_with_diagnostics(rules)
    codes = ("PD113", "PD315", "PD316", "PD317", "PD318", "PD516")
    return ruleset, [
        (one.code, one.primary.span.text) for one in remarks if one.code in codes and one.primary.span
    ]


# --- optional names


OIL = """needs: core
elements:
  oil: {{id: 20, density: 2, gravity: yes, color: "#1B1B1E", tags: [fluid, {tag}?], {burns}?: 30%}}
also:
  {wood}?: {tag}?
passes:
  oil:
    after: [flow, {fire}?]
    do:
      - oil -> {fire}? if count(lava?) > 0 or below is ({wood}?, wall)
"""
RIGHT = {"tag": "fuel", "burns": "burns", "wood": "wood", "fire": "fire"}


@pytest.mark.parametrize(
    ("what", "word"),
    [
        ("tag", "fule"),
        ("tag", "fuell"),
        ("tag", "feul"),
        ("burns", "burnz"),
        ("wood", "wodo"),
        ("fire", "fier"),
    ],
)
@pytest.mark.parametrize("others", ["core", "powderworld"])
def test_misspelled_names_are_found_wherever_they_stand(what: str, word: str, others: str) -> None:
    _, found = loaded(f"{others}+oil.yaml", oil=OIL.format(**{**RIGHT, what: word}))
    assert found == [("PD315", f"{word}?")]


@pytest.mark.parametrize("others", ["core", "core+sand+water", "powderworld", "powderworld-fire-lava"])
def test_names_that_some_pack_defines_are_quiet(others: str) -> None:
    assert loaded(f"{others}+oil.yaml", oil=OIL.format(**RIGHT))[1] == []


@pytest.mark.parametrize("word", ["food", "wool", "ash", "tar", "smoke", "salt_water", "mud", "honey", "ful"])
def test_other_words_are_quiet(word: str) -> None:
    for what in ("wood", "tag"):
        assert loaded("core+oil.yaml", oil=OIL.format(**{**RIGHT, what: word}))[1] == []


def test_a_name_of_a_strangers_pack_is_quiet_once_that_is_loaded() -> None:
    oil = OIL.format(**{**RIGHT, "wood": "woodd"})
    other = 'elements:\n  woodd: {color: "#123456"}\n'
    assert loaded("core+oil.yaml", oil=oil)[1] == [("PD315", "woodd?")]
    assert loaded("core+oil.yaml+other.yaml", oil=oil, other=other)[1] == []


def test_a_question_mark_in_a_world_is_no_name() -> None:
    text = (
        'needs: [core, sand]\ntests:\n  - it falls:\n      given: s\n      after: 1 step\n      expect: "?"\n'
    )
    assert loaded("core+sand+drawn.yaml", drawn=text)[1] == []


# --- values that several packs give


LIGHT = "needs: {needs}\nalso:\n  sand?: {{density: {density}}}\n"
ALONE = {"light": ("core", 2)}
ON_SAND = {"light": ("[core, sand]", 2)}
STRANGERS = {"two": ("[core, sand]", 2), "three": ("[core, sand]", 3)}
IN_TURN = {"first": ("[core, sand]", 2), "second": ("[core, sand, first]", 3)}


@pytest.mark.parametrize(
    ("rules", "packs", "holds", "told"),
    [
        ("sand+light.yaml", ON_SAND, 2, ["PD317"]),
        ("light.yaml+sand", ON_SAND, 2, ["PD317"]),
        ("sand+light.yaml", ALONE, 2, ["PD316"]),
        ("sand+two.yaml+three.yaml", STRANGERS, 3, ["PD316", "PD317"]),
        ("sand+three.yaml+two.yaml", STRANGERS, 2, ["PD316", "PD317"]),
        ("sand+first.yaml+second.yaml", IN_TURN, 3, ["PD317", "PD317"]),
        ("sand+second.yaml+first.yaml", IN_TURN, 3, ["PD317", "PD317"]),
    ],
)
def test_a_value_is_replaced_by_a_pack_that_needs_the_other_and_strangers_are_warned_of(
    rules: str, packs: dict[str, tuple[str, int]], holds: int, told: list[str]
) -> None:
    texts = {name: LIGHT.format(needs=needs, density=density) for name, (needs, density) in packs.items()}
    ruleset, found = loaded(f"core+{rules}", **texts)
    assert ruleset.property("density").values[ruleset.element("sand").id] == holds
    assert sorted(found) == [(code, "density") for code in told]


def test_the_same_value_twice_is_no_loss() -> None:
    assert loaded("core+sand+light.yaml", light=LIGHT.format(needs="core", density=4))[1] == []
    assert loaded("core+fire+b.yaml", b="also:\n  wood: {burns: 0.05}\n")[1] == []


def test_defaults_of_fields_follow_the_same_rules() -> None:
    heat = "needs: [core, sand]\nfields:\n  heat: {type: 0..9, at: element, sand: 3}\n"
    hot, warm = ("needs: [core, heat]\nalso:\n  sand?: {heat: %d}\n" % n for n in (5, 4))  # noqa: UP031
    ruleset, found = loaded("core+sand+heat.yaml+hot.yaml+warm.yaml", heat=heat, hot=hot, warm=warm)
    (field,) = [field for field in ruleset.fields if field.name == "heat"]
    assert field.own == ((ruleset.element("sand").id, 3),)
    assert {code for code, _ in found} == {"PD316"}


# --- overriding elements


FLOATS = """elements:
  sand: {{{id}override: yes, density: 2, gravity: yes, color: "#F3C23A"{tags}}}
"""


def test_an_element_that_overrides_keeps_its_id_and_the_tags_of_third_packs() -> None:
    ruleset, found = loaded("core+sand+floats.yaml", floats=FLOATS.format(id="", tags=""))
    sand = ruleset.element("sand")
    assert (sand.id, sand.tags, found) == (2, frozenset(), [])
    floats = FLOATS.format(id="", tags=", tags: fluid")
    third = "needs: [core, sand]\nalso:\n  sand: acid_proof\n"
    ruleset, _ = loaded("core+sand+floats.yaml+third.yaml", floats=floats, third=third)
    assert ruleset.element("sand").tags == {"fluid", "acid_proof"}
    ruleset, found = loaded("core+sand+floats.yaml", floats=FLOATS.format(id="id: 33, ", tags=""))
    assert (ruleset.element("sand").id, found) == (33, [("PD318", "33")])
    assert loaded("core+sand+floats.yaml", floats=FLOATS.format(id="id: 2, ", tags=""))[1] == []


# --- writes that are lost


YARD = """elements:
  floor: {{id: 0, color: "#EDF6F9"}}
  crate: {{id: 1, color: "#83C5BE"}}
  heap: {{id: 2, color: "#006D77"}}
fields:
  load: {{type: 0..9, at: element, of: crate}}
passes:
  fill: {{after: stack, do: load += 1 where crate and above is heap}}
  read: {{after: fill, do: crate -> heap if load == 9}}
  stack:
    {symmetry}do: {rule}
"""


@pytest.mark.parametrize(
    ("rule", "lost"),
    [
        ("load := 2 where floor", "load := 2"),
        ("right.load := 2 where right is heap", "right.load := 2"),
        ("load := 2 where count(crate) > 2", None),
        ("right.load := 2 where left is crate", None),
        ("crate -> heap if above is heap, then load := 1", "load := 1"),
        ("heap -> crate if above is heap, then load := 1", None),
        ("floor -> above if above is (heap, floor), then load := 1", "load := 1"),
        ("floor -> above if above is (heap, crate), then load := 1", None),
        ("crate moves right leaving floor if right is floor, then right.load += 1", None),
        ("heap moves right leaving floor if right is floor, then right.load += 1", "right.load += 1"),
        ("heap moves right leaving floor if right is floor, then load += 1", "load += 1"),
        ("crate moves right leaving floor if right is floor, then load += 1", None),
        ("heap swaps below if below is floor, then below.load := 1", "below.load := 1"),
        ("heap swaps below if below is crate, then load := 1", None),
        ("heap -> floor if left is crate and right is heap, then right.load += 1", "right.load += 1"),
    ],
)
@pytest.mark.parametrize("symmetry", ["", "symmetry: mirror\n    conflicts: drop_both\n    "])
def test_writes_that_no_cell_can_take_are_found(rule: str, lost: str | None, symmetry: str) -> None:
    _, found = loaded("yard.yaml", yard=YARD.format(rule=rule, symmetry=symmetry))
    assert found == ([] if lost is None else [("PD516", lost)])


def test_one_copy_that_writes_is_enough() -> None:
    loop = "for e in (floor, crate):\n      - load := 2 where e and above is heap"
    text = YARD.format(rule="PLACE", symmetry="").replace("do: PLACE", loop)
    assert loaded("yard.yaml", yard=text)[1] == []


# --- sections, functions


@pytest.mark.parametrize(
    "section", ["elements", "passes", "fields", "params", "also", "tests", "invariants", "needs"]
)
def test_empty_sections_are_told(section: str) -> None:
    text = f"tags: {{soft: a tag}}\n{section}:\nsets: {{nothing: soft}}\n"
    assert ("PD113", section) in loaded("core+yard.yaml", yard=text)[1]
    nothing = "[]" if section in ("tests", "invariants", "needs") else "{}"
    meant = text.replace(f"{section}:", f"{section}: {nothing}")
    assert ("PD113", section) not in loaded("core+yard.yaml", yard=meant)[1]
