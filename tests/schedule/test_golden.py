"""The plans of shipped rules as golden text: a change of plan is read before it is merged.

Small rules are printed whole. A long plan is a table with a row for each pass; its last column is a digest of the text.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from functools import cache
from hashlib import sha256
from pathlib import Path

import pytest

from powderdsl.compiler import load, lower
from powderdsl.ir.bits import segments
from powderdsl.ir.ops import REAL, Node, Program, ordered
from powderdsl.ir.text import print_program
from powderdsl.schedule.stages import PLANNERS, plan
from powderdsl.schedule.types import ANSWER, Compute, Guard, Move, Schedule, Sweeps, flat, print_schedule

GOLDEN = Path(__file__).parent / "golden"
UNREAD = {"powderworld2"}
"""Rules whose passes are nearly all in `powderworld`."""
SMALL = (
    *("life", "brians_brain", "cyclic", "margolus", "wireworld", "langtons_ant", "forest_fire"),
    "core+docs/examples/beetle.yaml",
)
LARGE = ("powderworld", "core+water+fire+lava+docs/examples/steam.yaml")


@cache
def planes(rules: str) -> tuple[Program, ...]:
    """The segments of rules that run on bit planes."""
    return tuple(part.planes for part in segments(lower(load(rules))) if part.planes is not None)


def schedules(rules: str, backend: str) -> list[Schedule]:
    return [plan(part, pass_, PLANNERS[backend]) for part in planes(rules) for pass_ in part.passes]


def work(nodes: Iterable[Node]) -> dict[str, int]:
    """The number of nodes of each kind that do something."""
    kinds = {
        "gates": ("and", "or", "xor", "not", "select", "when"),
        "shifts": ("shift",),
        "swaps": ("swap", "arrive"),
        "draws": ("chance", "below_planes", "below_param", "draw"),
    }
    by_op = {op: kind for kind, ops in kinds.items() for op in ops}
    counts = dict.fromkeys((*kinds, "floats", "answers", "others"), 0)
    for node in nodes:
        if node.type in (REAL, ANSWER):
            counts["floats" if node.type == REAL else "answers"] += bool(node.args)
        elif node.args or node.op in by_op:
            counts[by_op.get(node.op, "others")] += 1
    return counts


def schedule_rows(rules: str, backend: str) -> list[dict[str, str | int]]:
    rows: list[dict[str, str | int]] = []
    for schedule in schedules(rules, backend):
        statements = [*flat(schedule.body)]
        loops = [one for one in statements if isinstance(one, Compute) and one.over]
        row = {
            "pass": schedule.name,
            "loops": len(loops),
            "skipped": sum(loop.when is not None for loop in loops),
            "guards": sum(isinstance(one, Guard) for one in statements),
            "moves": sum(isinstance(one, Move) for one in statements),
            "joined": sum(len(one.body) for one in statements if isinstance(one, Sweeps)),
            "planes": sum(len(one.outs) for one in statements if isinstance(one, (Compute, Move))),
            "in place": sum(out.into is not None for one in statements for out in one.outs),
            "released": sum(len(one.frees) for one in statements),
        }
        values = [node for one in statements for node in ordered(one.values)]
        rows.append({**row, **work(values), "digest": digest(print_schedule(schedule))})
    return rows


def digest(text: str) -> str:
    """A digest of a plan without the places where its rules are written."""
    return sha256(re.sub(r" *# .*", "", text).encode()).hexdigest()[:8]


def table(rows: list[dict[str, str | int]]) -> str:
    """Rows as text, with their sum, without columns of zeros."""
    titles = [title for title in rows[0] if any(row[title] for row in rows)]
    sums = [sum(int(row[title]) for row in rows) for title in titles[1:-1]]
    lines = [titles, *([str(row[title]) for title in titles] for row in rows), ["all", *map(str, sums), ""]]
    return "".join(
        f"{name:8}{''.join(f'{cell:>10}' for cell in cells)}".rstrip() + "\n" for name, *cells in lines
    )


def file_of(rules: str, kind: str) -> Path:
    return GOLDEN / f"{rules.rpartition('/')[2].removesuffix('.yaml')}.{kind}.txt"


@pytest.mark.golden
@pytest.mark.parametrize("rules", SMALL)
def test_plans_of_small_rules(rules: str, golden: Callable[[Path, str], None]) -> None:
    golden(file_of(rules, "planes"), "\n".join(map(print_program, planes(rules))))
    for backend in ("native", "cuda"):
        golden(file_of(rules, backend), "\n\n".join(map(print_schedule, schedules(rules, backend))) + "\n")


@pytest.mark.golden
@pytest.mark.parametrize("rules", LARGE)
def test_plans_of_large_rules(rules: str, golden: Callable[[Path, str], None]) -> None:
    for backend in ("native", "cuda"):
        golden(file_of(rules, backend), table(schedule_rows(rules, backend)))


def test_every_shipped_ruleset_is_there() -> None:
    texts = {path.stem: f"\n{path.read_text()}" for path in Path("rules").glob("*.yaml")}
    shipped = {name for name, text in texts.items() if "\nruleset:" in text and "\nextends:" not in text}
    assert shipped - UNREAD <= {*SMALL, *LARGE}
