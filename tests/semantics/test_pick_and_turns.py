"""Values chosen by a draw, places turned around a cell, choices of places, sines."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

import powderdsl
from powderdsl.diagnostics import CompileError
from powderdsl.simulation.draw import to_numpy
from tests.compilers import skip_without_compiler

HEAD = """\
pack: compass
elements:
  air: {id: 0, color: "#101010"}
  bug: {id: 1, color: "#909090"}
  ant: {id: 2, color: "#707070"}
fields:
  heading: {type: direction, at: place}
  number: {type: 0..9, at: place}
  angle: {type: real(-1000000..1000000), at: place}
  sine: {type: real(-2..2), at: place}
  cosine: {type: real(-2..2), at: place}
  named: {type: element, at: place}
  found: {type: flag, at: place}
streams: {luck: {bits: 32}}
passes:
  look:
"""
BACKENDS = ["reference", "torch", "native", "wasm"]


def simulator(tmp_path: Path, body: str, backend: str = "reference"):  # type: ignore[no-untyped-def]
    skip_without_compiler(backend)
    path = tmp_path / "compass.yaml"
    path.write_text(HEAD + body)
    return powderdsl.compile(powderdsl.load(path), backend=backend)


# Draws


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("count", [2, 3, 4, 5, 16])
def test_each_value_stands_for_a_part_of_the_draws(tmp_path: Path, backend: str, count: int) -> None:
    values = [(3 * number) % 10 for number in range(count)]
    listed = ", ".join(map(str, values))
    sim = simulator(tmp_path, f"    do: number := pick(luck, {listed})\n", backend)
    draws = (np.arange(240, dtype=np.float64).reshape(1, 12, 20) + 0.5) / 240
    given = draws if backend == "reference" else __import__("torch").from_numpy(draws)
    world = sim.step(sim.world(np.zeros((1, 12, 20), np.uint8)), random={"luck": given})
    expected = np.array(values)[np.floor(count * draws).astype(int)]
    np.testing.assert_array_equal(to_numpy(world["number"]), expected)


@pytest.mark.parametrize(
    ("rule", "field", "expected"),
    [
        ("heading := pick(luck, right, below, left, above)", "heading", [0, 2, 4, 6]),
        ("heading := left if luck < 50% else above.right", "heading", [4, 4, 7, 7]),
        ("named := pick(luck, bug, ant)", "named", [1, 1, 2, 2]),
        ("found := pick(luck, left, right) is right", "found", [0, 0, 1, 1]),
        ("found := right is pick(luck, left, right)", "found", [0, 0, 1, 1]),
        ("found := pick(luck, left, right) is pick(luck, left, above, below, right)", "found", [1, 0, 0, 1]),
        ("heading := opposite(pick(luck, left, right))", "heading", [0, 0, 4, 4]),
        ("heading := clockwise(above if luck < 50% else below)", "heading", [0, 0, 4, 4]),
        ("found := pick(luck, right, here) is ant", "found", [1, 0, 0, 0]),
    ],
)
def test_places_are_directions_where_directions_are_expected(
    tmp_path: Path, rule: str, field: str, expected: list[int]
) -> None:
    sim = simulator(tmp_path, f'    do: "{rule}"\n')
    draws = np.array([[[0.125, 0.375, 0.625, 0.875]]])
    world = sim.step(sim.world([[[1, 2, 1, 1]]]), random={"luck": draws})
    assert to_numpy(world[field])[0, 0].tolist() == expected


@pytest.mark.parametrize(
    ("rule", "code"),
    [
        ("number := pick(3, 1, 2)", "PD401"),
        ("number := pick(luck, 1)", "PD406"),
        ("number := pick(luck, 1, bug)", "PD401"),
        ("heading := pick(luck, left, 3)", "PD401"),
        ("number := pick(luck, left, right)", "PD401"),
        ("heading := clockwise(3)", "PD401"),
        ("angle := sin(bug)", "PD401"),
        ("found := (left if luck < 50% else right).found", "PD401"),
    ],
)
def test_what_cannot_be_picked_or_turned_is_reported(tmp_path: Path, rule: str, code: str) -> None:
    with pytest.raises(CompileError) as caught:
        simulator(tmp_path, f'    do: "{rule}"\n')
    assert code in [one.code for one in caught.value.diagnostics]


# Turns


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(("word", "eighths"), [("clockwise", 2), ("counterclockwise", 6), ("opposite", 4)])
def test_directions_turn(tmp_path: Path, backend: str, word: str, eighths: int) -> None:
    sim = simulator(tmp_path, f"    do: heading := {word}(heading)\n", backend)
    headings = np.arange(8).reshape(1, 1, 8)
    world = sim.step(sim.replace(sim.world(np.zeros((1, 1, 8), np.uint8)), heading=headings))
    np.testing.assert_array_equal(to_numpy(world["heading"]), (headings + eighths) % 8)


@pytest.mark.parametrize(
    ("place", "expected"),
    [
        ("clockwise(right)", "below"),
        ("clockwise(below)", "left"),
        ("counterclockwise(right)", "above"),
        ("clockwise(clockwise(above.left))", "below.right"),
        ("clockwise(at(-1, 2))", "at(2, 1)"),
        ("opposite(clockwise(above))", "left"),
    ],
)
def test_places_turn(tmp_path: Path, place: str, expected: str) -> None:
    sim = simulator(tmp_path, f"    do: found := ({place} is bug) == ({expected} is bug)\n")
    ids = np.random.default_rng(3).integers(0, 3, (1, 7, 8)).astype(np.uint8)
    assert to_numpy(sim.step(sim.world(ids))["found"]).all()


def test_mirrored_copies_turn_the_other_way(tmp_path: Path) -> None:
    sim = simulator(
        tmp_path, "    symmetry: mirror\n    do: air -> bug if right is ant and clockwise(right) is ant\n"
    )
    mirrored = [[0, 0, 0, 0, 0], [0, 0, 2, 0, 0], [0, 0, 0, 0, 0]]
    mirrored[2][1] = mirrored[2][3] = 2
    found = to_numpy(sim.step(sim.world([mirrored])).ids)[0]
    assert found.tolist() == [[0, 0, 0, 0, 0], [0, 1, 2, 1, 0], [0, 2, 0, 2, 0]]


# Waves


@pytest.mark.parametrize("backend", BACKENDS)
def test_sines_are_the_same_everywhere_and_close(tmp_path: Path, backend: str) -> None:
    body = "    do:\n      - sine := sin(angle)\n      - cosine := cos(angle)\n"
    angles = np.concatenate([np.linspace(-1000, 1000, 3000), np.linspace(0, 2 * math.pi, 1040), np.zeros(8)])
    angles = angles.astype(np.float32).reshape(1, 46, 88)
    found = []
    for name in ("reference", backend):
        sim = simulator(tmp_path, body, name)
        world = sim.step(sim.replace(sim.world(np.zeros(angles.shape, np.uint8)), angle=angles))
        found.append([to_numpy(world[field]) for field in ("sine", "cosine")])
    np.testing.assert_array_equal(found[0], found[1])
    wide = angles.astype(np.float64)
    for values, exact in zip(found[0], (np.sin(wide), np.cos(wide)), strict=True):
        assert np.abs(values - exact).max() < 2.0**-22


def test_a_random_direction_has_length_one(tmp_path: Path) -> None:
    sim = simulator(
        tmp_path,
        "    let: {turn: 6.2831853 * luck}\n    do: found := 0.999999 < length(vector(cos(turn), sin(turn))) < 1.000001\n",
    )
    assert to_numpy(sim.step(sim.world(np.zeros((2, 32, 32), np.uint8)))["found"]).all()
