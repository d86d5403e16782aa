"""One operation per statement, for targets that execute each on all cells before the next."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from powderdsl.ir.ops import Graph, Node
from powderdsl.schedule.rewrite import with_values
from powderdsl.schedule.types import Compute, Guard, Namer, Out, Schedule, Statement, Var, load, ordered


def flatten(schedule: Schedule) -> Schedule:
    """Every operation gets a variable; arguments are variables and constants.

    `p = a & ~b` → `t = ~b; p = a & t`.
    """
    flattener = _Flattener(Namer(schedule), schedule.graph)
    body = flattener.block(schedule.body, {}, frozenset())
    leaves = tuple((slot, flattener.renamed(node)) for slot, node in schedule.leaves)
    return replace(schedule, body=body, leaves=leaves)


class _Flattener:
    def __init__(self, namer: Namer, graph: Graph):
        self.namer, self.graph = namer, graph
        self.same: dict[str, Node] = {}
        """The value of each variable that is a constant or another name of a variable."""

    def renamed(self, node: Node) -> Node:
        while node.op == "load" and node.attr in self.same:
            node = self.same[node.attr]
        return node

    def block(
        self, body: Sequence[Statement], known: dict[int, Node], kept: frozenset[str]
    ) -> tuple[Statement, ...]:
        """`known`: the variables of operations, by id. `kept`: names that the guard around the block keeps."""
        known = dict(known)
        result: list[Statement] = []
        for given in body:
            statement = with_values(given, self.graph, lambda node: self.renamed(node))
            match statement:
                case Compute(outs):
                    own = {id(out.value): out.var for out in reversed(outs)}
                    for out in outs:
                        value = self.operation(out.value, known, own, result)
                        if value.op == "load" and value.attr == out.var.name:
                            continue
                        if out.var.name in kept:
                            result.append(Compute((Out(out.var, value),)))
                        else:
                            self.same[out.var.name] = value
                case Guard(_, inner, keeps):
                    names = frozenset(var.name for var, _ in keeps)
                    result.append(replace(statement, body=self.block(inner, known, names)))
                case _:
                    result.append(statement)
        return tuple(result)

    def operation(
        self, root: Node, known: dict[int, Node], own: dict[int, Var], result: list[Statement]
    ) -> Node:
        """A variable or constant for a value. Missing operations are appended to `result`."""
        for node in ordered([root]):
            if id(node) in known:
                continue
            if node.op in ("const", "load"):
                known[id(node)] = node
                continue
            var = own.get(id(node)) or self.namer.var(node.type)
            args = tuple(known[id(arg)] for arg in node.args)
            value = self.graph.node(node.op, node.type, args, node.attr, node.places)
            result.append(Compute((Out(var, value),), node.places[0] if node.places else ""))
            known[id(node)] = load(self.graph, var)
        return known[id(root)]
