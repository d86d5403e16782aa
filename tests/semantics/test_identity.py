"""Packs by people who do not know each other: names, ids, glyphs and channels when they are loaded together."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import powderdsl
from powderdsl.compiler import load_with_diagnostics, whole_palette
from powderdsl.simulation.tracing import trace
from powderdsl.testing.pack_tests.runner import run_examples
from powderdsl.worlds.scene import draw_start, find_scene
from powderdsl.worlds.store import load_world, save
from tests.refusals import refusal, refused_codes

SLIME = """
pack: NAME
needs: core
tags: {sticky: slime holds on to it}
fields: {wet: {type: 0..9, at: element}}
params: {pace: 50%}
elements:
  slime: {id: 14, density: 3, gravity: yes, color: "#60C040", glyph: m, tags: sticky}
passes:
  creep:
    after: flow
    do:
      - empty -> slime if count(sticky) > 2 with chance pace
      - wet += 1 where slime
tests:
  - slime gets wet, and this pack means its own:
      given: m
      after: 3 steps
      expect: m
      always: [slime, wet > 0]
"""

HUNTER = """
pack: hunter
needs: two
elements:
  hunter: {color: "#402060"}
passes:
  hunt:
    do: slime -> hunter if above is hunter and wet > 1
    then: one.slime -> hunter if left is hunter and right.two.wet == 0
"""


@pytest.fixture(autouse=True)
def _packs(folder: Path) -> None:
    for name in ("one", "two"):
        Path(f"{name}.yaml").write_text(SLIME.replace("NAME", name))
    Path("hunter.yaml").write_text(HUNTER)


def pack(name: str, elements: str, more: str = "") -> str:
    """A small pack's file."""
    Path(f"{name}.yaml").write_text(f"pack: {name}\nneeds: core\nelements:\n{elements}\n{more}")
    return f"{name}.yaml"


def test_the_first_pack_keeps_its_names_and_the_second_is_qualified() -> None:
    alone = powderdsl.load("core", "one.yaml")
    rules, notes = load_with_diagnostics("core", "one.yaml", "two.yaml")
    names = [element.qualified for element in rules.elements]
    assert names == ["core.empty", "core.wall", "one.slime", "two.slime"]
    assert rules.element("slime") == rules.element("one.slime")
    assert alone.element("slime") == rules.element("slime")  # nothing changed for what was there
    assert [field.name for field in rules.fields][-2:] == ["wet", "two.wet"]
    assert [one.name for one in rules.passes][-2:] == ["creep", "two.creep"]
    assert rules.element("two.slime").glyph != rules.element("one.slime").glyph
    assert {note.code for note in notes} >= {"PD312", "PD313"}


def test_each_pack_means_its_own_and_draws_what_it_drew_alone() -> None:
    """Slime of both packs grows in separate chambers as it would grow if only its own pack were loaded."""
    both = powderdsl.compile(powderdsl.load("core", "one.yaml", "two.yaml"), "reference")
    number = both.ruleset.element("two.slime").id
    alone = powderdsl.compile(powderdsl.load("core", "two.yaml"), "reference")
    ids = np.zeros((2, 9, 9), np.uint8)
    ids[:, 4:, 2:7] = alone.ruleset.element("slime").id
    wanted = alone.step(alone.world(ids, seed=3), steps=4)
    ids[ids != 0] = number
    found = both.step(both.world(ids, seed=3), steps=4)
    assert (wanted.ids > 1).sum() > (ids > 1).sum()
    assert ((found.ids == number) == (wanted.ids == alone.ruleset.element("slime").id)).all()
    assert (found["two.wet"] == wanted["wet"]).all()
    assert not found["wet"].any()


def test_a_pack_means_what_it_needs_and_names_others_by_their_pack() -> None:
    rules = powderdsl.load("core", "one.yaml", "two.yaml", "hunter.yaml")
    sim = powderdsl.compile(rules, "reference")
    one, two, hunter = (rules.element(name).id for name in ("one.slime", "two.slime", "hunter"))
    start = sim.world(np.array([[[hunter, one, 0, 1], [two, 1, 0, 1]]], np.uint8))
    later = sim.step(start, steps=3)
    assert later.ids[0, 1, 0] == hunter  # `slime` is that of `two`, which `hunter` needs
    assert later.ids[0, 0, 1] == hunter  # `one.slime`


def test_a_ruleset_renames_without_editing_anyones_file() -> None:
    Path("garden.yaml").write_text(
        "ruleset: garden\npacks: [core, one, two]\nrename: {two.slime: ooze, two.wet: damp, two.creep: crawl}\n"
    )
    rules, notes = load_with_diagnostics("garden.yaml")
    assert rules.element("ooze").qualified == "two.slime"
    assert "damp" in [field.name for field in rules.fields]
    assert "crawl" in [one.name for one in rules.passes]
    assert {note.message for note in notes if note.code == "PD312"} == {
        "the tag `sticky` of `two` is named `two.sticky` here"
    }
    Path("garden.yaml").write_text("ruleset: garden\npacks: [core, one]\nrename: {one.slim: ooze}\n")
    assert refused_codes(powderdsl.load, "garden.yaml") == ["PD310"]


def test_ids_are_optional_and_adding_packs_moves_none() -> None:
    first = pack("aa", '  moss: {color: "#306030"}\n  fern: {id: 50, color: "#306030"}')
    second = pack("bb", '  crab: {id: 14, color: "#306030"}\n  fish: {color: "#306030"}')
    alone = powderdsl.load("powderworld", first)
    both = powderdsl.load("powderworld", first, second)
    assert (alone.element("moss").id, alone.element("fern").id) == (14, 50)
    for element in alone.elements:
        assert both.element(element.qualified).id == element.id
    assert [both.element(name).id for name in ("crab", "fish")] == [15, 16]
    assert powderdsl.load("powderworld-gas", first).element("moss").id == 14
    assert powderdsl.load(first, "powderworld").element("moss").id == 14  # the order of names decides nothing


def test_ids_of_packs_that_a_ruleset_leaves_out_stay_reserved() -> None:
    pack("aa", '  moss: {color: "#306030"}')
    pack("bb", '  crab: {color: "#306030"}')
    Path("shore.yaml").write_text("ruleset: shore\npacks: [core, aa, bb]\n")
    whole, less = powderdsl.load("shore.yaml"), powderdsl.load("shore.yaml+core-aa")
    assert whole.element("crab").id == less.element("crab").id == 3
    assert [channel.name for channel in less.matrix[:4]] == ["empty", "wall", "", "crab"]
    pack("aa", '  moss: {id: 5, color: "#306030"}')
    pack("bb", '  crab: {id: 5, color: "#306030"}')
    Path("shore.yaml").write_text("ruleset: shore\npacks: [core, aa]\n")
    rules, notes = load_with_diagnostics("shore.yaml-aa+bb.yaml")
    assert rules.element("crab").id != 5
    (note,) = [note for note in notes if note.code == "PD313"]
    assert note.primary.text == "`aa.moss` has id 5"


def test_taken_names_and_full_palettes_are_refused() -> None:
    many = "\n".join(f'  e{number}: {{color: "#306030"}}' for number in range(255))
    assert refused_codes(powderdsl.load, "core", pack("mine", many)) == ["PD508"]
    of_core = pack("mine", '  wall: {color: "#000000"}')
    assert refused_codes(powderdsl.load, "core", of_core) == ["PD302"]


def test_channels_of_a_ruleset_stay_in_place() -> None:
    paper = powderdsl.load("powderworld")
    names = [channel.name for channel in paper.matrix]
    assert len(names) == 20
    far = pack("far", '  glow: {id: 50, color: "#FFFFFF"}', "fields: {heat: {type: real(0..9), at: place}}\n"
               "passes: {warm: {do: heat += 1 where glow}}\n")  # fmt: skip
    more = pack("more", '  mist: {color: "#FFFFFF"}',
                "passes: {lift: {do: gravity := no where mist and above is empty}}\n")  # fmt: skip
    one, two = powderdsl.load("powderworld", far), powderdsl.load("powderworld", far, more)
    assert [channel.name for channel in one.matrix] == [*names, "glow", "heat"]
    assert [channel.name for channel in two.matrix] == [*names, "glow", "heat", "mist"]
    compact = [powderdsl.compile(rules, "torch").observer.compact_names for rules in (paper, one, two)]
    assert compact[1][: len(compact[0])] == compact[0]
    assert compact[2][: len(compact[1])] == compact[1]


def test_a_recorded_palette_decides_ids_but_not_what_happens() -> None:
    """Loops over elements keep their order: the same world under two palettes has the same future."""
    names = ("core", "sand", "water", "wind", "one.yaml")
    plain = powderdsl.load(*names)
    order = [element.qualified for element in plain.elements]
    turned = [order[0], None, *reversed(order[1:]), None]
    other = powderdsl.load(*names, palette=turned)
    assert other.palette == tuple(turned)
    to = np.zeros(256, np.uint8)
    for element in plain.elements:
        to[element.id] = other.element(element.qualified).id
    known = np.array([element.id for element in plain.elements], np.uint8)
    ids = np.random.default_rng(0).choice(known, (2, 20, 20))
    one, two = powderdsl.compile(plain, "reference"), powderdsl.compile(other, "wasm")
    first, second = one.step(one.world(ids), steps=8), two.step(two.world(to[ids]), steps=8)
    assert (to[first.ids.numpy()] == second.ids.numpy()).all()
    assert (first["velocity"] == second["velocity"]).all()


def test_the_palette_of_a_model_has_no_gaps_for_packs_that_are_added() -> None:
    far = pack("far", '  glow: {id: 50, color: "#FFFFFF"}')
    palette = whole_palette("powderworld-gas", far)
    assert len(palette) == 15
    assert palette[4] == "gas.gas"
    assert palette[14] == "far.glow"


def test_names_after_a_dot_may_be_absent() -> None:
    mine = pack("mine", '  bee: {color: "#306030"}', "passes:\n  buzz:\n    do:\n"
                "      - bee -> one.slime? if below is one.slime? and below.wet? > 1\n"
                "    then: bee swaps above if above is empty, then above.one.wet? += 1\n")  # fmt: skip
    rules, notes = load_with_diagnostics("core", mine)
    asleep = [note.message for note in notes if note.code == "PD506" and "mine" in str(note.primary.span)]
    assert asleep == [
        "this rule is inactive: `wet` is not loaded",
        "this rule is inactive: `one.wet` is not loaded",
    ]
    rules, notes = load_with_diagnostics("core", "one.yaml", mine)
    buzz = next(one for one in rules.passes if one.name == "buzz")
    assert [len(substep.rules) for substep in buzz.substeps] == [1, 1]


NAMESAKE = """
pack: snail
needs: core
tags: {slow: it creeps}
properties: {age: {type: 0..9, snail: 4}}
fields: {trail: {type: 0..9, at: place}, drift: {type: vec2(-9..9), at: place}}
params: {pace: 50%}
elements:
  snail: {color: "#60C040", tags: slow}
  shell: {color: "#C0C040"}
passes:
  creep: {do: [trail += 1 where slow, "shell -> empty with chance pace"]}
"""
READER = """
pack: bird
needs: [core, snail]
elements: {bird: {color: "#402060"}}
passes:
  hunt:
    do:
      - snail.snail -> bird if above is snail.slow and movement < snail.pace and snail.trail > 0
        and above.snail.trail > 0 and snail.age == 4 and above.drift.row == 0
      - bird -> empty if snail.wings? > 0 or above.snail.wings? > 0 or above is snail.wings?
    then:
      do: snail.trail := 9 where bird
      then: above.snail.trail -= 2 where bird
"""


def test_a_pack_that_has_an_element_of_its_name() -> None:
    """As most packs have: after the pack's name every word that it defines is known, an element's name leads nowhere."""
    Path("snail.yaml").write_text(NAMESAKE)
    Path("bird.yaml").write_text(READER)
    rules = powderdsl.load("core", "snail.yaml", "bird.yaml", params={"snail.pace": 1.0})
    sim = powderdsl.compile(rules, "reference")
    snail, bird = (rules.element(name).id for name in ("snail", "bird.bird"))
    world = sim.step(sim.world(np.array([[[snail], [snail], [1]]], np.uint8)), steps=1)
    assert world.ids[0, :, 0].tolist() == [snail, bird, 1]
    assert world["trail"][0, :, 0].tolist() == [0, 9, 0]


BOTH = """
pack: guest
needs: [core, one, two]
properties: {taste: {type: 0..9, one.slime: 3, two.slime: 4, zork.slime?: 9}}
sets: {goo: "(one.slime, two.slime)"}
fields: {mark: {type: 0..9, at: element, of: one.sticky, one.slime: 2}}
elements:
  guest: {color: "#402060", tags: [one.sticky, zork.sticky?], one.wet: 5}
also:
  one.slime: {tags: two.sticky}
  two.slime: {two.wet: 6}
  zork.slime?: {tags: two.sticky}
passes:
  meet:
    before: [one.creep, zork.creep?]
    after: two.creep
    do: goo -> guest if above is guest and taste > 3
tests:
  - drawn by qualified names:
      legend: {a: one.slime, b: two.slime, g: guest}
      given: a b g
      after: 0 steps
      fields: {one.wet: 1 . .}
      expect_fields: {one.wet: 1 0 5, two.wet: 0 6 0, mark: 2 0 0}
"""


@pytest.mark.parametrize("order", [("one", "two"), ("two", "one")])
def test_qualified_names_mean_the_same_wherever_a_pack_writes_them(order: tuple[str, str]) -> None:
    """Also the names of the pack that was loaded first, which are plain outside."""
    Path("guest.yaml").write_text(BOTH)
    rules = powderdsl.load("core", *(f"{name}.yaml" for name in order), "guest.yaml")
    sticky = {pack: "sticky" if pack == order[0] else f"{pack}.sticky" for pack in order}
    tags = {
        pack: {one.qualified for one in rules.elements if sticky[pack] in one.tags} for pack in ("one", "two")
    }
    assert tags == {"one": {"one.slime", "guest.guest"}, "two": {"one.slime", "two.slime"}}
    (taste,) = [one for one in rules.properties if one.name == "taste"]
    values = {one.qualified: taste.values[one.id] for one in rules.elements}
    assert (values["one.slime"], values["two.slime"]) == (3, 4)
    passes = [one.name for one in rules.passes][-3:]
    assert passes == (["two.creep", "meet", "creep"] if order[0] == "one" else ["creep", "meet", "one.creep"])
    assert [one.problem for one in run_examples(rules) if one.example.pack == "guest"] == [""]


def test_an_element_that_overrides_has_the_name_of_its_pack() -> None:
    Path("light.yaml").write_text(
        "pack: light\nneeds: [core, sand]\nelements:\n"
        "  sand: {override: yes, density: 2, gravity: yes, color: '#F3C23A'}\n"
    )
    path = pack(
        "glass", "  glass: {color: '#402060'}", "passes: {melt: {do: light.sand -> glass if above is wall}}"
    )
    rules = powderdsl.load("core", "sand", "light.yaml", path)
    sim = powderdsl.compile(rules, "reference")
    sand = rules.element("light.sand").id
    assert rules.element("sand.sand") is None
    later = sim.step(sim.world(np.array([[[1], [sand], [1]]], np.uint8)))
    assert later.ids[0, 1, 0] == rules.element("glass").id


def test_fields_of_worlds_are_known_by_their_pack() -> None:
    """Saved beside one stranger's pack, loaded beside another, or in another order: each gets its own field back."""
    sims = {
        order: powderdsl.compile(powderdsl.load("core", *(f"{name}.yaml" for name in order)), "reference")
        for order in (("one", "two"), ("two", "one"), ("two",))
    }
    start = sims["one", "two"]
    ids = np.array([[[start.ruleset.element(f"{name}.slime").id for name in ("one", "two")]]], np.uint8)
    save(start.replace(start.world(ids), **{"wet": [[[3, 0]]], "two.wet": [[[0, 7]]]}), "both.npz")
    for order in (("one", "two"), ("two", "one")):
        world = load_world("both.npz", sims[order])
        assert [sims[order].ruleset.palette[id] for id in world.ids[0, 0]] == ["one.slime", "two.slime"]
        assert world["one.wet"].tolist() == [[[3, 0]]]
        assert world["two.wet"].tolist() == [[[0, 7]]]
        assert world["wet"].tolist() == world[f"{order[0]}.wet"].tolist()
    assert refusal(load_world, "both.npz", sims["two",])[0].code == "PD603"
    alone = sims["two",]
    save(alone.replace(alone.world([[[alone.ruleset.element("slime").id]]]), wet=5), "two.npz")
    world = load_world("two.npz", start)
    assert (world["two.wet"].tolist(), world["one.wet"].tolist()) == ([[[5]]], [[[0]]])


def test_scenes_and_traces_take_qualified_fields() -> None:
    Path("scene.yaml").write_text(
        "scene: both\nsize: [2, 2]\nfill: one.slime\n"
        "draw: [one.wet := 4 in box rows 0:1 columns 0:2, two.wet := 6 in box rows 1:2 columns 0:2]\n"
    )
    for order in (("one", "two"), ("two", "one")):
        rules = powderdsl.load("core", *(f"{name}.yaml" for name in order))
        start = draw_start(find_scene("scene.yaml"), rules)
        fields = {name: field.values.tolist() for name, field in start.fields.items()}
        mine, other = ("wet", "two.wet") if order[0] == "one" else ("one.wet", "wet")
        assert (fields[mine][0], fields[other][1]) == ([4, 4], [6, 6])
        sim = powderdsl.compile(rules, "reference")
        world = sim.world(start.ids[None])
        assert [one.slot.name for one in trace(world, 0, 0, 1, of=["one.wet"]).slots] == [mine]
