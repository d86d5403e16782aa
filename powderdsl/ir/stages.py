"""The stages between lowering and targets: rewrite rules, their driver, and the list of stages.

The comment on each rule is its equation. Floats are never re-associated.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial, reduce
from math import frexp
from typing import NamedTuple

from powderdsl.ir.bits import simpler
from powderdsl.ir.ops import (
    OPS,
    REAL,
    Graph,
    Node,
    PassGraph,
    Program,
    Type,
    conjuncts,
    nodes_of,
    single,
    square_root,
    stepped,
)

Rewrite = Callable[[Node, Graph], Node | None]
"""From a node to its replacement, or None for no change."""


def rewrite_pass(pass_: PassGraph, rules: Sequence[Rewrite]) -> PassGraph:
    """The pass rebuilt bottom-up in a fresh graph, every node rewritten until no rule applies; earlier ones are preferred."""
    build = Graph()
    done: dict[Node, Node] = {}
    """Nodes of the new graph by those of the old one."""
    final: dict[Node, Node] = {}
    """The rewritten forms of nodes of the new graph."""

    def finish(node: Node) -> Node:
        """A node of the new graph, rewritten. Arguments that a rule has made are finished first, the last before the others."""
        if node in final:
            return final[node]
        args = tuple(map(finish, reversed(node.args)))[::-1]
        rebuilt = node if args == node.args else build.rebuild(node, args)
        if rebuilt not in final:
            final[rebuilt] = rebuilt  # the replacement may contain the node itself
            for rule in rules:
                replacement = rule(rebuilt, build)
                if replacement is not None and replacement is not rebuilt:
                    final[rebuilt] = finish(replacement)
                    break
        final[node] = final[rebuilt]
        return final[node]

    for node in nodes_of(pass_):
        build.place = node.places[0] if node.places else ""
        done[node] = finish(build.rebuild(node, tuple(map(done.__getitem__, node.args))))
    return pass_.map(lambda slot, node: [(slot, done[node])], done.__getitem__)


def fold(node: Node, build: Graph) -> Node | None:
    """Constant folding, the algebra of flags, and comparisons that ranges decide."""
    known = simpler(build, node.op, node.args, node.attr)
    if known is not None:
        return known
    match node.op, node.args, node.attr:
        case "not", (Node("le" | "lt" as op, args=(a, b)),), _ if a.type != REAL:
            # not (a ≤ b) = b < a, not (a < b) = b ≤ a: integers only, since a NaN is neither
            return build.derive("lt" if op == "le" else "le", b, a)
        case "and" | "or", (Node("in_set", _, (x,), s), Node("in_set", _, (y,), t)), _ if x is y:
            # x in S and x in T = x in S ∩ T, x in S or x in T = x in S ∪ T
            return build.in_set(x, s & t if node.op == "and" else s | t)
        case "in_set", (x,), members:
            # x in {} = no, x in everything = yes; values outside the range of x are dropped
            reachable = frozenset(i for i in members if x.type.lo <= i <= x.type.hi)
            if len(reachable) in (0, x.type.hi - x.type.lo + 1):
                return build.flag(bool(reachable))
            return build.in_set(x, reachable)
        case "eq" | "lt" | "le", (Node(type=Type("int") as a), Node(type=b)), _:
            always, never = {
                "eq": (a.lo == a.hi == b.lo == b.hi, a.hi < b.lo or b.hi < a.lo),
                "lt": (a.hi < b.lo, b.hi <= a.lo),
                "le": (a.hi <= b.lo, b.hi < a.lo),
            }[node.op]
            return build.flag(always) if always or never else None
        case "lt", (Node("const", attr=limit), Node("sqrt", args=(x,))), _ if 0 <= limit < 1e18:
            # c < √x = c' < x, where the square of c must be finite
            return build.derive("lt", build.real(_last_square(single(limit))), x)
        # Zeros of either sign are equal: clamping makes them one, and nothing distinguishes them.
        case "add" | "sub", (a, Node("const", attr=0)), _:  # a + 0 = a, a - 0 = a
            return a
        case "add", (Node("const", attr=0), b), _:
            return b
        case "mod", (x,), modulus if x.type.lo >= 0 and x.type.hi < modulus:
            return x
        case "div", (a, Node("const", attr=b)), _ if b and frexp(abs(b))[0] == 0.5:
            return build.derive("mul", a, build.real(1.0 / b))  # x / 2^k = x · 2^-k, exactly
        case "select", (c, a, Node("select", _, (again, _, d))), _ if c is again:
            return build.select(c, a, d)  # select(c, a, select(c, b, d)) = select(c, a, d)
        case "swap" | "arrive", (_, Node("const", attr=False), rest), _:  # nothing moves
            return rest
        case "shift", (Node("coordinate", attr=("step", *_)) as a,), (*_, True):
            return a
        case "shift", (Node("const" | "param") as a,), (dy, dx, wraps):
            return build.shift_uniform(a, (dy, dx), wraps)
        case "inside", (), (0, 0):  # a cell lies inside its own grid
            return build.flag(True)
        case "below", (Node(type=limit),), (_, bits) if limit.hi <= 0 or limit.lo >= 1 << bits:
            return build.flag(limit.hi > 0)
        case "count", (Node("const", attr=False),), _:
            return build.integer(0)
    return None


def _last_square(limit: float) -> float:
    """The last float whose root does not exceed a limit: roots are rounded, but never out of order."""
    square = single(limit * limit)
    while square_root(square) > limit:
        square = stepped(square, -1)
    while square_root(after := stepped(square, 1)) <= limit:
        square = after
    return square


MAX_VALUES = 16


def resolve(node: Node, build: Graph) -> Node | None:
    """Turn questions about properties into questions about elements: densities vanish, sets of ids remain."""
    holds: Callable[..., bool] = partial(OPS[node.op].value, None)
    match node.op, node.args, node.attr:
        case "shift", (Node("table", _, (x,), values),), (dy, dx, True):
            # shift(table(x)) = table(shift(x)), so that comparisons see the table
            return build.derive("table", build.shift(x, (dy, dx)), attr=values)
        case "eq" | "lt" | "le", (Node("table", _, (x,), values) as a, Node("table") as b), _:
            # a < b = (a == v and v < b), or the same for another value v of a
            known = sorted(set(values[max(x.type.lo, 0) : x.type.hi + 1]))
            if len(known) <= MAX_VALUES:
                return build.any([
                    build.and_(_where(a, partial(operator.eq, v), build), _where(b, partial(holds, v), build))
                    for v in known
                ])  # fmt: skip
        case "eq" | "lt" | "le", (a, Node("const", attr=limit)), _ if _is_table(a):
            return _where(a, lambda value: holds(value, limit), build)
        case "eq" | "lt" | "le", (Node("const", attr=limit), b), _ if _is_table(b):
            return _where(b, partial(holds, limit), build)
    return None


def _is_table(node: Node) -> bool:
    """True for a property and for a stored element id: both are best tested with sets of ids."""
    stored = node
    while stored.op == "shift":
        stored = stored.args[0]
    small = node.type.lo >= 0 and node.type.hi < 64
    return node.op == "table" or (small and stored.is_input("element"))


def _where(node: Node, holds: Callable[[int], bool], build: Graph) -> Node:
    """table(x) < c = x in {i : table[i] < c}. An element is the table of its own ids."""
    x, values = (node.args[0], node.attr) if node.op == "table" else (node, range(node.type.hi + 1))
    return build.in_set(x, frozenset(i for i, value in enumerate(values) if holds(value)))


_LOGIC = ("and", "or", "not", "eq", "lt", "le")
Tables = dict[Node, frozenset[Node]]


def specialise(pass_: PassGraph) -> PassGraph:
    """In `x in {3} and P(table(x))`, the table has one value: P becomes simpler. Rules of loops look like this."""
    return rewrite_pass(pass_, [partial(_use_known_element, {})])


def _use_known_element(tables: Tables, node: Node, build: Graph) -> Node | None:
    if node.op != "and" or not _tables(node, tables):
        return None
    parts = conjuncts(node)
    known = {part.args[0]: part.attr for part in parts if part.op == "in_set"}
    done: dict[Node, Node] = {}

    def substitute(part: Node) -> Node:
        """The condition with tables of known elements replaced."""
        if part.op == "table" and part.args[0] in known:
            values = {part.attr[i] for i in known[part.args[0]] if i < len(part.attr)}
            return build.integer(min(values)) if len(values) == 1 else part
        if part.op not in _LOGIC or _tables(part, tables).isdisjoint(known):
            return part
        if part not in done:
            args = tuple(map(substitute, part.args))
            done[part] = part if args == part.args else build.rebuild(part, args)
        return done[part]

    new = list(map(substitute, parts))
    return None if new == parts else reduce(build.and_, new)


def _tables(node: Node, known: Tables) -> frozenset[Node]:
    """The values whose tables a condition reads. Graphs share nodes, so results are kept in `known`."""
    if node not in known:
        parts = [_tables(arg, known) for arg in node.args] if node.op in _LOGIC else []
        own = node.args if node.op == "table" else ()
        known[node] = frozenset(own).union(*parts)
    return known[node]


def share(node: Node, build: Graph) -> Node | None:
    """Shifts move outward past operations on single cells: one read per neighbor and value, shared by all rules.

    Values are then combined before the shift, and a shifted flag is cheaper than a shifted number.
    """
    args: tuple[Node, ...]
    match node.op, node.args:
        case "shift", (Node("shift", _, (x,), (ey, ex, True)),) if node.attr[2]:
            # shift(shift(x, a), b) = shift(x, a + b), where both wrap
            return build.shift(x, (node.attr[0] + ey, node.attr[1] + ex))
        case "in_set" | "not", (Node("shift", _, (x,), (dy, dx, True)),):
            # not shift(a) = shift(not a)
            args = (x,)
        case "and" | "or" | "xor", (
            Node("shift", _, (x,), (dy, dx, True) as at),
            Node("shift", _, (y,), to),
        ) if at == to:
            # shift(a) and shift(b) = shift(a and b)
            args = x, y
        case "eq" | "lt" | "le", (Node("shift", _, (x,), (dy, dx, True)), Node("const") as limit):
            # shift(x) < c = shift(x < c)
            args = x, limit
        case "eq" | "lt" | "le", (Node("const") as limit, Node("shift", _, (x,), (dy, dx, True))):
            args = limit, x
        case _:
            return None
    return build.shift(build.rebuild(node, args), (dy, dx))


def prune(pass_: PassGraph) -> PassGraph:
    """The pass without writes of the values that slots already have, substeps that write nothing, and constant guards."""
    current: dict[str, Node] = {}

    def without_repeats(writes: Iterable[tuple[str, Node]]) -> tuple[tuple[str, Node], ...]:
        pairs = []
        for slot, node in writes:
            before, current[slot] = current.get(slot), node
            if before is not node and (before is not None or not node.is_input(slot)):
                pairs.append((slot, node))
        return tuple(pairs)

    substeps = []
    for step in pass_.substeps:
        if writes := without_repeats(step.writes):
            guards = tuple([guard for guard in step.guards if guard.op != "const" or guard.attr])
            substeps.append(replace(step, writes=writes, guards=guards))
    outputs = tuple([(slot, node) for slot, node in pass_.outputs if not node.is_input(slot)])
    return replace(pass_, substeps=tuple(substeps), outputs=outputs)


class Stage(NamedTuple):
    """A stage of the compiler: its name, one line of help, and its effect on one pass of a program."""

    name: str
    about: str
    run: Callable[[PassGraph], PassGraph]


PIPELINE: tuple[Stage, ...] = (
    Stage("fold", "folds constants and flags that are always equal", partial(rewrite_pass, rules=[fold])),
    # Before sharing: questions about a neighbor's property become questions about its element.
    Stage("specialise", "replaces the properties of a cell whose element is known", specialise),
    Stage("resolve", "turns tests of properties into tests of the element", partial(rewrite_pass, rules=[resolve, fold])),
    # After resolving: only now is it clear which neighbors are read.
    Stage("share", "reads each value of a neighbor once", partial(rewrite_pass, rules=[share, fold])),
    # Last: substeps whose rules never fire no longer write anything.
    Stage("prune", "removes substeps that change nothing", prune),
)  # fmt: skip


def run_passes(program: Program) -> Program:
    """The optimized program. Tests verify it after each stage."""
    for stage in PIPELINE:
        program = replace(program, passes=tuple(map(stage.run, program.passes)))
    return program
