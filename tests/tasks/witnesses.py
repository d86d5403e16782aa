"""Scripted players of the shipped tasks: short, and shown only what a person would see of a world."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Cells = NDArray[np.bool_]
Act = tuple[str | int, ...]
"""A choice, and the row and column it is made at; of `blow` also its direction downwards and to the right, −1..1."""

WAIT: Act = ("nothing", 0, 0)


@dataclass(frozen=True)
class Seen:
    """One world before an action: ids uint8 [64, 64], the task's regions bool [64, 64], and the number of the action."""

    ids: NDArray[np.uint8]
    regions: Mapping[str, Cells]
    elements: tuple[str, ...]
    turn: int

    def __getitem__(self, name: str) -> Cells:
        """A region, or the cells that hold an element."""
        return self.regions[name] if name in self.regions else self.ids == self.elements.index(name)


def most(cells: Cells) -> tuple[int, int]:
    """A cell in the middle of the 4×4 tile with most of the cells: the uppermost and leftmost of such tiles."""
    tiles = cells.reshape(16, 4, 16, 4).sum((1, 3))
    row, column = divmod(int(tiles.argmax()), 16)
    return 4 * row + 2, 4 * column + 2


def middle(cells: Cells) -> tuple[int, int]:
    """The mean row and column of cells; (32, 32) of none."""
    rows, columns = np.nonzero(cells)
    return (int(rows.mean()), int(columns.mean())) if len(rows) else (32, 32)


def burn_the_weeds(seen: Seen) -> Act:
    return "fire", *most(seen["plant"])


def dig_a_channel(seen: Seen) -> Act:
    """Along the bottom of the lake, then straight down into the cave."""
    (_, start), (bottom, end) = middle(seen["lake"]), middle(seen["cave"])
    path = [(18, column) for column in range(start, end, 4 if end > start else -4)]
    path += [(row, end) for row in range(18, bottom, 4)]
    rock = ~(seen["empty"] | seen["water"])
    closed = [(row, column) for row, column in path if rock[row, column]]
    return ("empty", *closed[0]) if closed else WAIT


def ice_bridge(seen: Seen) -> Act:
    return "ice", *most(seen["bridge"] & ~seen["ice"])


def build_an_arch(seen: Seen) -> Act:
    """A scaffold of wood, stones on it; then the scaffold goes."""
    beam, gap = seen["span"], seen["passage"]
    under = gap & np.roll(beam, 4, 0)
    if not (beam & ~seen["stone"]).any():
        return "empty", *most(gap & ~seen["empty"])
    if (under & ~seen["wood"]).any():
        return "wood", *most(under & ~seen["wood"])
    return "stone", *most(beam & ~seen["stone"])


def blow_up_the_heap(seen: Seen) -> Act:
    row, column = middle(seen["sand"] & seen["place"])
    return ("dust" if seen.turn % 2 == 0 else "fire"), row + 3, column


def greenhouses(seen: Seen) -> Act:
    """Water into the house with the fewest plants, above them."""
    house = min(("house_a", "house_b", "house_c"), key=lambda name: (seen[name] & seen["plant"]).sum())
    row, column = middle(seen[house] & seen["plant"])
    return "water", row - 4, column


def keep_ice(seen: Seen) -> Act:
    gap = seen["shell"] & ~seen["block"] & ~seen["wood"]
    return ("wood", *most(gap)) if gap.any() else WAIT


def sort_sand_and_stone(seen: Seen) -> Act:
    """What lies on the uppermost shelf that is not empty, the larger part first; then a pause until it is calm."""
    on_shelves = ~seen["left_side"] & ~seen["right_side"]
    for shelf in (16, 34, 52):
        sand, stone = ((seen[name] & on_shelves)[shelf - 10 : shelf].sum() for name in ("sand", "stone"))
        if sand + stone > 0:
            return "blow", shelf - 3, 32, 0, -1 if sand > stone else 1
    return WAIT


def herd_gas(seen: Seen) -> Act:
    """Down until it is below the curtain, then to the right."""
    row, column = middle(seen["gas"] & seen["outside"])
    curtain = seen["wall"] & ~seen["outside"] & ~seen["cage"]
    hem = int(np.nonzero(curtain[1:63, 1:63].any(1))[0].max()) + 2
    return "blow", row, column, int(row < hem + 5), int(row > hem)


def firewall(seen: Seen) -> Act:
    """From the top downwards, well before the fire."""
    column = 26 if middle(seen["fire"])[1] < 32 else 38
    rows = np.nonzero(seen["plant"][:, column - 2 : column + 2].any(1))[0]
    return ("wall", int(rows[0]), column) if len(rows) else WAIT


def quench_lava(seen: Seen) -> Act:
    return "water", *most(seen["lava"])


def prime_the_cloners(seen: Seen) -> Act:
    """Water above the cloner of a tank that has none."""
    for name in ("tank_a", "tank_b", "tank_c"):
        if not (seen[name] & seen["water"]).any():
            row, column = middle(seen[name] & seen["cloner"])
            return "water", row - 4, column
    return WAIT


WITNESSES: dict[str, Callable[[Seen], Act]] = {
    player.__name__.replace("_", "-"): player
    for player in (
        *(burn_the_weeds, dig_a_channel, ice_bridge, build_an_arch, blow_up_the_heap, greenhouses),
        *(keep_ice, sort_sand_and_stone, herd_gas, firewall, quench_lava, prime_the_cloners),
    )
}
"""Who solves which task."""
