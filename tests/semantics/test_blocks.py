"""Rules on blocks of cells: shown to be free of conflicts where worlds have no seam, and nothing is ever lost."""

from __future__ import annotations

import numpy as np
import pytest

import powderdsl as package
from powderdsl.compiler import load_with_diagnostics
from powderdsl.diagnostics import CompileError
from powderdsl.simulation.draw import to_numpy
from tests.cli.commands import powderdsl as command

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


def codes(tmp_path, rules: str, multiple: int) -> list[str]:
    path = tmp_path / "blocks.yaml"
    text = rules if rules.startswith("passes") else f"passes: {{p: {{do: '{rules}'}}}}\n"
    path.write_text(HEAD.format(multiple=multiple) + text)
    try:
        _, found = load_with_diagnostics(path)
    except CompileError as error:
        found = tuple(error.diagnostics)
    return sorted({one.code for one in found if one.severity.value == "error"})


@pytest.mark.parametrize("rule", [rule for rule in PROVEN if "moves" not in rule])
def test_worlds_without_a_seam_keep_swaps_apart(tmp_path, rule):
    multiple = PROVEN[rule]
    assert codes(tmp_path, rule, multiple) == []
    assert codes(tmp_path, rule, 3 * multiple) == []
    assert codes(tmp_path, rule, 1) == ["PD501"]
    assert codes(tmp_path, rule, 3) == ["PD501"]


@pytest.mark.parametrize("rule", REFUSED)
def test_what_meets_anyway_is_refused(tmp_path, rule):
    for multiple in (1, REFUSED[rule], 4 * REFUSED[rule]):
        assert codes(tmp_path, rule, multiple) == ["PD501"]


def test_the_fix_is_named_and_works(tmp_path):
    path = tmp_path / "blocks.yaml"
    path.write_text(HEAD.format(multiple=1) + MARGOLUS)
    with pytest.raises(CompileError) as raised:
        package.load(path)
    assert [one.code for one in raised.value.diagnostics] == ["PD501", "PD501"]
    assert all("`side_multiple: 2`" in one.helps[0] for one in raised.value.diagnostics)
    assert codes(tmp_path, MARGOLUS, 2) == []


@pytest.mark.parametrize("backend", ["reference", "torch", "native", "wasm"])
def test_nothing_is_lost_or_doubled(tmp_path, backend):
    path = tmp_path / "blocks.yaml"
    path.write_text(HEAD.format(multiple=2) + MARGOLUS)
    sim = package.compile(package.load(path), backend=backend)
    random = np.random.default_rng(0)
    for size in ((2, 2), (4, 6), (8, 34), (10, 66)):
        ids = random.integers(0, 3, (2, *size)).astype(np.uint8)
        world = sim.replace(sim.world(ids, seed=3), mark=random.integers(0, 100, (2, *size)))
        start = [np.sort((to_numpy(world.ids).astype(int) * 100 + to_numpy(world["mark"])).reshape(2, -1))]
        for _ in range(4):
            world = sim.step(world, steps=3)
            now = np.sort((to_numpy(world.ids).astype(int) * 100 + to_numpy(world["mark"])).reshape(2, -1))
            assert np.array_equal(now, start[0])


def test_other_sizes_are_refused_everywhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert codes(tmp_path, MARGOLUS, 2) == []
    sim = package.compile(package.load("blocks.yaml"), backend="reference")
    with pytest.raises(ValueError, match="rows and columns must be a multiple of 2"):
        sim.world(np.zeros((5, 4), np.uint8))
    for arguments in (["run", "blocks.yaml", "--size", "7x8"], ["bench", "blocks.yaml", "--size", "7x8"]):
        result = command(*arguments, *(["--steps", "1"] if arguments[0] == "run" else []))
        assert result.exit_code == 2
        assert "multiple of 2" in result.stderr
    assert command("run", "blocks.yaml", "--steps", "1").exit_code == 0
    (tmp_path / "task.yaml").write_text(
        "task: odd\nrules: blocks.yaml\nsize: [63, 64]\nfill: a\nagent: {may: [b], speed: 1, actions: 4}\n"
        "reward: {each: count(b)}\n"
    )
    result = command("check", "task.yaml")
    assert result.exit_code == 2
    assert "PD607" in result.output
    text = (tmp_path / "blocks.yaml").read_text()
    (tmp_path / "blocks.yaml").write_text(
        text + "tests: [{odd: {given: b c b, after: 1 step, expect: b c b}}]\n"
    )
    assert "multiples of 2" in command("check", "blocks.yaml").output


def test_invariants_are_tried_on_worlds_that_fit(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert codes(tmp_path, MARGOLUS + "invariants: [count(b) is constant, b never changes]\n", 2) == []
    result = command("check", "blocks.yaml")
    assert result.exit_code == 2
    assert result.output.count("error[PD512]") == 1
    assert "b never changes" in result.output
