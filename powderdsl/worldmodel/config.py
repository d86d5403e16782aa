"""What decides a run: configurations, presets, and the machine that computes it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any

from powderdsl.model.composition.palette import MAX_ELEMENTS
from powderdsl.system.settings import check_bounds, setting
from powderdsl.worldmodel.networks import is_network_name
from powderdsl.worldmodel.pairs import DataConfig

LATER = ("network", "recorded")
"""Settings that the first runs do not have, with the default None."""

MAX_CHANNELS = 256
"""Channels of recorded observations."""

MAX_WIDTH = 1024
"""Features of the first block."""


@dataclass(frozen=True)
class Recorded:
    """The dataset of a run with actions: its digest, and what its numbers mean. See `recordings`.

    `channels` are those of its observations, `steps` those of an action, `speed` the one that blowing gives to cells.
    Without `actions` the network does not see them.
    """

    digest: str
    channels: tuple[str, ...]
    steps: int
    speed: float
    actions: bool = True

    def __post_init__(self) -> None:
        """Raises ValueError for values that no dataset has."""
        if not 1 <= len(self.channels) <= MAX_CHANNELS or self.channels[0] != "element":
            raise ValueError(f"channels must be 1 to {MAX_CHANNELS} names, the first of them `element`")


@dataclass(frozen=True)
class TrainConfig:
    """Everything that decides the weights (on one kind of device). The defaults are the paper's.

    `parent` is the name of the checkpoint that a fine-tuned network starts from; without it weights are random.
    `palette` has the qualified name of the element of each of the network's slots, or None; empty: those of the task's
    and the data's rules. `slots` is how many there are at least: free ones are room for packs that come later.
    `network` is the name of a `CustomNetwork`, as text: what it names is imported only if the user gives it again.
    `recorded` is the dataset that is learned from; `data` then says which task it was recorded from.
    """

    data: DataConfig = field(default_factory=DataConfig)
    width: int = setting(32, low=1, high=MAX_WIDTH)
    iterations: int = setting(5000, low=1, high=1 << 40)
    batch: int = setting(256, low=1, high=1 << 20)
    learning_rate: float = 0.005
    seed: int = setting(0, low=0, high=2**63 - 1)
    parent: str | None = None
    slots: int = setting(0, low=0, high=MAX_ELEMENTS)
    palette: tuple[str | None, ...] = ()
    network: str | None = None
    recorded: Recorded | None = None

    def __post_init__(self) -> None:
        """Raises ValueError for values out of range."""
        check_bounds(self)
        if not 0 < self.learning_rate < float("inf"):
            raise ValueError(f"learning_rate must be above 0, found {self.learning_rate}")
        if len(self.palette) > MAX_ELEMENTS:
            raise ValueError(f"palette has more than {MAX_ELEMENTS} slots")
        if self.network is not None and not is_network_name(self.network):
            raise ValueError("network must have the form module:Class")

    @property
    def plain(self) -> dict[str, Any]:
        """For ``run.json``. Settings that came later are left out unless they are used: older runs lack them."""
        found = asdict(self)
        return {name: value for name, value in found.items() if name not in LATER or value is not None}

    @staticmethod
    def of(values: Mapping[str, Any]) -> TrainConfig:
        """The configuration in a run's JSON, without the run's other settings. Raises TypeError, ValueError."""
        own = {one.name: values[one.name] for one in fields(TrainConfig) if one.name in values}
        found = own.get("recorded")
        recorded = None if found is None else Recorded(**{**found, "channels": tuple(found["channels"])})
        return TrainConfig(**{**own, "data": DataConfig.of(own["data"]), "palette": (), "recorded": recorded})


PAPER = TrainConfig()
"""5,000 iterations of 256 pairs, width 32, a buffer of 1024·256: for a GPU."""

SMALL = TrainConfig(
    data=DataConfig(capacity=4096, refresh=8), width=16, iterations=1200, batch=8, learning_rate=0.002
)
"""The same network, narrower, on fewer pairs: minutes on one CPU core."""

PRESETS = {"paper": PAPER, "small": SMALL}


@dataclass(frozen=True)
class Machine:
    """Where a run is computed. A run may continue on another machine.

    `compiled` runs the network through ``torch.compile``. `store` is that of `Replay`.
    """

    device: str = "cpu"
    threads: int = 1
    backend: str = "auto"
    store: str = "auto"
    compiled: bool = False

    @property
    def simulation(self) -> dict[str, Any]:
        """The settings that `task_worlds` takes."""
        return {"device": self.device, "threads": self.threads, "backend": self.backend}


HERE = Machine()
"""One thread of this CPU."""
