"""Questions about properties become questions about elements: densities vanish, sets of ids remain."""

from __future__ import annotations

import operator
from collections.abc import Callable
from functools import reduce

from powderdsl.ir.build import Builder
from powderdsl.ir.ops import Node, PassGraph
from powderdsl.ir.rewrite import Rules, rewrite_pass

MAX_VALUES = 16

RESOLVE = Rules()


@RESOLVE.on("shift")
def _shift_of_table(node: Node, build: Builder) -> Node | None:
    """shift(table(x)) = table(shift(x)), so that comparisons see the table."""
    (table,) = node.args
    dy, dx, wraps = node.attr
    if table.op != "table" or not wraps:
        return None
    return build.table(build.shift(table.args[0], (dy, dx)), table.attr)


@RESOLVE.on("table")
def _table_of_constant(node: Node, build: Builder) -> Node | None:
    return build.integer(node.attr[node.args[0].attr]) if node.args[0].op == "const" else None


@RESOLVE.on("in_set")
def _in_set_of_table(node: Node, build: Builder) -> Node | None:
    """table(x) in S = x in {i : table[i] in S}."""
    return _where(node.args[0], lambda v: v in node.attr, build) if node.args[0].op == "table" else None


@RESOLVE.on("eq", "lt", "le")
def _table_compare(node: Node, build: Builder) -> Node | None:
    """table(x) < c = x in {i : table[i] < c}; between two tables, one such pair for each value of the first."""
    a, b = node.args
    holds = getattr(operator, node.op)
    if a.op == "table" and b.op == "const":
        return _where(a, lambda v: holds(v, b.attr), build)
    if b.op == "table" and a.op == "const":
        return _where(b, lambda v: holds(a.attr, v), build)
    if a.op == "table" and b.op == "table":
        index = a.args[0].type
        values = sorted(set(a.attr[max(index.lo, 0) : index.hi + 1]))
        if len(values) <= MAX_VALUES:
            parts = [
                build.and_(
                    _where(a, lambda v, x=x: v == x, build), _where(b, lambda v, x=x: holds(x, v), build)
                )
                for x in values
            ]
            return build.any(parts)
    # element == 3 = element in {3}
    if b.op == "const" and _is_element(a):
        return build.in_set(a, frozenset(i for i in _ids(a) if holds(i, b.attr)))
    if a.op == "const" and _is_element(b):
        return build.in_set(b, frozenset(i for i in _ids(b) if holds(a.attr, i)))
    return None


def _is_element(node: Node) -> bool:
    """Whether a node is an element id as stored somewhere, which sets of ids suit best."""
    small = node.type.lo >= 0 and node.type.hi < 64
    while node.op == "shift":
        node = node.args[0]
    return small and node.op == "input" and node.attr == "element"


def _ids(node: Node) -> range:
    return range(node.type.lo, node.type.hi + 1)


def _where(table: Node, holds: Callable[..., bool], build: Builder) -> Node:
    """x in {i : table[i] holds}."""
    return build.in_set(table.args[0], frozenset(i for i, v in enumerate(table.attr) if holds(v)))


_LOGIC = ("and", "or", "not", "eq", "lt", "le")
Tables = dict[Node, frozenset[Node]]


def specialise(pass_: PassGraph) -> PassGraph:
    """In `x in {3} and P(table(x))`, the table has one value: P becomes simpler. Rules of loops look like this."""
    tables: Tables = {}
    rules = Rules()
    rules.on("and")(lambda node, build: _specialise(node, build, tables))
    return rewrite_pass(pass_, rules)


def _specialise(node: Node, build: Builder, tables: Tables) -> Node | None:
    if not _tables(node, tables):
        return None
    parts = _conjuncts(node)
    known = {part.args[0]: part.attr for part in parts if part.op == "in_set"}
    done: dict[Node, Node] = {}
    new = [part if part.op == "in_set" else _substitute(part, known, build, tables, done) for part in parts]
    return None if new == parts else reduce(build.and_, new)


def _tables(node: Node, found: Tables) -> frozenset[Node]:
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
    node: Node, known: dict[Node, frozenset[int]], build: Builder, tables: Tables, done: dict[Node, Node]
) -> Node:
    """The condition with tables of known elements replaced."""
    if node.op == "table" and node.args[0] in known:
        values = sorted({node.attr[i] for i in known[node.args[0]] if i < len(node.attr)})
        return build.integer(values[0]) if len(values) == 1 else node
    if node.op not in _LOGIC or _tables(node, tables).isdisjoint(known):
        return node
    if node not in done:
        args = tuple(_substitute(arg, known, build, tables, done) for arg in node.args)
        done[node] = node if args == node.args else build.rebuild(node, args)
    return done[node]
