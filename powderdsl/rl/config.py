"""What a training run is: one frozen value, checked, that JSON can hold. Needs no torch."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from types import MappingProxyType
from typing import Any

from powderdsl.compiler import BACKENDS
from powderdsl.diagnostics import CompileError, Diagnostic, Label, suggest

NETWORKS = ("paper", "small")
OBSERVATIONS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {"paper": ("compact", "ids", "matrix"), "small": ("ids", "compact", "matrix")}
)
"""What each network takes; the first is the usual one."""

HOW = ("steps", "backend", "device", "threads", "checkpoint_minutes")
"""Settings that may change while a run goes on: how long and on what it is trained, not what is trained."""


@dataclass(frozen=True)
class TrainConfig:
    """Settings of a PPO run. The defaults are the paper's figures, and Stable-Baselines3's where it gives none."""

    task: str
    """A shipped task's name, or a file's path."""
    split: str = "train"
    knobs: Mapping[str, int] = field(default_factory=dict)
    params: Mapping[str, Any] = field(default_factory=dict)
    """Parameters of the rules: numbers, or text such as ``5%``."""
    packs: tuple[str, ...] = ()
    """Packs, by name or file, that are added to the task's rules."""
    slots: int = 0
    """Room for this many elements at least: packs that come later take free slots."""
    worlds: int = 1_000_000
    """How many worlds there are to draw from: "N start states"."""
    observation: str = "compact"
    network: str = "paper"
    features: int = 256
    """Width of the fully connected layers."""
    envs: int = 32
    rollout: int = 2048
    """Actions in every world between two updates."""
    batch: int = 256
    epochs: int = 10
    learning_rate: float = 3e-4
    gamma: float = 0.99
    gae_lambda: float = 0.95
    clip: float = 0.2
    entropy: float = 0.0
    seed: int = 0
    steps: int = 1_000_000
    """Interactions, of all worlds together. A run ends with the first whole rollout that reaches them."""
    backend: str = "auto"
    device: str = "cpu"
    threads: int = 1
    checkpoint_minutes: float = 2.0
    """How much work a kill may cost; 0 saves after every rollout."""

    def as_json(self) -> dict[str, Any]:
        """All settings, as JSON has them."""
        return asdict(self)

    @property
    def identity(self) -> dict[str, Any]:
        """The settings that decide what comes out, without those of HOW."""
        return {name: value for name, value in self.as_json().items() if name not in HOW}


_SMALL: Mapping[str, Any] = MappingProxyType(
    {
        "network": "small",
        "observation": "ids",
        "features": 128,
        "rollout": 128,
        "epochs": 4,
        "learning_rate": 1e-3,
        "entropy": 0.01,
        "steps": 200_000,
    }
)

PRESETS: Mapping[str, Mapping[str, Any]] = MappingProxyType({"paper": MappingProxyType({}), "small": _SMALL})
"""``paper``: its network and figures. ``small``: a network and figures for a few minutes on one processor core."""

_WHOLE: Mapping[str, tuple[int, int]] = MappingProxyType(
    {
        "worlds": (1, 2**62),
        "slots": (0, 256),
        "features": (1, 1 << 16),
        "envs": (1, 1 << 20),
        "rollout": (1, 1 << 20),
        "batch": (2, 1 << 24),
        "epochs": (1, 1000),
        "seed": (0, 2**32 - 1),
        "steps": (1, 10**12),
        "threads": (1, 1024),
    }
)
_REAL: Mapping[str, tuple[float, float]] = MappingProxyType(
    {
        "learning_rate": (1e-9, 10.0),
        "gamma": (0.0, 1.0),
        "gae_lambda": (0.0, 1.0),
        "clip": (1e-6, 10.0),
        "entropy": (0.0, 100.0),
        "checkpoint_minutes": (0.0, 1e6),
    }
)


def preset(name: str, task: str, **changes: Any) -> TrainConfig:
    """The settings of a preset, with changes. Raises CompileError (PD640) with everything that is wrong."""
    wrong: list[Diagnostic] = []
    if name not in PRESETS:
        wrong.append(_wrong(f"there is no preset `{name}`", suggest(str(name), PRESETS, "presets")))
    known = [one.name for one in fields(TrainConfig)]
    for other in changes:
        if other not in known:
            wrong.append(_wrong(f"there is no setting `{other}`", suggest(other, known)))
    given = {"task": task, **PRESETS.get(name, {})}
    given |= {one: value for one, value in changes.items() if one in known}
    # The usual observation hangs on the network.
    if "network" in changes and "observation" not in changes and changes["network"] in OBSERVATIONS:
        given["observation"] = OBSERVATIONS[changes["network"]][0]
    given["packs"] = tuple(given.get("packs", ()))
    config = TrainConfig(**given)
    wrong += _mistakes(config)
    if wrong:
        raise CompileError(wrong)
    return config


def from_json(values: Mapping[str, Any]) -> TrainConfig:
    """Settings as `TrainConfig.as_json` gives them; what is missing is as usual. Raises CompileError (PD640)."""
    return preset("paper", **{"task": "", **values})


def check_config(config: TrainConfig) -> TrainConfig:
    """The same settings. Raises CompileError (PD640) with everything that is wrong in them."""
    wrong = _mistakes(config)
    if wrong:
        raise CompileError(wrong)
    return config


def _mistakes(config: TrainConfig) -> list[Diagnostic]:
    found = []
    for name, (low, high) in _WHOLE.items():
        value = getattr(config, name)
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            found.append(_wrong(f"`{name}` is {value!r}: it takes a whole number from {low:,} to {high:,}"))
    for name, (least, most) in _REAL.items():
        value = getattr(config, name)
        real = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
        if not real or not least <= value <= most:
            found.append(_wrong(f"`{name}` is {value!r}: it takes a number from {least:g} to {most:g}"))
    for name in ("task", "split", "device"):
        value = getattr(config, name)
        if not isinstance(value, str) or not value:
            found.append(_wrong(f"`{name}` is {value!r}: it takes a name"))
    for name, choices in (("network", NETWORKS), ("backend", tuple(BACKENDS))):
        if getattr(config, name) not in choices:
            found.append(_no_choice(name, getattr(config, name), choices))
    takes = OBSERVATIONS.get(str(config.network), ("ids", "compact", "matrix"))
    if config.observation not in takes:
        found.append(_no_choice("observation", config.observation, takes))
    if not all(isinstance(one, str) for one in config.packs) or "" in config.packs:
        found.append(_wrong(f"`packs` is {config.packs!r}: it takes names or files of packs"))
    for name in ("knobs", "params"):
        value = getattr(config, name)
        if not isinstance(value, Mapping) or not all(isinstance(one, str) for one in value):
            found.append(_wrong(f"`{name}` is {value!r}: it takes values by name"))
    sizes = (config.rollout, config.envs)
    if all(isinstance(one, int) for one in sizes) and sizes[0] * sizes[1] < 2:
        found.append(_wrong("`rollout` × `envs` is 1: an update needs two actions or more"))
    return found


def _no_choice(name: str, value: Any, choices: tuple[str, ...]) -> Diagnostic:
    message = f"`{name}` is {value!r}: it takes one of {', '.join(choices)}"
    return _wrong(message, suggest(str(value), choices))


def _wrong(message: str, helps: list[str] | tuple[str, ...] = ()) -> Diagnostic:
    return Diagnostic("PD640", message, Label(None), helps=tuple(helps))
