"""Stored directions: their opposites, and what they are compared with."""

from __future__ import annotations

import contextlib

import numpy as np
import pytest

import powderdsl as package
from powderdsl.diagnostics import CompileError, Reporter, Source
from powderdsl.model.check import check
from powderdsl.model.declarations import PackDecl
from powderdsl.model.packs import read_file
from powderdsl.simulation.draw import to_numpy
from tests.compilers import skip_without_compiler

HEAD = """\
pack: compass
elements:
  air: {id: 0, color: "#101010"}
  bug: {id: 1, color: "#909090"}
fields:
  aim: {type: direction, at: place}
  back: {type: direction, at: place}
  heading: {type: direction, at: place}
  found: {type: flag, at: place}
passes:
  look:
"""

RIGHT, BELOW, LEFT, ABOVE_RIGHT = 0, 2, 4, 7
HEADINGS, AIMS = np.indices((8, 8))
"""Every heading with every aim: 0 to 7 from the right clockwise, as in saved worlds."""


def opposite(direction: np.ndarray) -> np.ndarray:
    """The direction with both of its steps reversed."""
    rows = np.array([0, 1, 1, 1, 0, -1, -1, -1])
    columns = np.array([1, 1, 0, -1, -1, -1, 0, 1])
    steps = {(y, x): octant for octant, (y, x) in enumerate(zip(rows, columns, strict=True))}
    return np.vectorize(lambda octant: steps[-rows[octant], -columns[octant]])(direction)


def reported(condition: str) -> list[str]:
    """Codes and messages for a rule with this condition."""
    reporter = Reporter()
    pack = read_file(Source("yard.yaml", f"{HEAD}    do: bug -> air if {condition}\n"), reporter)
    assert isinstance(pack, PackDecl)
    with contextlib.suppress(CompileError):
        check([pack], None, reporter)
    wanted = ("PD401", "PD503")
    return [f"{one.code}: {one.message}" for one in reporter.diagnostics if one.code in wanted]


@pytest.mark.parametrize("backend", ["reference", "torch", "native", "wasm"])
def test_the_opposite_points_the_other_way(tmp_path, backend):
    skip_without_compiler(backend)
    path = tmp_path / "compass.yaml"
    path.write_text(f"{HEAD}    do: ['back := opposite(heading)', 'aim := opposite(opposite(right.aim))']\n")
    sim = package.compile(package.load(path), backend=backend)
    world = sim.world(np.zeros((1, 8, 8), np.uint8))
    world = sim.step(sim.replace(world, heading=HEADINGS, aim=AIMS))
    np.testing.assert_array_equal(to_numpy(world["back"])[0], opposite(HEADINGS))
    np.testing.assert_array_equal(to_numpy(world["aim"])[0], np.roll(AIMS, -1, 1))


@pytest.mark.parametrize(
    ("condition", "expected"),
    [
        ("heading is aim", HEADINGS == AIMS),
        ("heading is not opposite(aim)", HEADINGS != opposite(AIMS)),
        ("left is heading", HEADINGS == LEFT),
        ("above.right is not opposite(heading)", HEADINGS != opposite(np.array(ABOVE_RIGHT))),
        ("opposite(heading) is left", HEADINGS == RIGHT),
        ("heading in (aim, below)", (HEADINGS == AIMS) | (HEADINGS == BELOW)),
        ("below in (aim, opposite(heading))", (AIMS == BELOW) | (opposite(HEADINGS) == BELOW)),
        ("any(side is aim and side is opposite(heading) for side in octants)", AIMS == opposite(HEADINGS)),
        ("(right if aim is left else heading) is right", (AIMS == LEFT) | (HEADINGS == RIGHT)),
        ("(heading if aim is not left else right) is right", (AIMS == LEFT) | (HEADINGS == RIGHT)),
        ("opposite(right if aim is left else heading) is left", (AIMS == LEFT) | (HEADINGS == RIGHT)),
    ],
)
def test_directions_are_compared_with_places_and_each_other(tmp_path, condition, expected):
    path = tmp_path / "compass.yaml"
    path.write_text(f"{HEAD}    do: found := {condition}\n")
    for backend in ("reference", "wasm"):
        sim = package.compile(package.load(path), backend=backend)
        world = sim.world(np.zeros((1, 8, 8), np.uint8))
        world = sim.step(sim.replace(world, heading=HEADINGS, aim=AIMS))
        np.testing.assert_array_equal(to_numpy(world["found"])[0], expected)


def test_the_checker_knows_what_opposites_exclude() -> None:
    assert reported("heading is opposite(aim) and aim is opposite(heading)") == []
    assert reported("heading is opposite(opposite(left)) and opposite(heading) is right") == []
    for never in (
        "heading is opposite(heading)",
        "heading is left and opposite(heading) is not right",
        "heading is aim and opposite(heading) is opposite(left) and aim is below",
    ):
        assert reported(never) == ["PD503: this rule can never fire"]


@pytest.mark.parametrize(
    ("condition", "message"),
    [
        ("opposite(3) is left", "expected a neighbor, found a number"),
        ("opposite(bug) is left", "expected a neighbor, found an element"),
        ("bug is heading", "expected a direction, found an element"),
        ("heading is bug", "expected an element, found a direction"),
        ("at(2, 0) is heading", "not a direction"),
    ],
)
def test_other_things_are_refused(condition: str, message: str) -> None:
    assert reported(condition) == [f"PD401: {message}"]
