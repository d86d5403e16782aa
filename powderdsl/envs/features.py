"""Feature extractors for Stable-Baselines3: bytes become channels on the device, then the paper's network."""

from __future__ import annotations

from typing import Any

import torch
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import Tensor, nn

from powderdsl.envs.tensor_env import TensorEnv


class Expand(nn.Module):
    """The channels of ``matrix``, float32 [B, C, H, W], from observations ``ids`` or ``compact``.

    Args:
        sources: the channel of the observation that each comes from. tables: [C, 256], what it is by the number there.
    """

    def __init__(self, sources: tuple[int, ...], tables: Any):
        super().__init__()
        whole = torch.as_tensor(tables, dtype=torch.float32)
        single = (whole != 0).sum(1) == 1
        of_one = (
            single & (whole.amax(1) == 1) & (torch.tensor(sources) == 0)
        )  # 1 where one element is, else 0
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


class PaperFeatures(BaseFeaturesExtractor):
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
    ):
        super().__init__(observation_space, features_dim)
        expand = nn.Identity() if sources is None else Expand(sources, tables)
        channels = observation_space.shape[0] if sources is None else len(sources)
        convolutions = nn.Sequential(
            expand,
            nn.Conv2d(channels, 32, 3, stride),
            nn.ReLU(),
            nn.Conv2d(32, 64, 3, stride),
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


def paper_policy(env: TensorEnv, features_dim: int = 256, stride: int = 2) -> dict[str, Any]:
    """`policy_kwargs` of ``CnnPolicy`` for the observations of an environment: the paper's network.

    Raises:
        ValueError: for observations that are pictures.
    """
    kind = env.observation.kind
    if kind == "rgb":
        raise ValueError("pictures need no expanding: use the policy's own network")
    how: dict[str, Any] = {"features_dim": features_dim, "stride": stride}
    if kind != "matrix":
        sources, tables = env.simulator.observer.matrix_tables
        kept = [channel for channel, source in enumerate(sources) if kind == "compact" or source == 0]
        how["sources"] = tuple(sources[channel] for channel in kept)
        how["tables"] = tables[kept].tolist()
    return {
        "features_extractor_class": PaperFeatures,
        "features_extractor_kwargs": how,
        "net_arch": [features_dim],
        "normalize_images": False,
    }
