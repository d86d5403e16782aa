"""A small network for processors: what lies in each patch of cells is counted, and convolutions run on the counts."""

from __future__ import annotations

from typing import Any

import torch
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import Tensor, nn

from powderdsl.envs.tensor_env import TensorEnv

FEWEST, MOST = 8, 32
"""Patches along a side; as many as the agent has bins, within these bounds."""


class Patches(nn.Module):
    """From bytes uint8 [B, C, H, W] to float32 [B, E + C − 1, rows, columns]: how much of each patch each element
    takes, and the means of all other channels. Nothing in here is learned, so no gradient passes through.

    Args:
        elements: how many element ids there are. size: rows and columns of worlds. patches: of patches.
        values: [C, 256], what the bytes of each channel stand for; those of the first are not used.
    """

    def __init__(self, elements: int, size: tuple[int, int], patches: tuple[int, int], values: Any):
        super().__init__()
        self.elements, self.patches = elements, patches
        places = [torch.arange(side) * count // side for side, count in zip(size, patches, strict=True)]
        self.register_buffer(
            "first", ((places[0][:, None] * patches[1] + places[1]) * elements).to(torch.int32)
        )
        rows, columns = (
            nn.functional.one_hot(one, count).float() for one, count in zip(places, patches, strict=True)
        )
        rows, columns = rows / rows.sum(0), columns / columns.sum(0)
        self.register_buffer("rows", rows.T.contiguous())
        self.register_buffer("columns", columns)
        share = rows.amax(0)[:, None] * columns.amax(0)  # one cell's part of its patch
        self.register_buffer("share", share[..., None].contiguous())
        self.register_buffer("values", torch.as_tensor(values, dtype=torch.float32))

    @property
    def channels(self) -> int:
        """Channels that come out."""
        return self.elements + len(self.get_buffer("values")) - 1

    def forward(self, observed: Tensor) -> Tensor:
        batch, count = len(observed), self.patches[0] * self.patches[1] * self.elements
        start = torch.arange(batch, dtype=torch.int32, device=observed.device) * count
        number = self.get_buffer("first") + observed[:, 0].int() + start[:, None, None]
        counts = torch.bincount(number.flatten(), minlength=batch * count)
        shares = counts.view(batch, *self.patches, self.elements) * self.get_buffer("share")
        parts = [shares.permute(0, 3, 1, 2)]
        values = self.get_buffer("values")
        for channel in range(1, len(values)):
            real = values[channel].index_select(0, observed[:, channel].int().flatten())
            real = real.view(batch, 1, *observed.shape[2:])
            parts.append(self.get_buffer("rows") @ real @ self.get_buffer("columns"))
        return torch.cat(parts, 1) if len(parts) > 1 else parts[0].contiguous()


class MatrixPatches(nn.Module):
    """The same of `matrix` observations, float32 [B, C, H, W]: the mean of each channel in each patch."""

    def __init__(self, channels: int, size: tuple[int, int], patches: tuple[int, int]):
        super().__init__()
        self.channels = channels
        for name, side, count in zip(("rows", "columns"), size, patches, strict=True):
            one = nn.functional.one_hot(torch.arange(side) * count // side, count).float()
            self.register_buffer(
                name, (one / one.sum(0)).T.contiguous() if name == "rows" else one / one.sum(0)
            )

    def forward(self, observed: Tensor) -> Tensor:
        means: Tensor = self.get_buffer("rows") @ observed @ self.get_buffer("columns")
        return means


class PatchFeatures(BaseFeaturesExtractor):
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
    ):
        super().__init__(observation_space, features_dim)
        channels, *size = observation_space.shape
        shape = (size[0], size[1])
        see = (
            MatrixPatches(channels, shape, patches)
            if values is None
            else Patches(elements, shape, patches, values)
        )
        convolutions = nn.Sequential(
            see,
            nn.Conv2d(see.channels, 32, 3, 2, 1),
            nn.ReLU(),
            nn.Conv2d(32, 32, 3, 1, 1),
            nn.ReLU(),
            nn.Flatten(),
        )
        with torch.no_grad():
            width = convolutions(torch.zeros(1, *observation_space.shape)).shape[1]
        self.layers = nn.Sequential(convolutions, nn.Linear(width, features_dim), nn.ReLU())

    def forward(self, observed: Tensor) -> Tensor:
        """Features float32 [B, features_dim]."""
        features: Tensor = self.layers(observed)
        return features


def small_policy(env: TensorEnv, features_dim: int = 128) -> dict[str, Any]:
    """`policy_kwargs` of ``CnnPolicy`` for the observations of an environment: the small network.

    Raises:
        ValueError: for observations that are pictures.
    """
    kind = env.observation.kind
    if kind == "rgb":
        raise ValueError("pictures need no counting: use the policy's own network")
    size, bins = env.task.size, env.task.agent.bins
    patches = tuple(min(side, max(FEWEST, min(MOST, count))) for side, count in zip(size, bins, strict=True))
    values = None
    if kind != "matrix":
        values = env.simulator.observer.compact_values[: len(env.observation.channels)].tolist()
    return {
        "features_extractor_class": PatchFeatures,
        "features_extractor_kwargs": {
            "features_dim": features_dim,
            "elements": env.simulator.ruleset.slots,
            "patches": patches,
            "values": values,
        },
        "net_arch": [features_dim],
        "normalize_images": False,
    }
