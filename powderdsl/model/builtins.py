"""Built-in words of rule files: directions, kernels, kinds. Functions are rows of `operations`."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

from powderdsl.model.operations import FUNCTIONS
from powderdsl.model.types import Kernel, Offset

DIRECTIONS: dict[str, Offset] = {
    "here": (0, 0),
    "above": (-1, 0),
    "below": (1, 0),
    "left": (0, -1),
    "right": (0, 1),
}
"""Names of neighbors: (rows down, columns right). Paths add up: `above.left`."""

OCTANTS: tuple[Offset, ...] = ((0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1), (-1, 0), (-1, 1))
"""The eight neighbors by octant: 0 right, 2 below, 4 left, 6 above, odd the diagonals between."""

DIRECTION_SETS: dict[str, tuple[Offset, ...]] = {
    "octants": OCTANTS,
    "sides": ((-1, 0), (1, 0), (0, -1), (0, 1)),
    "diagonals": ((-1, -1), (-1, 1), (1, -1), (1, 1)),
}
"""Sets of directions to loop over, in this order."""


def grid_kernel(name: str, rows: tuple[tuple[int, ...], ...], wrap: bool = False) -> Kernel:
    """A kernel from a matrix of integer weights with odd sides; zero weights are left out."""
    cy, cx = len(rows) // 2, len(rows[0]) // 2
    weights = tuple((y - cy, x - cx, w) for y, row in enumerate(rows) for x, w in enumerate(row) if w)
    return Kernel(name, weights, wrap)


KERNEL_SHAPES: dict[str, Callable[[int, int, int], bool]] = {
    # the cells at most R rows and R columns away, and the border of that box
    "box": lambda dy, dx, r: max(abs(dy), abs(dx)) <= r,
    "ring": lambda dy, dx, r: max(abs(dy), abs(dx)) == r,
    # the cells nearer than R + ½, as a circle, and those at most R steps to the sides away
    "disc": lambda dy, dx, r: dy * dy + dx * dx <= r * r + r,
    "diamond": lambda dy, dx, r: abs(dy) + abs(dx) <= r,
    # row and column of the cell, with it and without it
    "cross": lambda dy, dx, r: 0 in (dy, dx),
    "plus": lambda dy, dx, r: (dy == 0) != (dx == 0),
}
"""Which cells, rows and columns away, belong to kernels that take a radius: `box(5)`. With radius 1 they are those of KERNELS; a disc is a box then, a diamond a cross."""

MAX_RADIUS = 15
"""The largest radius of a kernel: 31 rows of 31 weights."""


@lru_cache(maxsize=256)
def shaped_kernel(shape: str, radius: int, name: str = "", wrap: bool = False) -> Kernel:
    """The kernel of a shape and radius. It is named as written, `box(5)`, unless the file names it."""
    covers, reach = KERNEL_SHAPES[shape], range(-radius, radius + 1)
    weights = tuple((dy, dx, 1) for dy in reach for dx in reach if covers(dy, dx, radius))
    return Kernel(name or f"{shape}({radius})", weights, wrap)


KERNELS: dict[str, Kernel] = {name: shaped_kernel(name, 1, name) for name in ("box", "ring", "cross", "plus")}
"""Neighborhoods for `count` and `sum`. Cells outside the grid do not count."""

COORDINATES = ("row", "column", "step")
"""Coordinates in space and time, which are used with `mod`, as in `(row + step) mod 2`."""

KIND_WORDS: dict[str, str] = {
    "flag": "yes or no",
    "element": "the name of an element",
    "direction": "one of the eight neighbors",
    "chance": "a probability, 0% to 100%",
    "real": "real(LOW..HIGH): a float32",
    "vec2": "vec2(LOW..HIGH): two float32, (rows, columns)",
}
"""Kinds of properties, fields and parameters, besides ranges of integers, LOW..HIGH."""

FLAG_WORDS = {"yes": 1, "true": 1, "no": 0, "false": 0}
"""Flags outside rules: in drawn fields, and for parameters."""

MAX_OFFSET = 15
"""Maximum offset of a rule."""

MAX_SIDE_MULTIPLE = 64
"""The largest `side_multiple`."""

MAX_MAGNITUDE = 1_000_000
"""The largest number a rule file may contain."""

RESERVED = frozenset((*DIRECTIONS, *DIRECTION_SETS, *KERNELS, *FUNCTIONS, *COORDINATES))
"""Words that definitions cannot use. Shapes, such as `diamond(3)`, need a radius, so elements may have their names."""

ELSEWHERE = {
    **dict.fromkeys(("up", "north", "top"), "write `above`"),
    **dict.fromkeys(("down", "south", "bottom"), "write `below`"),
    "west": "write `left`",
    "east": "write `right`",
    **dict.fromkeys(("self", "this"), "a rule applies to its own cell anyway: omit it, or write `here`"),
    "true": "write `yes`",
    "false": "write `no`",
    **dict.fromkeys(("none", "nothing", "air"), "name the element that represents nothing, such as `empty`"),
    **dict.fromkeys(("neighbors", "neighbours"), "count them: `count(SET)`, `count(SET in ring)`"),
    **dict.fromkeys(
        ("random", "rand"), "write `with chance 5%` at the end of the rule, or compare a stream: `luck < 5%`"
    ),
    "probability": "write `with chance 5%` at the end of the rule",
    **dict.fromkeys(("floor", "round", "int"), "`a div b` divides integers and rounds down"),
    "ceil": "`a div b` divides integers and rounds down: `(a + b - 1) div b` rounds up",
    "sqrt": "there are no roots; `length(VEC2)` is the length of a vector",
    "pow": "there is no power operator: write `x * x`",
    "distance": "`count(SET in disc(3)) > 0` tests what is near; `length(VEC2)` is the length of a vector",
}
"""Words of other languages, and what to write instead."""
