"""Feature extractors for Stable-Baselines3: the paper's network or a small one, on channels unpacked on the device."""

from __future__ import annotations

from typing import Any

import torch
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import Tensor, nn

from powderdsl.envs.tensor_env import TensorEnv

FEWEST, MOST = 8, 32
"""Bounds of the number of patches per side, which is otherwise the agent's number of bins."""

LAW_FEATURES = 16
"""Number of features that a network computes from laws."""


class Expand(nn.Module):
    """The channels of ``matrix``, float32 [B, C, H, W], from observations ``ids`` or ``compact``.

    `sources`: the observation's channel for each. `tables`: [C, 256], its value for each number there.
    """

    def __init__(self, sources: tuple[int, ...], tables: Tensor):
        super().__init__()
        self.sources, self.channels = sources, len(sources)
        self.register_buffer("tables", tables)

    def forward(self, observed: Tensor) -> Tensor:
        """Bytes, or the same numbers as floats: [B, C, H, W]."""
        batch, _, height, width = observed.shape
        out = torch.empty(batch, self.channels, height, width, device=observed.device)
        tables, numbers = self.get_buffer("tables"), observed.int().movedim(1, 0).flatten(1)
        for channel, source in enumerate(self.sources):
            values = tables[channel].index_select(0, numbers[source])
            out[:, channel] = values.view(batch, height, width)
        return out


class MatrixPatches(nn.Module):
    """From `matrix` observations, float32 [B, C, H, W], to [B, C, rows, columns]: the mean of each channel in each patch.

    It has no parameters, so it needs no gradient.
    """

    def __init__(self, channels: int, size: tuple[int, int], patches: tuple[int, int]):
        super().__init__()
        self.channels, self.patches = channels, patches
        self.places = [torch.arange(side) * count // side for side, count in zip(size, patches, strict=True)]
        """The row (and column) of patches that contains each row (and column) of cells."""
        shares = [
            nn.functional.one_hot(places, count).float()
            for places, count in zip(self.places, patches, strict=True)
        ]
        rows, columns = (share / share.sum(0) for share in shares)
        self.register_buffer("rows", rows.T.contiguous())
        self.register_buffer("columns", columns)

    def forward(self, observed: Tensor) -> Tensor:
        return self.get_buffer("rows") @ observed @ self.get_buffer("columns")


class Patches(MatrixPatches):
    """From bytes uint8 [B, C, H, W] to float32 [B, E + C − 1, rows, columns]: the share of each element in each patch,
    and the means of all other channels.

    Args:
        elements: number of element ids. size: rows and columns of worlds. patches: rows and columns of patches.
        values: [C, 256], the value of each byte of each channel; the first channel's are not used.
    """

    def __init__(self, elements: int, size: tuple[int, int], patches: tuple[int, int], values: Tensor):
        super().__init__(elements + len(values) - 1, size, patches)
        self.elements = elements
        first = (self.places[0][:, None] * patches[1] + self.places[1]) * elements
        self.register_buffer("first", first.to(torch.int32))
        rows, columns = self.get_buffer("rows").T, self.get_buffer("columns")
        share = rows.amax(0)[:, None] * columns.amax(0)  # one cell's share of its patch
        self.register_buffer("share", share[..., None].contiguous())
        wide = share[..., None].repeat(1, 1, elements)  # in the shape of counts, which is faster
        self.register_buffer("shares", wide, persistent=False)
        self.register_buffer("values", values.float().cpu())
        self.one_channel = len(values) == 1 < patches[0]
        """True if `count` returns the whole observation in another shape."""

    def count(self, observed: Tensor) -> Tensor:
        """The number of cells of each element in each patch, int64 [B, rows, columns, E]."""
        batch, count = len(observed), self.patches[0] * self.patches[1] * self.elements
        start = torch.arange(batch, dtype=torch.int32, device=observed.device) * count
        number = observed[:, 0].int().add_(self.get_buffer("first")).add_(start[:, None, None])
        counts = torch.bincount(number.flatten(), minlength=batch * count)
        return counts.view(batch, *self.patches, self.elements)

    def forward(self, observed: Tensor) -> Tensor:
        """Bytes, or the same numbers as floats; with a single channel, also results of `count`."""
        counts = observed if self.one_channel and observed.shape[1] > 1 else self.count(observed)
        parts = [(counts * self.get_buffer("shares")).permute(0, 3, 1, 2)]  # channels last in memory
        values = self.get_buffer("values")
        for channel in range(1, len(values)):
            cells = values[channel].index_select(0, observed[:, channel].int().flatten())
            parts.append(super().forward(cells.view(len(observed), 1, *observed.shape[2:])))
        return torch.cat(parts, 1) if len(parts) > 1 else parts[0]


class LawPatches(nn.Module):
    """From `laws` observations to patches of the elements, and features of the laws, which are the same in every patch.

    Args:
        see: maps element ids to patches.
        laws: bytes of laws.
    """

    def __init__(self, see: Patches, laws: int):
        super().__init__()
        self.see, self.laws, self.read = see, laws, nn.Linear(laws, LAW_FEATURES)
        self.channels = see.channels + LAW_FEATURES

    def forward(self, observed: Tensor) -> Tensor:
        patches = self.see(observed[:, :1])
        laws = observed[:, 1].flatten(1)[:, : self.laws].float() / 127.5 - 1
        features = self.read(laws).relu()[..., None, None].expand(-1, -1, *patches.shape[2:])
        return torch.cat([patches, features], 1)


class Frames(nn.Module):
    """The features that `see` extracts from each of several stacked observations, oldest first: [B, frames · channels, …]."""

    def __init__(self, see: Any, frames: int):
        super().__init__()
        self.see, self.frames = see, frames
        self.channels: int = see.channels * frames

    def forward(self, observed: Tensor) -> Tensor:
        seen: Tensor = self.see(observed.reshape(-1, observed.shape[1] // self.frames, *observed.shape[2:]))
        return seen.reshape(len(observed), self.channels, *seen.shape[2:])


class Features(BaseFeaturesExtractor):
    """`see`, two convolutions, and a fully connected layer.

    Args:
        channels: channels from `see`. widths: features of the two convolutions. strides: their (kernel, stride,
            padding).
    """

    def __init__(
        self,
        observation_space: spaces.Box,
        features_dim: int,
        see: nn.Module,
        channels: int,
        widths: Any,
        shapes: Any,
    ):
        super().__init__(observation_space, features_dim)
        first, second = nn.Conv2d(channels, widths[0], *shapes[0]), nn.Conv2d(*widths, *shapes[1])
        convolutions = nn.Sequential(see, first, nn.ReLU(True), second, nn.Flatten(), nn.ReLU(True))
        with torch.no_grad():
            width = convolutions(torch.zeros(1, *observation_space.shape)).shape[1]
        self.layers = nn.Sequential(convolutions, nn.Linear(width, features_dim), nn.ReLU())

    def forward(self, observed: Tensor) -> Tensor:
        """Features float32 [B, features_dim]."""
        return self.layers(observed)


def patches_of(env: TensorEnv, patches: tuple[int, int], frames: int = 1) -> Any:
    """A module from stacked observations of an environment to patches [B, its `channels`, rows, columns].

    Raises ValueError for observations that are pictures.
    """
    _refuse_pictures(env)
    see: Any
    count, size = len(env.observation.channels), env.task.size
    if env.observation.kind == "matrix":
        see = MatrixPatches(count, size, patches)
    else:
        values = env.simulator.observer.compact_values[: 1 if env.observation.kind == "laws" else count]
        see = Patches(env.simulator.ruleset.slots, size, patches, values)
        if env.observation.kind == "laws":
            see = LawPatches(see, len(env.program.laws))
    return see if frames == 1 else Frames(see, frames)


def paper_policy(env: TensorEnv, features_dim: int = 256, frames: int = 1) -> dict[str, Any]:
    """`policy_kwargs` of ``CnnPolicy`` for the observations of an environment: the paper's network.

    Two convolutions of kernel 3 with 32 and 64 features, and a fully connected layer; the policy's own layer is the
    second. The paper does not state the stride; with 2, the fully connected layer has a sixteenth of the weights.

    Args:
        frames: number of stacked observations, as in `VecFrameStack` of Stable-Baselines3.

    Raises:
        ValueError: for observations that are pictures.
    """
    _refuse_pictures(env)
    see: nn.Module = nn.Identity()
    channels = len(env.observation.channels) * frames
    if env.observation.kind != "matrix":
        sources, tables = env.simulator.observer.matrix_tables
        every = env.observation.kind == "compact"
        shown = [channel for channel, source in enumerate(sources) if every or source == 0]
        see = Expand(tuple(sources[channel] for channel in shown), tables[shown].cpu())
        see, channels = (see if frames == 1 else Frames(see, frames)), len(shown) * frames
    return _policy(features_dim, see=see, channels=channels, widths=(32, 64), shapes=((3, 2, 0), (3, 2, 0)))


def small_policy(env: TensorEnv, features_dim: int = 128, frames: int = 1) -> dict[str, Any]:
    """`policy_kwargs` of ``CnnPolicy`` for the observations of an environment: a small network for CPUs.

    It counts the elements in each patch of cells, and runs convolutions on the counts. `frames`: see `paper_policy`.
    Raises ValueError for observations that are pictures.
    """
    rows, columns = (
        min(side, max(FEWEST, min(MOST, count)))
        for side, count in zip(env.task.size, env.task.agent.bins, strict=True)
    )
    see = patches_of(env, (rows, columns), frames)
    return _policy(
        features_dim, see=see, channels=see.channels, widths=(32, 32), shapes=((3, 2, 1), (3, 1, 1))
    )


def _refuse_pictures(env: TensorEnv) -> None:
    if env.observation.kind == "rgb":
        raise ValueError("this network does not take pictures: use the policy's own")


def _policy(features_dim: int, **how: Any) -> dict[str, Any]:
    return {
        "features_extractor_class": Features,
        "features_extractor_kwargs": {"features_dim": features_dim, **how},
        "net_arch": [features_dim],
        "normalize_images": False,
    }
