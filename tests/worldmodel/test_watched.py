"""Worlds under other rules: elements keep their ids, draws keep to what is there."""

from __future__ import annotations

import pytest
import torch

import powderdsl
from powderdsl.tasks.episodes import compile_task
from powderdsl.worldmodel import DataConfig, TaskWorlds
from powderdsl.worldmodel.training import add, keep, leave_out, palette_of
from tests.refusals import refusal, refused_codes

PAPER = ("empty", "sand", "water", "wall", "plant", "fire", "wood", "ice", "lava", "dust", "cloner")


def ids_in(config: DataConfig, seeds: int = 60) -> set[str]:
    """Names of the elements that start worlds hold."""
    worlds = TaskWorlds(config, backend="reference")
    found = worlds.start(torch.arange(seeds)).ids.unique().tolist()
    return {element.name for element in worlds.rules.elements if element.id in found}


def test_under_its_own_rules_a_task_is_as_it_was() -> None:
    worlds = TaskWorlds(DataConfig(), backend="reference")
    seeds = torch.arange(20)
    same = compile_task("world-model", backend="reference").start(seeds)
    assert torch.equal(worlds.start(seeds).ids, same.world.ids)


def test_packs_that_are_left_out_are_never_drawn_and_channels_stay() -> None:
    config = DataConfig(rules="powderworld-gas-stone-acid")
    assert ids_in(config) == set(PAPER)
    rules = powderdsl.load("powderworld")
    palette = palette_of(config)
    assert len(palette) == 14
    assert palette == tuple(one.qualified for one in sorted(rules.elements, key=lambda one: one.id))
    kept = powderdsl.load(keep("powderworld", ["core", "sand", "water"]))
    assert (kept.packs, kept.slots) == (("core", "sand", "water"), 14)


def test_only_some_packs_are_drawn() -> None:
    assert ids_in(DataConfig(only=("gas", "stone", "acid"))) == {"empty", "wall", "gas", "stone", "acid"}
    assert ids_in(DataConfig(split="held_out")) == {"empty", "wall", "gas", "stone", "acid"}
    assert ids_in(DataConfig(only=("lava",))) == {"empty", "wall", "lava"}


def test_stands_that_rules_cannot_have_are_left_out_or_refused() -> None:
    config = DataConfig(split="designed", rules="powderworld-gas-stone-acid")
    found = TaskWorlds(config, backend="reference", partly=True)
    assert found.names == ("sand-on-water", "ice-and-plants", "burning-vines", "water-flowing")
    assert {name: lacking for name, lacking, _ in found.missing} == {
        "stone-arches": ("stone",),
        "acid-on-wood": ("acid",),
        "dust-on-lava": ("stone",),
        "gas-flowing": ("gas",),
    }
    full = TaskWorlds(DataConfig(split="designed"), backend="reference")
    kept = [full.names.index(name) for name in found.names]
    assert torch.equal(found.start(torch.arange(4)).ids, full.start(torch.arange(8)).ids[kept])
    assert refused_codes(TaskWorlds, config, backend="reference") == ["PD604"] * 4


def test_a_draw_without_elements_and_an_unknown_pack_are_refused() -> None:
    (found,) = refusal(TaskWorlds, DataConfig(split="held_out", rules="core+sand"), backend="reference")
    assert found.code == "PD604"
    assert "(gas, stone, acid)" in found.primary.span.text
    assert found.notes == ("they need gas, stone, acid",)
    (found,) = refusal(TaskWorlds, DataConfig(only=("gass",)), backend="reference")
    assert (found.code, found.helps) == ("PD304", ("did you mean `gas`?",))


def test_ids_follow_names_where_rules_number_them_otherwise(tmp_path, garden: str) -> None:  # type: ignore[no-untyped-def]
    (tmp_path / "other").mkdir()
    other = tmp_path / "other" / "moss.yaml"
    other.write_text((tmp_path / "moss.yaml").read_text().replace("id: 5", "id: 9"))
    own = TaskWorlds(DataConfig(task=garden), backend="reference")
    moved = TaskWorlds(DataConfig(task=garden, rules=f"core+{other}"), backend="reference")
    seeds = torch.arange(5)
    before, after = own.start(seeds).ids, moved.start(seeds).ids
    assert (before == 5).any()
    assert torch.equal(torch.where(before == 5, 9, before), after)


@pytest.mark.parametrize(
    ("made", "rules"),
    [
        (leave_out("powderworld", ["lava"]), "powderworld-lava"),
        (leave_out("powderworld-gas", ["lava", "gas"]), "powderworld-gas-lava"),
        (add("powderworld-gas-stone-acid", ["stone", "gas"]), "powderworld-acid"),
        (add("core+sand", ["sand", "water"]), "core+sand+water"),
        (add("core+sand-sand", ["sand"]), "core+sand"),
    ],
)
def test_packs_come_and_go_in_what_stands_for_rules(made: str, rules: str) -> None:
    assert powderdsl.load(made).packs == powderdsl.load(rules).packs
    assert made.count("-") == rules.count("-")
