"""Start worlds that are random in all their state."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import prod
from random import Random
from typing import TYPE_CHECKING, Any, TypeVar

from powderdsl.arrays import np
from powderdsl.model.state import SNAP, Slot, fitting, fresh_values, holders, slots, stored_range
from powderdsl.model.types import Kind, Ruleset

if TYPE_CHECKING:
    from powderdsl.simulation.simulator import Simulator, World

T = TypeVar("T")


class Choices:
    """Decisions, all made of one: `below(n)`, an integer of 0..n-1. Plain options stand first, at 0."""

    def __init__(self, below: Callable[[int], int]):
        self.below = below

    @classmethod
    def seeded(cls, seed: int) -> Choices:
        """The same decisions for the same seed, on every machine."""
        return cls(Random(seed).randrange)

    def pick(self, options: Sequence[T]) -> T:
        return options[self.below(len(options))]

    def integer(self, lo: int, hi: int) -> int:
        return lo + self.below(hi - lo + 1)

    def maybe(self, percent: int) -> bool:
        """True in `percent` cases of a hundred; False is the plain option."""
        return self.below(100) >= 100 - percent

    def some(self, options: Sequence[T], least: int, most: int) -> list[T]:
        """From `least` to `most` different options, in their order."""
        most = min(most, len(options))
        wanted = self.integer(min(least, most), most)
        picked: list[T] = []
        for i, option in enumerate(options):
            left = len(options) - i
            if self.below(left) < wanted - len(picked):
                picked.append(option)
        return picked


Array = np.ndarray[Any, Any]

SIDES = (1, 2, 3, 4, 5, 7, 9, 16, 31, 32, 33, 63, 64, 65, 97)
"""Lengths of sides: tiny ones, where neighbors coincide, and the borders of words of 32 and 64 columns."""

CLOCKS = (0, 0, 0, 1, 6, 1 << 20, (1 << 32) - 1, 1 << 40)
"""Steps at which worlds start: the clock runs on beyond 32 bits."""

FEW_CELLS = 12
"""Worlds of at most this many cells are chosen cell by cell, so that Hypothesis can shrink them; others are filled by a seed."""


@dataclass(frozen=True)
class Start:
    """A batch of start worlds of one shape, independent of backends. Slots missing in `fields` are fresh.

    `ids` is uint8 [B, H, W]. `seed`, `index` and `step`, int64 [B], are what random numbers depend on, as those of a
    `World`. `fields` are arrays by slot name, [B, H, W] or [B, 2, H, W]; `params` are float64 [B] by name, for all of
    a ruleset's parameters or none.
    """

    ids: Array
    seed: Array
    index: Array
    step: Array
    fields: Mapping[str, Array] = field(default_factory=dict)
    params: Mapping[str, Array] = field(default_factory=dict)

    @classmethod
    def fresh(
        cls,
        ids: Any,
        seed: int = 0,
        step: int = 0,
        fields: Mapping[str, Array] | None = None,
        params: Mapping[str, Array] | None = None,
    ) -> Start:
        """Worlds [B, H, W], or one world [H, W], that share a seed: each has its own index."""
        grid = np.asarray(ids, np.uint8)
        grid = grid[None] if grid.ndim == 2 else grid
        batch = len(grid)
        seeds, steps = np.full(batch, seed, np.int64), np.full(batch, step, np.int64)
        return cls(grid, seeds, np.arange(batch, dtype=np.int64), steps, fields or {}, params or {})

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns)."""
        return self.ids.shape[1], self.ids.shape[2]

    def select(self, worlds: Any) -> Start:
        """Some worlds of the batch, by anything that indexes an array."""
        return Start(
            self.ids[worlds],
            self.seed[worlds],
            self.index[worlds],
            self.step[worlds],
            {name: values[worlds] for name, values in self.fields.items()},
            {name: values[worlds] for name, values in self.params.items()},
        )

    def one(self, world: int) -> Start:
        return self.select(slice(world, world + 1))

    def repeated(self, count: int) -> Start:
        """One world, many times over."""
        return self.select(np.zeros(count, np.int64))

    def seeded(self) -> Start:
        """The same worlds with a seed of their own each, counting up, instead of an index."""
        return replace(self, seed=self.seed + self.index, index=np.zeros_like(self.index))

    def without(self, gone: frozenset[int], ruleset: Ruleset) -> Start:
        """The same worlds with the first other element where one of these is, in cells and in fields."""
        if not gone:
            return self
        other = min(element.id for element in ruleset.elements if element.id not in gone)
        names = {slot.name for slot in slots(ruleset) if slot.kind.name == "element"}

        def kept(values: Array) -> Array:
            return np.where(np.isin(values, sorted(gone)), values.dtype.type(other), values)

        fields = {name: kept(values) if name in names else values for name, values in self.fields.items()}
        return replace(self, ids=kept(self.ids), fields=fields)

    def world(self, simulator: Simulator, ruleset: Ruleset | None = None) -> World:
        """The same worlds for any simulator of the ruleset. `ruleset`: the rules whose slots to set, if the simulator has more."""
        world, put = simulator.world(self.ids, self.seed, index=self.index), simulator.kind.from_numpy
        dtypes = {slot.name: slot.dtype for slot in simulator.slots}
        values = full_state(ruleset or simulator.ruleset, self).items()
        arrays = {name: put(cells.astype(dtypes[name])) for name, cells in values}
        return replace(world, state={**world.state, **arrays}, start=put(self.step.copy()))


def fresh(ruleset: Ruleset, slot: Slot, ids: Array) -> Array:
    """A slot's values in fresh cells of these elements."""
    values = np.array(fresh_values(ruleset, slot), slot.dtype)[ids]
    return np.moveaxis(values, -1, 1) if slot.planes == 2 else values


def holding(ruleset: Ruleset, slot: Slot, ids: Array) -> Array:
    """bool, as `ids`: the cells whose element may have its own value in a slot."""
    some = holders(ruleset, slot)
    return np.ones(ids.shape, bool) if some is None else np.isin(ids, sorted(some))


def clamped_to_holders(ruleset: Ruleset, slot: Slot, values: Array, ids: Array) -> Array:
    """A slot's values, with those of fresh cells where the element cannot have another."""
    may = holding(ruleset, slot, ids)
    if may.all():
        return values
    kept = np.where(may[:, None] if slot.planes == 2 else may, values, fresh(ruleset, slot, ids))
    return kept.astype(slot.dtype)


def full_state(ruleset: Ruleset, sample: Start) -> dict[str, Array]:
    """All slots of the start worlds in their storage dtypes. Cells that cannot hold a value have their usual one."""
    state = {"element": sample.ids}
    for slot in slots(ruleset)[1:]:
        values = sample.fields.get(slot.name)
        values = fresh(ruleset, slot, sample.ids) if values is None else values
        state[slot.name] = clamped_to_holders(ruleset, slot, values, sample.ids)
    return state


def random_start(
    ruleset: Ruleset,
    choices: Choices,
    shape: Sequence[int] | None = None,
    max_batch: int = 3,
    max_side: int = 65,
) -> Start:
    """Random worlds: any shape up to the bounds, any ids, and any values that the ruleset's fields can hold."""
    if shape is None:
        batch, lengths = choices.integer(1, max_batch), [side for side in SIDES if side <= max_side]
        height, width = choices.pick(lengths[:6]), choices.pick(lengths)
        shape = (batch, width, height) if choices.maybe(20) else (batch, height, width)
    palette = [e.id for e in ruleset.elements]
    palette = choices.some(palette, 1, len(palette)) if choices.maybe(40) else palette
    shape = (shape[0], *(fitting(ruleset, side) for side in shape[1:]))
    fill = _Fill(choices, tuple(shape))
    ids = fill.choose(palette).astype(np.uint8)
    fields: dict[str, np.ndarray] = {}
    for slot in slots(ruleset)[1:]:
        if not choices.maybe(15):  # else it stays fresh
            fields[slot.name] = _values(ruleset, slot, ids, fill)
    params = {}
    if choices.maybe(25):
        params = {
            p.name: np.array([_param(p.kind, choices) for _ in range(shape[0])], float)
            for p in ruleset.params
        }
    return Start.fresh(ids, choices.below(1 << 31), choices.pick(CLOCKS), fields, params)


class _Fill:
    """Fills arrays of one shape with random values, cell by cell or from one seed."""

    def __init__(self, choices: Choices, shape: tuple[int, ...]):
        self.choices = choices
        self.shape = shape
        self.random = None if prod(shape) <= FEW_CELLS else Random(choices.below(1 << 31))

    def choose(self, options: Sequence[Any], planes: int = 1) -> np.ndarray:
        """An array of the shape (with an axis of components, if there are two) whose cells are options."""
        shape = self.shape if planes == 1 else (self.shape[0], planes, *self.shape[1:])
        if self.random is not None:
            return np.array(self.random.choices(options, k=prod(shape))).reshape(shape)
        return np.array([self.choices.pick(options) for _ in range(prod(shape))]).reshape(shape)


def _values(ruleset: Ruleset, slot: Slot, ids: np.ndarray, fill: _Fill) -> np.ndarray:
    """Values for a slot: extremes are frequent; where the element cannot hold one, its usual value."""
    kind, choices = slot.kind, fill.choices
    if slot.is_real:
        values = fill.choose(_reals(kind.lo, kind.hi, choices), slot.planes).astype(np.float32)
    else:
        lo, hi = map(int, stored_range(kind))
        options = [e.id for e in ruleset.elements] if kind.name == "element" else _integers(lo, hi, choices)
        values = fill.choose(options).astype(slot.dtype)
    return clamped_to_holders(ruleset, slot, values, ids)


def _integers(lo: int, hi: int, choices: Choices) -> list[int]:
    near = {min(max(v, lo), hi) for v in (0, 1, -1, 2, lo, hi, lo + 1, hi - 1)}
    return sorted(sorted({*near, *(choices.integer(lo, hi) for _ in range(3))}), key=abs)


def _reals(lo: float, hi: float, choices: Choices) -> list[float]:
    """Zeros, bounds, SNAP and its neighbors, numbers that do not add up exactly."""
    wanted = [0.0, 1.0, -1.0, 0.1, -0.1, lo, hi, SNAP, -SNAP, 1.5 * SNAP, 0.3, 1 / 3, hi * 0.7, lo * 0.7]
    wanted += [lo + (hi - lo) * choices.below(1000) / 999 for _ in range(4)]
    return [value for value in wanted if lo <= value <= hi]


def _param(kind: Kind, choices: Choices) -> float:
    match kind.name:
        case "flag":
            return choices.below(2)
        case "int":
            return choices.pick([int(kind.lo), int(kind.hi), choices.integer(int(kind.lo), int(kind.hi))])
        case "chance":
            return choices.pick([0.5, 0.0, 1.0, 2.0**-16, 0.3])
    return choices.pick(
        [float(kind.lo), float(kind.hi), 0.1, kind.lo + (kind.hi - kind.lo) * choices.below(1000) / 999]
    )
