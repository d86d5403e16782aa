"""Names of users beside names of ours: what Python calls its own arguments may name a field, a let or a loop."""

from __future__ import annotations

from pathlib import Path

import pytest

import powderdsl
from powderdsl.diagnostics import CompileError
from tests.semantics.texts import load_text

PACK = """
pack: names
elements:
  air: {id: 0, color: "#F8F9FA", glyph: "."}
  ball: {id: 1, color: "#264653"}
fields:
  NAME: {type: 0..9, at: place}
passes:
  roll:
    let: {near: count(ball)}
    do: NAME += 1 where near > 0 and any(cell is ball for cell in sides)
"""


def pack(name: str) -> str:
    return PACK.replace("NAME", name)


@pytest.mark.parametrize("name", ["world", "self", "steps", "seed", "cls", "state", "mask", "fields"])
def test_a_field_may_be_named_like_an_argument(name: str, tmp_path: Path) -> None:
    sim = powderdsl.compile(load_text(pack(name)), backend="wasm")
    world = sim.replace(sim.world([[[1, 1, 0]]]), **{name: 3})
    world = sim.paint(world, where=[[True, False, False]], **{name: 5})
    assert world[name][0, 0].tolist() == [5, 3, 3]
    world = sim.step(world)
    assert world[name][0, 0].tolist() == [6, 4, 4]
    powderdsl.save(world, tmp_path / "world.npz")
    again = powderdsl.load_world(tmp_path / "world.npz", sim)
    assert again[name][0, 0].tolist() == [6, 4, 4]


@pytest.mark.parametrize("name", ["element", "ids"])
def test_the_names_of_elements_in_a_state_are_reserved(name: str) -> None:
    properties = pack(name).replace("fields:", "properties:").replace(", at: place", ", ball: 2")
    for text in (pack(name), properties):
        with pytest.raises(CompileError, match=rf"PD311.*`{name}` is a reserved word"):
            load_text(text)


def test_local_names_may_be_pythons_but_not_the_languages() -> None:
    load_text(pack("charge").replace("near", "self").replace("cell", "names"))
    load_text(pack("charge").replace("near", "lambda"))
    with pytest.raises(CompileError, match=r"PD311.*`row` is a reserved word"):
        load_text(pack("charge").replace("near", "row"))
