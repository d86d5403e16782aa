"""What docs/architecture.md promises of new operations of the IR: a row in each table, in a copy of the sources, that targets run."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import powderdsl

PACKAGE = Path(powderdsl.__file__).parent

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
from powderdsl.ir.segments import carry, segments
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
writes = ("n", new), ("x", build.derive("settle", real, attr=(-50.0, 50.0)))
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
assert part.planes is not None, carry(program, program.passes[0]).why
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
assert "magnitude(" in native_source(part.planes, 64).text
assert "MAGNITUDE(" in cuda_source(part.planes, 16, 16, 1 << 16).text
"""


def test_an_operation_is_a_row_in_each_table(tmp_path: Path) -> None:
    copy = tmp_path / "powderdsl"
    shutil.copytree(PACKAGE, copy)  # with the compiled files, whose times it keeps
    for name, row in ROWS.items():
        lines = (copy / name).read_text("utf-8").splitlines(keepends=True)
        (place,) = [i for i, line in enumerate(lines) if line.strip().startswith(('"abs":', 'Op("abs",'))]
        (copy / name).write_text("".join([*lines[:place], row, *lines[place:]]), "utf-8")
    result = subprocess.run(
        [sys.executable, "-c", RUN],
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert result.returncode == 0, result.stderr
