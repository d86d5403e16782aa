"""Common subexpressions of several statements are computed once, before the first of them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace

from powderdsl.ir.ops import Node
from powderdsl.schedule.types import (
    Compute,
    Guard,
    Namer,
    Out,
    Schedule,
    Statement,
    Var,
    defined_by,
    in_order,
    load,
    loaded,
    ordered,
    over_variables,
)

_CHEAP = ("const", "param", "coordinate", "inside", "load")

Path = tuple[int, ...]
"""The position of a statement: its index in each of the nested blocks around it."""


def share(schedule: Schedule) -> Schedule:
    """Values that more than one statement computes get variables, outside guards that do not contain all of them.

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
    most = Counter[int]()  # the largest number of users of any parent
    for node in nodes.values():
        for arg in node.args:
            most[id(arg)] = max(most[id(arg)], count[id(node)])
    cut = [node for key, node in nodes.items() if count[key] > 1 and (key in roots or most[key] < count[key])]
    places = _places(schedule, cut, users)
    cut = [node for node in cut if id(node) in places]
    if not cut:
        return schedule
    namer = Namer(schedule)
    vars = {id(node): (places[id(node)], namer.var(node.type)) for node in cut}
    before: dict[Path, list[tuple[Node, Var]]] = {}
    for node in ordered(cut):
        if id(node) in vars:
            path, var = vars[id(node)]
            before.setdefault(path, []).append((node, var))
    return replace(schedule, body=_inserted(schedule, before, vars))


def _places(schedule: Schedule, cut: list[Node], users: dict[int, list[Path]]) -> dict[int, Path]:
    """The statement before which each value is computed, by the value's id. Values that cannot be shared are omitted.

    What a guard keeps has one name in its body and after it; users in the body then compute the value themselves.
    """
    defined: dict[str, list[Path]] = {var.name: [()] for _, var in schedule.finds}
    for path, statement in _paths(schedule.body):
        for var in defined_by(statement):
            defined.setdefault(var.name, []).append(path)
    found: dict[int, Path] = {}
    for node in cut:
        names = set(loaded([node]))
        left = users[id(node)]
        while len(left) > 1:
            path = _common(left)
            if all(any(_before(one, path) for one in defined[name]) for name in in_order(names)):
                found[id(node)] = path
                break
            left = [user for user in left if user[: len(path)] != path]
    return found


def _before(definition: Path, path: Path) -> bool:
    """Whether the definitions of one statement are visible at another."""
    if not definition:
        return True
    outer = len(definition) - 1
    return len(path) > outer and definition[:outer] == path[:outer] and definition[outer] < path[outer]


def _paths(body: Sequence[Statement], outer: Path = ()) -> Iterator[tuple[Path, Statement]]:
    for i, statement in enumerate(body):
        yield (*outer, i), statement
        if isinstance(statement, Guard):
            yield from _paths(statement.body, (*outer, i))


def _common(paths: list[Path]) -> Path:
    """The first of some statements, or the guard around it, in the innermost block that contains all of them."""
    depth = 0
    while all(len(path) > depth + 1 and path[depth] == paths[0][depth] for path in paths):
        depth += 1
    return min(path[: depth + 1] for path in paths)


def _inserted(
    schedule: Schedule, before: dict[Path, list[tuple[Node, Var]]], vars: dict[int, tuple[Path, Var]]
) -> tuple[Statement, ...]:
    graph = schedule.graph

    def shared(node: Node, path: Path) -> bool:
        """Whether a value is computed before a statement."""
        place = vars[id(node)][0] if id(node) in vars else None
        return place is not None and (path[: len(place)] == place or _before(place, path))

    def value(root: Node, path: Path, *, itself: bool) -> Node:
        """A value in terms of the shared variables; `itself`: also if the whole value is one of them."""

        def known(node: Node) -> Node | None:
            other = itself or node is not root
            return load(graph, vars[id(node)][1]) if other and shared(node, path) else None

        return over_variables(root, graph, known)

    def block(body: Sequence[Statement], outer: Path) -> tuple[Statement, ...]:
        result: list[Statement] = []
        for i, statement in enumerate(body):
            for node, var in before.get((*outer, i), ()):
                place = node.places[0] if node.places else ""
                result.append(Compute((Out(var, value(node, (*outer, i), itself=False)),), place))
            match statement:
                case Compute(outs):
                    path = (*outer, i)
                    new = tuple(replace(out, value=value(out.value, path, itself=True)) for out in outs)
                    result.append(replace(statement, outs=new))
                case Guard(_, inner, _):
                    result.append(replace(statement, body=block(inner, (*outer, i))))
                case _:
                    result.append(statement)
        return tuple(result)

    return block(schedule.body, ())
