"""The memory of a module: what lies where. A group is two lanes of work: two worlds, or the two halves of one world.

Addresses are bytes. Everything is aligned to 16 bytes.

    plane   refs, some, haloed, next: i32 each. Rows of words, lane by lane, with `around` rows above and below, which
            hold the rows that follow on the torus if `haloed`. `some`: it may hold a flag; if not, all words are zero.
    field   refs, some, –, next. A byte a line: whether it is `live`; other lines are zero and not to be read. Then the
            lines, of both lanes one after the other, with `reach` columns of the torus on both sides.
    batch   worlds, groups, next, bytes. Seeds, indices and steps, i64 a world each. The bits of parameters, a byte a
            world each; then their float32 values. Then the groups.
    group   the planes and fields of slots, i32 each; i64: the ids that are present, of those that passes ask for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from powderdsl.ir.ops import REAL, ordered
from powderdsl.schedule.types import Move, Schedule, Sweeps, flat
from powderdsl.targets.layout import Layout
from powderdsl.targets.values import chains_of

WORD, LANES = 64, 2
REFS, SOME, HALOED, NEXT, HEADER = 0, 4, 8, 12, 16
MOST_BITS = 64
"""Of a draw."""


def aligned(count: int, by: int = 16) -> int:
    return -(-count // by) * by


@dataclass(frozen=True)
class Extent:
    """The largest distances at which planes are read in rows (`around`), and fields in rows and columns; the most chains
    of choices in a loop.
    """

    around: int
    lines: int
    reach: int
    chains: int


def extent_of(schedules: Sequence[Schedule]) -> Extent:
    around = lines = reach = chains = 0
    for statement in (one for schedule in schedules for one in flat(schedule.body)):
        if isinstance(statement, Move):
            around = max(around, abs(statement.offset[0]))
            lines = max(lines, abs(statement.offset[0]) if statement.planes[0].new.type == REAL else 0)
        elif isinstance(statement, Sweeps):
            laid = (loop for loop in statement.loops if loop.over == "choices")
            chains = max(chains, *(len(chains_of(loop)) for loop in laid), 0)
        for node in ordered(statement.values()):
            if node.op == "shift" and node.type != REAL:
                around = max(around, abs(node.attr[0]))
            elif node.op in ("shift", "live"):
                lines = max(lines, abs(node.attr[0]))
                reach = max(reach, abs(node.attr[1]) if node.op == "shift" else 0)
    return Extent(around, lines, reach, chains)


@dataclass
class Memory:
    """The sizes of rows, and the static addresses, of a program for grids of one width."""

    width: int
    extent: Extent
    layout: Layout
    top: int = 64
    places: dict[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        layout = self.layout
        for name, size in (
            ("turn", 16),
            ("apart", 16),
            ("worlds", 32),
            ("clock", 16),
            ("keys", 32 * len(layout.streams)),
            ("params", 16 * len(layout.param_planes)),
            ("reals", 8 * len(layout.param_reals)),
            ("steps", 16 * len(layout.step_planes)),
            ("limits", 16 * (MOST_BITS + 1)),
            ("coins", 4 * len(layout.streams)),
            ("fixed", 4 * len(layout.fixed)),
            ("lines", 4 * 2 * (2 * self.extent.lines + 1)),
            ("moving", 4 * (len(layout.planes) + 1)),
            ("rows", 4),
            ("change", 2 * self.row),
            ("columns", 4 * self.stride),
            ("chains", 4 * self.stride * self.extent.chains),
        ):
            self.places[name] = self.top
            self.top = aligned(self.top + size)

    @property
    def words(self) -> int:
        """The words of a row."""
        return -(-self.width // WORD)

    @property
    def whole(self) -> bool:
        """Whether all words of a row are full."""
        return self.width % WORD == 0

    @property
    def row(self) -> int:
        """The bytes of a plane's row, both lanes."""
        return 8 * LANES * self.words

    @property
    def base(self) -> int:
        """Where a plane's first row lies."""
        return HEADER + self.extent.around * self.row

    @property
    def halo(self) -> int:
        """The columns beside a line of a field for which there is room."""
        return aligned(self.extent.reach, 4)

    @property
    def stride(self) -> int:
        """The floats of a line, with both halos and what a chunk may overlap."""
        return aligned(self.width, 4) + 2 * self.halo + 4

    @property
    def group(self) -> int:
        """The bytes of a group."""
        return aligned(self.present + 8)

    @property
    def present(self) -> int:
        """Where a group keeps the ids that are present."""
        return aligned(4 * (len(self.layout.planes) + len(self.layout.reals)), 8)

    def at(self, name: str, number: int = 0, size: int = 16) -> int:
        """The address of an item of a static table."""
        return self.places[name] + number * size

    def slot(self, name: str, type: object) -> int:
        """Where a group keeps a slot."""
        if type == REAL:
            return 4 * (len(self.layout.planes) + self.layout.reals[name])
        return 4 * self.layout.planes[name]

    def table(self, dy: int, *, wraps: bool) -> int:
        """Where the pointer to a table of lines lies: for each line, the one `dy` below it in its world."""
        return self.at("lines", 2 * (dy + self.extent.lines) + (not wraps), 4)
