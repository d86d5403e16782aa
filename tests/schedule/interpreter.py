"""A small, slow interpreter of schedules, and of the pass graphs that they mean: arrays [H, W] of bool and float32.

Variables of a body that is skipped, and released ones, are gone: reading one is an error. Where a draw is not asked
for, it is the opposite of what it would be.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from powderdsl.ir.ops import FLAG, OPS, REAL, Node, PassGraph, Threshold, ordered
from powderdsl.schedule.types import (
    ANSWER,
    Compute,
    Forget,
    Guard,
    Move,
    Out,
    Release,
    Schedule,
    Statement,
    Sweeps,
    Var,
    flat,
    made_in,
)

SNAP = np.float32(2.0**-20)
Array = np.ndarray[Any, Any]


@dataclass
class World:
    """What a pass finds: slots, parameters (as thresholds where a chance is asked for), draws by stream, the step."""

    shape: tuple[int, int]
    slots: Mapping[str, Array]
    params: Mapping[str, float]
    draws: Mapping[str, Array]
    step: int = 0
    known: bool = True
    """Whether the elements are still those that the pass has found."""


def run_graph(pass_: PassGraph, world: World) -> dict[int, Array]:
    """The value of every node of a pass, by id."""
    roots = [node for _, node in pass_.outputs]
    roots += [node for step in pass_.substeps for _, node in step.writes]
    roots += [guard for step in pass_.substeps for guard in step.guards]
    return evaluate(roots, world, {})


def run_schedule(schedule: Schedule, world: World, truth: Mapping[int, Array]) -> dict[str, Array]:
    """What a schedule leaves in the slots. Every variable is compared with what it means, in `truth`."""
    state = _State(world, truth, {var.name: world.slots[slot] for slot, var in schedule.inputs})
    state.buffers = dict(schedule.buffers)
    state.block(schedule.body)
    return {slot: np.array(evaluate([node], world, state.held)[id(node)]) for slot, node in schedule.outputs}


@dataclass
class _State:
    world: World
    truth: Mapping[int, Array]
    held: dict[str, Array]
    buffers: Mapping[str, tuple[str, int]] = field(default_factory=dict)

    def block(self, body: Sequence[Statement]) -> None:
        for statement in body:
            match statement:
                case Compute(outs=outs):
                    found = self.values([out.value for out in outs])
                    found = [
                        self.inside(statement, out, value) for out, value in zip(outs, found, strict=True)
                    ]
                    for out, value in zip(outs, found, strict=True):
                        if out.into is not None:
                            del self.held[out.into]
                        self.set(out.var, value)
                case Move(op=op, offset=(dy, dx), region=movers, outs=outs):
                    (m,) = self.values([movers])
                    targets = _shift(m, -dy, -dx, True)
                    olds = self.values([*statement.olds.values()])
                    for out, old, leaves in zip(outs, olds, self.values(statement.results), strict=True):
                        moved = np.where(targets, _shift(old, -dy, -dx, True), leaves)
                        if op == "swap":
                            moved = np.where(m, _shift(old, dy, dx, True), moved)
                        if out.into is not None:
                            del self.held[out.into]
                        self.set(out.var, moved)
                case Guard(when=when, body=inner, otherwise=otherwise):
                    before = dict(self.held)
                    if np.any(self.values([when])):
                        self.block(inner)
                        kept = {name: self.held[name] for name in statement.vars}
                    else:
                        kept = dict(zip(statement.olds, self.values([*statement.olds.values()]), strict=True))
                        self.block(otherwise)
                        for name in made_in(otherwise):
                            assert np.array_equal(self.held[name], kept[name]), name
                    # What the body released or overwrote is gone in either case.
                    gone = set(before) - set(self.held)
                    gone |= {name for inside in flat(inner) for name in inside.ended}
                    if self.buffers:  # skipped or not, what shares a buffer with what the body makes is gone
                        made = {self.buffers[name] for name in made_in(inner) if name in self.buffers}
                        gone |= {name for name in before if self.buffers.get(name) in made}
                    self.held = {name: value for name, value in before.items() if name not in gone}
                    for name, var in statement.vars.items():
                        self.set(var, kept[name])
                case Sweeps(body=loops, frees=passing):
                    self.block(loops)
                    for name in passing:
                        del self.held[name]
                case Forget():
                    self.world = replace(self.world, known=False)
                case Release(frees=names):
                    for name in names:
                        del self.held[name]

    def values(self, nodes: Sequence[Node]) -> list[Array]:
        found = evaluate(nodes, self.world, self.held)
        return [found[id(node)] for node in nodes]

    def inside(self, statement: Compute, out: Out, value: Array) -> Array:
        """What a variable gets: outside the region something else, which must be the same."""
        if statement.when is not None and not bool(self.values([statement.when])[0]):
            (value,) = (
                self.values([out.otherwise])
                if out.otherwise is not None
                else (np.zeros(self.world.shape, bool),)
            )
            return value
        if statement.region is None or out.otherwise is None:
            return value
        region, rest = self.values([statement.region, out.otherwise])
        return np.where(region, value, rest)

    def set(self, var: Var, value: Array) -> None:
        if var.means is not None and id(var.means) in self.truth:
            expected = np.broadcast_to(self.truth[id(var.means)], self.world.shape)
            found = np.broadcast_to(value, self.world.shape)
            # Zeros of either sign: clamping makes them one, and no operation tells them apart.
            assert np.array_equal(found, expected, equal_nan=var.type == REAL), var.name
        assert var.name not in self.held, f"{var.name} is assigned twice"
        self.held[var.name] = value
        if var.name in self.buffers:  # what stood in the buffer is gone
            others = [n for n in self.held if n != var.name and self.buffers.get(n) == self.buffers[var.name]]
            for name in others:
                del self.held[name]


def _shift(x: Array, dy: int, dx: int, wraps: bool) -> Array:
    if wraps:
        return np.roll(x, (-dy, -dx), (-2, -1))
    height, width = x.shape
    result = np.zeros_like(x)
    for y in range(height):
        for c in range(width):
            if 0 <= y + dy < height and 0 <= c + dx < width:
                result[y, c] = x[y + dy, c + dx]
    return result


def evaluate(roots: Sequence[Node], world: World, held: Mapping[str, Array]) -> dict[int, Array]:
    """The value of every node that some nodes are made of, by id; `held` has the variables."""
    done: dict[int, Array] = {}
    with np.errstate(all="ignore"):
        for node in ordered(roots):
            args = [done[id(arg)] for arg in node.args]
            value = held[node.attr] if node.op == "load" else _node(node, args, world)
            if node.type in (FLAG, REAL):
                value = np.broadcast_to(value, world.shape).astype(bool if node.type == FLAG else np.float32)
            done[id(node)] = value
    return done


def _node(node: Node, args: list[Array], world: World) -> Any:
    attr = node.attr
    match node.op:
        case "input":
            return world.slots[attr]
        case "const":
            return np.array(attr)
        case "param":
            name, view, *bit = attr
            if not bit:
                return np.float32(world.params[name]) if node.type == REAL else bool(world.params[name])
            return int(_limit(world.params[name], view)) >> bit[0] & 1 != 0
        case "coordinate":
            axis, modulus, bit = attr
            height, width = world.shape
            index = {
                "row": np.arange(height)[:, None],
                "column": np.arange(width)[None],
                "step": np.array(world.step),
            }
            return index[axis] % modulus >> bit & 1 != 0
        case "inside":
            return _shift(np.ones(world.shape, bool), *attr, False)
        case "chance":
            stream, _, limit = attr
            return _wanted(world.draws[stream] < limit, args)
        case "below_planes":
            stream, bits = attr
            limit = sum(plane.astype(np.int64) << (bits - i) for i, plane in enumerate(args[: bits + 1]))
            return _wanted(world.draws[stream] < limit, args[bits + 1 :])
        case "below_param":
            stream, _, name, view = attr
            return _wanted(world.draws[stream] < _limit(world.params[name], view), args)
        case "draw":
            stream, bits = attr
            return ((world.draws[stream] + 0.5) / 2.0**bits).astype(np.float32)
        case "shift":
            return _shift(args[0], *attr)
        case "not":
            return ~args[0]
        case "select":
            return np.where(*args)
        case "clamp":
            cut = np.clip(np.where(np.isnan(args[0]), 0, args[0]), *map(np.float32, attr))
            return np.where(np.abs(cut) < SNAP, 0, cut)
        case "swap" | "arrive" if node.type == FLAG:
            content, movers, rest = args
            dy, dx = attr
            moved = np.where(_shift(movers, -dy, -dx, True), _shift(content, -dy, -dx, True), rest)
            return np.where(movers, _shift(content, dy, dx, True), moved) if node.op == "swap" else moved
        case "div":
            return np.where(args[1] == 0, np.float32(0), args[0] / args[1])
        case "live":
            dy, reach = attr
            near = [_shift(args[0] != 0, dy, dx, True) for dx in range(-reach, reach + 1)]
            return np.logical_or.reduce(near)
        case "present":
            if not world.known:
                return True
            ids = sum(array.astype(np.int64) << i for i, array in _elements(world))
            return any(attr >> int(number) & 1 for number in np.unique(ids))
        case "and" | "or" if node.type == ANSWER:
            return (args[0] and args[1]) if node.op == "and" else (args[0] or args[1])
        case "any" | "some":
            return bool(np.any(args))
    if node.op in _SIMPLE:
        return _SIMPLE[node.op](*args)
    return np.vectorize(partial(OPS[node.op].value, attr))(*args)


def _elements(world: World) -> list[tuple[int, Array]]:
    slots = ((name.partition(":"), array) for name, array in world.slots.items())
    return [(int(bit), array) for (name, _, bit), array in slots if name == "element"]


def _limit(value: float, threshold: Threshold | None) -> int:
    if threshold is None:
        return int(value)
    count = 1 << threshold.bits
    scaled = np.float64(value) * count - 0.5
    limit = np.ceil(scaled) if threshold.strict else np.floor(scaled) + 1
    return int(limit.clip(0, count))


def _wanted(holds: Array, where: list[Array]) -> Array:
    """A draw, wrong where it is not asked for."""
    return np.where(where[0], holds, ~holds) if where else holds


_SIMPLE: dict[str, Callable[..., Any]] = {
    "and": np.logical_and, "when": np.logical_and, "led": np.logical_and, "or": np.logical_or, "xor": np.logical_xor, "eq": np.equal, "lt": np.less,
    "le": np.less_equal, "neg": np.negative, "abs": np.abs, "sqrt": np.sqrt, "min": np.minimum, "max": np.maximum,
    "add": np.add, "sub": np.subtract, "mul": np.multiply,
}  # fmt: skip
