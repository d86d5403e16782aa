"""Generators from seeds to worlds, without a loop over worlds, on tensors or on arrays without torch.

Every number that a world draws is a hash of its seed, the statement, the repetition and the number's index in the
statement. So a world is the same in any batch and on any device.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, reduce
from math import prod
from operator import or_
from typing import Any

from powderdsl.model.state import Slot
from powderdsl.model.types import Expr
from powderdsl.system.random import MASK, base_keys, mix, name_number
from powderdsl.targets.array_kind import Array, ArrayKind
from powderdsl.tasks.task import NOTHING, Drawing, Generator, Group, Region, Task
from powderdsl.worlds.raster import Shape, Size, covered_rows, mask
from powderdsl.worlds.scene.statements import constants


def shape_rows(
    kind: ArrayKind, shape: str, numbers: Sequence[Array | None], size: Size
) -> tuple[Array, Array]:
    """The first row that shapes, not frames, cover in each column, and how many: [..., W], of the type of `_row_type`.

    `numbers` are int64 [...], in the order of `scene.statements.NUMBERS`; None is an open end.
    """
    columns = [None if number is None else number[..., None] for number in numbers]
    edges = covered_rows(kind.xp, shape, columns, kind.arange(size[1]), size)
    first, last = (
        kind.xp.asarray(kind.xp.clip(edge, 0, size[0]), dtype=_row_type(kind, size)) for edge in edges
    )
    return first, kind.xp.maximum(first, last) - first


def _row_type(kind: ArrayKind, size: Size) -> Any:
    return kind.xp.uint8 if size[0] < 256 else kind.xp.int64


@cache
def _row_numbers(kind: ArrayKind, size: Size) -> Array:
    """The row of each cell: [H, W] in C order, as bytes if they fit, since many bytes are compared at a time."""
    row = kind.xp.asarray(kind.arange(size[0]), dtype=_row_type(kind, size))
    return kind.copied(kind.xp.broadcast_to(row[:, None], size))


def cells_between(kind: ArrayKind, first: Array, count: Array, size: Size) -> Array:
    """The cells of rows returned by `shape_rows`: bool [..., H, W]."""
    row = _row_numbers(kind, size) - first[..., None, :]
    return (row if size[0] < 256 else row & MASK) < count[..., None, :]  # rows above have large numbers


CHUNK_CELLS = 1 << 18
"""Number of cells of worlds to make together on the CPU, which fit its cache."""

CHANCE_BITS = 16
"""Bits of draws of scattered cells: chances are multiples of 2⁻¹⁶."""

_NUMBERS, _STATEMENT, _COUNTER, _INDEX = 128, 0x9E3779B1, 0x85EBCA6B, 0x7A51
"""Draws of one statement and repetition; odd factors that spread counters; the worlds' index of `base_keys`, which
keeps draws of generators apart from those of rules."""


_WITHOUT_ROWS = ("scatter", "stamp")
"""Statements whose cells are computed only when they are painted."""


@dataclass(frozen=True)
class Made:
    """Generated worlds: ids uint8 [B, H, W]; regions bool [B, H, W] or [1, H, W]; targets uint8 [B, H, W].

    `fields` has the values set, [B, H, W] or [B, 2, H, W], and their cells, bool [B, H, W].
    """

    ids: Array
    regions: Mapping[str, Array]
    targets: Mapping[str, Array]
    fields: Mapping[str, tuple[Array, Array]]


def join_worlds(kind: ArrayKind, parts: Sequence[Made], fixed: Mapping[str, Array]) -> Made:
    """The worlds of all parts in a row. Regions of `fixed` are the same in all worlds."""
    xp, regions = kind.xp, dict(fixed)
    for name in (name for name in parts[0].regions if name not in fixed):
        cells = [xp.broadcast_to(part.regions[name], part.ids.shape) for part in parts]
        regions[name] = xp.concatenate(cells)
    targets = {name: xp.concatenate([part.targets[name] for part in parts]) for name in parts[0].targets}
    fields = {}
    for name in parts[0].fields:
        values, where = zip(*(part.fields[name] for part in parts), strict=True)
        fields[name] = xp.concatenate(values), xp.concatenate(where)
    return Made(xp.concatenate([part.ids for part in parts]), regions, targets, fields)


class Hashes:
    """The random numbers of a batch of seeds, int64 [B]."""

    def __init__(self, seeds: Array, kind: ArrayKind):
        self.keys = base_keys(seeds, kind.xp.full_like(seeds, _INDEX), kind.xp)
        self.kind = kind

    def draw(self, statement: int, counters: Array) -> Array:
        """32-bit numbers of one statement: int64 [B, n] for counters int64 [n]."""
        key = self.kind.put([statement * _STATEMENT & MASK], "int64")
        keys = mix((self.keys[0][:, None] + key) & MASK)
        return mix((mix((keys + (counters * _COUNTER & MASK)) & MASK) + self.keys[1][:, None]) & MASK)


_CALCULATE: dict[str, Callable[..., Any]] = {
    "add": operator.add,
    "sub": operator.sub,
    "mul": operator.mul,
    "quotient": operator.floordiv,
    "neg": operator.neg,
}
"""Operations on integers, or on arrays of them."""


class _Draws:
    """The amounts of one statement, after one of some `choices`; each draw takes the next counter.

    `arrays` are int64 that broadcast to [B, R] for R repetitions, None for None; so is `choice`, None if there is but one.
    """

    def __init__(
        self,
        hashes: Hashes,
        statement: int,
        repeats: int,
        names: Mapping[str, Array],
        amounts: Sequence[Expr | None],
        choices: int = 1,
    ):
        self.names, kind = names, hashes.kind
        parts = [part for amount in amounts if amount is not None for part in amount.walk()]
        count = sum(part.op == "uniform" for part in parts) + (choices > 1)
        self.drawn: Iterator[Array] = iter(())
        if count:
            counters = kind.arange(repeats)[:, None] * _NUMBERS + kind.arange(count)
            drawn = hashes.draw(statement, counters.reshape(-1)).reshape(-1, *counters.shape)
            self.drawn = iter(kind.xp.moveaxis(drawn, -1, 0))
        self.choice = self.uniform(0, choices - 1) if choices > 1 else None
        values = [None if amount is None else self.value(amount) for amount in amounts]
        self.arrays = [kind.put(value, "int64") if isinstance(value, int) else value for value in values]

    def uniform(self, low: Array | int, high: Array | int) -> Array:
        """Integers from `low` to `high`, inclusive; `low` if there are none."""
        return low + ((next(self.drawn) * (high - low + 1)) >> 32)

    def value(self, amount: Expr) -> Array | int:
        match amount.op, [self.value(arg) for arg in amount.args]:
            case "const", _:
                return int(amount.value)
            case "let", _:
                return self.names[amount.value]
            case "uniform", [low, high]:
                return self.uniform(low, high)
            case "mod", [value]:
                return value % amount.value
            case op, values:
                return _CALCULATE[op](*values)


class WorldMaker:
    """An executable generator for one size and kind of arrays. `slots` are the fields that worlds set."""

    def __init__(self, generator: Generator, size: Size, kind: ArrayKind, slots: Sequence[Slot] = ()):
        self.generator, self.size, self.kind, self.slots = generator, size, kind, slots
        self.stamps = {stamp.name: _bordered(stamp.rows, kind) for stamp in generator.stamps}
        self._fixed: dict[Drawing, Array] = {}
        """Cells of shapes that are the same in every world."""
        nowhere = kind.zeros("bool", size)
        self.fixed_cells = {
            region.name: reduce(or_, map(self.fixed, region.shapes), nowhere)[None]
            for region in generator.regions
            if not region.drawn
        }

    def make(self, seeds: Array) -> Made:
        """The worlds of some seeds, int64 [B]."""
        chunk = max(1, len(seeds))
        if self.kind.on_cpu:
            chunk = max(1, CHUNK_CELLS // (self.size[0] * self.size[1]))
        chunks = [self._chunk(seeds[i : i + chunk]) for i in range(0, max(1, len(seeds)), chunk)]
        return chunks[0] if len(chunks) == 1 else join_worlds(self.kind, chunks, self.fixed_cells)

    def _chunk(self, seeds: Array) -> Made:
        hashes = Hashes(seeds, self.kind)
        names = self._lets(self.generator.lets, hashes, 1, {})
        regions = dict(self.fixed_cells)
        for region in self.generator.regions:
            if region.drawn:
                regions[region.name] = self._region(region, hashes, names)
        batch, fields = len(seeds), dict[str, tuple[Array, Array]]()
        for slot in self.slots:
            shape = (batch, *self.size) if slot.planes == 1 else (batch, slot.planes, *self.size)
            where = self.kind.zeros("bool", (batch, *self.size))
            fields[slot.name] = self.kind.zeros(slot.dtype, shape), where
        ids = self._painted(self.generator.fill, self.generator.groups, hashes, names, regions, fields)
        targets = {
            target.name: self._painted(NOTHING, target.groups, hashes, names, regions, {})
            for target in self.generator.targets
        }
        return Made(ids, regions, targets, fields)

    def _lets(
        self, lets: tuple[tuple[str, Expr], ...], hashes: Hashes, repeats: int, names: Mapping[str, Array]
    ) -> dict[str, Array]:
        """`names` and more of them: int64 that broadcasts to [B, R]."""
        known = dict(names)
        for name, amount in lets:
            (known[name],) = _Draws(hashes, name_number(name), repeats, known, (amount,)).arrays
        return known

    def _region(self, region: Region, hashes: Hashes, names: Mapping[str, Array]) -> Array:
        """The cells of a region: bool [B, H, W]."""
        batch = len(hashes.keys[0])
        region_cells = self.kind.zeros("bool", (batch, *self.size))
        for number, shape in enumerate(region.shapes):
            # A region's own draws depend on its name and the shape's place.
            draws = _Draws(hashes, name_number(f"{region.name} {number}"), 1, names, shape.amounts)
            if constants(shape.amounts) is not None:
                region_cells = region_cells | self.fixed(shape)
            else:
                rows = shape_rows(self.kind, shape.kind, draws.arrays, self.size)
                cells = cells_between(self.kind, *rows, self.size)
                region_cells = region_cells | cells.reshape(-1, *self.size)
        return region_cells

    def fixed(self, drawing: Drawing) -> Array:
        """The cells of a shape of plain numbers: bool [H, W]."""
        if drawing not in self._fixed:
            shape = Shape(drawing.kind, constants(drawing.amounts) or ())
            self._fixed[drawing] = self.kind.from_numpy(mask(shape, self.size))
        return self._fixed[drawing]

    def _painted(
        self,
        fill: int,
        groups: tuple[Group, ...],
        hashes: Hashes,
        names: Mapping[str, Array],
        regions: Mapping[str, Array],
        fields: dict[str, tuple[Array, Array]],
    ) -> Array:
        """All groups painted on one element: uint8 [B, H, W]. `fields`, as in `Made`, are changed."""
        xp, batch = self.kind.xp, len(hashes.keys[0])
        ids = self.kind.zeros("uint8", (batch, *self.size)) + self.kind.put(fill, "uint8")
        for group in groups:
            (count,) = _Draws(hashes, group.number, 1, names, (group.count,)).arrays
            assert count is not None
            repeats = group.most
            if self.kind.on_cpu and repeats > 1:
                # Skip repetitions that no world of the batch has.
                repeats = int(count.max()) if prod(count.shape) else 0
            if repeats == 0:
                continue
            active = xp.broadcast_to(self.kind.arange(repeats) < count, (batch, repeats))
            local = self._lets(group.lets, hashes, repeats, names)
            painters = [_Painter(self, drawing, hashes, local, active) for drawing in group.drawings]
            for repeat in range(repeats):
                for painter in painters:
                    ids = painter.painted(ids, repeat, regions, fields)
        return ids


class _Painter:
    """One statement in all its repetitions, whose inputs are computed at once."""

    def __init__(
        self, maker: WorldMaker, drawing: Drawing, hashes: Hashes, names: Mapping[str, Array], active: Array
    ):
        """`active`: bool [B, R], the repetitions of each world."""
        self.maker, self.drawing, self.hashes = maker, drawing, hashes
        kind, xp, shape = maker.kind, maker.kind.xp, tuple(active.shape)
        self.active = xp.asarray(active, dtype=xp.uint8)
        draws = _Draws(hashes, drawing.number, shape[1], names, drawing.amounts, len(drawing.ids))
        self.numbers = [None if array is None else xp.broadcast_to(array, shape) for array in draws.arrays]
        ids = kind.put(list(drawing.ids) or [0], "uint8")
        self.ids = xp.broadcast_to(ids if draws.choice is None else ids[draws.choice], shape)
        self.is_fixed = constants(drawing.amounts) is not None
        if drawing.kind not in _WITHOUT_ROWS and not self.is_fixed:
            rows = shape_rows(kind, drawing.kind, self.numbers, maker.size)
            first, count = (xp.broadcast_to(edge, (*shape, maker.size[1])) for edge in rows)
            self.rows = first, count * self.active[..., None]  # no rows without the repetition

    def painted(
        self, ids: Array, repeat: int, regions: Mapping[str, Array], fields: dict[str, tuple[Array, Array]]
    ) -> Array:
        """Worlds with one repetition on top: uint8 [B, H, W]."""
        drawing, maker = self.drawing, self.maker
        painted = self.ids[:, repeat, None, None]
        if drawing.kind == "stamp":
            painted = self._stamp(repeat)
            cells = painted != NOTHING
        elif drawing.kind == "scatter":
            cells = self._scattered(repeat)
        elif self.is_fixed:
            cells = maker.fixed(drawing)
        else:
            first, count = self.rows
            cells = cells_between(maker.kind, first[:, repeat], count[:, repeat], maker.size)
        if drawing.where is not None:
            cells = cells & regions[drawing.where]
        if drawing.over is not None:
            cells = cells & reduce(or_, [ids == number for number in sorted(drawing.over)])
        if fields:
            self._set_fields(ids, cells & (self.active[:, repeat, None, None] != 0), fields)
        if drawing.value is not None:
            return ids
        # Bit operations on bytes, many at a time; `where` takes 15 times as long.
        changed = (ids ^ painted) * cells
        if drawing.kind in _WITHOUT_ROWS or self.is_fixed:
            changed = changed * self.active[:, repeat, None, None]
        return ids ^ changed

    def _set_fields(self, ids: Array, cells: Array, fields: dict[str, tuple[Array, Array]]) -> None:
        """Set the value of a field in cells, bool [B, H, W]; new elements get their own values of what travels."""
        xp, value = self.maker.kind.xp, self.drawing.value
        if value is None:
            for slot in self.maker.slots:
                values, where = fields[slot.name]
                fields[slot.name] = values, where & ~cells if slot.travels else where
            return
        if value.owners is not None:
            owned = [ids == number for number in sorted(value.owners)]
            cells = cells & reduce(or_, owned, xp.zeros_like(cells))
        values, where = fields[value.slot.name]
        parts = self.maker.kind.put(list(value.parts), value.slot.dtype)
        if value.slot.planes == 1:
            new = xp.where(cells, parts[0], values)
        else:
            new = xp.where(cells[:, None], parts[:, None, None], values)
        fields[value.slot.name] = new, where | cells

    def _stamp(self, repeat: int) -> Array:
        """The stamp at its position in each world: uint8 [B, H, W], with NOTHING around it."""
        kind, picture = self.maker.kind, self.maker.stamps[str(self.drawing.stamp)]
        index = []
        for axis, side in enumerate(self.maker.size):
            start = self.numbers[axis]
            assert start is not None
            place = kind.arange(side) - start[:, repeat, None] + 1
            index.append(kind.xp.clip(place, 0, picture.shape[axis] - 1))
        return picture[index[0][:, :, None], index[1][:, None, :]]

    def _scattered(self, repeat: int) -> Array:
        """The cells, bool [B, H, W], each of which is set with the chance of `chance` in a hundred.

        Draws of CHANCE_BITS bits are compared with the threshold from the last bit to the first, for 32 cells at once.
        """
        kind, percent = self.maker.kind, self.numbers[0]
        assert percent is not None
        limit = (percent[:, repeat, None] << CHANCE_BITS) // 100
        height, width = self.maker.size
        halves = kind.arange(2 * width * -(-height // 64))
        below, last = kind.xp.zeros_like(halves)[None], repeat * _NUMBERS + _NUMBERS - 1
        for place in range(CHANCE_BITS):
            counters = ((halves + 1) * CHANCE_BITS + place) * (_NUMBERS * 256) + last
            drawn = self.hashes.draw(self.drawing.number, counters)
            bit = -(limit >> place & 1)
            below = (bit & ~drawn) | (~(bit ^ drawn) & below)
        below = kind.xp.where(limit >> CHANCE_BITS > 0, -1, below)
        columns = (below[..., None] >> kind.arange(32) & 1).reshape(len(below), width, -1)[..., :height]
        return kind.xp.moveaxis(columns, -1, -2) != 0


def _bordered(rows: tuple[tuple[int, ...], ...], kind: ArrayKind) -> Array:
    """A stamp's ids with a border of NOTHING, uint8 [h + 2, w + 2]: what lies outside is read there."""
    edge = [NOTHING] * (len(rows[0]) + 2)
    return kind.put([edge, *([NOTHING, *row, NOTHING] for row in rows), edge], "uint8")


class StartWorlds:
    """An executable split of a task for one kind of arrays."""

    def __init__(self, task: Task, split: str, kind: ArrayKind):
        self.kind = kind
        variants = task.split(split).variants
        drawings = [drawing for variant in variants for group in variant.groups for drawing in group.drawings]
        slots = {drawing.value.slot.name: drawing.value.slot for drawing in drawings if drawing.value}
        self._makers = [WorldMaker(variant, task.size, kind, tuple(slots.values())) for variant in variants]
        cells = [maker.fixed_cells for maker in self._makers]
        self.fixed: Mapping[str, Array] = {
            name: value
            for name, value in cells[0].items()
            if all(name in named and bool((value == named[name]).all()) for named in cells)
        }
        """Regions that are the same in all worlds of the split, bool [1, H, W]."""
        self._params = task.split(split).params

    def params(self, seeds: Array) -> dict[str, Array]:
        """The parameters that worlds draw, float64 [B] each, by name."""
        hashes, counter, xp = Hashes(seeds, self.kind), self.kind.arange(1), self.kind.xp
        values = {}
        for part in self._params:
            number = hashes.draw(name_number(part.name), counter)[:, 0]
            if part.whole:
                value = int(part.low) + (number * int(part.high - part.low + 1) >> 32)
            else:
                value = part.low + (part.high - part.low) * (xp.asarray(number, dtype=xp.float64) / 2**32)
            # As exact as a caller's parameters.
            values[part.name] = xp.asarray(xp.asarray(value, dtype=xp.float32), dtype=xp.float64)
        return values

    def make(self, seeds: Array) -> Made:
        """The start worlds of seeds, int64 [B], each from its own variant of the split."""
        if len(self._makers) == 1:
            return self._makers[0].make(seeds)
        variant = seeds % len(self._makers)
        variants = variant.tolist()
        numbers = sorted(set(variants)) or [0]
        parts = [self._makers[number].make(seeds[variant == number]) for number in numbers]
        batch = join_worlds(self.kind, parts, self.fixed)
        # Back from the order of variants to that of the seeds.
        worlds = sorted(range(len(variants)), key=variants.__getitem__)
        order = self.kind.put(sorted(worlds, key=worlds.__getitem__), "int64")
        regions = {name: cells[order] for name, cells in batch.regions.items() if name not in self.fixed}
        targets = {name: target[order] for name, target in batch.targets.items()}
        fields = {name: (values[order], where[order]) for name, (values, where) in batch.fields.items()}
        return Made(batch.ids[order], {**self.fixed, **regions}, targets, fields)
