"""What docs/architecture.md promises of new operations: a row or two, in a copy of the sources, that every backend runs."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import powderdsl
from powderdsl.compiler import load
from powderdsl.diagnostics import CompileError
from powderdsl.model.operations import FUNCTIONS, Operation

PACKAGE = Path(powderdsl.__file__).parent

ROW = "    # Numbers\n"
NEW = {
    "model/operations.py": (
        ROW,
        ROW
        + '    Operation("square", "a number times itself", "square(A)", meaning="A * A"),\n'
        + '    Operation("sign", "-1, 0 or 1", "sign(A)", meaning="1 if A > 0 else -1 if A < 0 else 0"),\n'
        + '    Operation("root", "the square root", "root(A)", (REAL,), REAL, lowers="sqrt"),\n',
    ),
    "model/reference.py": (
        "_OPS: dict[str, Any] = {\n",
        '_OPS: dict[str, Any] = {\n    "root": lambda e, at, a: np.sqrt(a),\n',
    ),
}
"""Files, a text in them, and what is written instead. Of these operations only `root` is one that others do not express."""

RULES = """\
pack: growth
elements:
  air: {id: 0, color: "#101010"}
  rock: {id: 1, color: "#909090"}
fields:
  x: {type: -9..9, at: place}
  y: {type: 0..81, at: place}
  z: {type: real(-50..50), at: place, default: 2}
passes:
  grow:
    do:
      - x += sign(2 - y) + row mod 3 - column mod 2
      - y := square(x)
      - z := sign(x) * root(square(left.z) + y)
      - air -> rock if sign(z) == square(sign(below.x))
"""

RUN = """\
import sys
import numpy as np
from powderdsl.simulation.simulator import compile as compile_rules

states = []
for backend in ("reference", "wasm"):
    simulator = compile_rules(sys.argv[1], backend)
    world = simulator.world(np.zeros((2, 7, 33), np.uint8), seed=1)
    for _ in range(6):
        world = simulator.step(world)
    states.append({name: value.tolist() for name, value in world.state.items()})
assert states[0] == states[1]
assert len({number for grid in states[0]["z"] for row in grid for number in row}) > 5
"""


def test_an_operation_that_others_express_is_one_row_and_the_oracles(tmp_path: Path) -> None:
    copy = tmp_path / "powderdsl"
    shutil.copytree(PACKAGE, copy)  # with the compiled files, whose times it keeps
    (tmp_path / "rules").mkdir()
    for name, (before, after) in NEW.items():
        text = (copy / name).read_text("utf-8")
        assert text.count(before) == 1
        (copy / name).write_text(text.replace(before, after), "utf-8")
    rules = tmp_path / "growth.yaml"
    rules.write_text(RULES, "utf-8")
    result = subprocess.run(
        [sys.executable, "-c", RUN, str(rules)],
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert result.returncode == 0, result.stderr


def test_what_repeats_its_argument_does_not_grow_without_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(FUNCTIONS, "twice", Operation("twice", usage="twice(A)", meaning="A + A"))
    rules = tmp_path / "twice.yaml"
    for depth in (4, 30):
        nested = "twice(" * depth + "x" + ")" * depth
        rules.write_text(
            f"pack: twice\nelements: {{air: {{id: 0, color: '#101010'}}}}\nfields: {{x: {{type: 0..1, at: place}}}}\n"
            f"passes: {{a: {{do: 'x += {nested}'}}}}\n",
            "utf-8",
        )
        if depth == 4:
            load(str(rules))
        else:
            with pytest.raises(CompileError, match="PD508"):
                load(str(rules))
