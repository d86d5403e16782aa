"""Settings of a run: configurations, presets, and the machine that computes it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any

from powderdsl.compiler import BACKENDS
from powderdsl.model.composition.compose import MAX_ELEMENTS
from powderdsl.system.settings import check_settings, checked_record, setting

TEST_SEEDS = 1 << 32
"""The first seed of test worlds. Training uses seeds below it."""


class CheckedSettings:
    """Settings that are checked when they are created."""

    def __post_init__(self) -> None:
        check_settings(self)


@dataclass(frozen=True)
class DataConfig(CheckedSettings):
    """The pairs that a network learns from. Plain values, which ``dataclasses.asdict`` converts for a run's file.

    The worlds have seeds 0 to `states` − 1. Each runs for `steps`·`pairs` steps and gives `pairs` pairs (in the paper,
    16 of 8 steps). `only` names the packs whose elements worlds draw. The replay buffer contains `capacity` pairs, of
    which each iteration replaces `refresh`; if all pairs of all worlds fit, it is never changed.
    """

    task: str = setting("world-model", form="a name or a file")
    split: str = setting("train", "Split of the task to train on.  [default: train]", form="a name")
    rules: str = setting("")
    """A shipped ruleset, or packs joined by ``+`` or left out by ``-``. Empty: the task's own."""
    only: tuple[str, ...] = setting(())
    knobs: Mapping[str, int] = setting(dict)
    params: Mapping[str, Any] = setting(dict)
    states: int = setting(1_000_000, "Number of worlds to draw from.", 1, TEST_SEEDS, option="worlds")
    steps: int = setting(8, low=1)
    pairs: int = setting(16, low=1)
    rulesets: int = setting(0, "Use only the first N rulesets of the split; 0: all.", 0, 4096)
    observation: str = setting("ids", "Network inputs: elements, or also laws.", choices=("ids", "laws"))
    capacity: int = setting(1024 * 256, "Capacity of the buffer, in pairs.", 1, 1 << 32, option="buffer")
    refresh: int = setting(256, "Pairs of the buffer that each iteration replaces.", 1, 1 << 20)


@dataclass(frozen=True)
class Recorded:
    """The dataset of a run with actions: its digest, and the meaning of its numbers. See `recordings`.

    `channels` are those of its observations, `steps` those of an action, `speed` that of blowing. Without `actions`,
    the network does not see them.
    """

    digest: str
    channels: tuple[str, ...]
    steps: int
    speed: float
    actions: bool = True


@dataclass(frozen=True)
class TrainConfig(CheckedSettings):
    """All settings that determine the weights (on one kind of device). The defaults are the paper's.

    `parent` is the name of the checkpoint that a fine-tuned network starts from; without it, weights are random.
    `palette` has the qualified name of the element of each of the network's slots, or None; if empty, those of the
    task's and the data's rules. `slots` is their minimum number: free ones leave room for packs added later. `network`
    is the name of a `CustomNetwork` as text, which is imported only if the user passes it again. `recorded` is the
    dataset to learn from; `data` then describes the task that it was recorded from.
    """

    data: DataConfig = field(default_factory=DataConfig)
    width: int = setting(32, "Number of features of the first block.", 1, 1024)
    iterations: int = setting(5000, "Number of Adam steps.", 1, 1 << 40)
    batch: int = setting(256, "Pairs per step.", 1, 1 << 20)
    learning_rate: float = setting(0.005, "Learning rate of Adam.", 1e-300, 1e300)
    seed: int = setting(0, "Seed of the weights, worlds and batches.", 0, 2**63 - 1)
    parent: str | None = None
    slots: int = setting(0, "Number of element slots, to leave room for packs added later.", 0, MAX_ELEMENTS)
    palette: tuple[str | None, ...] = ()
    network: str | None = None
    recorded: Recorded | None = None

    @property
    def plain(self) -> dict[str, Any]:
        """The values of all settings, as in ``run.json``."""
        return {name: value for name, value in asdict(self).items() if value is not None}

    @staticmethod
    def of(values: Mapping[str, Any]) -> TrainConfig:
        """The configuration in a run's JSON, without its palette and other entries. Raises ValueError."""
        names = {field.name for field in fields(TrainConfig)} - {"palette"}
        return checked_record(TrainConfig, {name: values[name] for name in values if name in names})


PRESETS = {
    "paper": TrainConfig(),
    "small": TrainConfig(
        data=DataConfig(capacity=4096, refresh=8), width=16, iterations=1200, batch=8, learning_rate=0.002
    ),
}
"""``paper``: 5,000 iterations of 256 pairs, for a GPU. ``small``: a narrower network, minutes on one CPU core."""


@dataclass(frozen=True)
class Machine(CheckedSettings):
    """The device and storage of a run, which may resume on another machine.

    `store` is that of `Replay`.
    """

    device: str = setting("cpu", form="a name")
    threads: int = setting(1, low=1, high=1024)
    backend: str = setting("auto", choices=tuple(BACKENDS))
    store: str = setting("auto", choices=("auto", "memory", "disk"))

    @property
    def simulation(self) -> dict[str, Any]:
        """The settings for `TaskWorlds`."""
        return {"device": self.device, "threads": self.threads, "backend": self.backend}


HERE = Machine()
"""One thread of this CPU."""
