"""Feature extractors for Stable-Baselines3: bytes become channels on the device, then the paper's network or a small one."""

from __future__ import annotations

from typing import Any

import torch
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import Tensor, nn

from powderdsl.envs.tensor_env import TensorEnv

FEWEST, MOST = 8, 32
"""Patches along a side: as many as the agent has bins, within these bounds."""


class Expand(nn.Module):
    """The channels of ``matrix``, float32 [B, C, H, W], from observations ``ids`` or ``compact``.

    Args:
        sources: the channel of the observation that each comes from. tables: [C, 256], what it is by the number there.
    """

    def __init__(self, sources: tuple[int, ...], tables: Any):
        super().__init__()
        whole = torch.as_tensor(tables, dtype=torch.float32)
        single = (whole != 0).sum(1) == 1
        # 1 where one element is, else 0.
        of_one = single & (whole.amax(1) == 1) & (torch.tensor(sources) == 0)
        flags = [*of_one.tolist(), False]
        first = flags.index(True) if True in flags else 0
        self.flags = slice(first, flags.index(False, first))  # in a row: then they are written at once
        self.channels = len(sources)
        rest = [channel for channel in range(self.channels) if not first <= channel < self.flags.stop]
        self.others = [(channel, sources[channel]) for channel in rest]
        self.register_buffer("tables", whole)
        self.register_buffer("elements", whole[self.flags].argmax(1).float()[:, None, None])

    def forward(self, observed: Tensor) -> Tensor:
        """Bytes, or the same numbers as floats: [B, C, H, W]."""
        batch, _, height, width = observed.shape
        out = torch.empty(batch, self.channels, height, width, device=observed.device)
        out[:, self.flags] = observed[:, :1].float() == self.get_buffer("elements")
        tables, numbers = self.get_buffer("tables"), observed.int()
        for channel, source in self.others:
            found = tables[channel].index_select(0, numbers[:, source].flatten())
            out[:, channel] = found.view(batch, height, width)
        return out


class MatrixPatches(nn.Module):
    """From `matrix` observations, float32 [B, C, H, W], to [B, C, rows, columns]: the mean of each channel in each patch.

    Nothing in here is learned, so no gradient passes through.
    """

    def __init__(self, channels: int, size: tuple[int, int], patches: tuple[int, int]):
        super().__init__()
        self.channels, self.patches = channels, patches
        self.places = [torch.arange(side) * count // side for side, count in zip(size, patches, strict=True)]
        """The row (and column) of patches that each row (and column) of cells lies in."""
        shares = [
            nn.functional.one_hot(one, count).float() for one, count in zip(self.places, patches, strict=True)
        ]
        rows, columns = (one / one.sum(0) for one in shares)
        self.register_buffer("rows", rows.T.contiguous())
        self.register_buffer("columns", columns)

    def forward(self, observed: Tensor) -> Tensor:
        means: Tensor = self.get_buffer("rows") @ observed @ self.get_buffer("columns")
        return means


class Patches(MatrixPatches):
    """From bytes uint8 [B, C, H, W] to float32 [B, E + C − 1, rows, columns]: how much of each patch each element
    takes, and the means of all other channels.

    Args:
        elements: how many element ids there are. size: rows and columns of worlds. patches: of patches.
        values: [C, 256], what the bytes of each channel stand for; those of the first are not used.
    """

    def __init__(self, elements: int, size: tuple[int, int], patches: tuple[int, int], values: Any):
        super().__init__(elements + len(values) - 1, size, patches)
        self.elements = elements
        first = (self.places[0][:, None] * patches[1] + self.places[1]) * elements
        self.register_buffer("first", first.to(torch.int32))
        rows, columns = self.get_buffer("rows").T, self.get_buffer("columns")
        share = rows.amax(0)[:, None] * columns.amax(0)  # one cell's part of its patch
        self.register_buffer("share", share[..., None].contiguous())
        self.register_buffer("values", torch.as_tensor(values, dtype=torch.float32))

    def forward(self, observed: Tensor) -> Tensor:
        batch, count = len(observed), self.patches[0] * self.patches[1] * self.elements
        start = torch.arange(batch, dtype=torch.int32, device=observed.device) * count
        number = self.get_buffer("first") + observed[:, 0].int() + start[:, None, None]
        counts = torch.bincount(number.flatten(), minlength=batch * count)
        shares = counts.view(batch, *self.patches, self.elements) * self.get_buffer("share")
        parts = [shares.permute(0, 3, 1, 2)]
        values = self.get_buffer("values")
        for channel in range(1, len(values)):
            cells = values[channel].index_select(0, observed[:, channel].int().flatten())
            parts.append(super().forward(cells.view(batch, 1, *observed.shape[2:])))
        return torch.cat(parts, 1) if len(parts) > 1 else parts[0].contiguous()


class Frames(nn.Module):
    """What `see` makes of each of several observations that are stacked, oldest first: [B, frames · channels, …]."""

    def __init__(self, see: Any, frames: int):
        super().__init__()
        self.see, self.frames = see, frames
        self.channels: int = see.channels * frames

    def forward(self, observed: Tensor) -> Tensor:
        seen: Tensor = self.see(observed.reshape(-1, observed.shape[1] // self.frames, *observed.shape[2:]))
        return seen.view(len(observed), self.channels, *seen.shape[2:])


class _Convolutions(BaseFeaturesExtractor):
    """Two convolutions on what `see` makes of observations, and a fully connected layer."""

    def __init__(
        self, space: spaces.Box, features_dim: int, see: nn.Module, first: nn.Conv2d, second: nn.Conv2d
    ):
        super().__init__(space, features_dim)
        convolutions = nn.Sequential(see, first, nn.ReLU(), second, nn.ReLU(), nn.Flatten())
        with torch.no_grad():
            width = convolutions(torch.zeros(1, *space.shape)).shape[1]
        self.layers = nn.Sequential(convolutions, nn.Linear(width, features_dim), nn.ReLU())

    def forward(self, observed: Tensor) -> Tensor:
        """Features float32 [B, features_dim]."""
        features: Tensor = self.layers(observed)
        return features


class PaperFeatures(_Convolutions):
    """Two convolutions of kernel 3 with 32 and 64 features, and a fully connected layer; the policy's own layer is the
    second. The paper does not give the stride; with 2, the fully connected layer has a sixteenth of the weights.

    Args:
        sources, tables: those of `Expand`; without them, observations are channels already.
    """

    def __init__(
        self,
        observation_space: spaces.Box,
        features_dim: int = 256,
        stride: int = 2,
        sources: tuple[int, ...] | None = None,
        tables: Any = None,
        frames: int = 1,
    ):
        see: nn.Module = nn.Identity() if sources is None else Expand(sources, tables)
        channels = observation_space.shape[0] if sources is None else len(sources) * frames
        if frames > 1 and sources is not None:
            see = Frames(see, frames)
        first, second = nn.Conv2d(channels, 32, 3, stride), nn.Conv2d(32, 64, 3, stride)
        super().__init__(observation_space, features_dim, see, first, second)


class PatchFeatures(_Convolutions):
    """Two convolutions of 32 features on patches, and a fully connected layer.

    Args:
        elements, patches, values: those of `Patches`; `values` is None for `matrix` observations.
    """

    def __init__(
        self,
        observation_space: spaces.Box,
        features_dim: int,
        elements: int,
        patches: tuple[int, int],
        values: Any = None,
        frames: int = 1,
    ):
        channels, height, width = observation_space.shape
        see = _patches(elements, channels // frames, (height, width), patches, values, frames)
        first, second = nn.Conv2d(see.channels, 32, 3, 2, 1), nn.Conv2d(32, 32, 3, 1, 1)
        super().__init__(observation_space, features_dim, see, first, second)


def _patches(
    elements: int, channels: int, size: tuple[int, int], patches: tuple[int, int], values: Any, frames: int
) -> Any:
    if values is None:
        see: Any = MatrixPatches(channels, size, patches)
    else:
        see = Patches(elements, size, patches, values)
    return see if frames == 1 else Frames(see, frames)


def patches_of(env: TensorEnv, patches: tuple[int, int], frames: int = 1) -> Any:
    """A module from stacked observations of an environment to patches [B, its `channels`, rows, columns].

    Raises:
        ValueError: for observations that are pictures.
    """
    if env.observation.kind == "rgb":
        raise ValueError("this network does not take pictures: use the policy's own")
    count = len(env.observation.channels)
    values = None if env.observation.kind == "matrix" else env.simulator.observer.compact_values[:count]
    return _patches(env.simulator.ruleset.slots, count, env.task.size, patches, values, frames)


def paper_policy(env: TensorEnv, features_dim: int = 256, stride: int = 2, frames: int = 1) -> dict[str, Any]:
    """`policy_kwargs` of ``CnnPolicy`` for the observations of an environment: the paper's network.

    Args:
        frames: how many observations are stacked, as `VecFrameStack` of Stable-Baselines3 does.

    Raises:
        ValueError: for observations that are pictures.
    """
    how: dict[str, Any] = {"stride": stride, "frames": frames}
    if env.observation.kind in ("ids", "compact"):
        sources, tables = env.simulator.observer.matrix_tables
        every = env.observation.kind == "compact"
        kept = [channel for channel, source in enumerate(sources) if every or source == 0]
        how["sources"] = tuple(sources[channel] for channel in kept)
        how["tables"] = tables[kept].tolist()
    return _policy(env, PaperFeatures, features_dim, how)


def small_policy(env: TensorEnv, features_dim: int = 128, frames: int = 1) -> dict[str, Any]:
    """`policy_kwargs` of ``CnnPolicy`` for the observations of an environment: a small network for processors.

    It counts what lies in each patch of cells, and runs convolutions on the counts. `frames`: see `paper_policy`.

    Raises:
        ValueError: for observations that are pictures.
    """
    sides = zip(env.task.size, env.task.agent.bins, strict=True)
    how: dict[str, Any] = {
        "elements": env.simulator.ruleset.slots,
        "frames": frames,
        "patches": tuple(min(side, max(FEWEST, min(MOST, count))) for side, count in sides),
    }
    if env.observation.kind != "matrix":
        values = env.simulator.observer.compact_values[: len(env.observation.channels)]
        how["values"] = values.tolist()
    return _policy(env, PatchFeatures, features_dim, how)


def _policy(
    env: TensorEnv, features: type[_Convolutions], features_dim: int, how: dict[str, Any]
) -> dict[str, Any]:
    if env.observation.kind == "rgb":
        raise ValueError("this network does not take pictures: use the policy's own")
    return {
        "features_extractor_class": features,
        "features_extractor_kwargs": {"features_dim": features_dim, **how},
        "net_arch": [features_dim],
        "normalize_images": False,
    }
