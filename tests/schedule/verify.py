"""The rules that every legal schedule obeys."""

from __future__ import annotations

from collections.abc import Sequence

from powderdsl.ir.ops import FLAG, OPS, REAL, Node, Type, ordered
from powderdsl.schedule.types import (
    ANSWER,
    Compute,
    Guard,
    Move,
    Schedule,
    Statement,
    Sweeps,
    Var,
    alternatives,
    field_reads,
    in_order,
    loaded,
    read_elsewhere,
)
from tests.ir.verify import InvalidIR, demand

SCHEDULE_OPS = {"load", "below_param", "any", "some", "when", "led", "live", "present"}
"""Operations that only schedules have."""

_KINDS = ("flag", "real", ANSWER.name)


def verify(schedule: Schedule, after: str) -> None:
    """Raise InvalidIR unless the schedule is legal.

    Variables are assigned once, and read only after their statement, in the same block or a nested one, and before their
    release. A guard keeps variables of its body, with alternatives of the same type. Values contain no slots.
    """
    try:
        checker = _Checker({var.name: var for _, var in schedule.inputs})
        checker.values(schedule.results, checker.block(schedule.body, set(checker.vars)))
    except InvalidIR as error:
        raise InvalidIR(f"after {after}, pass {schedule.name}: {error}") from None


class _Checker:
    def __init__(self, vars: dict[str, Var]):
        self.vars = vars
        self.checked: set[Node] = set()

    def block(self, body: Sequence[Statement], live: set[str]) -> set[str]:
        """The variables that exist after a block."""
        for statement in body:
            self.values(statement.values, live)
            for out in statement.outs:
                for node in (out.value, out.otherwise or out.value):
                    demand(node.type == out.var.type, f"{out.var.name} gets a {node.type}")
            end, skipped = self.block(statement.body, live), self.block(statement.otherwise, live)
            names, ended = statement.vars.keys(), statement.ended
            if isinstance(statement, Guard):
                demand(names <= end, f"{in_order(names - end)} are kept, but not made")
                made = skipped - live - names
                demand(not made, f"{in_order(made)} are made only where a body is skipped")
                live = live & end | names  # the body defines them; outside they exist from its end
                continue
            if isinstance(statement, Sweeps):
                _check_order(statement)
                live = end.difference(statement.frees)
                continue
            demand(ended <= live, f"{in_order(ended - live)} are released or overwritten, but not there")
            if isinstance(statement, Compute):
                demand(
                    all(part.op in ("load", "live") for part in alternatives(statement.region)),
                    "a region is made of stored flags and live fields",
                )
                far = read_elsewhere(statement.values) if statement.over == "words" else set()
                demand(not ended & far, f"{in_order(ended & far)} are overwritten, but read at neighbors")
            elif isinstance(statement, Move) and {var.type for var in statement.vars.values()} != {FLAG}:
                same = all(out.value is out.otherwise and out.var.type == REAL for out in statement.outs)
                demand(same and statement.op == "swap", "floats are exchanged, apart from flags")
            live = live - ended
            for name, var in statement.vars.items():
                demand(self.vars.setdefault(name, var) is var, f"two variables are called {name}")
                demand(name not in live, f"{name} is assigned twice")
                live.add(name)
        return live

    def values(self, roots: Sequence[Node], live: set[str]) -> None:
        for node in ordered(roots):
            if node.op == "load":
                demand(node.attr in live, f"{node.attr} is read, but not there")
                demand(self.vars[node.attr].type == node.type, f"{node.attr} is read as a {node.type}")
            elif node not in self.checked:
                self.checked.add(node)
                demand(node.op in OPS or node.op in SCHEDULE_OPS, f"unknown operation {node.op}")
                demand(node.op != "input", "a value reads a slot")
                demand(node.type.name in _KINDS, f"a value is a {node.type}")


def _check_order(sweeps: Sweeps) -> None:
    """A row is computed before loops that run together read it, or hold masks of choices; none reads it around the edge."""
    made: dict[str, tuple[int, int, Type]] = {}
    seen: list[tuple[str, int]] = []
    for loop in sweeps.body:
        part, lag = loop.part, loop.lag
        for read in field_reads(loop):
            before, behind, _ = made.get(read.name, (part, lag - read.dy, REAL))
            if before == part:
                around = read.name in made and read.wraps and read.dy
                demand(not around, f"{read.name} is read around the edge")
                demand(lag >= behind + read.dy, f"{read.name} is read before it is there")
            else:
                demand(read.name not in sweeps.frees, f"{read.name} is gone when it is read")
        if loop.over == "choices":
            early = [name for name in loaded(loop.values) if name in made and made[name][2] == FLAG]
            demand(not early, f"choices are made by {early}, which are not there in all rows")
        for out in loop.outs:  # a row is written over after all rows around it have been computed
            late = any(name == out.into and lag <= least for name, least in seen)
            demand(not late, f"{out.into} is written over before it is read")
        seen += [(read.name, lag - read.dy) for read in field_reads(loop)]
        made |= {name: (part, lag, var.type) for name, var in loop.vars.items()}
