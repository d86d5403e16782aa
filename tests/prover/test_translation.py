"""The stages of the compiler keep what passes do: proven, on bit planes, for all worlds."""

from __future__ import annotations

from collections import Counter
from functools import partial
from pathlib import Path

import pytest

from powderdsl.compiler import load, shipped_tests
from powderdsl.ir import stages
from powderdsl.ir.ops import Graph, Node
from powderdsl.ir.stages import Rewrite, rewrite_pass
from tests.fuzz.rulemaker import random_ruleset
from tests.prover.translation import compare
from tests.semantics.texts import load_text
from tests.tiers import tiered

ROOT = Path(__file__).resolve().parents[2]

RULES = [
    *shipped_tests(),
    *(f"powderworld+{path.relative_to(ROOT)}" for path in sorted(ROOT.glob("docs/examples/*.yaml"))),
]

LARGE = ("powderworld", "powderworld2")
"""Of these, `make test` compares only what stages make together of SLOW passes."""

SLOW = ("fish", "flow", "piling")


def failures(rules: str, *, each_stage: bool, slow: bool | None = None) -> list[str]:
    """What is not proven equal. `slow`: only the SLOW passes, or only the others."""
    return [
        f"{found.pass_} after {found.stage}: {found.verdict}"
        for found in compare(load(rules), each_stage=each_stage, takes=partial(_takes, slow))
        if found.verdict != "equal"
    ]


def _takes(slow: bool | None, name: str) -> bool:
    """Whether a pass is compared: the floats of `wind` are beyond proofs."""
    return not name.startswith("wind") and slow in (None, name in SLOW)


@pytest.mark.parametrize("rules", shipped_tests())
def test_every_stage_keeps_what_passes_do(rules: str) -> None:
    assert not failures(rules, each_stage=True, slow=False)


@pytest.mark.parametrize("rules", LARGE)
def test_all_stages_keep_what_slow_passes_do(rules: str) -> None:
    assert not failures(rules, each_stage=False, slow=True)


@pytest.mark.slow
@pytest.mark.parametrize("rules", RULES)
def test_every_stage_keeps_what_all_passes_do(rules: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    assert not failures(rules, each_stage=True)


# Wrong stages, each of which must be found


def union_of_sets(node: Node, build: Graph) -> Node | None:
    """x in S and x in T is not x in S ∪ T."""
    match node.op, node.args:
        case "and", (Node("in_set", _, (x,), s), Node("in_set", _, (y,), t)) if x is y:
            return build.in_set(x, s | t)
    return None


def smaller_set(node: Node, build: Graph) -> Node | None:
    """A clause of a set is lost: the larger of two elements."""
    if node.op == "in_set" and len(node.attr) == 2:
        return build.in_set(node.args[0], node.attr - {max(node.attr)})
    return None


def opposite_shift(node: Node, build: Graph) -> Node | None:
    """not shift(a) is not shift(not a) by the opposite offset."""
    match node.op, node.args:
        case "in_set" | "not", (Node("shift", _, (x,), (dy, dx, True)),) if (dy, dx) > (0, 0):
            return build.shift(build.rebuild(node, (x,)), (-dy, -dx))
    return None


def exchanged_branches(node: Node, build: Graph) -> Node | None:
    """select(not c, a, b) is not select(c, a, b)."""
    match node.op, node.args:
        case "select", (Node("not", _, (condition,)), yes, no):
            return build.select(condition, yes, no)
    return None


def next_number(node: Node, build: Graph) -> Node | None:
    """x < c is not x < c + 1, nor x ≤ c."""
    match node.op, node.args:
        case "lt", (x, Node("const", attr=limit)) if x.type.name == "int":
            return build.derive("le", x, build.integer(limit))
    return None


WRONG: list[tuple[str, list[Rewrite]]] = [
    ("fold", [union_of_sets, stages.fold]),
    ("fold", [exchanged_branches, stages.fold]),
    ("resolve", [smaller_set, stages.resolve, stages.fold]),
    ("resolve", [next_number, stages.resolve, stages.fold]),
    ("share", [opposite_shift, stages.share, stages.fold]),
]

PACK = """
pack: validated
elements:
  ground: {id: 0, density: 0, color: "#000000"}
  sand: {id: 1, density: 3, color: "#C0A060"}
  water: {id: 2, density: 2, color: "#4060F0"}
  stone: {id: 3, density: 4, color: "#808080"}
properties:
  density: 0..4
fields:
  heat: {type: 0..7, at: place}
  lit: {type: flag, at: place}
passes:
  fall:
    conflicts: first_wins
    do: swap below if here in (sand, water) and here in (water, stone) and not below in (sand, stone)
  sink:
    do: swap left if density == 3 and left.density < 3
  warm:
    do: heat := min(heat + 1, 6) if not (lit or below.lit) else heat where density < 3
"""


@pytest.mark.parametrize(("stage", "rewrites"), WRONG, ids=[rules[0].__name__ for _, rules in WRONG])
def test_a_wrong_rewrite_is_found(
    stage: str, rewrites: list[Rewrite], monkeypatch: pytest.MonkeyPatch
) -> None:
    ruleset = load_text(PACK)
    assert [found.verdict for found in compare(ruleset, each_stage=True)].count("equal") > 3
    wrong = partial(rewrite_pass, rules=rewrites)
    pipeline = [row._replace(run=wrong) if row.name == stage else row for row in stages.PIPELINE]
    monkeypatch.setattr(stages, "PIPELINE", tuple(pipeline))
    verdicts = {(found.stage, found.verdict) for found in compare(ruleset, each_stage=True)}
    assert {name for name, verdict in verdicts if verdict != "equal"} == {stage}
    assert (stage, "differs") in verdicts
    assert "differs" in [found.verdict for found in compare(ruleset, each_stage=False)]


def test_a_field_of_one_value_holds_it() -> None:
    ruleset = load_text(
        """
pack: constant
elements:
  ground: {id: 0, color: "#000000"}
  sand: {id: 1, color: "#C0A060"}
fields:
  heat: {type: 0..0, at: place}
passes:
  warm:
    do:
      - ground -> sand if at(3, 0).heat > heat or below is sand
      - sand -> ground if below is ground
"""
    )
    assert {found.verdict for found in compare(ruleset, each_stage=True)} == {"equal"}


# Random rulesets

FEW, MANY = range(60, 80), [range(first, first + 100) for first in range(0, 2000, 100)]

MOST_UNDECIDED = 0.15
"""Of all passes and stages: too large, or arithmetic of floats, which the prover does not know."""


@pytest.mark.parametrize("seeds", tiered([FEW, *MANY], [FEW]), ids=str)
def test_every_stage_keeps_what_random_passes_do(seeds: range) -> None:
    verdicts = Counter[str]()
    for seed in seeds:
        ruleset = random_ruleset(seed)
        for found in compare(ruleset, each_stage=True, seconds=5) if ruleset else ():
            assert found.verdict != "differs", f"seed {seed}: {found}"
            verdicts[found.verdict] += 1
    assert verdicts["equal"] >= (1 - MOST_UNDECIDED) * verdicts.total() > 0
