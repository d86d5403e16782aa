"""Moves that leave behind what their targets held, alone and in rows, and rules that overwrite each other."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import powderdsl
from powderdsl.analysis.ledger import ledger
from powderdsl.compiler import load_with_diagnostics
from powderdsl.diagnostics import CompileError
from powderdsl.simulation.draw import to_numpy
from tests.compilers import skip_without_compiler

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
BACKENDS = ["reference", "torch", "native", "wasm"]


def rules(tmp_path: Path, body: str) -> Path:
    path = tmp_path / "road.yaml"
    path.write_text(HEAD + body)
    return path


def driven(path: Path, backend: str, ids: list[list[int]], drives: list[list[int]]) -> tuple[list, list]:  # type: ignore[type-arg]
    """Elements and loads after a step; at first each cell's load is its number."""
    skip_without_compiler(backend)
    sim = powderdsl.compile(powderdsl.load(path), backend=backend)
    cells = np.array(ids)
    numbers = np.arange(1, cells.size + 1).reshape(cells.shape)
    speed = np.stack([numbers, -numbers])[None].astype(np.float32) / 4
    world = sim.replace(
        sim.world(cells[None].astype(np.uint8)), drives=np.array([drives]), load=numbers[None], speed=speed
    )
    world = sim.step(world)
    loads = to_numpy(world["load"])[0]
    np.testing.assert_array_equal(to_numpy(world["speed"])[0, 0] * 4, loads)  # vectors travel as numbers do
    return to_numpy(world.ids)[0].tolist(), loads.tolist()


@pytest.mark.parametrize("backend", BACKENDS)
def test_one_alone_trades_places(tmp_path: Path, backend: str) -> None:
    path = rules(tmp_path, "    do: any moves right leaving right if drives and not right.drives\n")
    found = driven(path, backend, [[1, 2, 0]], [[1, 0, 0]])
    assert found == ([[2, 1, 0]], [[2, 1, 3]])


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_row_advances_and_the_last_keeps_a_copy_of_its_target(tmp_path: Path, backend: str) -> None:
    path = rules(tmp_path, "    do: any moves right leaving right if drives\n")
    found = driven(path, backend, [[1, 2, 3, 0, 0]], [[1, 1, 1, 0, 0]])
    assert found == ([[2, 1, 2, 3, 0]], [[2, 1, 2, 3, 5]])


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_ring_turns(tmp_path: Path, backend: str) -> None:
    path = rules(tmp_path, "    do: any moves right leaving right\n")
    assert driven(path, backend, [[1, 2, 3]], [[0, 0, 0]]) == ([[3, 1, 2]], [[3, 1, 2]])


@pytest.mark.parametrize("backend", BACKENDS)
def test_rows_of_one_rule_do_not_compete_and_other_rules_do(tmp_path: Path, backend: str) -> None:
    path = rules(
        tmp_path,
        "    conflicts: first_wins\n    do:\n"
        "      - car moves right leaving right if drives\n      - bus moves left leaving left if drives\n",
    )
    assert driven(path, backend, [[1, 1, 0, 2]], [[1, 1, 0, 1]]) == ([[1, 1, 1, 2]], [[2, 1, 2, 4]])


@pytest.mark.parametrize("backend", BACKENDS)
def test_later_rules_overwrite_earlier_ones(tmp_path: Path, backend: str) -> None:
    path = rules(
        tmp_path,
        "    conflicts: overwrite\n    do:\n      - car swaps right if drives\n      - bus swaps left if drives\n",
    )
    # Both go into the pit's place. The bus is written last, the car is lost, and the pit is there twice.
    assert driven(path, backend, [[1, 3, 2]], [[1, 0, 1]]) == ([[3, 2, 3]], [[2, 3, 2]])


def test_what_is_left_is_what_the_target_held(tmp_path: Path) -> None:
    path = rules(tmp_path, "    do: car moves right leaving left if right is air\n")
    with pytest.raises(CompileError, match="what is left behind") as caught:
        powderdsl.load(path)
    assert [one.code for one in caught.value.diagnostics] == ["PD405"]


def test_the_ledger_knows_that_rows_over_one_element_lose_nothing(tmp_path: Path) -> None:
    one = powderdsl.load(
        rules(tmp_path, "    do: car moves right leaving right if drives and right is air\n")
    )
    assert ("car",) in ledger(one).constant_sums
    any_ = powderdsl.load(
        rules(tmp_path, "    do: car moves right leaving right if drives and right is not car\n")
    )
    assert ("car",) in ledger(any_).constant_sums
    assert ("pit",) not in ledger(any_).constant_sums


def test_the_ledger_knows_that_overwriting_loses_things(tmp_path: Path) -> None:
    body = "    conflicts: overwrite\n    do:\n      - car swaps right if right is pit\n      - bus swaps left if left is pit\n"
    found = ledger(powderdsl.load(rules(tmp_path, body)))
    assert ("car",) not in found.constant_sums
    assert ("pit",) not in found.constant_sums


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
    tmp_path: Path, rule: str, is_proven: bool
) -> None:
    let = "    let: {wants: count(car in box(3)) > 5 and length(speed) > 1 or drives and load > 3}\n"
    path = rules(tmp_path, f"{let}    do: {rule}\n")
    try:
        found = [one.code for one in load_with_diagnostics(path)[1]]
    except CompileError as error:
        found = [one.code for one in error.diagnostics]
    assert ("PD501" not in found) == is_proven
