"""The scripts that play for data: random blocks mixed with filled worlds, lines and squares. No world is looked at.

All draws are hashes of the seed, the episode and the place in it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from powderdsl.ogbench.draws import keyed
from powderdsl.ogbench.levels import Level

Numbers = NDArray[np.int64]
Place = tuple[int, int]

RANDOM = 0.5
"""The chance that a random action comes before the next one of the current script."""

SCRIPT_DRAWS = 16
"""Draws for one script."""

VALIDATION = 1 << 31
"""The number of the first validation episode; training episodes are numbered from 0."""


def play(level: Level, seed: int, episodes: Numbers, count: int) -> NDArray[np.int16]:
    """The first `count` whole actions of episodes, by their numbers below 2³², int64 [n]: (element, x, y), int16 [n, count, 3]."""
    rows = np.repeat(episodes, count), np.tile(np.arange(count), len(episodes))
    drawn = keyed((np.full(len(rows[0]), seed), *rows), "ogbench play", 4).reshape(len(episodes), count, 4)
    choices = np.array([level.choices(stage) for stage in range(3)])
    found = (drawn[:, :, 1:] * choices).astype(np.int16)
    for number, episode in enumerate(episodes):
        script = scripted(level, seed, int(episode))
        for at in np.flatnonzero(drawn[number, :, 0] >= RANDOM):
            found[number, at] = next(script)
    return found


def scripted(level: Level, seed: int, episode: int) -> Iterator[tuple[int, int, int]]:
    """The scripts of an episode without end, one after the other: (element, x, y)."""
    number = 0
    while True:
        drawn = keyed(([seed], [episode], [number]), "ogbench script", SCRIPT_DRAWS)[0].tolist()
        element = int(drawn[1] * len(level.elements))
        for x, y in _script(drawn[0])(level.places, drawn[2:]):
            yield element, x, y
        number += 1


def _script(drawn: float) -> Callable[[int, list[float]], list[Place]]:
    """Fill in one of seven cases, a line in three, a square in three."""
    return (_fill, *[_line] * 3, *[_square] * 3)[int(drawn * 7)]


def _fill(places: int, drawn: list[float]) -> list[Place]:
    """All places, row by row; mirrored in x, in y, and with x and y exchanged, each with probability ½."""
    mirror_x, mirror_y, exchange = (one < 0.5 for one in drawn[:3])
    last = places - 1
    found = [
        (last - x if mirror_x else x, last - y if mirror_y else y)
        for y in range(places)
        for x in range(places)
    ]
    return [(y, x) for x, y in found] if exchange else found


def _line(places: int, drawn: list[float]) -> list[Place]:
    """A row, or a column, from its beginning."""
    across = int(drawn[0] * places)
    return [(across, along) if drawn[1] < 0.5 else (along, across) for along in range(places)]


def _square(places: int, drawn: list[float]) -> list[Place]:
    """The four sides of a square in any order, each in either direction; corners belong to two sides."""
    length = 1 + int(drawn[0] * (places - 1))
    left, top = (int(one * (places - length)) for one in drawn[1:3])
    right, bottom = left + length, top + length
    sides = [
        [(x, top) for x in range(left, right + 1)],
        [(x, bottom) for x in range(left, right + 1)],
        [(left, y) for y in range(top, bottom + 1)],
        [(right, y) for y in range(top, bottom + 1)],
    ]
    turned = [side[::-1] if one < 0.5 else side for side, one in zip(sides, drawn[3:7], strict=True)]
    return [place for at in np.argsort(drawn[7:11], kind="stable") for place in turned[at]]
