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
        self.sources = sources
        self.register_buffer("tables", torch.as_tensor(tables, dtype=torch.float32).T.contiguous())
        self.of_elements = [channel for channel, source in enumerate(sources) if source == 0]

    def forward(self, observed: Tensor) -> Tensor:
        """Bytes, or the same numbers as floats: [B, C, H, W]."""
        numbers = observed.long()
        batch, _, height, width = numbers.shape
        out = torch.empty(batch, len(self.sources), height, width, device=observed.device)
        tables = self.get_buffer("tables")
        out[:, self.of_elements] = tables[:, self.of_elements][numbers[:, 0]].permute(0, 3, 1, 2)
        for channel, source in enumerate(self.sources):
            if source:
                out[:, channel] = tables[numbers[:, source], channel]
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
