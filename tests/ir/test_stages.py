"""The IR of small packs after lowering and after every stage, as golden text; and the verifier, which must fail."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from powderdsl.compiler import load
from powderdsl.ir.bits import lower_bits
from powderdsl.ir.lower import lower_ruleset
from powderdsl.ir.ops import (
    FLAG,
    REAL,
    Graph,
    Node,
    PassGraph,
    Program,
    SlotType,
    SubstepGraph,
    integer,
    nodes_of,
)
from powderdsl.ir.stages import PIPELINE
from powderdsl.ir.text import print_program
from tests.ir.verify import InvalidIR, verify

GOLDEN = Path(__file__).parent / "golden"

FALL = """\
pack: fall
properties: {weight: 0..3}
elements:
  air: {id: 0, color: "#FFFFFF", weight: 1}
  grain: {id: 1, color: "#C0A000", weight: 3}
  smoke: {id: 2, color: "#777777", weight: 0}
passes:
  sink:
    for w in 0..3:
      - swap below if weight == w > below.weight
"""

GLOW = """\
pack: glow
streams: [dice]
params: {dim: 25%}
elements:
  dark: {id: 0, color: "#000000"}
  lamp: {id: 1, color: "#FFFF00"}
fields:
  charge: {type: 0..3, at: element, of: lamp}
  heat: {type: real(0..10), at: place}
passes:
  shine:
    let: {near: count(lamp in plus) >= 2}
    do:
      - dark -> lamp if near and dice < dim, then charge := 3
      - charge -= 1 where lamp and charge > 0
    then:
      - heat := heat / 2 + sum(heat in box) / 18 + (1 if lamp else 0)
"""

PACKS = {"fall": FALL, "glow": GLOW}


def program_of(name: str, folder: Path) -> Program:
    path = folder / f"{name}.yaml"
    path.write_text(PACKS[name], encoding="utf-8")
    program = lower_ruleset(load(path))
    for pass_ in program.passes:  # golden texts do not depend on where the test put its file
        for node in nodes_of(pass_):
            object.__setattr__(node, "places", ())
    passes = tuple(
        replace(p, substeps=tuple(replace(m, place="") for m in p.substeps)) for p in program.passes
    )
    return replace(program, passes=passes)


@pytest.mark.golden
@pytest.mark.parametrize("name", list(PACKS))
def test_golden_ir(name: str, tmp_path: Path, golden) -> None:  # type: ignore[no-untyped-def]
    program = program_of(name, tmp_path)
    stages = {"lower": program}
    for stage in PIPELINE:
        program = replace(program, passes=tuple(map(stage.run, program.passes)))
        stages[stage.name] = program
    planes = lower_bits(program)
    assert {node.type.name for pass_ in planes.passes for node in nodes_of(pass_)} <= {"flag", "real"}
    stages["bits"] = planes
    text = before = ""
    for stage, after in stages.items():
        verify(after, stage)
        printed = print_program(after)
        text += f"== {stage}\n" + ("as before\n" if printed == before else printed)
        before = printed
    golden(GOLDEN / f"{name}.ir", text)


def a_program(*outputs: tuple[str, Node]) -> Program:
    slots = (
        SlotType("f", FLAG, 0, False),
        SlotType("n", integer(0, 3), 0, False),
        SlotType("r", REAL, 0.0, False),
    )
    pass_ = PassGraph("p", "pack", (SubstepGraph("", "", outputs, ()),), outputs)
    return Program("broken", slots, (("q", "chance"),), (("s", 7, 16),), (pass_,))


BUILD = Graph()
F, N, R = BUILD.input("f", FLAG), BUILD.input("n", integer(0, 3)), BUILD.input("r", REAL)


@pytest.mark.parametrize(
    ("output", "message"),
    [
        (("f", Node("nand", FLAG, (F, F), None, 900)), "unknown operation"),
        (("f", Node("and", FLAG, (F,), None, 901)), "has 1 arguments"),
        (("f", Node("not", FLAG, (N,), None, 902)), "takes flag"),
        (("f", Node("eq", FLAG, (N, R), None, 903)), "mixes"),
        (("f", Node("shift", FLAG, (F,), None, 904)), "attribute"),
        (("n", Node("add", REAL, (N, N), None, 905)), "gives real"),
        (("n", BUILD.derive("add", N, N)), "gets 0..6"),
        (("f", N), "gets a 0..3"),
        (("g", F), "unknown slot g"),
        (("f", BUILD.input("h", FLAG)), "unknown slot h"),
        (("f", BUILD.node("below", FLAG, (N,), ("t", 16))), "unknown stream"),
        (("r", BUILD.node("param", REAL, attr=("z", "value"))), "unknown parameter"),
        (("f", Node("and", FLAG, (Node("not", FLAG, (F,), None, 906), Node("not", FLAG, (F,), None, 907)), None, 908)), "interned"),
    ],
)  # fmt: skip
def test_the_verifier_refuses(output: tuple[str, Node], message: str) -> None:
    with pytest.raises(InvalidIR, match=message):
        verify(a_program(output), "a test")


def test_the_verifier_accepts() -> None:
    verify(a_program(("f", BUILD.not_(F)), ("n", N), ("r", R)), "a test")
