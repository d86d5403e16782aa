"""The checked model -> IR: expressions and rules. Vectors become two slots, fresh cells their parts, conflict policies masks."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial, reduce
from math import ceil, floor, pi

from powderdsl.analysis.changes import facts_of
from powderdsl.ir.ops import (
    FLAG,
    REAL,
    Builder,
    Graph,
    Node,
    PassGraph,
    Program,
    SlotType,
    SubstepGraph,
    Threshold,
    Type,
    component_names,
    integer,
    kernel_rows,
)
from powderdsl.ir.single import single
from powderdsl.model.logic.satisfy import Budget, satisfiable
from powderdsl.model.operations import OPERATIONS
from powderdsl.model.state import scratch_slots, slots
from powderdsl.model.types import (
    HERE,
    Assign,
    Expr,
    Kind,
    Moment,
    Move,
    Offset,
    Pass,
    Property,
    Ruleset,
    Swap,
    Transform,
    Value,
)

Parts = tuple[Node, ...]
"""A value: one node, or the row and column components of a vector."""

NEAR, FAR = 0.92387953251128674, 0.38268343236508977
"""cos(π/8) and cos(3π/8), where octants end."""

HALF_PI = (1.5703125, 0.0004837512969970703125, 7.549789954891609e-08)
"""π/2 in three parts, the first two of few bits."""

SINE = (-1 / 6, 1 / 120, -1 / 5040, 1 / 362880)
COSINE = (1 / 24, -1 / 720, 1 / 40320, -1 / 3628800)
"""The series of sine and cosine from x³ and x⁴ on."""

ROUNDER = 12582912.0
"""1.5 · 2²³, which rounds what is added to it to an integer."""


@dataclass
class Inputs:
    """What expressions read: the current node of each slot, and lets."""

    ruleset: Ruleset
    build: Builder
    state: dict[str, Node]
    lets: dict[str, Parts]
    threshold: Threshold | None = None
    """Chances are the number of draws below them if this is given, else floats."""

    def with_threshold(self, threshold: Threshold | None) -> Inputs:
        return Inputs(self.ruleset, self.build, self.state, self.lets, threshold)

    def constant(self, value: Value | str, kind: Kind) -> Node:
        """A constant of a kind; a text names a parameter."""
        build, threshold = self.build, self.threshold
        if isinstance(value, str):
            param = next(p for p in self.ruleset.params if p.name == value)
            if kind.name == "chance" and threshold is not None:
                return build.make("param", integer(0, 1 << threshold.bits), attr=(value, threshold))
            return build.make("param", ir_type(param.kind), attr=(value, None))
        assert not isinstance(value, tuple)
        match kind.name:
            case "flag":
                return build.flag(bool(value))
            case "chance" if threshold is not None:
                return build.integer(draws_below(value, threshold))
            case "chance" | "real":
                return _real(build, value)
        return build.integer(int(value))

    def property_of(self, prop: Property, element: Node) -> Node:
        """A property of given elements; chances, and values that are parameters, are chosen one at a time."""
        values = prop.values
        if prop.kind.name == "chance" or any(isinstance(value, str) for value in values):
            return self.by_element(element, [self.constant(value, prop.kind) for value in values])
        if prop.kind.name == "flag":
            return self.build.in_set(element, frozenset(i for i, value in enumerate(values) if value))
        return self.build.derive("table", element, attr=tuple(int(value) for value in values))  # type: ignore[arg-type]  # only numbers are left

    def by_element(self, element: Node, values: list[Node]) -> Node:
        """The value that belongs to the element: one select a distinct value."""
        groups: dict[Node, set[int]] = {}
        for identity, value in enumerate(values):
            groups.setdefault(value, set()).add(identity)
        (result, _), *others = sorted(groups.items(), key=lambda group: -len(group[1]))
        for value, ids in others:
            result = self.build.select(self.build.in_set(element, frozenset(ids)), value, result)
        return result


def lower_expression(expr: Expr, at: Inputs) -> Parts:
    """The nodes of a checked expression.

    What has no code in `_LOWER` is an operation of the IR, as its row says, of numbers or of both parts of vectors.
    """
    if expr.op in _LOWER:
        value = _LOWER[expr.op](expr, at)
        return (value,) if isinstance(value, Node) else value
    name = OPERATIONS[expr.op].lowers or expr.op
    args = [lower_expression(arg, at) for arg in expr.args]
    return _each(partial(at.build.derive, name, attr=expr.value), *args)


def node(expr: Expr, at: Inputs) -> Node:
    """The node of an expression that is not a vector."""
    (number,) = lower_expression(expr, at)
    return number


def _each(function: Callable[..., Node], *values: Parts) -> Parts:
    """Apply to numbers, or to both parts of vectors; numbers beside vectors serve both parts."""
    if all(len(value) == 1 for value in values):
        return (function(*[number for (number,) in values]),)
    return tuple([function(*[value[part % len(value)] for value in values]) for part in (0, 1)])


def _real(build: Builder, value: float | Fraction) -> Node:
    """A constant as the float32 it is rounded to, going through float64 as the reference does."""
    return build.real(single(float(value)))


def _property(expr: Expr, at: Inputs) -> Node:
    prop = at.ruleset.property(str(expr.value))
    assert prop is not None
    return at.state[prop.name] if prop.stored else at.property_of(prop, at.state["element"])


def _look(expr: Expr, at: Inputs) -> Parts:
    return _each(lambda part: at.build.shift(part, expr.value), lower_expression(expr.args[0], at))


def _eq(expr: Expr, at: Inputs) -> Node:
    a, b = (node(arg, at) for arg in expr.args)
    if a.type == FLAG:
        return at.build.not_(at.build.derive("xor", a, b))
    return at.build.derive("eq", a, b)


# Draws


def draws_below(chance: Fraction | float, threshold: Threshold) -> int:
    """How many of the 2^bits draws lie below a chance, or not above it."""
    scaled = Fraction(float(chance)) * (1 << threshold.bits) - Fraction(1, 2)
    count = ceil(scaled) if threshold.strict else floor(scaled) + 1
    return min(max(count, 0), 1 << threshold.bits)


def _stream(name: str, at: Inputs) -> tuple[str, int]:
    """A stream and the bits of its draws."""
    return name, next(stream.bits for stream in at.ruleset.streams if stream.name == name)


def _split_draw(expr: Expr, at: Inputs) -> tuple[tuple[str, int], Offset, Node | None]:
    """A draw as its stream, the offset at which it is read, and the integer that is added to it."""
    build = at.build
    if expr.op == "draw":
        return _stream(expr.value, at), (0, 0), None
    if expr.op == "look":
        stream, (dy, dx), extra = _split_draw(expr.args[0], at)
        oy, ox = expr.value
        return stream, (dy + oy, dx + ox), build.shift(extra, (oy, ox)) if extra else None
    draw, number = sorted(expr.args, key=lambda arg: arg.kind.name != "draw")
    stream, offset, extra = _split_draw(draw, at)
    other = node(number, at)
    other = build.derive("neg", other) if expr.op == "sub" else other
    return stream, offset, build.derive("add", extra, other) if extra else other


def _lt(expr: Expr, at: Inputs) -> Node:
    left, right = expr.args
    build = at.build
    if "draw" not in (left.kind.name, right.kind.name):
        return build.derive("lt", node(left, at), node(right, at))
    # draw + extra < other, or other < draw + extra, which is the opposite of draw + extra <= other
    flipped = right.kind.name == "draw"
    draw, other = (right, left) if flipped else (left, right)
    stream, offset, extra = _split_draw(draw, at)
    threshold = Threshold(stream[1], strict=not flipped)
    if other.kind.name == "int":
        limit = node(other, at)
        result = build.derive("lt", extra or build.integer(0), limit)
        return build.not_(result) if flipped else result
    base = floor(other.value) if other.op == "const" else 0
    if other.op == "const":
        limit = build.integer(draws_below(other.value - base, threshold))
    else:
        limit = node(other, at.with_threshold(threshold))
    there = build.shift(limit, (-offset[0], -offset[1]))
    part = build.shift(build.derive("below", there, attr=stream), offset)
    if extra is None:
        result = part if base == 0 else build.flag(base > 0)
    else:
        bound = build.integer(base)
        less = build.derive("lt", extra, bound)
        result = build.or_(less, build.and_(build.derive("eq", extra, bound), part))
    return build.not_(result) if flipped else result


# Neighborhoods and vectors


def _sum(expr: Expr, at: Inputs) -> Parts:
    """The weighted sum, each row from the left, then the rows from the top. Equal rows are summed once and shifted."""
    build, kernel = at.build, expr.value

    def weighted(value: Node, dx: int, weight: int) -> Node:
        term = build.shift(value, (0, dx), kernel.wrap)
        return term if weight == 1 else build.derive("mul", term, build.const(weight, value.type))

    def total(value: Node) -> Node:
        if not kernel.weights:
            return build.const(0, value.type)
        rows = (
            build.shift(reduce(add, (weighted(value, *cell) for cell in cells)), (dy, 0), kernel.wrap)
            for dy, cells in kernel_rows(kernel.weights).items()
        )
        return reduce(add, rows)

    add = partial(build.derive, "add")
    return _each(total, lower_expression(expr.args[0], at))


def _length(expr: Expr, at: Inputs) -> Node:
    derive = at.build.derive
    y, x = lower_expression(expr.args[0], at)
    return derive("sqrt", derive("add", derive("mul", y, y), derive("mul", x, x)))


def _octant(expr: Expr, at: Inputs) -> Node:
    """The octant, by comparing x with the borders of the octants at this length."""
    build, derive = at.build, at.build.derive
    y, x = lower_expression(expr.args[0], at)
    reach = derive("add", _length(expr, at), _real(build, 0.001))
    near, far = (derive("mul", _real(build, border), reach) for border in (NEAR, FAR))
    up = derive("lt", y, build.real(0.0))
    result = build.integer(4)
    borders = (near, far, derive("neg", far), derive("neg", near))
    for octant in (3, 2, 1, 0):
        mirrored = build.select(up, build.integer((8 - octant) % 8), build.integer(octant))
        result = build.select(derive("lt", borders[octant], x), mirrored, result)
    return result


def _turned(eighths: int) -> Callable[[Expr, Inputs], Node]:
    return lambda expr, at: at.build.derive(
        "mod", at.build.derive("add", node(expr.args[0], at), at.build.integer(eighths)), attr=8
    )


def _wave(expr: Expr, at: Inputs) -> Node:
    """A sine or cosine: π/2 is taken off in three parts, then follows a series. See `model.reference` for each step."""
    build, x = at.build, node(expr.args[0], at)
    real = partial(_real, build)
    add, sub, mul, lt = (partial(build.derive, op) for op in ("add", "sub", "mul", "lt"))

    def rounded(value: Node) -> Node:
        return sub(add(value, real(ROUNDER)), real(ROUNDER))

    def series(coefficients: tuple[float, ...]) -> Node:
        *others, last = map(real, coefficients)
        return reduce(lambda total, coefficient: add(coefficient, mul(z, total)), reversed(others), last)

    def between(low: float, high: float) -> Node:
        return build.and_(lt(real(low), turn), lt(turn, real(high)))

    q = rounded(mul(x, real(2 / pi)))
    coarse, middle, fine = (mul(q, real(part)) for part in HALF_PI)
    near = sub(sub(x, coarse), middle)
    rest = sub(near, fine)
    small = sub(sub(near, rest), fine)
    turn = sub(q, mul(real(4.0), rounded(sub(mul(q, real(0.25)), real(0.375)))))
    z = mul(rest, rest)
    rising = add(rest, add(small, mul(rest, mul(z, series(SINE)))))
    level = sub(real(1.0), add(mul(real(0.5), z), sub(mul(rest, small), mul(mul(z, z), series(COSINE)))))
    odd = build.or_(between(0.5, 1.5), lt(real(2.5), turn))
    is_cosine = expr.op == "cos"
    down = between(0.5, 2.5) if is_cosine else lt(real(1.5), turn)
    value = build.select(odd, rising, level) if is_cosine else build.select(odd, level, rising)
    return build.select(down, build.derive("neg", value), value)


_LOWER: dict[str, Callable[[Expr, Inputs], Node | Parts]] = {
    **dict.fromkeys(("const", "param"), lambda e, at: at.constant(e.value, e.kind)),
    "element": lambda e, at: at.state["element"],
    "property": _property,
    "field": lambda e, at: tuple([at.state[name] for name in part_names(e.value, e.kind)]),
    "let": lambda e, at: at.lets[e.value],
    "draw": lambda e, at: at.build.derive("draw", attr=_stream(e.value, at)),
    "coordinate": lambda e, at: at.build.make("coordinate", ir_type(e.kind), attr=e.value),
    "look": _look,
    "eq": _eq,
    "lt": _lt,
    "to_real": lambda e, at: at.build.to_real(node(e.args[0], at.with_threshold(None))),
    "count": lambda e, at: at.build.derive(
        "count", node(e.args[0], at), attr=(e.value.weights, e.value.wrap)
    ),
    "sum": _sum,
    "octant": _octant,
    "opposite": _turned(4),
    "clockwise": _turned(2),
    **dict.fromkeys(("sin", "cos"), _wave),
    "length": _length,
    "row_part": lambda e, at: lower_expression(e.args[0], at)[0],
    "column_part": lambda e, at: lower_expression(e.args[0], at)[1],
    "vector": lambda e, at: (node(e.args[0], at), node(e.args[1], at)),
}
"""Operations of the model that are more than one of the IR."""


Mover = Transform | Swap | Move

LIVE_BUDGET = 100_000
"""Nodes evaluated to find rules that no world lets happen, a tenth of a second. After that every rule stays."""


def part_names(name: str, kind: Kind) -> tuple[str, ...]:
    """The IR slots of a state array: one, or one for each component of a vector."""
    return component_names(name) if kind.name == "vec2" else (name,)


def ir_type(kind: Kind, ids: int = 256) -> Type:
    """The IR type in which values of a kind are held; `ids` is the number of element ids."""
    types = {"flag": FLAG, "element": integer(0, ids - 1), "direction": integer(0, 7)}
    if kind.name in ("real", "vec2", "chance"):
        return REAL
    return types.get(kind.name) or integer(int(kind.lo), int(kind.hi))


def lower_ruleset(ruleset: Ruleset) -> Program:
    """All passes of a ruleset, one graph each."""
    slot_types = []
    for slot in slots(ruleset):
        names = part_names(slot.name, slot.kind)
        for i, name in enumerate(names):
            default = slot.default[i] if isinstance(slot.default, tuple) else slot.default
            type, component = ir_type(slot.kind, ruleset.slots), i if len(names) > 1 else None
            slot_types.append(SlotType(name, type, default, slot.resets, slot.name, component))
    # The range of a slot that starts each step at its default grows from pass to pass.
    ranges = {
        s.name: integer(int(s.default), int(s.default))
        for s in slot_types
        if s.resets and s.type.name == "int"
    }
    passes = []
    for pass_ in live_passes(ruleset):
        graph = _PassLowering(ruleset, pass_, Graph(), ranges).lower()
        for name, last in graph.outputs:
            if name in ranges:
                ranges[name] = integer(min(ranges[name].lo, last.type.lo), max(ranges[name].hi, last.type.hi))
        passes.append(graph)
    return Program(
        ruleset.name,
        tuple(slot_types),
        tuple((p.name, p.kind.name) for p in ruleset.params),
        tuple((s.name, s.ident, s.bits) for s in ruleset.streams),
        tuple(passes),
    )


def live_passes(ruleset: Ruleset) -> tuple[Pass, ...]:
    """The passes without rules whose conditions cannot hold: a loop writes many copies, of which few suit the elements."""
    facts = replace(facts_of(ruleset), budget=Budget(LIVE_BUDGET))

    def live(moment: Moment) -> Moment:
        rules = [rule for rule in moment.rules if satisfiable(facts, [(rule.mask, HERE)], moment.values)]
        return replace(moment, rules=tuple(rules))

    return tuple([replace(pass_, moments=tuple(map(live, pass_.moments))) for pass_ in ruleset.passes])


def lower_pass(ruleset: Ruleset, pass_: Pass, graph: Graph) -> dict[str, Node]:
    """The nodes of the slots that a pass writes, in a graph that several passes may share."""
    return dict(_PassLowering(ruleset, pass_, graph).lower().outputs)


def lower_substep(ruleset: Ruleset, pass_: Pass, number: int, graph: Graph) -> dict[str, Node]:
    """The nodes of what one substep of a pass writes, as functions of the world that the substep finds.

    Scratch fields and values that `let` fixed in earlier substeps are inputs too, the latter as ``let NAME``; values
    that this substep fixes are among the results.
    """
    lowering = _PassLowering(ruleset, pass_, graph)
    for moment in pass_.moments[:number]:
        for let in moment.lets:
            type = ir_type(let.value.kind, ruleset.slots)
            names = [f"let {name}" for name in part_names(let.name, let.value.kind)]
            lowering.lets[let.name] = tuple([lowering.build.input(name, type) for name in names])
    before = dict(lowering.state)
    moment = pass_.moments[number]
    lowering.substep(moment)
    changed = {name: node for name, node in lowering.state.items() if before[name] is not node}
    for let in moment.lets:
        names = [f"let {name}" for name in part_names(let.name, let.value.kind)]
        changed |= zip(names, lowering.lets[let.name], strict=True)
    return changed


class _PassLowering:
    """Lowers one pass: keeps the current node of every slot, and the values of lets."""

    def __init__(self, ruleset: Ruleset, pass_: Pass, graph: Graph, ranges: Mapping[str, Type] | None = None):
        self.ruleset, self.pass_ = ruleset, pass_
        self.build = Builder(graph)
        self.slots = {slot.name: slot for slot in slots(ruleset)} | scratch_slots(pass_)
        """The state's arrays, and scratch fields."""
        self.state: dict[str, Node] = {}
        for slot in self.slots.values():
            type = ir_type(slot.kind, ruleset.slots)
            for name in part_names(slot.name, slot.kind):
                self.state[name] = self.build.input(name, (ranges or {}).get(name, type))
        self.lets: dict[str, Parts] = {}

    def lower(self) -> PassGraph:
        build, before = self.build, dict(self.state)
        for slot in scratch_slots(self.pass_).values():
            # The number nearest to zero: the same in both components of a vector.
            default = slot.default[0] if isinstance(slot.default, tuple) else slot.default
            for name in part_names(slot.name, slot.kind):
                self.state[name] = build.const(default, before[name].type)
        substeps = tuple([self.substep(moment) for moment in self.pass_.moments])
        outputs = []
        for slot in slots(self.ruleset):
            for name in part_names(slot.name, slot.kind):
                last = self.state[name]
                if last is not before[name]:
                    limits = (float(slot.kind.lo), float(slot.kind.hi))
                    outputs.append(
                        (name, build.derive("settle", last, attr=limits) if slot.is_real else last)
                    )
        return PassGraph(self.pass_.name, self.pass_.pack, substeps, tuple(outputs))

    def inputs(self) -> Inputs:
        return Inputs(self.ruleset, self.build, dict(self.state), self.lets)

    def substep(self, moment: Moment) -> SubstepGraph:
        build = self.build
        place = next((f"{r.span.source.name}:{r.span.line}" for r in moment.rules), "")
        build.place = place
        for let in moment.lets:
            self.lets[let.name] = lower_expression(let.value, self.inputs())
        at = self.inputs()
        masks = {id(rule): node(rule.mask, at) for rule in moment.rules}
        movers: list[Mover] = [rule for rule in moment.rules if not isinstance(rule, Assign)]
        if moment.policy in ("drop_both", "first_wins"):
            self._apply_policy(moment.policy, movers, masks)
        writes = [(rule, masks[id(rule)]) for rule in moment.rules if isinstance(rule, Assign)]
        effects = [(effect, masks[id(rule)]) for rule in movers for effect in rule.effects]
        values = {id(write): lower_expression(write.value, at) for write, _ in (*writes, *effects)}
        before = dict(self.state)
        for write, mask in writes:
            self._assign(write, values[id(write)], mask)
        self._move(movers, masks, at, moment.policy)
        for write, mask in effects:
            self._assign(write, values[id(write)], mask)
        changed = tuple((name, new) for name, new in self.state.items() if before[name] is not new)
        return SubstepGraph(moment.label, place, changed, tuple(masks.values()))

    def _assign(self, write: Assign, value: Parts, mask: Node) -> None:
        """`field op value` at an offset from each cell of the mask, read from the target's side."""
        build = self.build
        slot = self.slots[write.field]
        back = (-write.offset[0], -write.offset[1])
        mask = build.shift(mask, back)
        if slot.of is not None:  # cells of other elements keep reading the default
            mask = build.and_(mask, build.in_set(self.state["element"], slot.of))
        for name, part in zip(part_names(slot.name, slot.kind), value, strict=True):
            old = self.state[name]
            new = build.shift(part, back)
            if write.op != ":=":
                new = build.derive("add" if write.op == "+=" else "sub", old, new)
            if slot.kind.name == "int":
                new = build.clamp(new, int(slot.kind.lo), int(slot.kind.hi))
            self.state[name] = build.select(mask, new, old)

    def _move(self, movers: list[Mover], masks: dict[int, Node], at: Inputs, policy: str) -> None:
        """Transforms and what moves leave behind first, then arrivals, all from the world before.

        Without a policy that keeps them apart, a cell may take part in several exchanges. They are then not swaps, of
        which each cell belongs to one at most: movers take what their targets held, and what they held arrives there.
        """
        build = self.build
        before = dict(self.state)
        travelling = [
            name for slot in self.slots.values() if slot.travels for name in part_names(slot.name, slot.kind)
        ]
        for rule in movers:
            if isinstance(rule, Swap):
                continue
            target = rule.target if isinstance(rule, Transform) else rule.leaving
            left = (
                {name: build.shift(before[name], rule.offset) for name in travelling}
                if target is None and isinstance(rule, Move)
                else self._fresh(node(target, at))  # type: ignore[arg-type]  # only moves may have none
            )
            for name, value in left.items():
                self.state[name] = build.select(masks[id(rule)], value, self.state[name])
        for rule in movers:
            if isinstance(rule, Transform):
                continue
            swaps = isinstance(rule, Swap)
            op = "swap" if swaps and policy != "overwrite" else "arrive"
            for name in travelling:
                mask, rest = masks[id(rule)], self.state[name]
                moved = build.derive(op, before[name], mask, rest, attr=rule.offset)
                if swaps and op == "arrive":
                    moved = build.select(mask, build.shift(before[name], rule.offset), moved)
                self.state[name] = moved

    def _fresh(self, element: Node) -> dict[str, Node]:
        """What a new cell of an element holds."""
        build = self.build
        at = self.inputs()
        found = {"element": element}
        for slot in self.slots.values():
            if not slot.travels or slot.name == "element":
                continue
            prop = self.ruleset.property(slot.name)
            if prop is not None:
                found[slot.name] = at.property_of(prop, element)
                continue
            defaults = slot.default if isinstance(slot.default, tuple) else (slot.default,)
            type = ir_type(slot.kind, self.ruleset.slots)
            for part, (name, default) in enumerate(
                zip(part_names(slot.name, slot.kind), defaults, strict=True)
            ):
                values = [build.const(default, type)] * self.ruleset.slots
                for identity, own in slot.own:
                    values[identity] = build.const(own[part] if isinstance(own, tuple) else own, type)
                found[name] = at.by_element(element, values)
        return found

    def _apply_policy(self, policy: str, movers: list[Mover], masks: dict[int, Node]) -> None:
        """Narrow the masks so that no two rules claim one cell."""
        build = self.build
        wanted = {id(rule): masks[id(rule)] for rule in movers}

        def reach(rule: Mover, cells: Node, way: int) -> Node:
            """The cells and their targets, or under -1 these cells and those from where they are targets."""
            if isinstance(rule, Transform):
                return cells
            return build.or_(cells, build.shift(cells, (way * rule.offset[0], way * rule.offset[1])))

        taken = build.flag(False)
        for rule in movers:
            mask = wanted[id(rule)]
            if isinstance(rule, Swap) or (isinstance(rule, Move) and rule.leaving is not None):
                dy, dx = rule.offset
                chained = build.or_(build.shift(mask, (dy, dx)), build.shift(mask, (-dy, -dx)))
                mask = build.and_(mask, build.not_(chained))
            if policy == "drop_both":
                for other in movers:
                    if other is not rule:
                        mask = build.and_(
                            mask, build.not_(reach(rule, reach(other, wanted[id(other)], -1), 1))
                        )
            else:
                mask = build.and_(mask, build.not_(reach(rule, taken, 1)))
                taken = build.or_(taken, reach(rule, mask, -1))
            masks[id(rule)] = mask
