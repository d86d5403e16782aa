"""The plot of a report, and what is said where matplotlib is missing."""

from __future__ import annotations

import sys

import pytest
from PIL import Image

import powderdsl
from powderdsl.experiments.bench import make_plan
from powderdsl.experiments.bench.machine import Machine, Memory
from powderdsl.experiments.bench.plot import require_matplotlib, write_plot
from powderdsl.experiments.bench.report import CellFigures, make_report

MACHINE = Machine("Linux", "some processor", 4, "cpu", "3", "2", "none", "0", load=0.1)


def a_report(sizes):
    plan = make_plan(powderdsl.load("life"), backends=["wasm", "native"], batches=[1, 32], sizes=sizes)
    memory, times = Memory(0, "not at all"), [1.0, 2.0]
    cells = [CellFigures(cell, 1.0, 1.0, memory, 100, 2, 5, times, times) for cell in plan.cells]
    return make_report(plan, MACHINE, cells)


def test_several_sizes_have_a_figure_of_their_own(tmp_path):
    pytest.importorskip("matplotlib")
    widths = []
    for name, sizes in (("one.png", [(8, 8)]), ("two.png", [(8, 8), (16, 32)])):
        write_plot(tmp_path / name, a_report(sizes))
        with Image.open(tmp_path / name) as image:
            widths.append(image.width)
            assert len(image.convert("RGB").getcolors(1 << 24)) > 10
    assert widths[1] > widths[0]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["one.png", "two.png"]


def test_without_matplotlib_the_fix_is_named(monkeypatch):
    for name in [name for name in sys.modules if name.partition(".")[0] == "matplotlib"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(powderdsl.CompileError) as caught:
        require_matplotlib()
    found = caught.value.diagnostics[0]
    assert found.code == "PD612"
    assert "pip install 'powderdsl[plot]'" in found.helps
