"""`a div b`: rounded down for all signs, 0 where b is 0, the same on every backend; its range; coordinates under it."""

from __future__ import annotations

from fractions import Fraction
from math import floor

import numpy as np
import pytest

import powderdsl as package
from powderdsl.diagnostics import CompileError
from powderdsl.simulation.draw import to_numpy

PACK = """\
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
  f0: {type: -40..41, at: place}
  f1: {type: -12..13, at: place}
  f2: {type: -11..8, at: place}
  f3: {type: -100..100, at: place}
  f4: {type: -9..9, at: place}
  f5: {type: -100..100, at: place}
  f6: {type: -9000..9000, at: place}
  f7: {type: 0..2, at: place}
  f8: {type: 0..3, at: place}
passes:
  divide:
    do:
      - f0 := x div y
      - f1 := x div 3
      - f2 := x div -4
      - f3 := 100 div y
      - f4 := few div -2
      - f5 := x div divisor
      - f6 := many div y
      - f7 := row div 2 mod 3
      - f8 := (column + step - 1) div 5 mod 4
"""


def exact(a: int, b: int) -> int:
    return floor(Fraction(a, b)) if b else 0


@pytest.mark.parametrize("backend", ["reference", "torch", "native", "wasm"])
def test_it_rounds_down_for_all_signs(tmp_path, backend):
    path = tmp_path / "quotients.yaml"
    path.write_text(PACK)
    sim = package.compile(package.load(path), backend=backend)
    x, y = np.meshgrid(np.arange(-33, 41), np.arange(-7, 7))
    few, many = np.clip(x, -9, 9), (x + 33) * 811
    world = sim.world(np.zeros((1, *x.shape), np.uint8))
    world = sim.step(sim.replace(world, x=x, y=y, few=few, many=many), steps=2)
    divide = np.vectorize(exact)
    rows, columns = np.indices(x.shape)
    expected = [
        divide(x, y),
        divide(x, 3),
        divide(x, -4),
        divide(100, y),
        divide(few, -2),
        divide(x, -3),
        np.clip(divide(many, y), -9000, 9000),
        rows // 2 % 3,
        columns // 5 % 4,
    ]
    for number, wanted in enumerate(expected):
        assert np.array_equal(to_numpy(world[f"f{number}"])[0], wanted), f"f{number}"
    changed = sim.step(world, params={"quotients.divisor": 0})
    assert not to_numpy(changed["f5"]).any()


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
def test_its_range_is_known(tmp_path, value, low, high):
    """A field of exactly this range takes it without a warning; one that is smaller by one does not."""
    for lo, hi, codes in ((low, high, []), (low, high - 1, ["PD408"]), (low + 1, high, ["PD408"])):
        if lo > hi:
            continue
        path = tmp_path / "ranges.yaml"
        head = PACK.split("  f0:")[0].replace("quotients", "ranges")
        path.write_text(
            f"{head}  f: {{type: {lo}..{hi}, at: place}}\npasses: {{p: {{do: 'f := {value}'}}}}\n"
        )
        _, found = package.compiler.load_with_diagnostics(path)
        assert [one.code for one in found if one.code == "PD408"] == codes, (lo, hi)


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
def test_what_does_not_divide(tmp_path, rule, code, under):
    path = tmp_path / "wrong.yaml"
    head = PACK.split("  f0:")[0].replace("quotients", "wrong")
    path.write_text(f"{head}passes: {{p: {{do: '{rule}'}}}}\n")
    with pytest.raises(CompileError) as raised:
        package.load(path)
    (found,) = raised.value.diagnostics
    assert found.code == code
    assert found.primary.span.text == under


def test_constants_are_divided_when_rules_are_read(tmp_path):
    path = tmp_path / "constants.yaml"
    path.write_text(
        "pack: constants\nelements: {a: {id: 0, color: '#000000'}, b: {id: 1, color: '#111111'}}\n"
        "passes: {p: {do: a -> b if -7 div 2 == -4 and 7 div -2 == -4 and 7 div 2 * 2 + 7 mod 2 == 7}}\n"
        "tests: [{t: {given: a, after: 1 step, expect: b}}]\n"
    )
    from powderdsl.testing.pack_tests.runner import run_examples

    assert [one.problem for one in run_examples(package.load(path))] == [""]
