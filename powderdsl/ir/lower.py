"""The checked model -> IR: expressions and rules. Vectors become two slots, fresh cells their parts, conflict policies masks."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial, reduce
from itertools import starmap
from math import ceil, floor, pi

from powderdsl.analysis.changes import facts_of
from powderdsl.ir.ops import (
    FLAG,
    REAL,
    Graph,
    Node,
    PassGraph,
    Program,
    SlotType,
    SubstepGraph,
    Threshold,
    Type,
    integer,
    kernel_rows,
    single,
)
from powderdsl.model.logic.satisfy import Budget, satisfiable
from powderdsl.model.operations import OPERATIONS
from powderdsl.model.state import Slot, scratch_slots, slots
from powderdsl.model.types import (
    HERE,
    Assign,
    Expr,
    Kernel,
    Kind,
    Move,
    Offset,
    Pass,
    Property,
    Rule,
    Ruleset,
    Substep,
    Swap,
    Transform,
    Value,
    footprint,
    writes_of,
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
"""1.5 · 2²³: adding it to a number rounds the number to an integer."""


@dataclass
class Inputs:
    """The inputs of expressions: the current node of each slot, and of each value under `let` as ``let NAME``."""

    ruleset: Ruleset
    build: Graph
    state: dict[str, Node]
    threshold: Threshold | None = None
    """If given, chances are the number of draws below them, else floats."""

    def stream(self, name: str) -> tuple[str, int]:
        """A stream and the bits of its draws."""
        return name, next(stream.bits for stream in self.ruleset.streams if stream.name == name)

    def constant(self, value: Value | str, kind: Kind) -> Node:
        """A constant of a kind; a text names a parameter."""
        build, threshold = self.build, self.threshold
        if isinstance(value, str):
            param = next(p for p in self.ruleset.params if p.name == value)
            if kind.name == "chance" and threshold is not None:
                return build.node("param", integer(0, 1 << threshold.bits), attr=(value, threshold))
            return build.node("param", ir_type(param.kind), attr=(value, None))
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
        """The value of the element in each cell: one select per distinct value."""
        groups: dict[Node, set[int]] = {}
        for identity, value in enumerate(values):
            groups.setdefault(value, set()).add(identity)
        (result, _), *others = sorted(groups.items(), key=lambda group: -len(group[1]))
        for value, ids in others:
            result = self.build.select(self.build.in_set(element, frozenset(ids)), value, result)
        return result


def lower_expression(expr: Expr, at: Inputs) -> Parts:
    """The nodes of a checked expression.

    An operation without a case becomes the IR operation of its row, on numbers or on both parts of vectors.
    """
    build, value = at.build, expr.value
    match expr.op:
        case "const" | "param":
            return (at.constant(value, expr.kind),)
        case "element":
            return (at.state["element"],)
        case "property":
            prop = at.ruleset.property(value)
            assert prop is not None
            return (at.state[value] if prop.stored else at.property_of(prop, at.state["element"]),)
        case "field" | "let":
            name = value if expr.op == "field" else f"let {value}"
            return tuple([at.state[part] for part in part_names(name, expr.kind)])
        case "draw":
            return (build.derive("draw", attr=at.stream(value)),)
        case "coordinate":
            return (build.node("coordinate", ir_type(expr.kind), attr=value),)
        case "lt" if any(arg.kind.name == "draw" for arg in expr.args):
            return (_lt_draw(expr, at),)
        case "to_real":
            at = replace(at, threshold=None)
    args = [lower_expression(arg, at) for arg in expr.args]
    match expr.op, args:
        case "look", (parts,):
            return tuple([build.shift(part, value) for part in parts])
        case "eq", ((a,), (b,)) if a.type == FLAG:
            return (build.not_(build.derive("xor", a, b)),)
        case "to_real", (parts,) if parts[0].type == REAL:
            return parts
        case "count", ((flag,),):
            return (build.derive("count", flag, attr=(value.weights, value.wrap)),)
        case "sum", (parts,):
            return tuple([_sum(build, value, part) for part in parts])
        case "octant", ((y, x),):
            return (_octant(build, y, x),)
        case "opposite" | "clockwise", ((direction,),):
            eighths = build.integer(4 if expr.op == "opposite" else 2)
            return (build.derive("mod", build.derive("add", direction, eighths), attr=8),)
        case "sin" | "cos", ((x,),):
            return (_wave(build, x, expr.op == "cos"),)
        case "length", ((y, x),):
            return (_length(build, y, x),)
        case ("row_part", ((part, _),)) | ("column_part", ((_, part),)):
            return (part,)
        case "vector", ((y,), (x,)):
            return y, x
    name = OPERATIONS[expr.op].lowers or expr.op
    # A number combined with a vector serves both parts.
    return tuple([
        build.derive(name, *[parts[i % len(parts)] for parts in args], attr=value)
        for i in range(max(map(len, args), default=1))
    ])  # fmt: skip


def node(expr: Expr, at: Inputs) -> Node:
    """The node of an expression that is not a vector."""
    (number,) = lower_expression(expr, at)
    return number


def _real(build: Graph, value: float | Fraction) -> Node:
    """A constant as the float32 it is rounded to, going through float64 as the reference does."""
    return build.real(single(float(value)))


# Draws


def draws_below(chance: Fraction | float, threshold: Threshold) -> int:
    """The number of the 2^bits draws that lie below a chance, or not above it."""
    scaled = Fraction(float(chance)) * (1 << threshold.bits) - Fraction(1, 2)
    count = ceil(scaled) if threshold.strict else floor(scaled) + 1
    return min(max(count, 0), 1 << threshold.bits)


def _split_draw(expr: Expr, at: Inputs) -> tuple[tuple[str, int], Offset, Node]:
    """A draw as its stream, the offset at which it is read, and the integer that is added to it."""
    build = at.build
    if expr.op == "draw":
        return at.stream(expr.value), (0, 0), build.integer(0)
    if expr.op == "look":
        stream, (dy, dx), extra = _split_draw(expr.args[0], at)
        oy, ox = expr.value
        return stream, (dy + oy, dx + ox), build.shift(extra, (oy, ox))
    draw, number = sorted(expr.args, key=lambda arg: arg.kind.name != "draw")
    stream, offset, extra = _split_draw(draw, at)
    other = node(number, at)
    return (
        stream,
        offset,
        build.derive("add", extra, build.derive("neg", other) if expr.op == "sub" else other),
    )


def _lt_draw(expr: Expr, at: Inputs) -> Node:
    """draw + extra < other, or other < draw + extra, which is the opposite of draw + extra <= other."""
    build = at.build
    draw, other = sorted(expr.args, key=lambda arg: arg.kind.name != "draw")
    flipped = draw is not expr.args[0]
    stream, offset, extra = _split_draw(draw, at)
    threshold = Threshold(stream[1], strict=not flipped)
    base, limit = build.integer(0), build.integer(0)
    if other.kind.name == "int":
        base = node(other, at)
    elif other.op == "const":
        base = build.integer(floor(other.value))
        limit = build.integer(draws_below(other.value - floor(other.value), threshold))
    else:
        limit = node(other, replace(at, threshold=threshold))
    there = build.shift(limit, (-offset[0], -offset[1]))
    part = build.shift(build.derive("below", there, attr=stream), offset)
    less, same = build.derive("lt", extra, base), build.derive("eq", extra, base)
    result = build.or_(less, build.and_(same, part))
    return build.not_(result) if flipped else result


# Neighborhoods and vectors


def _sum(build: Graph, kernel: Kernel, value: Node) -> Node:
    """The weighted sum, each row from the left, then the rows from the top. Equal rows are summed once and shifted."""

    def weighted(dx: int, weight: int) -> Node:
        term = build.shift(value, (0, dx), kernel.wrap)
        return term if weight == 1 else build.derive("mul", term, build.const(weight, value.type))

    if not kernel.weights:
        return build.const(0, value.type)
    add = partial(build.derive, "add")
    rows = kernel_rows(kernel.weights).items()
    return reduce(
        add, (build.shift(reduce(add, starmap(weighted, row)), (dy, 0), kernel.wrap) for dy, row in rows)
    )


def _length(build: Graph, y: Node, x: Node) -> Node:
    add, mul = (partial(build.derive, op) for op in ("add", "mul"))
    return build.derive("sqrt", add(mul(y, y), mul(x, x)))


def _octant(build: Graph, y: Node, x: Node) -> Node:
    """The octant, by comparing x with the borders of the octants at this length."""
    derive = build.derive
    reach = derive("add", _length(build, y, x), _real(build, 0.001))
    near, far = (derive("mul", _real(build, border), reach) for border in (NEAR, FAR))
    up = derive("lt", y, build.real(0.0))
    result = build.integer(4)
    borders = (near, far, derive("neg", far), derive("neg", near))
    for octant in (3, 2, 1, 0):
        mirrored = build.select(up, build.integer((8 - octant) % 8), build.integer(octant))
        result = build.select(derive("lt", borders[octant], x), mirrored, result)
    return result


def _wave(build: Graph, x: Node, cosine: bool) -> Node:
    """A sine or cosine: π/2 is taken off in three parts, then follows a series. See `model.reference` for each step."""
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
    down = between(0.5, 2.5) if cosine else lt(real(1.5), turn)
    value = build.select(odd, rising, level) if cosine else build.select(odd, level, rising)
    return build.select(down, build.derive("neg", value), value)


Mover = Transform | Swap | Move
Claim = tuple[Rule, Node]
"""A rule and the cells in which it fires."""

LIVE_BUDGET = 100_000
"""Maximum number of nodes evaluated to find rules that never fire: a tenth of a second. Beyond it, every rule stays."""


def part_names(name: str, kind: Kind) -> tuple[str, ...]:
    """The IR slots of a state array: one, or one for each component of a vector."""
    return (f"{name}.row", f"{name}.column") if kind.name == "vec2" else (name,)


def ir_type(kind: Kind, ids: int = 256) -> Type:
    """The IR type that stores values of a kind; `ids` is the number of element ids."""
    types = {"flag": FLAG, "element": integer(0, ids - 1), "direction": integer(0, 7)}
    if kind.name in ("real", "vec2", "chance"):
        return REAL
    return types.get(kind.name) or integer(int(kind.lo), int(kind.hi))


def slot_parts(slot: Slot, ruleset: Ruleset) -> tuple[SlotType, ...]:
    """The IR slots of a state array: see `part_names`."""
    type, names = ir_type(slot.kind, ruleset.slots), part_names(slot.name, slot.kind)
    if len(names) == 1:
        return (SlotType(slot.name, type, slot.default, slot.resets, slot.name),)
    return tuple([
        SlotType(name, type, slot.default[i], slot.resets, slot.name, i) for i, name in enumerate(names)
    ])  # fmt: skip


def state_slots(ruleset: Ruleset) -> list[SlotType]:
    """The IR slots of a state; the first is the element's."""
    return [part for slot in slots(ruleset) for part in slot_parts(slot, ruleset)]


def program_of(ruleset: Ruleset, slots: Iterable[SlotType], passes: Iterable[PassGraph]) -> Program:
    """A program with the parameters and streams of a ruleset."""
    return Program(
        ruleset.name,
        tuple(slots),
        tuple((p.name, p.kind.name) for p in ruleset.params),
        tuple((s.name, s.ident, s.bits) for s in ruleset.streams),
        tuple(passes),
    )


def lower_ruleset(ruleset: Ruleset) -> Program:
    """All passes of a ruleset, one graph each."""
    slot_types = state_slots(ruleset)
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
    return program_of(ruleset, slot_types, passes)


def lower_values(ruleset: Ruleset, values: Mapping[str, Expr], lets: Iterable[str] = ()) -> PassGraph:
    """Expressions as a pass that writes a slot for each. `lets`: names of flags, slots too, that `let` may read."""
    build = Graph()
    inputs = {part.name: build.input(part.name, part.type) for part in state_slots(ruleset)}
    inputs |= {f"let {name}": build.input(name, FLAG) for name in lets}
    at = Inputs(ruleset, build, inputs)
    return PassGraph("values", "", (), tuple((name, node(value, at)) for name, value in values.items()))


def live_passes(ruleset: Ruleset) -> tuple[Pass, ...]:
    """The passes without rules whose conditions cannot hold: a loop writes many copies, few of which fit the elements."""
    facts = replace(facts_of(ruleset), budget=Budget(LIVE_BUDGET))

    def live(substep: Substep) -> Substep:
        rules = [rule for rule in substep.rules if satisfiable(facts, [(rule.mask, HERE)], substep.values)]
        return replace(substep, rules=tuple(rules))

    return tuple([replace(pass_, substeps=tuple(map(live, pass_.substeps))) for pass_ in ruleset.passes])


class _PassLowering:
    """Lowers one pass; `state` has the current node of every slot and let."""

    def __init__(self, ruleset: Ruleset, pass_: Pass, graph: Graph, ranges: Mapping[str, Type] | None = None):
        self.ruleset, self.pass_ = ruleset, pass_
        self.build = graph
        self.scratch = scratch_slots(pass_)
        self.slots = {slot.name: slot for slot in slots(ruleset)} | self.scratch
        """The state's arrays, and scratch fields."""
        self.parts = [(slot, part) for slot in self.slots.values() for part in slot_parts(slot, ruleset)]
        self.traveling = [part.name for slot, part in self.parts if slot.travels]
        self.state: dict[str, Node] = {}
        for _, part in self.parts:
            self.state[part.name] = self.build.input(part.name, (ranges or {}).get(part.name, part.type))

    def lower(self) -> PassGraph:
        build, before = self.build, dict(self.state)
        for slot, part in self.parts:
            if slot.name in self.scratch:
                self.state[part.name] = build.const(part.default, part.type)
        substeps = tuple(map(self.substep, self.pass_.substeps))
        outputs = []
        for slot, part in self.parts:
            last = self.state[part.name]
            if slot.name not in self.scratch and last is not before[part.name]:
                limits = (float(slot.kind.lo), float(slot.kind.hi))
                outputs.append(
                    (part.name, build.derive("clamp", last, attr=limits) if slot.is_real else last)
                )
        return PassGraph(self.pass_.name, self.pass_.pack, substeps, tuple(outputs))

    def inputs(self) -> Inputs:
        return Inputs(self.ruleset, self.build, dict(self.state))

    def substep(self, substep: Substep) -> SubstepGraph:
        place = next((f"{r.span.source.name}:{r.span.line}" for r in substep.rules), "")
        self.build.place = place
        for let in substep.lets:
            names = part_names(f"let {let.name}", let.value.kind)
            self.state |= zip(names, lower_expression(let.value, self.inputs()), strict=True)
        at = self.inputs()
        claims: list[Claim] = [(rule, node(rule.mask, at)) for rule in substep.rules]
        if substep.policy in ("drop_both", "first_wins"):
            claims = self._keep_apart(claims, substep.policy)
        movers = [(rule, mask) for rule, mask in claims if not isinstance(rule, Assign)]
        assigns = [(rule, mask) for rule, mask in claims if isinstance(rule, Assign)]
        # All values are those before the substep; effects are written after the movements.
        writes, effects = (
            [
                (write, mask, lower_expression(write.value, at))
                for rule, mask in rules
                for write in writes_of(rule)
            ]
            for rules in (assigns, movers)
        )
        before = dict(self.state)
        for write in writes:
            self._assign(*write)
        self._move(movers, at, substep.policy)
        for effect in effects:
            self._assign(*effect)
        changed = tuple((name, new) for name, new in self.state.items() if before[name] is not new)
        return SubstepGraph(substep.label, place, changed, tuple(mask for _, mask in claims))

    def _assign(self, write: Assign, mask: Node, value: Parts) -> None:
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

    def _move(self, movers: Sequence[tuple[Mover, Node]], at: Inputs, policy: str) -> None:
        """Write transforms and the content left behind by moves, then arrivals, all from the world before.

        Unless a policy separates them, a cell may take part in several exchanges, which are then not swaps: in swaps,
        each cell belongs to at most one. Movers take the content of their targets, where their own content arrives.
        """
        build, state = self.build, self.state
        before = dict(state)
        for rule, mask in movers:
            if isinstance(rule, Swap):
                continue
            element = rule.target if isinstance(rule, Transform) else rule.leaving
            if element is not None:
                left = self._fresh(node(element, at), at)
            else:
                left = {name: build.shift(before[name], rule.offset) for name in self.traveling}  # type: ignore[union-attr]  # only moves have none
            for name, value in left.items():
                state[name] = build.select(mask, value, state[name])
        for rule, mask in movers:
            if isinstance(rule, Transform):
                continue
            swaps = isinstance(rule, Swap)
            op = "swap" if swaps and policy != "overwrite" else "arrive"
            for name in self.traveling:
                state[name] = build.derive(op, before[name], mask, state[name], attr=rule.offset)
                if swaps and op == "arrive":
                    state[name] = build.select(mask, build.shift(before[name], rule.offset), state[name])

    def _fresh(self, element: Node, at: Inputs) -> dict[str, Node]:
        """The nodes of the slots in a new cell of an element."""
        build, fresh = self.build, {"element": element}
        for slot, part in self.parts:
            if not slot.travels or slot.name == "element":
                continue
            prop = self.ruleset.property(slot.name)
            if prop is not None:
                fresh[slot.name] = at.property_of(prop, element)
                continue
            values = [build.const(part.default, part.type)] * self.ruleset.slots
            for identity, own in slot.own:
                value = own if part.component is None else own[part.component]
                values[identity] = build.const(value, part.type)
            fresh[part.name] = at.by_element(element, values)
        return fresh

    def _keep_apart(self, claims: Sequence[Claim], policy: str) -> list[Claim]:
        """Narrow the masks of movers so that no two claim one cell."""
        build = self.build

        def reach(rule: Rule, cells: Node, way: int) -> Node:
            """The cells and their targets; for way -1, the cells and the movers that target them."""
            return build.any([build.shift(cells, (way * dy, way * dx)) for dy, dx in footprint(rule)])

        narrowed: list[Claim] = []
        taken = build.flag(False)
        for rule, mask in claims:
            if isinstance(rule, Assign):
                narrowed.append((rule, mask))
                continue
            if isinstance(rule, Swap) or (isinstance(rule, Move) and rule.leaving is not None):
                dy, dx = rule.offset
                chained = build.or_(build.shift(mask, (dy, dx)), build.shift(mask, (-dy, -dx)))
                mask = build.and_(mask, build.not_(chained))
            if policy == "first_wins":
                mask = build.and_(mask, build.not_(reach(rule, taken, 1)))
                taken = build.or_(taken, reach(rule, mask, -1))
            for other, wanted in claims if policy == "drop_both" else ():
                if other is not rule and not isinstance(other, Assign):
                    mask = build.and_(mask, build.not_(reach(rule, reach(other, wanted, -1), 1)))
            narrowed.append((rule, mask))
        return narrowed
