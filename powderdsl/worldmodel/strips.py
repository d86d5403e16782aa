"""A row of pictures for each test: start, end, prediction and its errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from powderdsl.model.types import Ruleset
from powderdsl.simulation.draw import contact_sheet, palette, rgb, scale
from powderdsl.worldmodel.recordings import Recording
from powderdsl.worldmodel.scores import Network
from powderdsl.worldmodel.worlds import TaskWorlds, unseen_seeds

RIGHT, WRONG = (235, 235, 235), (200, 30, 30)
"""Colors of cells that were predicted correctly, and of others."""


@dataclass(frozen=True)
class Strip:
    """One test: ids uint8 [H, W] at the start, at the end, and as predicted."""

    name: str
    start: NDArray[np.uint8]
    truth: NDArray[np.uint8]
    predicted: NDArray[np.uint8]

    @property
    def wrong(self) -> int:
        """The number of cells that were predicted wrongly."""
        return int((self.truth != self.predicted).sum())


@torch.no_grad()
def strips(predict: Network, worlds: TaskWorlds, *, step: int, times: int = 1, after: int = 0) -> list[Strip]:
    """A strip for each variant of a split.

    Args:
        step: steps that the network was trained to predict. times: how often it is applied to what it predicted.
        after: steps that worlds have run before.
    """
    seeds = unseen_seeds(1, len(worlds.names)).to(worlds.device)
    world = worlds.later(worlds.start(seeds), after)
    predicted = world.ids
    for _ in range(times):
        predicted = predict(predicted).argmax(1).to(torch.uint8)
    truth = worlds.later(world, step * times).ids
    three = [ids.cpu().numpy() for ids in (world.ids, truth, predicted)]
    return [Strip(name, *(ids[n] for ids in three)) for n, name in enumerate(worlds.names)]


@torch.no_grad()
def recorded_strips(predict: Network, recording: Recording, count: int = 8) -> list[Strip]:
    """Strips of transitions of test worlds, evenly spread."""
    found: list[Strip] = []
    for inputs, ends in recording.spread(recording.parts[2], count):
        predicted = predict(inputs).argmax(1).to(torch.uint8)
        for three in zip(inputs[:, 0], ends, predicted, strict=True):
            found.append(Strip(f"transition {len(found) + 1}", *(ids.cpu().numpy() for ids in three)))
    return found


def sheet(found: list[Strip], rules: Ruleset, *, factor: int = 2) -> NDArray[np.uint8]:
    """Strips one below the other, uint8 [H', W', 3]: start, truth, prediction, error. A cell has `factor`² pixels.

    Colors do not follow fields here: networks predict elements alone.
    """
    known = palette(rules.elements)
    colors = np.zeros((256, 3), dtype=np.uint8)
    colors[: len(known)] = known  # a network may predict slots that the rules leave vacant: black
    pictures = []
    for strip in found:
        pictures += [rgb(ids, colors) for ids in (strip.start, strip.truth, strip.predicted)]
        wrong = (strip.truth != strip.predicted)[..., None]
        pictures.append(np.where(wrong, *(np.array(color, dtype=np.uint8) for color in (WRONG, RIGHT))))
    return contact_sheet([scale(picture, factor) for picture in pictures], columns=4, gap=4)
