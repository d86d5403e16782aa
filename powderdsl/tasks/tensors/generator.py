"""Generators: seeds in, worlds out, no loop over worlds. On tensors, or on arrays without torch.

Every number that a world draws is a hash of its seed, the statement, the repetition and which number of the statement
it is. So a world is the same alone and in any batch, on any device.

Painting happens on bits: an id is a few planes, a word is 64 rows of a column.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, reduce
from math import prod
from operator import or_
from typing import Any

from powderdsl.model.types import Expr
from powderdsl.system.random import MASK, base_keys, mix, name_number
from powderdsl.targets.array_kind import Array, ArrayKind
from powderdsl.tasks.task import Drawing, Generator, Group, Region, Task
from powderdsl.worlds.raster import Shape, Size, covered_rows, mask
from powderdsl.worlds.scene.amounts import constants


def shape_words(kind: ArrayKind, shape: str, numbers: Sequence[Array | None], size: Size) -> Array:
    """The cells of shapes, not frames, as bits: int64 [..., W, ⌈H/64⌉].

    `numbers` are int64 [...], in the order of `scene.statements.NUMBERS`; None is an open end.
    """
    xp = kind.xp
    given = [None if one is None else one[..., None] for one in numbers]
    rows = covered_rows(xp, shape, given, kind.arange(size[1]), size)
    first, last = (xp.clip(one, 0, size[0]) for one in rows)
    below = [_bits_below(xp, last - base) & ~_bits_below(xp, first - base) for base in range(0, size[0], 64)]
    return xp.stack(below, -1)


def _bits_below(xp: Any, n: Array) -> Array:
    """Words whose bits below bit n are set; all of them from 64 on."""
    return xp.where(n >= 64, -1, (1 << xp.clip(n, 0, 63)) - 1)


def pack(kind: ArrayKind, cells: Array) -> Array:
    """Cells, bool [..., H, W], as bits: int64 [..., W, ⌈H/64⌉]."""
    *batch, height, width = cells.shape
    number, xp = -(-height // 64), kind.xp
    missing = kind.zeros("uint8", (*batch, 64 * number - height, width))
    padded = xp.concatenate([xp.asarray(cells, dtype=xp.uint8), missing], axis=-2)
    bits = xp.asarray(padded.reshape(*batch, number, 64, width), dtype=xp.int64)
    return kind.contiguous(xp.moveaxis((bits << kind.arange(64)[:, None]).sum(-2), -1, -2))


def unpack(kind: ArrayKind, planes: Sequence[Array] | Array, height: int) -> Array:
    """Numbers whose bits are planes, int64 [..., W, ⌈H/64⌉] each, lowest first: uint8 [..., H, W]."""
    table = _eight_rows(kind)
    found: Array | None = None
    for place, words in enumerate(planes):
        # A byte of a word is eight rows. In the table it is eight bytes, so that eight numbers are put together at once.
        eight = kind.entries(table, kind.as_bytes(words)) << place
        found = eight if found is None else found | eight
    assert found is not None
    *batch, width, number = planes[0].shape
    columns = kind.as_bytes(found).reshape(*batch, width, 64 * number)
    return kind.contiguous(kind.xp.moveaxis(columns[..., :height], -1, -2))


@cache
def _eight_rows(kind: ArrayKind) -> Array:
    """The bits of each byte as eight bytes, which are one word: int64 [256]."""
    return kind.put([sum((byte >> row & 1) << 8 * row for row in range(8)) for byte in range(256)], "int64")


NOTHING = 255
"""In targets and stamps: no element."""

CHUNK_CELLS = 1 << 20
"""Cells of the worlds that are made together on the CPU: their words fit its cache."""

CHANCE_BITS = 16
"""Scattered cells are drawn with that many bits: chances are multiples of 2⁻¹⁶."""

_NUMBERS, _STATEMENT, _COUNTER, _INDEX = 128, 0x9E3779B1, 0x85EBCA6B, 0x7A51
"""Draws of one statement and repetition; odd factors that spread counters; the worlds' index of `base_keys`, which
keeps draws of generators apart from those of rules."""


_LIMITED = ("scatter", "stamp")
"""Statements whose cells are found only when they are painted."""


@dataclass(frozen=True)
class Made:
    """Generated worlds: ids uint8 [B, H, W]; regions bool [B, H, W] or [1, H, W]; targets uint8 [B, H, W]."""

    ids: Array
    regions: Mapping[str, Array]
    targets: Mapping[str, Array]


def joined(kind: ArrayKind, parts: Sequence[Made], fixed: Mapping[str, Array]) -> Made:
    """The worlds of all parts in a row. Regions of `fixed` are the same in all worlds."""
    xp, regions = kind.xp, dict(fixed)
    for name in (name for name in parts[0].regions if name not in fixed):
        cells = [xp.broadcast_to(one.regions[name], one.ids.shape) for one in parts]
        regions[name] = xp.concatenate(cells)
    targets = {name: xp.concatenate([one.targets[name] for one in parts]) for name in parts[0].targets}
    return Made(xp.concatenate([one.ids for one in parts]), regions, targets)


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
    """Values of the amounts of one statement, [B, R] for R repetitions; each of its `wanted` draws takes the next counter."""

    def __init__(self, hashes: Hashes, statement: int, repeats: int, names: Mapping[str, Array], wanted: int):
        self.names, self.kind = names, hashes.kind
        counters = self.kind.arange(repeats)[:, None] * _NUMBERS + self.kind.arange(wanted)
        drawn = hashes.draw(statement, counters.reshape(-1)).reshape(-1, repeats, wanted) if wanted else ()
        self.drawn = iter(self.kind.xp.moveaxis(drawn, -1, 0) if wanted else ())

    def uniform(self, low: Array | int, high: Array | int) -> Array:
        """Integers from `low` to `high`, both included; where there are none, `low`."""
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

    def array(self, amount: Expr | None) -> Array | None:
        """int64 that broadcasts to [B, R]."""
        if amount is None:
            return None
        value = self.value(amount)
        return self.kind.put(value, "int64") if isinstance(value, int) else value


def _draws_in(*amounts: Expr | None) -> int:
    return sum(part.op == "uniform" for one in amounts if one is not None for part in one.walk())


def _groups(generator: Generator) -> list[Group]:
    return [*generator.groups, *(group for target in generator.targets for group in target.groups)]


def _shape_number(region: Region, place: int) -> int:
    """A region's own draws depend on its name and the shape's place."""
    return name_number(f"{region.name} {place}")


class WorldMaker:
    """A generator made executable for one size and kind of arrays."""

    def __init__(self, generator: Generator, size: Size, kind: ArrayKind):
        self.generator, self.size, self.kind = generator, size, kind
        self.words = -(-size[0] // 64)
        self.stamps = {stamp.name: _bordered(stamp.rows, kind) for stamp in generator.stamps}
        painted = [i for group in _groups(generator) for one in group.drawings for i in one.ids]
        held = [i for stamp in generator.stamps for row in stamp.rows for i in row if i != NOTHING]
        self.planes = max(1, max([generator.fill, *painted, *held]).bit_length())
        self.fixed: dict[Drawing, Array] = {}
        """Words of shapes that are the same in every world."""
        self._bits: dict[tuple[int, int], Array] = {}
        nowhere = kind.zeros("int64", (size[1], self.words))
        self.fixed_regions = {
            region.name: reduce(or_, map(self.fixed_words, region.shapes), nowhere)[None]
            for region in generator.regions
            if not region.drawn
        }
        self.fixed_cells = {name: self._cells([words]) for name, words in self.fixed_regions.items()}

    def _cells(self, planes: Sequence[Array]) -> Array:
        """The cells of one plane of words: bool [..., H, W]."""
        return unpack(self.kind, planes, self.size[0]) != 0

    def make(self, seeds: Array) -> Made:
        """The worlds of some seeds, int64 [B]."""
        chunk = max(1, len(seeds))
        if self.kind.on_cpu:
            chunk = max(1, CHUNK_CELLS // (self.size[0] * self.size[1]))
        made = [self._chunk(seeds[i : i + chunk]) for i in range(0, max(1, len(seeds)), chunk)]
        return made[0] if len(made) == 1 else joined(self.kind, made, self.fixed_cells)

    def _chunk(self, seeds: Array) -> Made:
        kind, height = self.kind, self.size[0]
        hashes = Hashes(seeds, kind)
        names = self._lets(self.generator.lets, hashes, 1, {})
        regions = dict(self.fixed_regions)
        for region in self.generator.regions:
            if region.drawn:
                regions[region.name] = self._region(region, hashes, names)
        cells = {
            name: self.fixed_cells[name] if name in self.fixed_cells else self._cells([words])
            for name, words in regions.items()
        }
        planes = self._canvas(len(seeds), self.generator.fill)
        self._paint(planes, self.generator.groups, hashes, names, regions)
        targets = {}
        for target in self.generator.targets:
            canvas = self._canvas(len(seeds), 0, more=1)
            self._paint(canvas, target.groups, hashes, names, regions)
            ids = unpack(kind, canvas[:-1], height)
            targets[target.name] = kind.xp.where(self._cells(canvas[-1:]), ids, NOTHING)
        return Made(unpack(kind, planes, height), cells, targets)

    def _canvas(self, batch: int, fill: int, more: int = 0) -> Array:
        """Planes of an element everywhere, int64 [P, B, W, K]; with one more plane for what has been painted."""
        bits = [-(fill >> plane & 1) for plane in range(self.planes + more)]
        plane = self.kind.put(bits, "int64")[:, None, None, None]
        shape = (len(bits), batch, self.size[1], self.words)
        return self.kind.copied(self.kind.xp.broadcast_to(plane, shape))

    def _lets(
        self, lets: tuple[tuple[str, Expr], ...], hashes: Hashes, repeats: int, names: Mapping[str, Array]
    ) -> dict[str, Array]:
        """`names` and more of them: int64 that broadcasts to [B, R]."""
        found = dict(names)
        for name, amount in lets:
            value = _Draws(hashes, name_number(name), repeats, found, _draws_in(amount)).array(amount)
            assert value is not None
            found[name] = value
        return found

    def _region(self, region: Region, hashes: Hashes, names: Mapping[str, Array]) -> Array:
        """Words [B, W, K] of a region."""
        shape = (len(hashes.keys[0]), self.size[1], self.words)
        found = self.kind.zeros("int64", shape)
        for number, drawn in enumerate(region.shapes):
            draws = _Draws(hashes, _shape_number(region, number), 1, names, _draws_in(*drawn.amounts))
            words = self.drawn_words(drawn, [draws.array(one) for one in drawn.amounts])
            found = found | self.kind.xp.broadcast_to(words, (shape[0], 1, *shape[1:]))[:, 0]
        return found

    def drawn_words(self, drawing: Drawing, numbers: list[Array | None]) -> Array:
        """The words of a shape whose numbers broadcast to [B, R]: broadcasts to [B, R, W, K]."""
        if drawing.kind in ("frame", "fill"):
            return self.fixed_words(drawing)
        return shape_words(self.kind, drawing.kind, numbers, self.size)

    def fixed_words(self, drawing: Drawing) -> Array:
        """The words [W, K] of a shape of plain numbers."""
        if drawing not in self.fixed:
            shape = Shape(drawing.kind, constants(drawing.amounts) or ())
            self.fixed[drawing] = pack(self.kind, self.kind.from_numpy(mask(shape, self.size)))
        return self.fixed[drawing]

    def fixed_bits(self, number: int, planes: int) -> Array:
        """The bits of an id, as `_plane_bits` has them."""
        if (number, planes) not in self._bits:
            ids = self.kind.put([[number]], "int64")
            self._bits[number, planes] = _plane_bits(self.kind, ids, planes, self.planes)
        return self._bits[number, planes]

    def _paint(
        self,
        planes: Array,
        groups: tuple[Group, ...],
        hashes: Hashes,
        names: Mapping[str, Array],
        regions: Mapping[str, Array],
    ) -> None:
        """Paint all groups on planes, in place."""
        xp, batch = self.kind.xp, planes.shape[1]
        for group in groups:
            count = _Draws(hashes, group.number, 1, names, _draws_in(group.count)).array(group.count)
            assert count is not None
            repeats = group.most
            if self.kind.on_cpu and repeats > 1:
                # Repetitions that no world of the batch has are not drawn.
                repeats = int(count.max()) if prod(count.shape) else 0
            if repeats == 0:
                continue
            active = xp.broadcast_to(self.kind.arange(repeats) < count, (batch, repeats))
            once = -xp.asarray(active, dtype=xp.int64)[..., None, None]
            local = self._lets(group.lets, hashes, repeats, names)
            painters = []
            for one in group.drawings:
                wanted = _draws_in(*one.amounts) + (len(one.ids) > 1)
                draws = _Draws(hashes, one.number, repeats, local, wanted)
                painters.append(_Painter(self, one, draws, hashes, once, len(planes)))
            for repeat in range(repeats):
                for painter in painters:
                    painter.paint(planes, repeat, regions)


class _Painter:
    """One statement in all its repetitions: what it needs is computed for all of them at once."""

    def __init__(
        self, maker: WorldMaker, drawing: Drawing, draws: _Draws, hashes: Hashes, once: Array, planes: int
    ):
        """`once`: int64 [B, R, 1, 1], all bits where a world has a repetition."""
        self.maker, self.drawing, self.hashes = maker, drawing, hashes
        repeats, kind = once.shape[1], maker.kind
        if len(drawing.ids) > 1:
            ids = kind.put(list(drawing.ids), "int64")[draws.uniform(0, len(drawing.ids) - 1)]
            bits = _plane_bits(kind, ids, planes, maker.planes)
        else:  # those of stamps stand in their pictures
            bits = maker.fixed_bits(drawing.ids[0] if drawing.ids else 0, planes)
        some = list(kind.xp.moveaxis(bits, 2, 0))
        self.bits = some if len(some) > 1 else some * repeats
        self.numbers: list[Array | None] = []
        words = once
        if drawing.kind not in _LIMITED and constants(drawing.amounts) is not None:
            words = maker.fixed_words(drawing) & once
        else:
            shape = tuple(once.shape[:2])
            for one in drawing.amounts:
                value = draws.array(one)
                self.numbers.append(None if value is None else kind.xp.broadcast_to(value, shape))
            if drawing.kind not in _LIMITED:
                words = maker.drawn_words(drawing, self.numbers) & once
        self.words = list(kind.xp.moveaxis(words, 1, 0))

    def paint(self, planes: Array, repeat: int, regions: Mapping[str, Array]) -> None:
        """Paint one repetition on planes, in place."""
        drawing, kind = self.drawing, self.maker.kind
        words, bits = self.words[repeat], self.bits[repeat]
        if drawing.kind == "stamp":
            picture = self._stamp(repeat)
            words = words & pack(kind, picture != NOTHING)
            layers = [pack(kind, (picture >> place & 1) != 0) for place in range(self.maker.planes)]
            layers += [kind.xp.full_like(words, -1)] * (len(planes) - len(layers))
            bits = kind.xp.stack(layers)
        elif drawing.kind == "scatter":
            words = words & self._scattered(repeat)
        if drawing.where is not None:
            words = words & regions[drawing.where]
        if drawing.over is not None:
            words = words & self._holding(planes, drawing.over)
        planes[...] = planes ^ ((planes ^ bits) & words)

    def _holding(self, planes: Array, ids: frozenset[int]) -> Array:
        """The words of cells that hold one of some elements."""
        xp = self.maker.kind.xp
        found = xp.zeros_like(planes[0])
        for one in sorted(ids):
            same = xp.full_like(planes[0], -1 if one >> self.maker.planes == 0 else 0)
            for place in range(self.maker.planes):
                same = same & (planes[place] if one >> place & 1 else ~planes[place])
            found = found | same
        return found

    def _stamp(self, repeat: int) -> Array:
        """The stamp where it stands in each world: uint8 [B, H, W], NOTHING around it."""
        kind, picture = self.maker.kind, self.maker.stamps[str(self.drawing.stamp)]
        index = []
        for axis, side in enumerate(self.maker.size):
            start = self.numbers[axis]
            assert start is not None
            place = kind.arange(side) - start[:, repeat, None] + 1
            index.append(kind.xp.clip(place, 0, picture.shape[axis] - 1))
        return picture[index[0][:, :, None], index[1][:, None, :]]

    def _scattered(self, repeat: int) -> Array:
        """Words [B, W, K] in which each bit is set with the chance of `chance` in a hundred.

        A draw of CHANCE_BITS bits is compared with the threshold from the last bit to the first, 64 cells at once.
        """
        kind, percent = self.maker.kind, self.numbers[0]
        assert percent is not None
        limit = (percent[:, repeat, None] << CHANCE_BITS) // 100
        width, words = self.maker.size[1], self.maker.words
        halves = kind.arange(2 * width * words)
        below = kind.xp.zeros_like(halves)[None]
        for place in range(CHANCE_BITS):
            counters = (
                ((halves + 1) * CHANCE_BITS + place) * (_NUMBERS * 256) + repeat * _NUMBERS + _NUMBERS - 1
            )
            drawn = self.hashes.draw(self.drawing.number, counters)
            bit = -(limit >> place & 1)
            below = (bit & ~drawn) | (~(bit ^ drawn) & below)
        below = kind.xp.where(limit >> CHANCE_BITS > 0, -1, below) & MASK
        low, high = kind.xp.moveaxis(below.reshape(-1, width, words, 2), -1, 0)
        return low | high << 32


def _plane_bits(kind: ArrayKind, ids: Array, planes: int, own: int) -> Array:
    """The bits of ids [B, R] in each plane, as whole words: int64 [P, B, R, 1, 1], planes beyond `own` set."""
    place = kind.arange(planes)[:, None, None]
    return kind.xp.where(place < own, -(ids >> place & 1), -1)[..., None, None]


def _bordered(rows: tuple[tuple[int, ...], ...], kind: ArrayKind) -> Array:
    """A stamp's ids with a border of NOTHING, uint8 [h + 2, w + 2]: what lies outside is read there."""
    edge = [NOTHING] * (len(rows[0]) + 2)
    return kind.put([edge, *([NOTHING, *row, NOTHING] for row in rows), edge], "uint8")


class StartWorlds:
    """A task's split made executable for one kind of arrays."""

    def __init__(self, task: Task, split: str, kind: ArrayKind):
        self.kind = kind
        self._makers = [WorldMaker(one, task.size, kind) for one in task.split(split).variants]
        cells = [maker.fixed_cells for maker in self._makers]
        self.fixed: Mapping[str, Array] = {
            name: value
            for name, value in cells[0].items()
            if all(name in one and bool((value == one[name]).all()) for one in cells)
        }
        """Regions that are the same in all worlds of the split, bool [1, H, W]."""

    def make(self, seeds: Array) -> Made:
        """The start worlds of seeds, int64 [B]; where the split has several variants, each world comes from its own."""
        if len(self._makers) == 1:
            return self._makers[0].make(seeds)
        variant = seeds % len(self._makers)
        variants = variant.tolist()
        numbers = sorted(set(variants)) or [0]
        parts = [self._makers[number].make(seeds[variant == number]) for number in numbers]
        made = joined(self.kind, parts, self.fixed)
        # Back from the order of variants to that of the seeds.
        worlds = sorted(range(len(variants)), key=variants.__getitem__)
        order = self.kind.put(sorted(worlds, key=worlds.__getitem__), "int64")
        regions = {name: one if name in self.fixed else one[order] for name, one in made.regions.items()}
        return Made(made.ids[order], regions, {name: one[order] for name, one in made.targets.items()})
