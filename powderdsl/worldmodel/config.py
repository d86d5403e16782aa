"""Settings of a run: configurations, presets, and the machine that computes it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any

from powderdsl.compiler import BACKENDS
from powderdsl.model.composition.compose import MAX_ELEMENTS
from powderdsl.system.settings import check_settings, checked_record, setting

TEST_SEEDS = 1 << 32
"""The first seed of worlds that models are tested on. Training takes seeds below it."""


class Checked:
    """Settings that are checked when they are made."""

    def __post_init__(self) -> None:
        check_settings(self)


@dataclass(frozen=True)
class DataConfig(Checked):
    """The pairs that a network learns from. Plain values: ``dataclasses.asdict`` gives what a run's file keeps.

    The worlds are those of seeds 0 to `states` − 1. Each is run for `steps`·`pairs` steps and gives `pairs` pairs: the
    paper's 16 of 8 steps. `only` names packs: worlds draw no other pack's elements. The replay buffer holds `capacity`
    pairs, of which each iteration replaces `refresh`; if all pairs of all worlds fit in, it holds these and stays so.
    """

    task: str = setting("world-model", form="a name or a file")
    split: str = setting("train", "Split of the task to train on.  [default: train]", form="a name")
    rules: str = setting("")
    """As everywhere: a shipped ruleset, packs joined by ``+``, left out behind ``-``. Empty: the task's own."""
    only: tuple[str, ...] = setting(())
    knobs: Mapping[str, int] = setting(dict)
    params: Mapping[str, Any] = setting(dict)
    states: int = setting(
        1_000_000, "How many worlds there are to draw from.", 1, TEST_SEEDS, option="worlds"
    )
    steps: int = setting(8, low=1)
    pairs: int = setting(16, low=1)
    rulesets: int = setting(0, "Use only the first rulesets of the split, this many; 0: all.", 0, 4096)
    capacity: int = setting(1024 * 256, "Capacity of the buffer, in pairs.", 1, 1 << 32, option="buffer")
    refresh: int = setting(256, "Pairs that each iteration replaces in the buffer.", 1, 1 << 20)


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


@dataclass(frozen=True)
class TrainConfig(Checked):
    """Everything that decides the weights (on one kind of device). The defaults are the paper's.

    `parent` is the name of the checkpoint that a fine-tuned network starts from; without it weights are random.
    `palette` has the qualified name of the element of each of the network's slots, or None; empty: those of the task's
    and the data's rules. `slots` is how many there are at least: free ones are room for packs that come later.
    `network` is the name of a `CustomNetwork`, as text: what it names is imported only if the user gives it again.
    `recorded` is the dataset that is learned from; `data` then says which task it was recorded from.
    """

    data: DataConfig = field(default_factory=DataConfig)
    width: int = setting(32, "Features of the first block.", 1, 1024)
    iterations: int = setting(5000, "Steps of Adam.", 1, 1 << 40)
    batch: int = setting(256, "Pairs per step.", 1, 1 << 20)
    learning_rate: float = setting(0.005, "Learning rate of Adam.", 1e-300, 1e300)
    seed: int = setting(0, "Seed of weights, worlds and batches.", 0, 2**63 - 1)
    parent: str | None = None
    slots: int = setting(0, "Room for this many elements, for packs that come later.", 0, MAX_ELEMENTS)
    palette: tuple[str | None, ...] = ()
    network: str | None = None
    recorded: Recorded | None = None

    @property
    def plain(self) -> dict[str, Any]:
        """The settings that are used, as ``run.json`` has them."""
        return {name: value for name, value in asdict(self).items() if value is not None}

    @staticmethod
    def of(values: Mapping[str, Any]) -> TrainConfig:
        """The configuration in a run's JSON, without its palette and what is no setting. Raises ValueError."""
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
class Machine(Checked):
    """The device and storage of a run. A run may continue on another machine.

    `store` is that of `Replay`.
    """

    device: str = setting("cpu", form="a name")
    threads: int = setting(1, low=1, high=1024)
    backend: str = setting("auto", choices=tuple(BACKENDS))
    store: str = setting("auto", choices=("auto", "memory", "disk"))

    @property
    def simulation(self) -> dict[str, Any]:
        """The settings that `TaskWorlds` takes."""
        return {"device": self.device, "threads": self.threads, "backend": self.backend}


HERE = Machine()
"""One thread of this CPU."""
