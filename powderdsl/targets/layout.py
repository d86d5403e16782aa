"""State arrays as slots of a program, parameters as numbers that kernels read, and the numbers of both in compiled code.

A state array is one slot of the IR, or two if it is a vector. On bit planes, an integer slot has one plane per bit.
Arrays are of one library: torch, or `powderdsl.arrays`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from powderdsl.ir.ops import REAL, Node, Program, SlotType, Threshold, nodes_of


def pieces(program: Program) -> dict[str, tuple[SlotType, ...]]:
    """The slots of each state array of a program on numbers, by the array's name."""
    groups: dict[str, tuple[SlotType, ...]] = {}
    for slot in program.slots:
        name = slot.state or slot.name
        groups[name] = (*groups.get(name, ()), slot)
    return groups


def limits(xp: Any, values: Any, threshold: Threshold) -> Any:
    """The number of possible draws below each chance (float64 [B]), or not above it if not strict: int64 [B]."""
    count = 1 << threshold.bits
    scaled = values * count - 0.5
    limit = -xp.floor(-scaled) if threshold.strict else xp.floor(scaled) + 1
    return xp.asarray(xp.clip(limit, 0, count), dtype=xp.int64)


@dataclass
class Layout:
    """The numbers of slots, streams, parameters and fixed planes."""

    planes: dict[str, int] = field(default_factory=dict)
    reals: dict[str, int] = field(default_factory=dict)
    streams: dict[str, int] = field(default_factory=dict)
    param_planes: dict[tuple[str, Threshold | None, int], int] = field(default_factory=dict)
    param_reals: dict[str, int] = field(default_factory=dict)
    step_planes: dict[tuple[int, int], int] = field(default_factory=dict)
    fixed: dict[tuple[int, int, int], int] = field(default_factory=dict)

    def home(self, piece: SlotType) -> tuple[int, int, bool]:
        """The location of a piece of the state: the number of its field, 0 and False; or the number of its first plane, the
        number of planes, and True if the last plane is a sign.
        """
        if piece.type == REAL:
            return self.reals[piece.name], 0, False
        return self.planes[piece.planes[0]], len(piece.planes), piece.type.signed

    @cached_property
    def _bits(self) -> tuple[dict[Threshold | None, dict[str, None]], list[int], list[int]]:
        """The parameters of each threshold, and of each plane, the number of its parameter there and its bit."""
        groups: dict[Threshold | None, dict[str, None]] = {}
        for name, threshold, _ in self.param_planes:
            groups.setdefault(threshold, {})[name] = None
        keys = [(name, threshold) for threshold, names in groups.items() for name in names]
        rows, planes = {key: row for row, key in enumerate(keys)}, self.param_planes
        return groups, [rows[key[:2]] for key in planes], [bit for *_, bit in planes]

    def parameters(self, xp: Any, params: Mapping[str, Any], batch: int, **where: Any) -> tuple[Any, Any]:
        """Parameters as the bits and floats that compiled code reads: uint8 [n, B], float32 [m, B].

        `xp` is the library of the arrays; `where` is its device argument, if it has one.
        """

        def rows_of(names: Iterable[str], dtype: Any) -> Any:
            return xp.stack(
                [xp.broadcast_to(xp.asarray(params[name], dtype=dtype), (batch,)) for name in names]
            )

        groups, rows, places = self._bits
        bits, floats = (xp.zeros((1, batch), dtype=dtype, **where) for dtype in (xp.uint8, xp.float32))
        if rows:
            values = [
                limits(xp, rows_of(names, xp.float64), threshold) if threshold else rows_of(names, xp.int64)
                for threshold, names in groups.items()
            ]
            numbers = xp.concatenate(values)[xp.asarray(rows, **where)]
            bits = xp.asarray(numbers >> xp.asarray(places, **where).reshape(-1, 1) & 1, dtype=xp.uint8)
        if self.param_reals:
            floats = rows_of(self.param_reals, xp.float32)
        return bits, floats

    def limit(self, draw: Node) -> int:
        """The plane of the highest bit of the parameter that a draw is compared with; lower bits follow."""
        _, bits, name, threshold = draw.attr
        return self.param_planes[name, threshold, bits]


@dataclass
class NativeLayout(Layout):
    """The layout of a native context, and the sizes of its tables: the largest numbers and distances in any pass."""

    coins: dict[int, int] = field(default_factory=dict)
    """The number of each stream whose draws are coins, which are tossed once a step."""
    moving: int = 0
    """Planes in a movement."""
    turned: int = 0
    """Masks of choices that a loop applies."""
    waiting: int = 0
    """Rows of floats that are buffered for loops some rows behind."""
    marks: int = 0
    """Loops over cells that run together and test planes for rows to run in."""
    marked: int = 0
    """Planes that such a loop tests."""
    reach: int = 1
    """Distance in columns beyond the edges at which a row of floats is read."""
    halo: int = 16
    """Rows and columns beyond the grid for which tables and rows of floats have room."""
    around_rows: int = 0
    """Distance in rows at which planes are read, wrapping at the edges."""
    beyond_rows: int = 0
    """The same distance with zeros outside the grid."""

    def cover(self, **sizes: int) -> None:
        """Enlarge tables to at least these sizes."""
        for name, size in sizes.items():
            setattr(self, name, max(getattr(self, name), size))


def layout_of(program: Program) -> Layout:
    layout = Layout()
    for slot in program.slots:
        number(layout.reals if slot.type.name == "real" else layout.planes, slot.name)
    for name, _, _ in program.streams:
        number(layout.streams, name)
    for pass_ in program.passes:
        for node in nodes_of(pass_):
            match node.op:
                case "param" if node.type.name == "real":
                    number(layout.param_reals, node.attr[0])
                case "param":
                    name, threshold, bit = param_key(node)
                    for i in range(threshold.bits, -1, -1) if threshold else (bit,):
                        number(layout.param_planes, (name, threshold, i))
                case "coordinate" if node.attr[0] == "step":
                    number(layout.step_planes, node.attr[1:])
                case "coordinate" | "inside":
                    number(layout.fixed, fixed_key(node))
    return layout


def native_layout(program: Program) -> NativeLayout:
    """The layout of a program on planes, with the distances at which it reads."""
    layout = NativeLayout(**vars(layout_of(program)))
    for pass_ in program.passes:
        for node in nodes_of(pass_):
            if node.op in ("shift", "swap", "arrive"):
                dy, dx, *wraps = node.attr
                # A value recomputed at a neighbor reads neighbors itself, up to a few levels deep.
                layout.cover(halo=-(-4 * max(abs(dy), abs(dx)) // 16) * 16)
                if node.type.name != "real":
                    layout.cover(**{"beyond_rows" if wraps == [False] else "around_rows": abs(dy)})
    return layout


def number(table: dict, key: object) -> int:
    """The number of a key, assigned on first use."""
    return int(table.setdefault(key, len(table)))


def param_key(node: Node) -> tuple[str, Threshold | None, int]:
    """Name, threshold and bit of a parameter's plane."""
    name, threshold, *bit = node.attr
    return name, threshold, bit[0] if bit else 0


def fixed_key(node: Node) -> tuple[int, int, int]:
    """The key of a plane that never changes: it depends on a bit of the row (0) or column (1), or on a neighbor (2)."""
    if node.op == "inside":
        return 2, node.attr[0], node.attr[1]
    axis, modulus, bit = node.attr
    return 0 if axis == "row" else 1, modulus, bit


def literal(value: float) -> str:
    """A float32 constant, exactly."""
    return f"{value.hex()}f"


def braced(items: Iterable[object]) -> str:
    return f"{{{', '.join(map(str, items))}}}"
