"""Collecting datasets of scripted play in OGBench's file format. Every byte depends only on the options.

Scripts mix random blocks with filled worlds, lines and squares, without observing worlds. Their draws are hashes of the
seed, the episode and the position in it. Episodes are played in parts, whose worlds are stored in files next to the
dataset until it is complete, so that an interrupted collection can be resumed.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from powderdsl.experiments.runs import lock_folder
from powderdsl.ogbench.episodes import LevelProgram, keyed
from powderdsl.ogbench.levels import FAMILY, VERSION, Level
from powderdsl.system.archives import BadArchive, Parts, open_archive, write_archive
from powderdsl.system.reading import read_json
from powderdsl.system.settings import fingerprint
from powderdsl.system.writing import failure, replacing, write_text, writing

Array = NDArray[Any]
Numbers = NDArray[np.int64]
Place = tuple[int, int]
Frames = NDArray[np.uint8]
Progress = Callable[[float, int], None]
"""Called with the number of finished episodes, including fractions of unfinished ones, and the total number."""

RANDOM = 0.5
"""The probability of a random action before the next action of the current script."""

SCRIPT_DRAWS = 16
"""Draws for one script."""

VALIDATION = 1 << 31
"""The number of the first validation episode; training episodes are numbered from 0."""

PART = 64
"""Episodes of a part."""

WRITTEN = 8
"""Number of episodes whose rows are in memory at once."""

COMPRESSION = 1
"""zlib's level: 6, its default, takes three times as long and saves little."""

PLAYED = 0.6
"""The share of an episode's work that is playing; the rest is compressing."""


@dataclass(frozen=True)
class FileRecipe:
    """Everything that determines the bytes of one file: `count` episodes of `rows` rows from number `first`."""

    level: str
    rules: str
    seed: int
    first: int
    count: int
    rows: int

    @property
    def painted(self) -> int:
        """Number of whole actions of an episode, which change its world."""
        return (self.rows - 1) // 3

    @property
    def parts(self) -> list[Numbers]:
        """The numbers of the episodes of each part."""
        every = np.arange(self.first, self.first + self.count)
        return [every[at : at + PART] for at in range(0, self.count, PART)]

    def actions(self, level: Level, numbers: Numbers) -> NDArray[np.int16]:
        """The whole actions of some episodes: int16 [count, n, 3]; the rows may end within the last one."""
        return play(level, self.seed, numbers, -(-self.rows // 3))


def collect(
    program: LevelProgram,
    folder: str | Path,
    *,
    episodes: int | None = None,
    validation: int | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> list[Path]:
    """Write ``powderworld-LEVEL-play-v0.npz`` and ``…-val.npz`` to a folder; existing files are kept.

    Args:
        episodes, validation: numbers of episodes; by default the level's, or a tenth for validation if only `episodes`
            is given.
        seed: determines the actions of each episode, and thereby its worlds.

    Returns:
        the files.

    Raises:
        CompileError: PD613 if something cannot be written, PD622 if another process writes there. ValueError: other
            data of the same name exists.
    """
    level, place = program.level, Path(folder)
    train = level.play.episodes if episodes is None else episodes
    few = validation
    if few is None:
        few = level.play.validation if episodes is None else -(-train // 10)
    rules = fingerprint(program.simulator.ruleset)
    name = f"{FAMILY}-{level.name}-play-{VERSION}"
    recipes = {
        place / f"{name}.npz": FileRecipe(level.name, rules, seed, 0, train, level.play.steps),
        place / f"{name}-val.npz": FileRecipe(level.name, rules, seed, VALIDATION, few, level.play.steps),
    }
    with writing(place):
        place.mkdir(parents=True, exist_ok=True)
    done = 0.0

    def report(more: float) -> None:
        nonlocal done
        done += more
        if progress is not None:
            progress(done, train + few)

    with lock_folder(place):
        for path, recipe in recipes.items():
            _write(program, path, recipe, report)
    return list(recipes)


def _write(program: LevelProgram, path: Path, recipe: FileRecipe, report: Callable[[float], None]) -> None:
    about, parts = path.with_suffix(".json"), path.with_suffix(".parts")
    written = read_json(about)
    if written is not None and written != asdict(recipe):
        own = asdict(recipe)
        changed = next((key for key in own if written.get(key) != own[key]), "form")
        changed = {"count": "number of episodes", "rows": "number of rows"}.get(changed, changed)
        raise ValueError(
            f"{path} was collected with another {changed}: choose another folder, or remove it and {about.name}"
        )
    if path.exists():
        if written is None:
            raise ValueError(f"{path} exists, but {about.name} does not: choose another folder")
        report(recipe.count)
        return
    parts.mkdir(exist_ok=True)
    write_text(about, json.dumps(asdict(recipe), indent=2) + "\n")
    for numbers in recipe.parts:
        file = parts / f"{numbers[0]:010}.npz"
        if _read_part(file, recipe, program.level, len(numbers)) is None:
            frames = _played(program, recipe, numbers)
            with replacing(file) as temporary, temporary.open("wb") as part:
                write_archive(part, {"frames": frames}, COMPRESSION)
        report(PLAYED * len(numbers))
    rows, side = recipe.count * recipe.rows, program.level.side
    terminals = np.zeros((recipe.count, recipe.rows), dtype=np.int32)
    terminals[:, -1] = 1
    actions = (recipe.actions(program.level, numbers) for numbers in recipe.parts)
    action_rows = (part.reshape(len(part), -1)[:, : recipe.rows].astype(np.int32) for part in actions)
    arrays: dict[str, Array | Parts | str] = {
        "observations": Parts("|u1", (rows, side, side, 6), _observations(program, parts, recipe, report)),
        "actions": Parts("<i4", (rows,), action_rows),
        "terminals": terminals.reshape(-1),
    }
    with replacing(path) as temporary, temporary.open("wb") as whole:
        write_archive(whole, arrays, COMPRESSION)
    shutil.rmtree(parts, ignore_errors=True)


def _observations(
    program: LevelProgram, parts: Path, recipe: FileRecipe, report: Callable[[float], None]
) -> Iterator[Frames]:
    for numbers in recipe.parts:
        frames = _read_part(parts / f"{numbers[0]:010}.npz", recipe, program.level, len(numbers))
        if frames is None:
            raise failure("PD613", f"cannot write the dataset: {parts} was changed meanwhile")
        actions = recipe.actions(program.level, numbers)
        for at in range(0, len(numbers), WRITTEN):
            few = slice(at, at + WRITTEN)
            yield rows_of(program, frames[few], actions[few], recipe.rows)
            report((1 - PLAYED) * len(numbers[few]))


def _played(program: LevelProgram, recipe: FileRecipe, numbers: Numbers) -> Frames:
    """The worlds' pictures at the start and after each whole action: uint8 [count, painted + 1, H, W, 3]."""
    actions = recipe.actions(program.level, numbers).astype(np.int64)
    world = program.start(np.full_like(numbers, recipe.seed), numbers)
    frames = [world.rgb().cpu().numpy()]
    for number in range(recipe.painted):
        world = program.act(world, actions[:, number])
        frames.append(world.rgb().cpu().numpy())
    return np.stack(frames, 1)


def rows_of(program: LevelProgram, frames: Frames, actions: NDArray[np.int16], rows: int) -> Frames:
    """Observations before each action of episodes: uint8 [n, rows, H, W, 6]."""
    level = program.level
    frame_rows = np.zeros((len(frames), rows, level.side, level.side, 6), dtype=np.uint8)
    paints: Array = program.paints.cpu().numpy()
    chosen = paints[actions[:, :, 0]]
    first = actions[:, :, 1, None].astype(np.int64) * level.grid
    columns = np.tile(np.arange(level.side), level.side)
    inside = (columns >= first) & (columns < first + level.brush)
    pixels = frame_rows.reshape(len(frames), rows, -1, 6)
    pictures = frames.reshape(len(frames), frames.shape[1], -1, 3)
    for stage in range(3):
        at = pixels[:, stage::3]
        count = at.shape[1]
        for channel in range(3):  # one at a time, since copying rows of three bytes is slow
            at[..., channel] = pictures[:, :count, :, channel]
            if stage == 1:
                at[..., 3 + channel] = chosen[:, :count, None, channel]
            elif stage == 2:
                at[..., 3 + channel] = inside[:, :count] * chosen[:, :count, None, channel]
    return frame_rows


def _read_part(file: Path, recipe: FileRecipe, level: Level, count: int) -> Frames | None:
    """The frames of a part; None if the file is missing or damaged."""
    shape = (count, recipe.painted + 1, level.side, level.side, 3)
    try:
        with open_archive(file) as archive:
            frames = archive.read("frames")
    except (OSError, BadArchive, KeyError):
        return None
    return frames if frames.shape == shape else None


# Scripts


def play(level: Level, seed: int, episodes: Numbers, count: int) -> NDArray[np.int16]:
    """The first `count` whole actions of episodes, by their numbers below 2³², int64 [n]: (element, x, y), int16 [n, count, 3]."""
    rows = np.repeat(episodes, count), np.tile(np.arange(count), len(episodes))
    drawn = keyed((np.full(len(rows[0]), seed), *rows), "ogbench play", 4).reshape(len(episodes), count, 4)
    choices = np.array([level.choices(stage) for stage in range(3)])
    actions = (drawn[:, :, 1:] * choices).astype(np.int16)
    for number, episode in enumerate(episodes):
        script = scripted(level, seed, int(episode))
        for at in np.flatnonzero(drawn[number, :, 0] >= RANDOM):
            actions[number, at] = next(script)
    return actions


def scripted(level: Level, seed: int, episode: int) -> Iterator[tuple[int, int, int]]:
    """Endless scripts of an episode, one after another: (element, x, y)."""
    number = 0
    while True:
        drawn = keyed(([seed], [episode], [number]), "ogbench script", SCRIPT_DRAWS)[0].tolist()
        element = int(drawn[1] * len(level.elements))
        script = SCRIPTS[int(drawn[0] * len(SCRIPTS))]
        for x, y in script(level.places, drawn[2:]):
            yield element, x, y
        number += 1


def _fill(places: int, drawn: list[float]) -> list[Place]:
    """All places, row by row; with probability ½ each, mirrored in x, mirrored in y, and with x and y exchanged."""
    mirror_x, mirror_y, exchange = (number < 0.5 for number in drawn[:3])
    last = places - 1
    corners = [
        (last - x if mirror_x else x, last - y if mirror_y else y)
        for y in range(places)
        for x in range(places)
    ]
    return [(y, x) for x, y in corners] if exchange else corners


def _line(places: int, drawn: list[float]) -> list[Place]:
    """A row, or a column, from its beginning."""
    across = int(drawn[0] * places)
    return [(across, along) if drawn[1] < 0.5 else (along, across) for along in range(places)]


def _square(places: int, drawn: list[float]) -> list[Place]:
    """The four sides of a square in any order, each in either direction; corners belong to two sides."""
    length = 1 + int(drawn[0] * (places - 1))
    left, top = (int(number * (places - length)) for number in drawn[1:3])
    right, bottom = left + length, top + length
    sides = [
        [(x, top) for x in range(left, right + 1)],
        [(x, bottom) for x in range(left, right + 1)],
        [(left, y) for y in range(top, bottom + 1)],
        [(right, y) for y in range(top, bottom + 1)],
    ]
    turned = [side[::-1] if number < 0.5 else side for side, number in zip(sides, drawn[3:7], strict=True)]
    return [place for at in np.argsort(drawn[7:11], kind="stable") for place in turned[at]]


SCRIPTS = (_fill, *[_line] * 3, *[_square] * 3)
"""Scripts, repeated by their relative frequency."""
