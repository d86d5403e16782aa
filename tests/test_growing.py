"""What docs/compiler.md promises of new operations: rows of tables, or of a copy of the sources, which backends run."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import powderdsl
from powderdsl.compiler import load
from powderdsl.diagnostics import CompileError
from powderdsl.model import reference
from powderdsl.model.operations import FUNCTIONS, OPERATIONS, Operation
from powderdsl.model.types import REAL

PACKAGE = Path(powderdsl.__file__).parent

NEW = (
    Operation("square", "a number times itself", "square(A)", meaning="A * A"),
    Operation("sign", "-1, 0 or 1", "sign(A)", meaning="1 if A > 0 else -1 if A < 0 else 0"),
    Operation("root", "the square root", "root(A)", (REAL,), REAL, lowers="sqrt"),
)
"""Of these operations only `root` is one that others do not express."""

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

ROWS = {
    "ir/ops.py": (
        '    Op("distance", ("=", "="), "=", "", "", lambda a, b: (0, max(a.hi - b.lo, b.hi - a.lo, 0)),\n'
        "       lambda a, b: abs(a - b), commutative=True),\n"
    ),
    "ir/bits.py": (
        '    "distance": lambda gates, node, a, b: gates.choose(\n'
        "        gates.lt(a, b), gates.sub(b, a, node.type), gates.sub(a, b, node.type), node.type\n"
        "    ),\n"
    ),
    "targets/torch/source.py": '    "distance": "({0} - {1}).abs()",\n',
    "targets/cpp/cells.py": '    "distance": "magnitude({0} - {1})",\n',
    "targets/cuda/text.py": '    "distance": "MAGNITUDE({0} - {1})",\n',
    "targets/wasm/cells.py": '    "distance": lambda a, b: op("f32x4.abs", op("f32x4.sub", a, b)),\n',
}
"""The rows of an operation on integers or floats, each written before that of `abs`."""

RUN = """\
import torch
from powderdsl.ir.ops import REAL, Graph, PassGraph, Program, SlotType, SubstepGraph, integer
from powderdsl.ir.bits import choose_form, segments
from powderdsl.ir.stages import run_passes
from powderdsl.targets.cpp.source import native_source
from powderdsl.targets.cuda.source import cuda_source
from powderdsl.targets.job import Clock, Job
from powderdsl.targets.tensor_kind import Tensors
from powderdsl.targets.torch.program import TorchProgram
from powderdsl.targets.wasm.program import WasmProgram

build = Graph()
types = {"element": integer(0, 3), "n": integer(-9, 12), "x": REAL}
slots = tuple(SlotType(name, type, 0, False) for name, type in types.items())
element, n, x = (build.input(name, type) for name, type in types.items())
folded = build.derive("distance", build.integer(-2), build.integer(5))
far = build.derive("distance", n, element)
assert far.type == integer(0, 12), far.type
new = build.derive("min", build.derive("add", far, folded), build.integer(12))
real = build.derive("distance", x, build.derive("mul", x, build.real(3.0)))
writes = ("n", new), ("x", build.derive("clamp", real, attr=(-50.0, 50.0)))
program = Program("grown", slots, (), (), (PassGraph("p", "p", (SubstepGraph("", "", writes, ()),), writes),))
program = run_passes(program)

generator = torch.Generator().manual_seed(1)
state = {
    "element": torch.randint(0, 4, (2, 5, 33), generator=generator, dtype=torch.uint8),
    "n": torch.randint(-9, 13, (2, 5, 33), generator=generator, dtype=torch.int8),
    "x": torch.randn(2, 5, 33, generator=generator),
}
zeros = torch.zeros(2, dtype=torch.int64)
job = Job(state, Clock(zeros, zeros, zeros), 3, {}, {}, None)
(part,) = segments(program)
assert part.planes is not None, choose_form(program, program.passes[0]).why
results = [
    runnable.run(job)
    for runnable in (TorchProgram(program, torch.device("cpu")), WasmProgram(program, part.planes, Tensors()))
]
wanted = dict(state)
for _ in range(3):
    wanted["n"] = ((wanted["n"].int() - wanted["element"].int()).abs() + 7).clamp(max=12)
    wanted["x"] = (wanted["x"] - wanted["x"] * 3).abs().clamp(-50, 50)
for result in results:
    assert torch.equal(result["n"].int(), wanted["n"])
    assert torch.equal(result["x"], wanted["x"])
assert "magnitude(" in native_source(part.planes, 64).passes
assert "MAGNITUDE(" in cuda_source(part.planes, 16, 16, 1 << 16).text
"""


def run_grown(folder: Path, edits: dict[str, tuple[str, str]], program: str) -> None:
    """Run a program with a copy of the package in which texts are replaced."""
    copy = folder / "powderdsl"
    shutil.copytree(PACKAGE, copy)  # with the compiled files, whose times it keeps
    for name, (before, after) in edits.items():
        text = (copy / name).read_text("utf-8")
        assert text.count(before) == 1
        (copy / name).write_text(text.replace(before, after), "utf-8")
    environment = {**os.environ, "PYTHONPATH": str(folder)}
    command = [sys.executable, "-c", program]
    result = subprocess.run(command, env=environment, cwd=folder, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr


def test_an_operation_that_others_express_is_one_row_and_the_oracles(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for operation in NEW:
        for table in (FUNCTIONS, OPERATIONS):
            monkeypatch.setitem(table, operation.name, operation)
    monkeypatch.setitem(reference._OPS, "root", lambda e, at, a: np.sqrt(a))
    rules = tmp_path / "growth.yaml"
    rules.write_text(RULES, "utf-8")
    states = []
    for backend in ("reference", "wasm"):
        simulator = powderdsl.compile(str(rules), backend=backend)
        world = simulator.step(simulator.world(np.zeros((2, 7, 33), np.uint8), seed=1), 6)
        states.append({name: value.tolist() for name, value in world.state.items()})
    assert states[0] == states[1]
    assert len({number for grid in states[0]["z"] for row in grid for number in row}) > 5


def test_an_operation_of_the_ir_is_a_row_in_each_table(tmp_path: Path) -> None:
    edits = {}
    for name, row in ROWS.items():
        lines = (PACKAGE / name).read_text("utf-8").splitlines(keepends=True)
        (before,) = [line for line in lines if line.strip().startswith(('"abs":', 'Op("abs",'))]
        edits[name] = (before, row + before)
    run_grown(tmp_path, edits, RUN)


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
