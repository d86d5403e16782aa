"""Questions about properties become questions about elements: densities vanish, sets of ids remain."""

from __future__ import annotations

from powderdsl.ir.build import Builder
from powderdsl.ir.ops import Node, PassGraph
from powderdsl.ir.rewrite import Rewrite, rebuild, rewrite_pass

MAX_VALUES = 16


def _table_compare(node: Node, build: Builder) -> Node | None:
    """table(x) < c = x in {i : table[i] < c}; between two tables, one such pair for each value of the first."""
    if node.op not in ("eq", "lt", "le") or node.args[0].type.name != "int":
        return None
    a, b = node.args
    holds = {"eq": lambda p, q: p == q, "lt": lambda p, q: p < q, "le": lambda p, q: p <= q}[node.op]
    if a.op == "table" and b.op == "const":
        return _where(a, lambda v: holds(v, b.attr), build)
    if b.op == "table" and a.op == "const":
        return _where(b, lambda v: holds(a.attr, v), build)
    if a.op == "table" and b.op == "table":
        values = sorted(set(_values(a)))
        if len(values) <= MAX_VALUES:
            parts = [
                build.and_(
                    _where(a, lambda v, x=x: v == x, build), _where(b, lambda v, x=x: holds(x, v), build)
                )
                for x in values
            ]
            return build.any(parts)
    small = a if b.op == "const" else b if a.op == "const" else None
    if small is not None and small.type.lo >= 0 and small.type.hi < 64 and _is_identity(small):
        # element == 3 = element in {3}
        ids = range(small.type.lo, small.type.hi + 1)
        if b.op == "const":
            return build.in_set(small, frozenset(i for i in ids if holds(i, b.attr)))
        return build.in_set(small, frozenset(i for i in ids if holds(a.attr, i)))
    return None


def _is_identity(node: Node) -> bool:
    """Whether a node is an element id as stored somewhere, which sets of ids suit best."""
    while node.op == "shift":
        node = node.args[0]
    return node.op == "input" and node.attr == "element"


def _values(table: Node) -> tuple[int, ...]:
    index = table.args[0]
    values = table.attr
    assert isinstance(values, tuple)
    return values[max(index.type.lo, 0) : index.type.hi + 1]


def _where(table: Node, holds, build: Builder) -> Node:  # type: ignore[no-untyped-def]
    values = table.attr
    assert isinstance(values, tuple)
    return build.in_set(table.args[0], frozenset(i for i, v in enumerate(values) if holds(v)))


def _table_of_constant(node: Node, build: Builder) -> Node | None:
    if node.op == "table" and node.args[0].op == "const":
        return build.whole(node.attr[node.args[0].attr])
    if node.op == "in_set" and node.args[0].op == "table":  # table(x) in S = x in {i : table[i] in S}
        members = node.attr
        assert isinstance(members, frozenset)
        return _where(node.args[0], lambda v: v in members, build)
    return None


def _shift_of_table(node: Node, build: Builder) -> Node | None:
    """shift(table(x)) = table(shift(x)), so that comparisons see the table."""
    if node.op == "shift" and node.args[0].op == "table" and node.attr[2]:
        dy, dx, _ = node.attr
        table = node.args[0]
        return build.table(build.shift(table.args[0], (dy, dx)), table.attr)
    return None


RESOLVE: tuple[Rewrite, ...] = (_shift_of_table, _table_of_constant, _table_compare)


_LOGIC = ("and", "or", "not", "eq", "lt", "le")
"""What a specialized condition is looked through. Not shifts: what is known here says nothing of neighbors."""


def specialise(pass_: PassGraph) -> PassGraph:
    """In `x in {3} and P(table(x))`, the table has one value: P becomes simpler. Rules of loops look like this."""
    tables: dict[Node, frozenset[Node]] = {}
    return rewrite_pass(pass_, (lambda node, build: _specialise(node, build, tables),))


def _specialise(node: Node, build: Builder, tables: dict[Node, frozenset[Node]]) -> Node | None:
    if node.op != "and" or not _tables(node, tables):
        return None
    parts = _conjuncts(node)
    known = {p.args[0]: p.attr for p in parts if p.op == "in_set"}
    changed = False
    done: dict[Node, Node] = {}
    result = []
    for part in parts:
        new = _substitute(part, known, build, tables, done) if part.op != "in_set" else part
        changed = changed or new is not part
        result.append(new)
    if not changed:
        return None
    joined = result[0]
    for part in result[1:]:
        joined = build.and_(joined, part)
    return joined


def _tables(node: Node, found: dict[Node, frozenset[Node]]) -> frozenset[Node]:
    """The values whose tables a condition asks for. Graphs share nodes, so answers are kept in `found`."""
    if node not in found:
        if node.op == "table":
            found[node] = frozenset(node.args)
        else:
            parts = [_tables(arg, found) for arg in node.args] if node.op in _LOGIC else []
            found[node] = frozenset[Node]().union(*parts)
    return found[node]


def _conjuncts(node: Node) -> list[Node]:
    if node.op != "and":
        return [node]
    return [part for arg in node.args for part in _conjuncts(arg)]


def _substitute(
    node: Node,
    known: dict[Node, object],
    build: Builder,
    tables: dict[Node, frozenset[Node]],
    done: dict[Node, Node],
) -> Node:
    """The condition with tables of known elements replaced."""
    if node.op == "table" and node.args[0] in known:
        members = known[node.args[0]]
        assert isinstance(members, frozenset)
        assert isinstance(node.attr, tuple)
        values = sorted({node.attr[i] for i in members if i < len(node.attr)})
        return build.whole(values[0]) if len(values) == 1 else node
    if node.op not in _LOGIC or _tables(node, tables).isdisjoint(known):
        return node
    if node not in done:
        args = tuple(_substitute(arg, known, build, tables, done) for arg in node.args)
        same = all(a is b for a, b in zip(args, node.args, strict=True))
        done[node] = node if same else rebuild(node, args, build)
    return done[node]
