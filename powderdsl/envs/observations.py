"""Observations of worlds, of several kinds: each has a Gymnasium space and a function on tensors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from gymnasium.spaces import Box
from torch import Tensor

from powderdsl.model.state import property_values
from powderdsl.simulation.observe import Observer
from powderdsl.simulation.simulator import Simulator, World
from powderdsl.system.settings import check_choice
from powderdsl.worlds.raster import Size

KINDS = ("ids", "compact", "matrix", "rgb")


@dataclass(frozen=True)
class Observation:
    """One kind of observation of worlds of one ruleset and size. Channels come first, except in pictures.

    ``ids``: uint8 [1, H, W], element ids. ``compact``: uint8 [C, H, W], everything that lasts from step to step, as
    `Observer.compact` codes it. ``matrix``: float32 [C, H, W], as the ruleset's `matrix:` names its channels (the
    paper's 20). ``rgb``: uint8 [H, W, 3].
    """

    kind: str
    space: Box
    """Of one world."""
    channels: tuple[str, ...]
    """The names of the channels."""

    def of(self, world: World) -> Tensor:
        """The observations of a batch, in memory of their own: [B, *space.shape]."""
        shape, dtype = (len(world), *self.space.shape), getattr(torch, self.space.dtype.name)
        out = torch.empty(shape, dtype=dtype, device=world.seed.device)
        if self.kind == "ids":
            world.read("element", out[:, 0])
        else:
            getattr(world, self.kind)(out)
        return out


def channels_of(kind: str, observer: Observer) -> tuple[str, ...]:
    """The names of the channels of a kind of observation. Raises ValueError for an unknown kind."""
    check_choice("observation", kind, KINDS)
    if kind in ("ids", "rgb"):
        return ("element",) if kind == "ids" else ("red", "green", "blue")
    return observer.compact_names if kind == "compact" else observer.matrix_names


def observation_of(kind: str, simulator: Simulator, size: Size) -> Observation:
    """The observation of a kind. Raises ValueError for an unknown kind."""
    observer, ruleset = simulator.observer, simulator.ruleset
    channels = channels_of(kind, observer)
    shape = (*size, 3) if kind == "rgb" else (len(channels), *size)
    if kind != "matrix":
        # Bytes, 0..255 whatever occurs: what Stable-Baselines3 takes for pictures, and stores as such.
        return Observation(kind, Box(0, 255, shape, np.uint8), channels)
    bounds = [abs(bound) for slot in observer.slots.values() for bound in (slot.kind.lo, slot.kind.hi)]
    bounds += [max(map(abs, property_values(ruleset, prop.name))) for prop in ruleset.properties]
    limit = max(ruleset.slots, *bounds)
    return Observation(kind, Box(-limit, limit, shape, np.float32), channels)
