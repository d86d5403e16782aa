"""Directions and places: comparing, turning and picking them, in fields and in conditions; sines of angles."""

from __future__ import annotations

import math

import numpy as np
import pytest

from powderdsl.simulation.draw import to_numpy
from tests.semantics.texts import diagnosed, simulator

HEAD = """\
pack: compass
elements:
  air: {id: 0, color: "#101010"}
  bug: {id: 1, color: "#909090"}
  ant: {id: 2, color: "#707070"}
fields:
  aim: {type: direction, at: place}
  heading: {type: direction, at: place}
  turned: {type: direction, at: place}
  number: {type: 0..9, at: place}
  angle: {type: real(-1000000..1000000), at: place}
  sine: {type: real(-2..2), at: place}
  cosine: {type: real(-2..2), at: place}
  named: {type: element, at: place}
  mark: {type: flag, at: place}
streams: {luck: {bits: 32}}
passes:
  look:
"""

RIGHT, BELOW, LEFT, ABOVE_RIGHT = 0, 2, 4, 7
HEADINGS, AIMS = np.indices((8, 8))
"""Every heading with every aim: 0 to 7 from the right clockwise, as in saved worlds."""
OPPOSITE = (np.arange(8) + 4) % 8


def stepped(body: str, backend: str = "reference", ids=None, random=None, **fields):  # type: ignore[no-untyped-def]
    sim = simulator(HEAD + body, backend)
    shape = next(iter(fields.values())).shape if fields else (8, 8)
    world = sim.world(np.zeros((1, *shape[-2:]), np.uint8) if ids is None else ids)
    return sim.step(sim.replace(world, **fields), random=random)


# Comparisons


@pytest.mark.parametrize(
    ("condition", "expected"),
    [
        ("heading is aim", HEADINGS == AIMS),
        ("heading is not opposite(aim)", HEADINGS != OPPOSITE[AIMS]),
        ("left is heading", HEADINGS == LEFT),
        ("above.right is not opposite(heading)", HEADINGS != OPPOSITE[ABOVE_RIGHT]),
        ("heading in (aim, below)", (HEADINGS == AIMS) | (HEADINGS == BELOW)),
        ("below in (aim, opposite(heading))", (AIMS == BELOW) | (OPPOSITE[HEADINGS] == BELOW)),
        ("any(side is aim and side is opposite(heading) for side in octants)", AIMS == OPPOSITE[HEADINGS]),
        ("(heading if aim is not left else right) is right", (AIMS == LEFT) | (HEADINGS == RIGHT)),
        ("opposite(right if aim is left else heading) is left", (AIMS == LEFT) | (HEADINGS == RIGHT)),
    ],
)
def test_directions_are_compared_with_places_and_each_other(condition: str, expected: np.ndarray) -> None:
    world = stepped(f"    do: mark := {condition}\n", heading=HEADINGS, aim=AIMS)
    np.testing.assert_array_equal(to_numpy(world["mark"])[0], expected)


@pytest.mark.parametrize(
    ("condition", "fires"),
    [
        ("heading is opposite(aim) and aim is opposite(heading)", True),
        ("heading is opposite(opposite(left)) and opposite(heading) is right", True),
        ("heading is opposite(heading)", False),
        ("heading is left and opposite(heading) is not right", False),
        ("heading is aim and opposite(heading) is opposite(left) and aim is below", False),
    ],
)
def test_the_checker_knows_what_opposites_exclude(condition: str, fires: bool) -> None:
    found = diagnosed(f"{HEAD}    do: bug -> air if {condition}\n")
    messages = [one.message for one in found if one.code in ("PD401", "PD503")]
    assert messages == ([] if fires else ["this rule can never fire"])


# Turns


@pytest.mark.parametrize(("word", "eighths"), [("clockwise", 2), ("counterclockwise", 6), ("opposite", 4)])
def test_directions_turn(word: str, eighths: int) -> None:
    world = stepped(f"    do: turned := {word}(right.heading)\n", heading=HEADINGS.T)
    np.testing.assert_array_equal(to_numpy(world["turned"])[0], np.roll(HEADINGS.T + eighths, -1, 1) % 8)


@pytest.mark.parametrize(
    ("place", "expected"),
    [
        ("clockwise(right)", "below"),
        ("counterclockwise(right)", "above"),
        ("clockwise(clockwise(above.left))", "below.right"),
        ("clockwise(at(-1, 2))", "at(2, 1)"),
        ("opposite(clockwise(above))", "left"),
    ],
)
def test_places_turn(place: str, expected: str) -> None:
    ids = np.random.default_rng(3).integers(0, 3, (1, 7, 8)).astype(np.uint8)
    world = stepped(f"    do: mark := ({place} is bug) == ({expected} is bug)\n", ids=ids)
    assert to_numpy(world["mark"]).all()


def test_mirrored_copies_turn_the_other_way() -> None:
    body = "    symmetry: mirror\n    do: air -> bug if right is ant and clockwise(right) is ant\n"
    world = stepped(body, ids=[[[0, 0, 0, 0, 0], [0, 0, 2, 0, 0], [0, 2, 0, 2, 0]]])
    assert to_numpy(world.ids)[0].tolist() == [[0, 0, 0, 0, 0], [0, 1, 2, 1, 0], [0, 2, 0, 2, 0]]


# Draws


@pytest.mark.parametrize("count", [2, 3, 16])
def test_each_value_stands_for_a_part_of_the_draws(count: int) -> None:
    values = [(3 * number) % 10 for number in range(count)]
    draws = (np.arange(240, dtype=np.float64).reshape(1, 12, 20) + 0.5) / 240
    body = f"    do: number := pick(luck, {', '.join(map(str, values))})\n"
    world = stepped(body, ids=np.zeros((1, 12, 20), np.uint8), random={"luck": draws})
    expected = np.array(values)[np.floor(count * draws).astype(int)]
    np.testing.assert_array_equal(to_numpy(world["number"]), expected)


@pytest.mark.parametrize(
    ("rule", "field", "expected"),
    [
        ("heading := pick(luck, right, below, left, above)", "heading", [0, 2, 4, 6]),
        ("heading := left if luck < 50% else above.right", "heading", [4, 4, 7, 7]),
        ("named := pick(luck, bug, ant)", "named", [1, 1, 2, 2]),
        ("mark := right is pick(luck, left, right)", "mark", [0, 0, 1, 1]),
        ("mark := pick(luck, left, right) is pick(luck, left, above, below, right)", "mark", [1, 0, 0, 1]),
        ("heading := opposite(pick(luck, left, right))", "heading", [0, 0, 4, 4]),
        ("heading := clockwise(above if luck < 50% else below)", "heading", [0, 0, 4, 4]),
        ("mark := pick(luck, right, here) is ant", "mark", [1, 0, 0, 0]),
    ],
)
def test_places_are_directions_where_directions_are_expected(
    rule: str, field: str, expected: list[int]
) -> None:
    draws = {"luck": np.array([[[0.125, 0.375, 0.625, 0.875]]])}
    world = stepped(f'    do: "{rule}"\n', ids=[[[1, 2, 1, 1]]], random=draws)
    assert to_numpy(world[field])[0, 0].tolist() == expected


@pytest.mark.parametrize(
    ("rule", "problem"),
    [
        ("bug -> air if opposite(3) is left", "PD401: expected a neighbor, found a number"),
        ("bug -> air if opposite(bug) is left", "PD401: expected a neighbor, found an element"),
        ("bug -> air if bug is heading", "PD401: expected a direction, found an element"),
        ("bug -> air if heading is bug", "PD401: expected an element, found a direction"),
        ("bug -> air if at(2, 0) is heading", "PD401: not a direction"),
        ("number := pick(3, 1, 2)", "PD401"),
        ("number := pick(luck, 1)", "PD406"),
        ("number := pick(luck, 1, bug)", "PD401"),
        ("heading := pick(luck, left, 3)", "PD401"),
        ("number := pick(luck, left, right)", "PD401"),
        ("heading := clockwise(3)", "PD401"),
        ("angle := sin(bug)", "PD401"),
        ("mark := (left if luck < 50% else right).mark", "PD401"),
    ],
)
def test_what_cannot_be_compared_picked_or_turned_is_reported(rule: str, problem: str) -> None:
    found = [f"{one.code}: {one.message}" for one in diagnosed(f'{HEAD}    do: "{rule}"\n')]
    (reported,) = [one for one in found if one.startswith(("PD4", "PD503"))]
    assert reported.startswith(problem)


# Sines


def test_sines_are_close_and_those_of_the_oracle() -> None:
    body = "    do:\n      - sine := sin(angle)\n      - cosine := cos(angle)\n"
    angles = np.concatenate([np.linspace(-1000, 1000, 3000), np.linspace(0, 2 * math.pi, 1040), np.zeros(8)])
    angles = angles.astype(np.float32).reshape(1, 46, 88)
    oracle, world = (stepped(body, name, angle=angles) for name in ("reference", "wasm"))
    for field, exact in (("sine", np.sin(angles.astype(float))), ("cosine", np.cos(angles.astype(float)))):
        np.testing.assert_array_equal(to_numpy(world[field]), to_numpy(oracle[field]))
        assert np.abs(to_numpy(world[field]) - exact).max() < 2.0**-22
