"""Moves that leave behind what their targets held, alone and in rows, and rules that overwrite each other."""

from __future__ import annotations

import numpy as np
import pytest

from powderdsl.analysis.ledger import ledger
from powderdsl.simulation.draw import to_numpy
from tests.semantics.texts import codes, load_text, mistakes, simulator

HEAD = """\
pack: road
elements:
  air: {id: 0, color: "#F8F9FA"}
  car: {id: 1, color: "#D62828"}
  bus: {id: 2, color: "#457B9D"}
  pit: {id: 3, color: "#1D3557"}
fields:
  drives: {type: flag, at: place}
  load: {type: 0..99, at: element}
  wear: {type: 0..99, at: place}
  speed: {type: vec2(-9..9), at: element}
passes:
  drive:
"""


def driven(body: str, ids: list[int], drives: list[int]) -> tuple[list[int], list[int]]:
    """Elements and loads of a row of cells after a step; at first each cell's load is its number."""
    sim = simulator(HEAD + body)
    numbers = np.arange(1, len(ids) + 1)[None, None]
    speed = np.stack([numbers[0], -numbers[0]])[None].astype(np.float32) / 4
    world = sim.replace(sim.world([[ids]]), drives=np.array([[drives]]), load=numbers, speed=speed)
    world = sim.step(world)
    loads = to_numpy(world["load"])[0]
    np.testing.assert_array_equal(to_numpy(world["speed"])[0, 0] * 4, loads)  # vectors travel as numbers do
    return to_numpy(world.ids)[0, 0].tolist(), loads[0].tolist()


MOVES = {
    "one alone trades places": (
        "    do: any moves right leaving right if drives and not right.drives\n",
        ([1, 2, 0], [1, 0, 0]),
        ([2, 1, 0], [2, 1, 3]),
    ),
    "a row advances, and the last keeps a copy of its target": (
        "    do: any moves right leaving right if drives\n",
        ([1, 2, 3, 0, 0], [1, 1, 1, 0, 0]),
        ([2, 1, 2, 3, 0], [2, 1, 2, 3, 5]),
    ),
    "a ring turns": (
        "    do: any moves right leaving right\n",
        ([1, 2, 3], [0, 0, 0]),
        ([3, 1, 2], [3, 1, 2]),
    ),
    "rows of one rule do not compete, and other rules do": (
        "    conflicts: first_wins\n    do:\n"
        "      - car moves right leaving right if drives\n      - bus moves left leaving left if drives\n",
        ([1, 1, 0, 2], [1, 1, 0, 1]),
        ([1, 1, 1, 2], [2, 1, 2, 4]),
    ),
    # Both go into the pit's place. The bus is written last, the car is lost, and the pit is there twice.
    "later rules overwrite earlier ones": (
        "    conflicts: overwrite\n    do:\n      - car swaps right if drives\n      - bus swaps left if drives\n",
        ([1, 3, 2], [1, 0, 1]),
        ([3, 2, 3], [2, 3, 2]),
    ),
}


@pytest.mark.parametrize("name", MOVES)
def test_rows_move(name: str) -> None:
    body, start, end = MOVES[name]
    assert driven(body, *start) == end


def test_only_the_target_can_be_left_behind() -> None:
    text = f"{HEAD}    do: car moves right leaving left if right is air\n"
    assert [code for code, _ in mistakes(text)] == ["PD405"]


@pytest.mark.parametrize(
    ("body", "constant"),
    [
        ("    do: car moves right leaving right if drives and right is air\n", {"car", "pit"}),
        ("    do: car moves right leaving right if drives and right is not car\n", {"car"}),
        (
            "    conflicts: overwrite\n    do:\n      - car swaps right if right is pit\n"
            "      - bus swaps left if left is pit\n",
            set(),
        ),
    ],
)
def test_the_ledger_knows_what_rows_and_overwriting_lose(body: str, constant: set[str]) -> None:
    sums = ledger(load_text(HEAD + body)).constant_sums
    assert {name for name in ("car", "pit") if (name,) in sums} == constant


@pytest.mark.parametrize(
    ("rule", "is_proven"),
    [
        ("swap right if wants and not left.wants", True),
        ("swap below.right if wants and not above.left.wants", True),
        ("swap right if wants and not (left.wants or left is pit)", True),
        ("swap right if wants and not right.wants", True),
        ("swap right if wants and not below.wants", False),
        ("swap right if wants or not left.wants", False),
        ("swap right if wants and (not left.wants or drives)", False),
    ],
)
def test_a_value_that_one_rule_needs_and_the_other_denies_keeps_them_apart(
    rule: str, is_proven: bool
) -> None:
    let = "    let: {wants: count(car in box(3)) > 5 and length(speed) > 1 or drives and load > 3}\n"
    assert ("PD501" not in codes(f"{HEAD}{let}    do: {rule}\n")) == is_proven
