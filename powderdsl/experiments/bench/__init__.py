"""How fast rules run: worlds, rounds of measuring, and reports as text, JSON and a plot.

`make_plan` says what is measured, `measure` does it, `report_text` and `report_data` show what came of it.
"""

from __future__ import annotations

from powderdsl.experiments.bench.measure import measure
from powderdsl.experiments.bench.plan import WORKLOADS, Cell, Plan, make_plan
from powderdsl.experiments.bench.report import CellFigures, Report, report_data, report_text

__all__ = [
    "WORKLOADS",
    "Cell",
    "CellFigures",
    "Plan",
    "Report",
    "make_plan",
    "measure",
    "report_data",
    "report_text",
]
