"""The numbers of a program's slots, streams, parameters and fixed planes in a native context."""

from __future__ import annotations

from dataclasses import dataclass, field

from powderdsl.ir.ops import Node, Program, Threshold, nodes_of


@dataclass
class Layout:
    """The numbers of slots, streams, parameters and fixed planes, and the sizes of a context's tables."""

    planes: dict[str, int] = field(default_factory=dict)
    reals: dict[str, int] = field(default_factory=dict)
    streams: dict[str, int] = field(default_factory=dict)
    param_planes: dict[tuple[str, Threshold | None, int], int] = field(default_factory=dict)
    param_reals: dict[str, int] = field(default_factory=dict)
    step_planes: dict[tuple[int, int], int] = field(default_factory=dict)
    fixed: dict[tuple[int, int, int], int] = field(default_factory=dict)
    coins: dict[int, int] = field(default_factory=dict)
    """By stream: the draws of one bit, each of which is made once a step."""
    turned: int = 0
    """The largest number of masks of choices that a loop applies."""
    waiting: int = 0
    """The largest number of rows of floats that wait for loops some rows behind."""
    marks: int = 0
    """The largest number of loops over cells that run together and ask planes in which rows to run."""
    marked: int = 0
    """The largest number of planes that such a loop asks."""
    moving: int = 0
    """The largest number of planes in a movement."""
    reach: int = 1
    """The largest distance in columns at which a row of floats is read around the edges."""
    rows: int = 1
    """The largest distance in rows at which floats are read."""
    halo: int = 16
    """Rows and columns beyond the grid for which tables and rows of floats have room."""
    around: int = 0
    """The largest distance in rows at which planes are read, wrapping at the edges."""
    beyond: int = 0
    """The same with zeros outside the grid."""


def layout_of(program: Program) -> Layout:
    """The layout of a program on planes."""
    layout = Layout()
    for slot in program.slots:
        table = layout.reals if slot.type.name == "real" else layout.planes
        table[slot.name] = len(table)
    for i, (name, _, _) in enumerate(program.streams):
        layout.streams[name] = i
    for pass_ in program.passes:
        for node in nodes_of(pass_):
            _place(node, layout)
    return layout


def _place(node: Node, layout: Layout) -> None:
    attr = node.attr
    match node.op:
        case "param" if node.type.name == "real":
            number(layout.param_reals, attr[0])
        case "param":
            number(layout.param_planes, param_key(node))
        case "coordinate" if attr[0] == "step":
            number(layout.step_planes, (attr[1], attr[2]))
        case "coordinate":
            number(layout.fixed, (0 if attr[0] == "row" else 1, attr[1], attr[2]))
        case "inside":
            number(layout.fixed, (2, attr[0], attr[1]))
        case "shift" | "swap" | "arrive":
            # A value recomputed at a neighbor reads neighbors itself, up to a few levels deep.
            layout.halo = max(layout.halo, -(-4 * max(abs(attr[0]), abs(attr[1])) // 16) * 16)
            if node.type.name == "real":
                return
            if node.op == "shift" and not attr[2]:
                layout.beyond = max(layout.beyond, abs(attr[0]))
            else:
                layout.around = max(layout.around, abs(attr[0]))


def number(table: dict, key: object) -> int:
    """The number of a key, assigned on first use."""
    return int(table.setdefault(key, len(table)))


def param_key(node: Node) -> tuple[str, Threshold | None, int]:
    """Name, threshold and bit of a parameter's plane."""
    name, threshold, *bit = node.attr
    return name, threshold, bit[0] if bit else 0


def literal(value: float) -> str:
    """A float32 constant, exactly."""
    return f"{value.hex()}f"
