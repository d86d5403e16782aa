"""The oracle: a slow, obvious NumPy interpreter of the checked model. It defines what rules mean.

It shares no code with the compiler: no IR, no passes. Arrays are [B, H, W] ([B, 2, H, W] for vectors). Integers
are int64 here, floats float32 with one rounding an operation, draws float64.
"""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any, NamedTuple, Protocol

from powderdsl.arrays import np
from powderdsl.model.state import SNAP, Slot, scratch_slots, slots
from powderdsl.model.types import (
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
)

Array = np.ndarray[Any, Any]
State = dict[str, Array]

WIDE: dict[str, Any] = {
    **dict.fromkeys(("int", "element", "direction"), np.int64),
    "flag": np.bool_,
    **dict.fromkeys(("real", "vec2"), np.float32),
    **dict.fromkeys(("chance", "number"), np.float64),
}
"""The dtype in which values of a kind are computed."""


@dataclass(frozen=True)
class Clock:
    """The inputs of a batch's random numbers: arrays [B] of seed (64 bits), world index and step."""

    seed: Array
    index: Array
    step: Array


# Random numbers


def mix(x: Array, key: Any = 0) -> Array:
    """A 32-bit finalizer (xor-shift-multiply) with a key before the last round, on uint64 arrays of 32-bit numbers."""
    mask = 0xFFFFFFFF
    x = x & mask
    x = x ^ (x >> 16)
    x = (x * 0x7FEB352D) & mask
    x = x ^ (x >> 15)
    x = ((x + key) * 0x846CA68B) & mask
    return x ^ (x >> 16)


def key(clock: Clock, stream: int, start: int) -> Array:
    """The 32-bit key of each world: seed, world index, step and stream mixed in one after the other."""
    seed = clock.seed.astype(np.uint64)
    result = np.full(seed.shape, start, np.uint64)
    for part in (seed, seed >> 32, clock.index, clock.step, np.asarray(stream)):
        result = mix(result + (part.astype(np.uint64) & 0xFFFFFFFF))
    return result


def draw(clock: Clock, stream: int, bits: int, height: int, width: int) -> Array:
    """Uniform draws, float64 [B, H, W], strictly between 0 and 1.

    Bit j of the 32 cells (y, 32 w) … (y, 32 w + 31) is one 32-bit hash, of word number (y ⌈W/32⌉ + w) 32 + j. The
    first bit is the most significant one; a draw of n bits k stands for (k + ½) / 2ⁿ.
    """
    key0 = key(clock, stream, 0x243F6A88)[:, None, None]
    key1 = key(clock, stream, 0x85A308D3)[:, None, None]
    words = -(-width // 32)
    y, w = np.arange(height, dtype=np.uint64)[:, None], np.arange(words, dtype=np.uint64)
    bit = np.arange(width, dtype=np.uint64) % 32
    value = np.zeros((len(clock.seed), height, width), np.int64)
    for j in range(bits):
        n = ((y * words + w) * 32 + j) * 0x9E3779B1
        hashes = mix(n + key0, key1)[:, :, np.arange(width) // 32]
        value = value * 2 + ((hashes >> bit) & 1).astype(np.int64)
    return (value.astype(np.float64) + 0.5) / 2.0**bits


# Neighbors


def look(value: Array, offset: Offset) -> Array:
    """The array's value at the neighbor `offset` of each cell; the grid wraps around."""
    return np.roll(value, (-offset[0], -offset[1]), (-2, -1)) if any(offset) else value


def back(offset: Offset) -> Offset:
    """The offset from the neighbor to the cell."""
    return (-offset[0], -offset[1])


def inside(shape: tuple[int, ...], offset: Offset) -> Array:
    """bool [H, W]: True where the neighbor is inside the grid."""
    height, width = shape
    y, x = np.arange(height)[:, None] + offset[0], np.arange(width) + offset[1]
    return (y >= 0) & (y < height) & ((x >= 0) & (x < width))


def neighborhood(value: Array, kernel: Kernel) -> Array:
    """The weighted sum over a kernel, by rows from the top, each from the left."""
    rows: dict[int, Array] = {}
    for dy, dx, weight in kernel.weights:
        seen = look(value, (dy, dx))
        if not kernel.wrap:
            seen = np.where(inside(value.shape[-2:], (dy, dx)), seen, np.zeros((), value.dtype))
        term = seen if weight == 1 else seen * value.dtype.type(weight)
        rows[dy] = rows[dy] + term if dy in rows else term
    return functools.reduce(operator.add, rows.values()) if rows else np.zeros_like(value)


# Expressions


class Change(NamedTuple):
    """A write to a slot, by a rule or in every step.

    `origin` is the offset from a written cell to the cell in which the rule's condition holds, `source` the offset to the
    cell that the new content comes from.
    """

    how: str
    slot: Slot
    rule: Rule | None = None
    origin: Offset = (0, 0)
    source: Offset | None = None


class Watch(Protocol):
    """Receives the events of a step. Contexts are mutated after each event."""

    def begins(self, substep: Substep, at: Context, masks: Mapping[int, Array]) -> None:
        """The lets of a substep are fixed; `masks` has the cells in which each rule will fire, by `id`."""

    def wrote(self, change: Change, before: Array, after: Array, mask: Array | None = None) -> None:
        """A slot was written where the mask holds; without a mask, anywhere."""


@dataclass
class Context:
    """The inputs of expressions: the world before the substep, earlier lets, draws, and parameters."""

    ruleset: Ruleset
    state: State
    params: Mapping[str, Array]
    draws: dict[str, Array]
    clock: Clock
    lets: dict[str, Array] = field(default_factory=dict)
    watch: Watch | None = None

    @property
    def shape(self) -> tuple[int, int, int]:
        batch, height, width = self.state["element"].shape
        return batch, height, width


def evaluate(expr: Expr, at: Context) -> Array:
    """The value of an expression in every cell."""
    args = [evaluate(arg, at) for arg in expr.args]
    if any(arg.ndim == 4 for arg in args):  # numbers beside vectors get an axis to match
        args = [arg if arg.ndim == 4 else arg[:, None] for arg in args]
    with np.errstate(all="ignore"):
        return np.asarray(_OPS[expr.op](expr, at, *args))


def _property(expr: Expr, at: Context) -> Array:
    prop = at.ruleset.property(str(expr.value))
    assert prop is not None
    if prop.stored:
        return at.state[prop.name]
    return _of_elements(prop, at.state["element"], at)


@functools.cache
def _members(some: frozenset[int]) -> Array:
    """A table of elements by id, bool [256]."""
    return np.asarray([number in some for number in range(256)])


def _of_elements(prop: Property, ids: Array, at: Context) -> Array:
    """The values of a property for cells of these ids."""
    plain = (float(value) if isinstance(value, Fraction) else value for value in prop.values)
    numbers = [0 if isinstance(value, str) else value for value in plain]
    numbers += [0] * (256 - len(numbers))
    result = np.asarray(numbers, WIDE[prop.kind.name])[ids]
    for identity, value in enumerate(prop.values):
        if isinstance(value, str):
            result = np.where(ids == identity, at.params[value][:, None, None], result)
    return result


def _draw(expr: Expr, at: Context) -> Array:
    name = str(expr.value)
    if name not in at.draws:
        stream = next(s for s in at.ruleset.streams if s.name == name)
        at.draws[name] = draw(at.clock, stream.ident, stream.bits, *at.shape[1:])
    return at.draws[name]


def _coordinate(expr: Expr, at: Context) -> Array:
    name, modulus = expr.value
    _, height, width = at.shape
    values = {
        "row": np.arange(height)[:, None],
        "column": np.arange(width),
        "step": at.clock.step.astype(np.int64)[:, None, None],
    }
    return np.broadcast_to(values[name] % modulus, at.shape)


_OPS: dict[str, Any] = {
    "const": lambda e, at: np.broadcast_to(np.asarray(e.value, WIDE[e.kind.name]), at.shape),
    "param": lambda e, at: np.broadcast_to(at.params[e.value][:, None, None], at.shape),
    "element": lambda e, at: at.state["element"],
    "property": _property,
    "field": lambda e, at: at.state[e.value],
    "let": lambda e, at: at.lets[e.value],
    "draw": _draw,
    "coordinate": _coordinate,
    "inside": lambda e, at: np.broadcast_to(inside(at.shape[1:], e.value), at.shape),
    "look": lambda e, at, a: look(a, e.value),
    "member": lambda e, at, a: _members(e.value)[a],
    "not": lambda e, at, a: ~a,
    "and": lambda e, at, a, b: a & b,
    "or": lambda e, at, a, b: a | b,
    "eq": lambda e, at, a, b: a == b,
    "lt": lambda e, at, a, b: a < b,
    "le": lambda e, at, a, b: a <= b,
    "add": lambda e, at, a, b: a + b,
    "sub": lambda e, at, a, b: a - b,
    "mul": lambda e, at, a, b: a * b,
    "div": lambda e, at, a, b: np.where(b == 0, np.float32(0), a / b),
    "quotient": lambda e, at, a, b: np.where(b == 0, 0, a // np.where(b == 0, 1, b)),
    "neg": lambda e, at, a: -a,
    "abs": lambda e, at, a: np.abs(a),
    "min": lambda e, at, a, b: np.minimum(a, b),
    "max": lambda e, at, a, b: np.maximum(a, b),
    "mod": lambda e, at, a: a % e.value,
    "to_real": lambda e, at, a: a.astype(np.float32),
    "count": lambda e, at, a: neighborhood(a.astype(np.int64), e.value),
    "sum": lambda e, at, a: neighborhood(a, e.value),
    "choose": lambda e, at, condition, yes, no: np.where(condition, yes, no),
    "octant": lambda e, at, v: octant(v),
    "opposite": lambda e, at, a: (a + 4) % 8,
    "clockwise": lambda e, at, a: (a + 2) % 8,
    "sin": lambda e, at, a: wave(a, cosine=False),
    "cos": lambda e, at, a: wave(a, cosine=True),
    "length": lambda e, at, v: length(v),
    "row_part": lambda e, at, v: v[:, 0],
    "column_part": lambda e, at, v: v[:, 1],
    "vector": lambda e, at, y, x: np.stack([y, x], 1),
}


# Floats, step by step: each rounds once, to float32. Reordering these steps would change bits.

NEAR, FAR = 0.92387953251128674, 0.38268343236508977
"""cos(π/8) and cos(3π/8): the borders of the octants."""

HALF_PI = (1.5703125, 0.0004837512969970703125, 7.549789954891609e-08)
"""π/2 in three parts, the first two with few enough bits that small multiples are exact."""

SERIES = ((-1 / 6, 1 / 120, -1 / 5040, 1 / 362880), (1 / 24, -1 / 720, 1 / 40320, -1 / 3628800))
"""Coefficients of the sine from x³ on, and of the cosine from x⁴ on."""

ROUNDER = 12582912.0
"""1.5 · 2²³: a float32 of a smaller magnitude plus this number is rounded to an integer."""


def length(v: Array) -> Array:
    y, x = v[:, 0], v[:, 1]
    return np.sqrt(y * y + x * x)


def wave(x: Array, *, cosine: bool) -> Array:
    """The sine or cosine of angles in radians, within 2⁻²² for those up to 1000.

    x is the q-th multiple of π/2 plus a remainder, and the rounding error of the remainder, to which the series apply.
    """
    sine, cosine_of = ([np.float32(number) for number in row] for row in SERIES)
    rounder, whole = np.float32(ROUNDER), np.float32(1)
    q = (x * np.float32(2 / math.pi) + rounder) - rounder
    coarse, middle, fine = (q * np.float32(part) for part in HALF_PI)
    near = (x - coarse) - middle  # exact
    rest = near - fine
    small = (near - rest) - fine
    turn = q - np.float32(4) * ((q * np.float32(0.25) - np.float32(0.375) + rounder) - rounder)
    z = rest * rest
    rising = rest + (small + rest * (z * (sine[0] + z * (sine[1] + z * (sine[2] + z * sine[3])))))
    higher = z * z * (cosine_of[0] + z * (cosine_of[1] + z * (cosine_of[2] + z * cosine_of[3])))
    level = whole - (np.float32(0.5) * z + (rest * small - higher))
    odd = ((turn > np.float32(0.5)) & (turn < np.float32(1.5))) | (turn > np.float32(2.5))
    down = (turn > np.float32(0.5)) & (turn < np.float32(2.5)) if cosine else turn > np.float32(1.5)
    value = np.where(~odd if cosine else odd, level, rising)
    return np.where(down, -value, value)


def octant(v: Array) -> Array:
    """The octant of the angle acos(x / (|v| + 0.001)), by comparing x with the octants' borders."""
    y, x = v[:, 0], v[:, 1]
    reach = np.sqrt(y * y + x * x) + np.float32(0.001)
    near, far = np.float32(NEAR) * reach, np.float32(FAR) * reach
    lower = np.where(x > -far, 2, np.where(x > -near, 3, 4))
    half = np.where(x > near, 0, np.where(x > far, 1, lower))
    return np.where(y < 0, (8 - half) % 8, half)


# Substeps


def run_substep(substep: Substep, at: Context, table: Mapping[str, Slot]) -> State:
    """The state after one simultaneous sub-step. `at.lets` gains the substep's lets."""
    for let in substep.lets:
        at.lets[let.name] = evaluate(let.value, at)
    masks = masks_of(substep, at)
    if at.watch is not None:
        at.watch.begins(substep, at, masks)
    claims = [rule for rule in substep.rules if not isinstance(rule, Assign)]
    assigns = [rule for rule in substep.rules if isinstance(rule, Assign)]
    effects = [(rule, effect) for rule in claims for effect in rule.effects]
    values = {
        id(write): evaluate(write.value, at) for write in (*assigns, *(effect for _, effect in effects))
    }
    traveling = [slot for slot in table.values() if slot.travels]
    state = dict(at.state)

    def write(change: Change, value: Array, mask: Array) -> None:
        name = change.slot.name
        old, state[name] = state[name], _where(mask, value, state[name])
        if at.watch is not None:
            at.watch.wrote(change, old, state[name], mask)

    def assign(how: str, rule: Rule, assignment: Assign) -> None:
        """`field op value` at the cell `offset` away from each cell where the rule fires."""
        slot, place = table[assignment.field], back(assignment.offset)
        value = _apply_write(assignment, slot.kind, state[slot.name], look(values[id(assignment)], place))
        write(Change(how, slot, rule, place), value, look(masks[id(rule)], place))

    def become(how: str, rule: Rule, target: Expr) -> None:
        ids = evaluate(target, at)
        for slot in traveling:
            write(Change(how, slot, rule), _in_fresh_cells(slot, ids, at), masks[id(rule)])

    def arrive(rule: Swap | Move, source: Offset, origin: Offset = (0, 0)) -> None:
        """Contents come from the neighbor `source` where the rule's condition holds in the neighbor `origin`."""
        mask = look(masks[id(rule)], origin)
        for slot in traveling:
            write(Change("arrive", slot, rule, origin, source), look(before[slot.name], source), mask)

    for assignment in assigns:
        assign("assign", assignment, assignment)
    before = dict(state)
    for rule in claims:
        if isinstance(rule, Transform):
            become("become", rule, rule.target)
        elif isinstance(rule, Move) and rule.leaving is not None:
            become("leave", rule, rule.leaving)
        elif isinstance(rule, Move):
            arrive(rule, rule.offset)
    for rule in claims:
        if isinstance(rule, (Swap, Move)):
            arrive(rule, back(rule.offset), back(rule.offset))
        if isinstance(rule, Swap):
            arrive(rule, rule.offset)
    for claim, effect in effects:
        assign("effect", claim, effect)
    for slot in table.values():
        if slot.of is not None:
            holders = _members(slot.of)[state["element"]]
            write(Change("limit", slot), _default(slot, state[slot.name]), ~holders)
    return state


def masks_of(substep: Substep, at: Context) -> dict[int, Array]:
    """The cells in which each rule of a substep fires, bool [B, H, W] by `id`. `at.lets` has the substep's lets."""
    masks = {id(rule): evaluate(rule.mask, at) for rule in substep.rules}
    if substep.policy in ("drop_both", "first_wins"):
        claims = [rule for rule in substep.rules if not isinstance(rule, Assign)]
        _resolve_claims(substep.policy, claims, masks)
    return masks


def _default(slot: Slot, like: Array) -> Array:
    """A slot's default in every cell, in the shape and dtype of its array."""
    default = np.asarray(slot.default, like.dtype)
    return np.broadcast_to(default[:, None, None] if slot.planes == 2 else default, like.shape)


def _where(mask: Array, yes: Array, no: Array) -> Array:
    return np.where(mask[:, None] if no.ndim == 4 else mask, yes, no)


def _in_fresh_cells(slot: Slot, ids: Array, at: Context) -> Array:
    """The values of a slot that travels, in new cells of these elements."""
    if slot.name == "element":
        return ids
    like = at.state[slot.name]
    if (prop := at.ruleset.property(slot.name)) is not None:
        return _of_elements(prop, ids, at).astype(like.dtype)
    fresh = _default(slot, like)
    for identity, value in slot.own:
        own = np.asarray(value, fresh.dtype)
        fresh = _where(ids == identity, own[:, None, None] if slot.planes == 2 else own, fresh)
    return fresh


def _apply_write(assign: Assign, kind: Kind, old: Array, value: Array) -> Array:
    """`old op value`; integers are clamped."""
    new = value if assign.op == ":=" else old + value if assign.op == "+=" else old - value
    return np.clip(new, int(kind.lo), int(kind.hi)) if kind.name == "int" else new


def _resolve_claims(policy: str, claims: list[Any], masks: dict[int, Array]) -> None:
    """Apply a conflict policy: narrow the masks so that no two rules claim one cell."""
    wanted = {id(rule): masks[id(rule)] for rule in claims}

    def claimed(rule: Any, mask: Array) -> Array:
        """The cells that a rule with this mask takes part in."""
        return mask | look(mask, back(rule.offset)) if isinstance(rule, (Swap, Move)) else mask

    def touches(rule: Any, cells: Array) -> Array:
        """The cells in which a rule would touch one of these cells."""
        return cells | look(cells, rule.offset) if isinstance(rule, (Swap, Move)) else cells

    taken = np.zeros_like(next(iter(wanted.values()))) if wanted else None
    for rule in claims:
        mask = wanted[id(rule)]
        if isinstance(rule, Swap) or (isinstance(rule, Move) and rule.leaving is not None):
            # Pairs of one rule that share a cell have no order, so none fires. Those that trade places move in rows.
            mask = mask & ~(look(mask, rule.offset) | look(mask, back(rule.offset)))
        if policy == "drop_both":
            for other in claims:
                if other is not rule:
                    mask = mask & ~touches(rule, claimed(other, wanted[id(other)]))
        else:
            mask = mask & ~touches(rule, taken)  # type: ignore[arg-type]
            taken = taken | claimed(rule, mask)
        masks[id(rule)] = mask


# Steps


def clamp(state: State, table: Mapping[str, Slot]) -> State:
    """The state with float fields clamped to their range, and NaN and magnitudes below SNAP set to zero."""
    result = dict(state)
    for name, slot in table.items():
        if slot.is_real:
            value = np.where(np.isnan(state[name]), np.float32(0), state[name])
            value = np.clip(value, np.float32(slot.kind.lo), np.float32(slot.kind.hi))
            result[name] = np.where(np.abs(value) < np.float32(SNAP), np.float32(0), value)
    return result


def run_pass(pass_: Pass, at: Context, table: Mapping[str, Slot]) -> State:
    scratch = scratch_slots(pass_)
    at.state = {**at.state, **{name: _fresh(slot, at.shape) for name, slot in scratch.items()}}
    at.lets = {}
    everything = {**table, **scratch}
    for substep in pass_.substeps:
        at.state = run_substep(substep, at, everything)
    after = clamp({name: value for name, value in at.state.items() if name in table}, table)
    if at.watch is not None:
        for name, slot in table.items():
            at.watch.wrote(Change("clamp", slot), at.state[name], after[name])
    return after


def _fresh(slot: Slot, shape: tuple[int, int, int]) -> Array:
    batch, height, width = shape
    whole = (batch, 2, height, width) if slot.planes == 2 else shape
    return _default(slot, np.zeros(whole, WIDE[slot.kind.name])).copy()


def widen(ruleset: Ruleset, state: Mapping[str, Array]) -> State:
    """The slots of a state in the dtypes that steps compute in."""
    kinds = {slot.name: slot.kind.name for slot in slots(ruleset)}
    return {name: value.astype(WIDE[kinds[name]]) for name, value in state.items()}


def parameters(ruleset: Ruleset, batch: int, values: Mapping[str, Any]) -> dict[str, Array]:
    """All parameters as arrays [B]: the given numbers or arrays, and defaults of the others."""
    return {
        param.name: np.broadcast_to(
            np.asarray(values.get(param.name, float(param.default)), np.float64), (batch,)
        ).astype(WIDE[param.kind.name])
        for param in ruleset.params
    }


def step(
    ruleset: Ruleset,
    state: State,
    clock: Clock,
    params: Mapping[str, Array],
    *,
    passes: frozenset[str] | None = None,
    draws: Mapping[str, Array] | None = None,
    tick: Callable[[str], None] | None = None,
    watch: Watch | None = None,
) -> State:
    """One step of every world.

    Args:
        state: arrays by slot name in their storage dtypes (`model.state`); not changed.
        clock: the inputs of the random numbers.
        params: [B] arrays by qualified name.
        passes: names of the passes to run; all of them by default.
        draws: float64 [B, H, W] in [0, 1) by stream name, to use instead of random numbers.
        tick: called with the name of each finished pass.
        watch: receives each substep and each write.
    """
    table = {slot.name: slot for slot in slots(ruleset)}
    working = widen(ruleset, state)
    shape = state["element"].shape
    for name, slot in table.items():
        if slot.resets:
            old, working[name] = working[name], _fresh(slot, shape)
            if watch is not None:
                watch.wrote(Change("reset", slot), old, working[name])
    at = Context(ruleset, working, params, dict(draws or {}), clock, watch=watch)
    for pass_ in ruleset.passes:
        if passes is None or pass_.name in passes:
            at.state = run_pass(pass_, at, table)
            if tick is not None:
                tick(pass_.name)
    return {name: value.astype(table[name].dtype) for name, value in at.state.items()}
