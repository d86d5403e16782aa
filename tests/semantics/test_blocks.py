"""Rules on blocks of cells: shown to be free of conflicts where worlds have no seam, and nothing is ever lost."""

from __future__ import annotations

import numpy as np
import pytest

from powderdsl.simulation.draw import to_numpy
from tests.cli.commands import powderdsl as command
from tests.semantics.texts import diagnosed, mistakes, simulator

HEAD = """\
pack: blocks
side_multiple: {multiple}
elements:
  a: {{id: 0, color: "#101010", glyph: "."}}
  b: {{id: 1, color: "#202020"}}
  c: {{id: 2, color: "#303030"}}
fields:
  mark: {{type: 0..99, at: element}}
"""
MARGOLUS = """\
passes:
  turn:
    let:
      corner: (row + step) mod 2 == 0 and (column + step) mod 2 == 0
      first: corner and here is b
      second: corner and right is c
      either: first or second
    do: swap right if either or above.either
    then: swap below if first or left.first
"""
PROVEN = {
    "swap right if column mod 2 == 0": 2,
    "swap right if (column + step) mod 2 == 0": 2,
    "swap right if (column + 3) mod 4 == 1": 4,
    "swap right if column div 2 mod 2 == 0 and column mod 2 == 0": 4,
    "swap below if (row - step) mod 2 == 1 and b": 2,
    "swap below.right if row mod 2 == 0": 2,
    "a moves right leaving c if column mod 2 == 0 and step mod 2 == 0": 2,
}
REFUSED = {
    "swap right if row mod 2 == 0": 2,
    "swap below if column mod 2 == 0": 2,
    "swap right if column mod 3 != 0": 3,
    "swap right if column mod 2 == 0 or step mod 5 == 0": 2,
    "swap at(0, 2) if column mod 2 == 0": 2,
}


def pack(rules: str, multiple: int) -> str:
    text = rules if rules.startswith("passes") else f"passes: {{p: {{do: '{rules}'}}}}\n"
    return HEAD.format(multiple=multiple) + text


def errors(rules: str, multiple: int) -> set[str]:
    return {code for code, _ in mistakes(pack(rules, multiple))}


@pytest.mark.parametrize("rule", PROVEN)
def test_worlds_without_a_seam_keep_swaps_apart(rule):
    multiple = PROVEN[rule]
    assert errors(rule, multiple) == errors(rule, 3 * multiple) == set()
    if "moves" not in rule:
        assert errors(rule, 1) == errors(rule, 3) == {"PD501"}


@pytest.mark.parametrize("rule", REFUSED)
def test_what_meets_anyway_is_refused(rule):
    for multiple in (1, REFUSED[rule], 4 * REFUSED[rule]):
        assert errors(rule, multiple) == {"PD501"}


def test_the_fix_is_named_and_works():
    conflicts = [error for error in diagnosed(pack(MARGOLUS, 1)) if error.code == "PD501"]
    assert len(conflicts) == 2
    assert all("`side_multiple: 2`" in error.helps[0] for error in conflicts)
    assert errors(MARGOLUS, 2) == set()


def test_nothing_is_lost_or_doubled():
    sim = simulator(pack(MARGOLUS, 2))
    random = np.random.default_rng(0)
    for size in ((2, 2), (4, 6), (8, 34), (10, 66)):
        ids = random.integers(0, 3, (2, *size)).astype(np.uint8)
        world = sim.replace(sim.world(ids, seed=3), mark=random.integers(0, 100, (2, *size)))
        start = contents(world)
        for _ in range(4):
            world = sim.step(world, steps=3)
            assert np.array_equal(contents(world), start)


def contents(world) -> np.ndarray:
    return np.sort((to_numpy(world.ids).astype(int) * 100 + to_numpy(world["mark"])).reshape(2, -1))


def test_other_sizes_are_refused_everywhere(folder):
    (folder / "blocks.yaml").write_text(pack(MARGOLUS, 2))
    sim = simulator(pack(MARGOLUS, 2))
    with pytest.raises(ValueError, match="rows and columns must be a multiple of 2"):
        sim.world(np.zeros((5, 4), np.uint8))
    for name in ("run", "bench"):
        assert "multiple of 2" in command(name, "blocks.yaml", "--size", "7x8", exits=2).stderr
    command("run", "blocks.yaml", "--steps", "1", exits=0)
    (folder / "task.yaml").write_text(
        "task: odd\nrules: blocks.yaml\nsize: [63, 64]\nfill: a\nagent: {may: [b], speed: 1, actions: 4}\n"
        "reward: {each: count(b)}\n"
    )
    assert "PD607" in command("check", "task.yaml", exits=2).output
    test = "tests: [{odd: {given: b c b, after: 1 step, expect: b c b}}]\n"
    (folder / "blocks.yaml").write_text(pack(MARGOLUS, 2) + test)
    assert "multiples of 2" in command("check", "blocks.yaml").output


def test_invariants_are_tried_on_worlds_that_fit(folder):
    invariants = "invariants: [count(b) is constant, b never changes]\n"
    (folder / "blocks.yaml").write_text(pack(MARGOLUS, 2) + invariants)
    result = command("check", "blocks.yaml", exits=2)
    assert result.output.count("error[PD512]") == 1
    assert "b never changes" in result.output
