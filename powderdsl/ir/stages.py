"""The stages between lowering and targets: rewrite rules by operation, their driver, and the list of stages.

The comment on each rule is its equation. Floats are never re-associated.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial, reduce
from math import frexp

from powderdsl.ir.bits import is_const, simpler
from powderdsl.ir.ops import OPS, REAL, Builder, Node, PassGraph, Program, nodes_of, verify
from powderdsl.ir.single import single, square_root, stepped

Rewrite = Callable[[Node, Builder], Node | None]
"""From a node to its replacement, or None for no change."""

Rules = Mapping[str, Sequence[Rewrite]]
"""Rewrite rules by the operation that they apply to, in the order in which they are tried."""


def rewrite_pass(pass_: PassGraph, rules: Rules) -> PassGraph:
    """The pass rebuilt bottom-up in a fresh graph, every node rewritten until no rule applies."""
    build = Builder()
    done: dict[Node, Node] = {}
    """Nodes of the new graph by those of the old one."""
    final: dict[Node, Node] = {}
    """What nodes of the new graph were rewritten to."""

    def finish(node: Node) -> Node:
        """A node of the new graph, rewritten. Arguments that a rule has made are finished first, the last before the others."""
        if node in final:
            return final[node]
        args = tuple(map(finish, reversed(node.args)))[::-1]
        rebuilt = node if args == node.args else build.rebuild(node, args)
        if rebuilt not in final:
            final[rebuilt] = rebuilt  # the replacement may contain the node itself
            for rule in rules.get(rebuilt.op, ()):
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


def _simpler(node: Node, build: Builder) -> Node | None:
    return simpler(build, node.op, node.args, node.attr)


def _not_compared(node: Node, build: Builder) -> Node | None:
    """not (a ≤ b) = b < a, not (a < b) = b ≤ a: integers only, since a NaN is neither."""
    (a,) = node.args
    if a.op not in ("le", "lt") or a.args[0].type == REAL:
        return None
    return build.derive("lt" if a.op == "le" else "le", a.args[1], a.args[0])


def _of_sets(node: Node, build: Builder) -> Node | None:
    """x in S and x in T = x in S ∩ T, x in S or x in T = x in S ∪ T."""
    a, b = node.args
    if not a.op == b.op == "in_set" or a.args[0] is not b.args[0]:
        return None
    return build.in_set(a.args[0], a.attr | b.attr if node.op == "or" else a.attr & b.attr)


def _in_set(node: Node, build: Builder) -> Node | None:
    """x in {} = no, x in everything = yes; what x cannot be is left out."""
    (a,) = node.args
    reachable = frozenset(i for i in node.attr if a.type.lo <= i <= a.type.hi)
    if len(reachable) in (0, a.type.hi - a.type.lo + 1):
        return build.flag(bool(reachable))
    return build.in_set(a, reachable)


def _compare(node: Node, build: Builder) -> Node | None:
    """Comparisons of integers that their ranges decide."""
    a, b = (arg.type for arg in node.args)
    if a.name != "int":
        return None
    always, never = {
        "eq": (a.lo == a.hi == b.lo == b.hi, a.hi < b.lo or b.hi < a.lo),
        "lt": (a.hi < b.lo, b.hi <= a.lo),
        "le": (a.hi <= b.lo, b.hi < a.lo),
    }[node.op]
    return build.flag(always) if always or never else None


def _neutral(node: Node, build: Builder) -> Node | None:
    """a + 0 = a, a - 0 = a, a div 1 = a. Zeros of either sign are alike: clamping makes them one, nothing tells them apart."""
    a, b = node.args
    if b.op == "const" and b.attr == (1 if node.op == "quotient" else 0):
        return a
    return b if node.op == "add" and a.op == "const" and a.attr == 0 else None


def _small_mod(node: Node, build: Builder) -> Node | None:
    """x mod n = x where 0 ≤ x < n."""
    (a,) = node.args
    return a if a.type.lo >= 0 and a.type.hi < node.attr else None


def _nested(node: Node, build: Builder) -> Node | None:
    """select(c, a, select(c, b, d)) = select(c, a, d)."""
    condition, yes, no = node.args
    if no.op == "select" and no.args[0] is condition:
        return build.select(condition, yes, no.args[2])
    return None


def _movement(node: Node, build: Builder) -> Node | None:
    """Nothing moves, or everything is alike."""
    content, movers, rest = node.args
    return rest if is_const(movers, False) or (content.op == "const" and rest is content) else None


def _shift_of_constant(node: Node, build: Builder) -> Node | None:
    (a,) = node.args
    dy, dx, wraps = node.attr
    if a.op == "coordinate" and a.attr[0] == "step" and wraps:
        return a
    return build.shift_uniform(a, (dy, dx), wraps) if a.op in ("const", "param") else None


def _below(node: Node, build: Builder) -> Node | None:
    """A chance that nothing or everything is below."""
    limit, bits = node.args[0].type, node.attr[1]
    return build.flag(limit.hi > 0) if limit.hi <= 0 or limit.lo >= 1 << bits else None


def _count(node: Node, build: Builder) -> Node | None:
    return build.integer(0) if is_const(node.args[0], False) else None


def _divide(node: Node, build: Builder) -> Node | None:
    """x / 2^k = x · 2^-k, exactly."""
    a, b = node.args
    if b.op == "const" and b.attr and frexp(abs(b.attr))[0] == 0.5:
        return build.derive("mul", a, build.real(1.0 / b.attr))
    return None


def _root(node: Node, build: Builder) -> Node | None:
    """c < √x = c' < x, where c' is the last float whose root does not exceed c: roots are rounded, but never out of order."""
    left, root = node.args
    if root.op != "sqrt" or left.op != "const":
        return None
    limit = single(left.attr)
    if not 0 <= limit < 1e18:  # its square must be finite
        return None
    square = single(limit * limit)
    while square_root(square) > limit:
        square = stepped(square, -1)
    while square_root(after := stepped(square, 1)) <= limit:
        square = after
    return build.derive("lt", build.real(square), root.args[0])


def _inside(node: Node, build: Builder) -> Node | None:
    """A cell lies inside its own grid."""
    return build.flag(True) if node.attr[:2] == (0, 0) else None


_FOLDS: Rules = {
    "not": [_not_compared],
    "and": [_of_sets],
    "or": [_of_sets],
    "in_set": [_in_set],
    "eq": [_compare],
    "lt": [_compare, _root],
    "le": [_compare],
    "add": [_neutral],
    "sub": [_neutral],
    "quotient": [_neutral],
    "mod": [_small_mod],
    "select": [_nested],
    "swap": [_movement],
    "arrive": [_movement],
    "shift": [_shift_of_constant],
    "below": [_below],
    "count": [_count],
    "div": [_divide],
    "inside": [_inside],
}

FOLD: Rules = {op: [_simpler, *_FOLDS.get(op, ())] for op in OPS}
"""Constant folding and the algebra of flags."""


def _then_fold(rules: Rules) -> Rules:
    return {op: [*rules.get(op, ()), *FOLD[op]] for op in OPS}


MAX_VALUES = 16


def _shift_of_table(node: Node, build: Builder) -> Node | None:
    """shift(table(x)) = table(shift(x)), so that comparisons see the table."""
    (table,) = node.args
    dy, dx, wraps = node.attr
    if table.op != "table" or not wraps:
        return None
    return build.derive("table", build.shift(table.args[0], (dy, dx)), attr=table.attr)


def _in_set_of_table(node: Node, build: Builder) -> Node | None:
    """table(x) in S = x in {i : table[i] in S}."""
    return _where(node.args[0], node.attr.__contains__, build) if node.args[0].op == "table" else None


def _table_compare(node: Node, build: Builder) -> Node | None:
    """table(x) < c = x in {i : table[i] < c}; between two tables, one such pair for each value of the first."""
    a, b = node.args
    holds = getattr(operator, node.op)
    if a.op == b.op == "table":
        index = a.args[0].type
        values = sorted(set(a.attr[max(index.lo, 0) : index.hi + 1]))
        if len(values) <= MAX_VALUES:
            return build.any([
                build.and_(_where(a, partial(operator.eq, x), build), _where(b, partial(holds, x), build))
                for x in values
            ])  # fmt: skip
    for side, other, test in ((a, b, lambda v: holds(v, b.attr)), (b, a, lambda v: holds(a.attr, v))):
        if other.op == "const" and side.op == "table":
            return _where(side, test, build)
        if other.op == "const" and _is_element(side):  # element == 3 = element in {3}
            ids = range(side.type.lo, side.type.hi + 1)
            return build.in_set(side, frozenset(filter(test, ids)))
    return None


def _is_element(node: Node) -> bool:
    """Whether a node is an element id as stored somewhere, which sets of ids suit best."""
    small = node.type.lo >= 0 and node.type.hi < 64
    while node.op == "shift":
        node = node.args[0]
    return small and node.op == "input" and node.attr == "element"


def _where(table: Node, holds: Callable[[int], bool], build: Builder) -> Node:
    """x in {i : table[i] holds}."""
    return build.in_set(table.args[0], frozenset(i for i, v in enumerate(table.attr) if holds(v)))


RESOLVE = _then_fold(
    {
        "shift": [_shift_of_table],
        "in_set": [_in_set_of_table],
        "eq": [_table_compare],
        "lt": [_table_compare],
        "le": [_table_compare],
    }
)
"""Questions about properties become questions about elements: densities vanish, sets of ids remain."""

_LOGIC = ("and", "or", "not", "eq", "lt", "le")
Tables = dict[Node, frozenset[Node]]


def specialise(pass_: PassGraph) -> PassGraph:
    """In `x in {3} and P(table(x))`, the table has one value: P becomes simpler. Rules of loops look like this."""
    tables: Tables = {}
    return rewrite_pass(pass_, {"and": [lambda node, build: _specialise(node, build, tables)]})


def _specialise(node: Node, build: Builder, tables: Tables) -> Node | None:
    if not _tables(node, tables):
        return None
    parts = _conjuncts(node)
    known = {part.args[0]: part.attr for part in parts if part.op == "in_set"}
    done: dict[Node, Node] = {part: part for part in parts if part.op == "in_set"}

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
    """The values whose tables a condition asks for. Graphs share nodes, so answers are kept in `known`."""
    if node not in known:
        parts = [_tables(arg, known) for arg in node.args] if node.op in _LOGIC else []
        own = node.args if node.op == "table" else ()
        known[node] = frozenset(own).union(*parts)
    return known[node]


def _conjuncts(node: Node) -> list[Node]:
    return [part for arg in node.args for part in _conjuncts(arg)] if node.op == "and" else [node]


def _wraps(node: Node) -> bool:
    return node.op == "shift" and node.attr[2]


def _shift_of_shift(node: Node, build: Builder) -> Node | None:
    """shift(shift(x, a), b) = shift(x, a + b), where both wrap."""
    (inner,) = node.args
    if not (_wraps(node) and _wraps(inner)):
        return None
    (dy, dx, _), (ey, ex, _) = node.attr, inner.attr
    return build.shift(inner.args[0], (dy + ey, dx + ex))


def _of_shifts(node: Node, build: Builder) -> Node | None:
    """shift(a) and shift(b) = shift(a and b), not shift(a) = shift(not a), shift(x) < c = shift(x < c).

    What is combined then stands on one side, and a flag is a fraction of a number: the question is asked once.
    """
    compares = node.op in ("eq", "lt", "le")
    shifts = [arg for arg in node.args if not (compares and arg.op == "const")]
    wanted = 1 if compares else len(node.args)
    if len(shifts) != wanted or not all(map(_wraps, shifts)) or len({arg.attr for arg in shifts}) > 1:
        return None
    args = tuple([arg.args[0] if arg in shifts else arg for arg in node.args])
    return build.shift(build.rebuild(node, args), shifts[0].attr[:2])


SHARE = _then_fold(
    {
        "shift": [_shift_of_shift],
        "in_set": [_of_shifts],
        "not": [_of_shifts],
        "and": [_of_shifts],
        "or": [_of_shifts],
        "xor": [_of_shifts],
        "eq": [_of_shifts],
        "lt": [_of_shifts],
        "le": [_of_shifts],
    }
)
"""Shifts move outwards over what is computed cell by cell: one read a neighbor and value, shared by all rules."""


def prune(pass_: PassGraph) -> PassGraph:
    """The pass without writes of the values that slots already have, substeps that write nothing, and constant guards."""
    current: dict[str, Node] = {}

    def changed(writes: Iterable[tuple[str, Node]]) -> tuple[tuple[str, Node], ...]:
        pairs = []
        for slot, node in writes:
            before, current[slot] = current.get(slot), node
            if before is not node and (before is not None or not node.is_input(slot)):
                pairs.append((slot, node))
        return tuple(pairs)

    substeps = []
    for step in pass_.substeps:
        if writes := changed(step.writes):
            guards = tuple([guard for guard in step.guards if guard.op != "const" or guard.attr])
            substeps.append(replace(step, writes=writes, guards=guards))
    outputs = tuple([(slot, node) for slot, node in pass_.outputs if not node.is_input(slot)])
    return replace(pass_, substeps=tuple(substeps), outputs=outputs)


@dataclass(frozen=True)
class Stage:
    """A stage of the compiler: its name, one line of help, and what it does to one pass of a program."""

    name: str
    about: str
    run: Callable[[PassGraph], PassGraph]


PIPELINE: tuple[Stage, ...] = (
    Stage("fold", "folds constants and flags that are always equal", partial(rewrite_pass, rules=FOLD)),
    # Before sharing: what a neighbor's property decides becomes a question about its element.
    Stage("specialise", "replaces the properties of a cell whose element is known", specialise),
    Stage("resolve", "turns tests of properties into tests of the element", partial(rewrite_pass, rules=RESOLVE)),
    # After resolving: only now is it clear which neighbors are read.
    Stage("share", "reads each value of a neighbor once", partial(rewrite_pass, rules=SHARE)),
    # Last: substeps whose rules have turned out never to fire no longer write anything.
    Stage("prune", "removes substeps that change nothing", prune),
)  # fmt: skip


def run_passes(program: Program, until: str | None = None) -> Program:
    """The optimized program; `until` names the last stage to run. The IR is verified after every stage."""
    verify(program, "lower")
    for stage in PIPELINE:
        program = replace(program, passes=tuple(map(stage.run, program.passes)))
        verify(program, stage.name)
        if stage.name == until:
            break
    return program
