"""Films of episodes: worlds side by side, with regions, what the agent does, and the return so far."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

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
from powderdsl.tasks.tensors.actions import cells_of

LINE = 14
"""Pixels below each world, for the return."""

HAND = (0, 0, 0)
INK = (235, 235, 235)
PAPER = (30, 30, 30)


class FilmScene(NamedTuple):
    """All worlds between two steps: `ids` uint8 [B, H, W]; `fields` [B, H, W] or of vectors [B, 2, H, W], those that
    pictures show; `actions` int64 [B, 5] or None before the first and where nobody acts; `returns`
    float64 [B] before them; `over` bool [B]."""

    ids: NDArray[np.uint8]
    fields: dict[str, NDArray[Any]]
    actions: Tensor | None
    returns: Tensor
    over: Tensor


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
    recorder = Film(program.task, len(worlds), factor)
    played = play(program, policy, worlds, observation=observation, seed=seed, recorder=recorder)
    return played, recorder.pictures()


class Film:
    """Keeps the scenes of `play`, and draws them with cells of `factor`² pixels."""

    def __init__(self, task: Task, count: int, factor: int) -> None:
        self.task, self.factor = task, factor
        self.regions: dict[str, NDArray[np.bool_]] = {}
        self.scenes: list[FilmScene] = []
        self._pending: list[tuple[Any, Any]] = []
        self._returns = torch.zeros(count, dtype=torch.float64)
        self._over = torch.zeros(count, dtype=torch.bool)
        self._fields = shown_fields(task.ruleset)
        self._colors, self._font = palette(task.ruleset.elements), ImageFont.load_default()
        self._looks: Any = {"ramps": ramps(task.ruleset.elements), "tints": tints(task.ruleset.fields)}

    def begin(self, episodes: Episodes) -> None:
        """The worlds at their start."""
        self.regions = {name: value.cpu().numpy() for name, value in episodes.regions.items()}
        self.see(episodes.world)
        self.act(None, self._returns, self._over)

    def see(self, world: World) -> None:
        """The worlds after an action, or a step."""
        fields = {name: world[name].cpu().numpy().copy() for name in self._fields}
        self._pending.append((world.ids.cpu().numpy().copy(), fields))

    def act(self, actions: Tensor | None, returns: Tensor, over: Tensor) -> None:
        """Assign the worlds seen since the last call to these actions; the last of them shows the new returns."""
        *earlier, last = self._pending
        self.scenes += [FilmScene(*seen, actions, self._returns, self._over) for seen in earlier]
        self._pending, self._returns, self._over = [], returns.cpu().clone(), over.cpu().clone()
        self.scenes.append(FilmScene(*last, actions, self._returns, self._over))

    def pictures(self) -> Iterator[NDArray[np.uint8]]:
        """A picture of each scene, all worlds side by side."""
        over: dict[int, NDArray[np.uint8]] = {}
        columns = min(4, len(self._over))
        for scene in self.scenes:
            tiles = []
            for world in range(len(scene.ids)):
                tile = over[world] if world in over else self._tile(scene, world)
                if scene.over[world]:
                    over[world] = tile
                tiles.append(tile)
            yield contact_sheet(tiles, columns=columns)

    def _tile(self, scene: FilmScene, world: int) -> NDArray[np.uint8]:
        """One world, uint8 [H·factor + LINE, W·factor, 3]."""
        task, factor = self.task, self.factor
        fields = {name: values[world] for name, values in scene.fields.items()}
        picture = np.array(scale(rgb(scene.ids[world], self._colors, fields=fields, **self._looks), factor))
        for number, masks in enumerate(self.regions.values()):
            outline(picture, masks[world % len(masks)], factor, OUTLINES[number % len(OUTLINES)])
        words = ""
        if scene.actions is not None:
            action = scene.actions[world].cpu()
            choice, *blow = action[2:].tolist()
            words = _words(task, choice, blow)
            if words:
                block = cells_of(task.agent, task.size, action[1:2], action[:1])[0]
                outline(picture, block.numpy(), factor, HAND)
        image = Image.new("RGB", (picture.shape[1], picture.shape[0] + LINE), PAPER)
        image.paste(Image.fromarray(picture), (0, 0))
        mark = "over" if scene.over[world] else words
        text = f"{float(scene.returns[world]):.2f}  {mark}"
        ImageDraw.Draw(image).text((2, picture.shape[0] + 1), text, fill=INK, font=self._font)
        return np.array(image)


def _words(task: Task, choice: int, blow: list[int]) -> str:
    """An action in a word or two; an empty string if it changes nothing."""
    number = task.agent.choices[choice]
    if number >= 0:
        return next(one.name for one in task.ruleset.elements if one.id == number)
    if number != BLOW:
        return ""
    parts = ("left", "", "right")[blow[0]], ("up", "", "down")[blow[1]]
    return "blow " + (" ".join(part for part in parts if part) or "still")
