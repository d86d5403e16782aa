"""The plot of a report, and what is said where matplotlib is missing."""

from __future__ import annotations

import sys

import pytest
from PIL import Image

import powderdsl
from powderdsl.experiments.bench.machine import Machine
from powderdsl.experiments.bench.plan import make_plan
from powderdsl.experiments.bench.plot import require_matplotlib, write_plot
from powderdsl.experiments.bench.report import CellFigures, Report

MACHINE = Machine("Linux", "some processor", 4, "cpu", "3", "2", "none", "0", load=0.1)


def test_every_line_is_drawn(tmp_path):
    pytest.importorskip("matplotlib")
    life, times = powderdsl.load("life"), [1.0, 2.0]
    plan = make_plan(life, backends=["wasm", "native"], batches=[1, 32], sizes=[(8, 8), (16, 32)])
    cells = tuple(CellFigures(cell, 1.0, 1.0, None, 2, 5, times, times) for cell in plan.cells)
    colors = []
    for name, drawn in (("all.png", cells), ("one.png", cells[:1])):
        write_plot(tmp_path / name, Report(plan, MACHINE, drawn))
        with Image.open(tmp_path / name) as image:
            colors.append(len(image.convert("RGB").getcolors(1 << 24)))
    assert colors[0] > colors[1] > 10
    assert sorted(path.name for path in tmp_path.iterdir()) == ["all.png", "one.png"]


def test_without_matplotlib_the_fix_is_named(monkeypatch):
    for name in [name for name in sys.modules if name.partition(".")[0] == "matplotlib"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(powderdsl.CompileError) as caught:
        require_matplotlib()
    found = caught.value.diagnostics[0]
    assert found.code == "PD612"
    assert "pip install 'powderdsl[plot]'" in found.helps
