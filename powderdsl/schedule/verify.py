"""The rules that every legal schedule obeys."""

from __future__ import annotations

from collections.abc import Sequence

from powderdsl.ir.ops import FLAG, OPS, REAL, InvalidIR, Node, Type, demand, ordered
from powderdsl.schedule.join import field_reads
from powderdsl.schedule.types import (
    ANSWER,
    Compute,
    Guard,
    Move,
    Release,
    Schedule,
    Statement,
    Sweeps,
    Var,
    in_order,
    loaded,
    read_elsewhere,
)

_KINDS = ("flag", "real", ANSWER.name)


def verify(schedule: Schedule, after: str) -> None:
    """Raise InvalidIR unless the schedule is legal.

    Variables are assigned once, and read only after their statement, in the same block or a nested one, and before their
    release. A guard keeps variables of its body, with alternatives of the same type. Values contain no slots.
    """
    try:
        checker = _Checker({var.name: var for _, var in schedule.finds})
        end = checker.block(schedule.body, set(checker.vars))
        for _, node in schedule.leaves:
            checker.value(node, end)
    except InvalidIR as error:
        raise InvalidIR(f"after {after}, pass {schedule.name}: {error}") from None


class _Checker:
    def __init__(self, vars: dict[str, Var]):
        self.vars = vars
        self.checked: set[int] = set()

    def block(self, body: Sequence[Statement], live: set[str]) -> set[str]:
        """The variables that exist after a block."""
        live = set(live)
        for statement in body:
            if not isinstance(statement, Sweeps):
                for node in statement.values():
                    self.value(node, live)
            match statement:
                case Guard(when, inner, keeps, _, otherwise):
                    demand(
                        all(node.type in (FLAG, ANSWER) for node in when), "a guard asks what is not a flag"
                    )
                    before = set(live)
                    # The body defines the variables that are kept; outside they exist from its end.
                    end = self.block(inner, live)
                    for var, value in keeps:
                        demand(var.name in end, f"{var.name} is kept, but not made")
                        demand(var.type == value.type, f"{var.name} is a {var.type}, else a {value.type}")
                    kept = {var.name for var, _ in keeps}
                    made = self.block(otherwise, live) - before
                    demand(made <= kept, f"{in_order(made - kept)} are made only where a body is skipped")
                    live = (before & end) | kept
                    continue
                case Compute(outs):
                    demand(_is_region(statement.region), "a region is made of stored flags and live fields")
                    elsewhere = read_elsewhere(statement.values()) if statement.over == "words" else set()
                    for out in outs:
                        demand(out.var.type == out.value.type, f"{out.var.name} gets a {out.value.type}")
                        demand(out.into not in elsewhere, f"{out.into} is overwritten, but read at neighbors")
                        if out.into is not None:
                            demand(out.into in live, f"{out.into} is overwritten, but not there")
                            live.discard(out.into)
                case Sweeps(loops):
                    _check_order(statement)
                    live = self.block(loops, live) - set(statement.passing)
                    continue
                case Move(op, _, movers, planes):
                    live -= {plane.into for plane in planes if plane.into is not None}
                    demand(op in ("swap", "arrive"), f"a movement by {op}")
                    demand(
                        all(p.new.type == p.old.type == p.leaves.type for p in planes),
                        "values keep their type",
                    )
                    floats = [p for p in planes if p.new.type == REAL]
                    exchanged = op == "swap" and all(p.old is p.leaves for p in floats)
                    demand(not floats or exchanged, "floats are exchanged")
                    demand(len(floats) in (0, len(planes)), "flags and floats move apart")
                    demand(movers.type == FLAG, "movers are flags")
                case Release(names):
                    demand(set(names) <= live, f"{names} are released, but not there")
                    live -= set(names)
            for var in statement.defined():
                demand(self.vars.setdefault(var.name, var) is var, f"two variables are called {var.name}")
                demand(var.name not in live, f"{var.name} is assigned twice")
                live.add(var.name)
        return live

    def value(self, root: object, live: set[str]) -> None:
        for node in ordered([root]):  # type: ignore[list-item]
            if node.op == "load":
                demand(node.attr in live, f"{node.attr} is read, but not there")
                demand(self.vars[node.attr].type == node.type, f"{node.attr} is read as a {node.type}")
            elif id(node) not in self.checked:
                self.checked.add(id(node))
                demand(node.op in OPS or node.op in SCHEDULE_OPS, f"unknown operation {node.op}")
                demand(node.op != "input", "a value reads a slot")
                demand(node.type.name in _KINDS, f"a value is a {node.type}")


def _check_order(sweeps: Sweeps) -> None:
    """A row is computed before loops that run together read it, or hold masks of choices; none reads it around the edge."""
    made: dict[str, tuple[int, int]] = {}
    types: dict[str, Type] = {}
    seen: list[tuple[str, int]] = []
    for loop, part, lag in zip(sweeps.loops, sweeps.parts, sweeps.lags, strict=True):
        for read in field_reads(loop):
            if made.get(read.name, (part - 1,))[0] == part:
                demand(read.live or not (read.wraps and read.dy), f"{read.name} is read around the edge")
                demand(lag >= made[read.name][1] + read.dy, f"{read.name} is read before it is there")
            else:
                demand(
                    read.name not in made or read.name not in sweeps.passing,
                    f"{read.name} is gone when it is read",
                )
        if loop.over == "choices":
            early = [name for name in loaded(loop.values()) if name in made and types[name] == FLAG]
            demand(not early, f"choices are made by {early}, which are not there in all rows")
        for out in loop.outs:  # a row is written over after all rows around it have been computed
            late = any(name == out.into and lag <= least for name, least in seen)
            demand(not late, f"{out.into} is written over before it is read")
        seen += [(read.name, lag - read.dy) for read in field_reads(loop)]
        made |= {out.var.name: (part, lag) for out in loop.outs}
        types |= {out.var.name: out.var.type for out in loop.outs}


def _is_region(node: Node | None) -> bool:
    if node is not None and node.op == "or":
        return all(map(_is_region, node.args))
    return node is None or node.op in ("load", "live", "const")


SCHEDULE_OPS = frozenset({"load", "below_param", "any", "when", "led", "live", "present"})
"""Operations that only schedules have: `load` → what a variable holds; `below_param` → a draw below a parameter; `any`
(flag) → whether it holds in some cell; `when` (flag, flag) → both, the second computed only in words where the first
holds somewhere; `led` (comparison, comparison) → the same in cells; `live` (floats), attribute (rows, reach) → whether
the field may be other than zero so many rows down, at most so many columns to either side."""
