"""What several statements compute is computed once, before the first of them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace

from powderdsl.ir.ops import Node
from powderdsl.schedule.types import Compute, Guard, Namer, Out, Schedule, Statement, Var, load, ordered

_CHEAP = ("const", "param", "coordinate", "inside", "load")

Path = tuple[int, ...]
"""Where a statement stands: its index in each block that it lies in."""


def share(schedule: Schedule) -> Schedule:
    """Values that more than one statement computes get variables, outside the guards that not all of them lie in.

    `if any a: x = f & g; if any b: y = f & h` → `t = f; if any a: x = t & g; if any b: y = t & h`.
    """
    users: dict[int, list[Path]] = {}
    nodes: dict[int, Node] = {}
    roots: set[int] = set()
    for path, statement in _paths(schedule.body):
        if isinstance(statement, Compute):
            values = [out.value for out in statement.outs]
            roots |= set(map(id, values))
            for node in ordered(values):
                if node.op not in _CHEAP:
                    nodes[id(node)] = node
                    users.setdefault(id(node), []).append(path)
    count = Counter({key: len(found) for key, found in users.items()})
    most = Counter[int]()  # the users of the parent that has most of them
    for node in nodes.values():
        for arg in node.args:
            most[id(arg)] = max(most[id(arg)], count[id(node)])
    cut = [node for key, node in nodes.items() if count[key] > 1 and (key in roots or most[key] < count[key])]
    if not cut:
        return schedule
    namer = Namer(schedule)
    vars = {id(node): namer.var(node.type) for node in cut}

    before: dict[Path, list[tuple[Node, Var]]] = {}
    for node in ordered(cut):
        if id(node) in vars:
            before.setdefault(_common(users[id(node)]), []).append((node, vars[id(node)]))
    return replace(schedule, body=_inserted(schedule, before, vars))


def _paths(body: Sequence[Statement], outer: Path = ()) -> Iterator[tuple[Path, Statement]]:
    for i, statement in enumerate(body):
        yield (*outer, i), statement
        if isinstance(statement, Guard):
            yield from _paths(statement.body, (*outer, i))


def _common(paths: list[Path]) -> Path:
    """The first statement, or the guard around it, that has all the others after it in the same block."""
    depth = 0
    while all(len(path) > depth + 1 and path[depth] == paths[0][depth] for path in paths):
        depth += 1
    return min(path[: depth + 1] for path in paths)


def _inserted(
    schedule: Schedule, before: dict[Path, list[tuple[Node, Var]]], vars: dict[int, Var]
) -> tuple[Statement, ...]:
    graph = schedule.graph

    def value(root: Node, *, itself: bool) -> Node:
        """A value over the variables, with one for itself or not."""
        done: dict[int, Node] = {}
        stack = [(root, False)]
        while stack:
            node, ready = stack.pop()
            if id(node) in done:
                continue
            if id(node) in vars and (itself or node is not root):
                done[id(node)] = load(graph, vars[id(node)])
            elif ready or not node.args:
                args = tuple(done[id(arg)] for arg in node.args)
                same = all(a is b for a, b in zip(args, node.args, strict=True))
                done[id(node)] = (
                    node if same else graph.node(node.op, node.type, args, node.attr, node.places)
                )
            else:
                stack.append((node, True))
                stack.extend((arg, False) for arg in node.args)
        return done[id(root)]

    def block(body: Sequence[Statement], outer: Path) -> tuple[Statement, ...]:
        result: list[Statement] = []
        for i, statement in enumerate(body):
            for node, var in before.get((*outer, i), ()):
                place = node.places[0] if node.places else ""
                result.append(Compute((Out(var, value(node, itself=False)),), place))
            match statement:
                case Compute(outs):
                    new = tuple(replace(out, value=value(out.value, itself=True)) for out in outs)
                    result.append(replace(statement, outs=new))
                case Guard(_, inner, _):
                    result.append(replace(statement, body=block(inner, (*outer, i))))
                case _:
                    result.append(statement)
        return tuple(result)

    return block(schedule.body, ())
