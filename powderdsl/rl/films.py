"""Films of episodes: worlds side by side, with regions, what the agent does, and the return so far."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from powderdsl.envs.acting import Policy
from powderdsl.rl.evaluation import Played, play
from powderdsl.simulation.draw import (
    OUTLINES,
    contact_sheet,
    outline,
    palette,
    ramps,
    rgb,
    scale,
    shown_fields,
    tints,
)
from powderdsl.simulation.simulator import World
from powderdsl.tasks.episodes import Episodes, TaskProgram
from powderdsl.tasks.players import ExpertPlayer
from powderdsl.tasks.task import BLOW, Task

LINE = 14
"""Pixels below each world, for the return."""

HAND = (0, 0, 0)
INK = (235, 235, 235)
PAPER = (30, 30, 30)


@dataclass(frozen=True)
class FilmScene:
    """All worlds between two steps: `ids` uint8 [B, H, W]; `fields` [B, H, W] or of vectors [B, 2, H, W], those that
    pictures show; `actions` int64 [B, 5] or None before the first and where nobody acts; `returns`
    float64 [B] before them; `over` bool [B]."""

    ids: NDArray[np.uint8]
    fields: dict[str, NDArray[Any]]
    actions: Tensor | None
    returns: Tensor
    over: Tensor


class FilmRecorder:
    """Keeps the scenes of `play`."""

    def __init__(self, count: int) -> None:
        self.regions: dict[str, NDArray[np.bool_]] = {}
        self.scenes: list[FilmScene] = []
        self._pending: list[tuple[Any, Any]] = []
        self._returns = torch.zeros(count, dtype=torch.float64)
        self._over = torch.zeros(count, dtype=torch.bool)

    def begun(self, episodes: Episodes) -> None:
        """The worlds at their start."""
        self.regions = {name: value.cpu().numpy() for name, value in episodes.regions.items()}
        self.seen(episodes.world)
        self.acted(None, self._returns, self._over)

    def seen(self, world: World) -> None:
        """The worlds after an action, or a step."""
        names = shown_fields(world.sim.ruleset)
        fields = {name: world[name].cpu().numpy().copy() for name in names}
        self._pending.append((world.ids.cpu().numpy().copy(), fields))

    def acted(self, actions: Tensor | None, returns: Tensor, over: Tensor) -> None:
        """Assign the worlds seen since the last call to these actions; the last of them shows the new returns."""
        before, after = (self._returns, self._over), (returns.cpu().clone(), over.cpu().clone())
        for number, seen in enumerate(self._pending, 1):
            now = after if number == len(self._pending) else before
            self.scenes.append(FilmScene(*seen, actions, *now))
        self._pending.clear()
        self._returns, self._over = after


def film(
    program: TaskProgram,
    policy: Policy | ExpertPlayer | None,
    worlds: Tensor,
    *,
    observation: str = "ids",
    seed: int = 0,
    factor: int = 4,
) -> tuple[Played, Iterator[NDArray[np.uint8]]]:
    """Play worlds, int64 [n], as `rl.evaluation.play` does; the results, and the pictures, uint8 [H', W', 3].

    There is a picture of the start, and one after each action and each step, free steps included. Worlds whose
    episode is over no longer change.
    """
    recorder = FilmRecorder(len(worlds))
    played = play(
        program,
        policy,
        worlds,
        observation=observation,
        seed=seed,
        begun=recorder.begun,
        seen=recorder.seen,
        acted=recorder.acted,
    )
    return played, _pictures(program.task, recorder, factor)


def _pictures(task: Task, recorder: FilmRecorder, factor: int) -> Iterator[NDArray[np.uint8]]:
    colors, font = palette(task.ruleset.elements), ImageFont.load_default()
    still: dict[int, NDArray[np.uint8]] = {}
    columns = min(4, len(recorder.scenes[0].ids))
    for scene in recorder.scenes:
        tiles = []
        for world in range(len(scene.ids)):
            tile = still.get(world)
            if tile is None:
                tile = _tile(task, recorder, scene, world, colors, factor, font)
                if scene.over[world]:
                    still[world] = tile
            tiles.append(tile)
        yield contact_sheet(tiles, columns=columns)


def _tile(
    task: Task, recorder: FilmRecorder, scene: FilmScene, world: int, colors: Any, factor: int, font: Any
) -> NDArray[np.uint8]:
    """One world, uint8 [H·factor + LINE, W·factor, 3]."""
    fields = {name: values[world] for name, values in scene.fields.items()}
    ramped, tinted = ramps(task.ruleset.elements), tints(task.ruleset.fields)
    picture = np.array(
        scale(rgb(scene.ids[world], colors, ramps=ramped, tints=tinted, fields=fields), factor)
    )
    for number, masks in enumerate(recorder.regions.values()):
        outline(picture, masks[world % len(masks)], factor, OUTLINES[number % len(OUTLINES)])
    words = ""
    if scene.actions is not None:
        x, y, choice, *blow = scene.actions[world].tolist()
        words = _words(task, choice, blow)
        if words:
            outline(picture, _block(task, y, x), factor, HAND)
    image = Image.new("RGB", (picture.shape[1], picture.shape[0] + LINE), PAPER)
    image.paste(Image.fromarray(picture), (0, 0))
    mark = "  over" if scene.over[world] else f"  {words}"
    text = f"{float(scene.returns[world]):.2f}{mark}"
    ImageDraw.Draw(image).text((2, picture.shape[0] + 1), text, fill=INK, font=font)
    return np.array(image)


def _block(task: Task, row: int, column: int) -> NDArray[np.bool_]:
    """The cells that an action at a bin changes: bool [H, W]."""
    lines = []
    for axis, (place, side) in enumerate(zip((row, column), task.size, strict=True)):
        first = task.agent.first_line(axis, place, side)
        lines.append((np.arange(side) >= first) & (np.arange(side) < first + task.agent.brush[axis]))
    return lines[0][:, None] & lines[1]


def _words(task: Task, choice: int, blow: list[int]) -> str:
    """An action in a word or two; an empty string if it changes nothing."""
    number = task.agent.choices[choice]
    if number >= 0:
        return next(one.name for one in task.ruleset.elements if one.id == number)
    if number != BLOW:
        return ""
    parts = ("left", "", "right")[blow[0]], ("up", "", "down")[blow[1]]
    return "blow " + (" ".join(part for part in parts if part) or "still")
