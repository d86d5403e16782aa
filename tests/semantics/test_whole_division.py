"""`a div b`: rounded down for all signs, 0 where b is 0, its range; coordinates under it."""

from __future__ import annotations

import numpy as np
import pytest

from powderdsl.simulation.draw import to_numpy
from powderdsl.testing.pack_tests.runner import run_examples
from tests.semantics.texts import codes, load_text, mistakes, simulator

HEAD = """\
pack: quotients
elements:
  one: {id: 0, color: "#101010"}
params:
  divisor: {type: -3..3, default: -3}
fields:
  x: {type: -33..40, at: place}
  y: {type: -7..6, at: place}
  few: {type: -9..9, at: place}
  many: {type: 0..60000, at: place}
"""
QUOTIENTS = {
    "x div y": lambda x, y, few, many: divide(x, y),
    "x div -4": lambda x, y, few, many: divide(x, -4),
    "100 div y": lambda x, y, few, many: divide(100, y),
    "few div -2": lambda x, y, few, many: divide(few, -2),
    "x div divisor": lambda x, y, few, many: divide(x, -3),
    "many div y": lambda x, y, few, many: np.clip(divide(many, y), -9000, 9000),
    "row div 2 mod 3": lambda x, y, few, many: np.indices(x.shape)[0] // 2 % 3,
    "(column + step - 1) div 5 mod 4": lambda x, y, few, many: np.indices(x.shape)[1] // 5 % 4,
}


def divide(a: np.ndarray | int, b: np.ndarray | int) -> np.ndarray:
    return np.where(np.equal(b, 0), 0, np.floor_divide(a, np.where(np.equal(b, 0), 1, b)))


def test_it_rounds_down_for_all_signs() -> None:
    fields = "".join(f"  f{number}: {{type: -9000..9000, at: place}}\n" for number in range(len(QUOTIENTS)))
    rules = "".join(f"      - f{number} := {quotient}\n" for number, quotient in enumerate(QUOTIENTS))
    sim = simulator(f"{HEAD}{fields}passes:\n  divide:\n    do:\n{rules}")
    x, y = np.meshgrid(np.arange(-33, 41), np.arange(-7, 7))
    few, many = np.clip(x, -9, 9), (x + 33) * 811
    world = sim.world(np.zeros((1, *x.shape), np.uint8))
    world = sim.step(sim.replace(world, x=x, y=y, few=few, many=many), steps=2)
    for number, (quotient, expected) in enumerate(QUOTIENTS.items()):
        assert np.array_equal(to_numpy(world[f"f{number}"])[0], expected(x, y, few, many)), quotient
    changed = sim.step(world, params={"quotients.divisor": 0})
    assert not to_numpy(changed["f4"]).any()


@pytest.mark.parametrize(
    ("value", "low", "high"),
    [
        ("x div y", -40, 40),
        ("x div 3", -11, 13),
        ("x div -4", -10, 8),
        ("many div 60001", 0, 0),
        ("x div (y + 10)", -11, 13),
        ("100 div y", -100, 100),
        ("few div (y mod 3 + 2)", -5, 4),
    ],
)
def test_its_range_is_known(value: str, low: int, high: int) -> None:
    """A field of exactly this range takes it without a warning; one that is smaller by one does not."""
    for lo, hi, cut in ((low, high, 0), (low, high - 1, 1), (low + 1, high, 1)):
        if lo <= hi:
            field = f"  f: {{type: {lo}..{hi}, at: place}}\n"
            found = codes(f"{HEAD}{field}passes: {{p: {{do: 'f := {value}'}}}}\n")
            assert found.count("PD408") == cut, (lo, hi)


@pytest.mark.parametrize(
    ("rule", "code", "under"),
    [
        ("x := x div 0", "PD402", "0"),
        ("x := x div (2 - 2)", "PD402", "2 - 2"),
        ("x := x div 1.5", "PD401", "1.5"),
        ("x := x div (x / 2)", "PD401", "x / 2"),
        ("x := 0.5 div x", "PD401", "0.5"),
        ("x := x // 2", "PD201", "/"),
        ("x := row div 2", "PD406", "row"),
        ("x := row div 9 mod 8", "PD405", "9"),
        ("x := row div x mod 8", "PD405", "x"),
    ],
)
def test_what_does_not_divide(rule: str, code: str, under: str) -> None:
    assert mistakes(f"{HEAD}passes: {{p: {{do: '{rule}'}}}}\n") == [(code, under)]


def test_constants_are_divided_when_rules_are_read() -> None:
    rules = load_text(
        "pack: constants\nelements: {a: {id: 0, color: '#000000'}, b: {id: 1, color: '#111111'}}\n"
        "passes: {p: {do: a -> b if -7 div 2 == -4 and 7 div -2 == -4 and 7 div 2 * 2 + 7 mod 2 == 7}}\n"
        "tests: [{t: {given: a, after: 1 step, expect: b}}]\n"
    )
    assert [result.problem for result in run_examples(rules)] == [""]
