"""Training: batches out of the buffer, Adam, and a run folder that any kill leaves in order."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from powderdsl.compiler import load, whole_palette
from powderdsl.diagnostics import CompileError
from powderdsl.experiments.runs import (
    Checkpoint,
    RunFolder,
    does_not_fit,
    find_run,
    no_run,
    open_run,
    read_run,
)
from powderdsl.model.composition.palette import MAX_ELEMENTS, Palette
from powderdsl.model.fingerprint import fingerprint
from powderdsl.model.types import Ruleset
from powderdsl.system.interrupts import held_back
from powderdsl.system.settings import check_bounds, setting
from powderdsl.system.writing import failure
from powderdsl.tasks.shipped import load_task
from powderdsl.worldmodel.pairs import DataConfig, Worlds, task_worlds
from powderdsl.worldmodel.replay import Replay
from powderdsl.worldmodel.rule_words import add, pack_names
from powderdsl.worldmodel.scores import Network
from powderdsl.worldmodel.unet import UNet, fresh_unet

KIND = "worldmodel"

LOG_EVERY = 10
"""Iterations whose mean loss makes a line of the metrics."""

MAX_WIDTH = 1024
"""Features of the first block."""


@dataclass(frozen=True)
class TrainConfig:
    """Everything that decides the weights (on one kind of device). The defaults are the paper's.

    `parent` is the name of the checkpoint that a fine-tuned network starts from; without it weights are random.
    `palette` has the qualified name of the element of each of the network's slots, or None; empty: those of the task's
    and the data's rules. `slots` is how many there are at least: free ones are room for packs that come later.
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

    def __post_init__(self) -> None:
        """Raises ValueError for values out of range."""
        check_bounds(self)
        if not 0 < self.learning_rate < float("inf"):
            raise ValueError(f"learning_rate must be above 0, found {self.learning_rate}")
        if len(self.palette) > MAX_ELEMENTS:
            raise ValueError(f"palette has more than {MAX_ELEMENTS} slots")

    @staticmethod
    def of(values: Mapping[str, Any]) -> TrainConfig:
        """The configuration in a run's JSON, without the run's other settings. Raises TypeError, ValueError."""
        own = {one.name: values[one.name] for one in fields(TrainConfig) if one.name in values}
        return TrainConfig(**{**own, "data": DataConfig.of(own["data"]), "palette": ()})


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


@dataclass(frozen=True)
class TrainingProgress:
    """The state after each iteration: how many are done, and the last loss that was logged."""

    done: int
    of: int
    loss: float | None
    simulated: float = 0.0
    """The share of time that making worlds takes, since the last line of metrics."""


def train(
    config: TrainConfig,
    folder: str | Path,
    *,
    machine: Machine = HERE,
    worlds: Worlds | None = None,
    identity: Mapping[str, Any] | None = None,
    network: nn.Module | None = None,
    parent: Checkpoint | None = None,
    note: Mapping[str, Any] | None = None,
    tell: Callable[[TrainingProgress], None] | None = None,
    save_seconds: float = 60,
) -> RunFolder:
    """Train a network until `config.iterations`, or continue with the run that is in the folder.

    On one device and one thread the weights are the same however often a run is killed and continues.

    Args:
        worlds: your own, instead of those of the task that `config.data` names, whose rules and split then say nothing.
        identity: what else decides which weights come out, such as what your own worlds depend on: kept in ``run.json``,
            and compared when a run continues.
        network: your own, with ids uint8 [B, H, W] -> logits [B, slots, H, W]; the paper's U-net otherwise.
        parent: weights to start from, of the run that `finetuned` was given.
        note: more for ``run.json``, such as where the parent lies.
        save_seconds: how often a checkpoint is written, besides the last one.

    Raises:
        CompileError: from `task_worlds` and `open_run`; PD622 if another process trains there; PD623 if weights do not
            fit the network; PD624 if the loss is no longer finite.
        ValueError: your own network gives logits of another shape.
        KeyboardInterrupt: Ctrl-C, after a last checkpoint.
    """
    palette = _palette_for(config, Path(folder), worlds)
    if worlds is None:
        found = task_worlds(config.data, **machine.simulation, palette=palette)
        worlds, identity = found, {"worlds": found.fingerprint, **(identity or {})}
    check_palette(Path(folder), palette, worlds.rules)
    own = {"palette": palette, "rules_fingerprint": fingerprint(worlds.rules), **(identity or {})}
    run = open_run(folder, KIND, {**asdict(config), **own}, note={"machine": asdict(machine), **(note or {})})
    with run.locked():
        model = network or fresh_unet(len(palette), config.width, config.seed)
        trainer = _Trainer(config, machine, run, model.to(machine.device), len(palette))
        trainer.restore(parent)
        if trainer.done < config.iterations:
            trainer.train(worlds, tell or (lambda progress: None), save_seconds)
    return run


class _Trainer:
    """A network in training: `done` iterations so far, and the losses since the last line of metrics."""

    def __init__(self, config: TrainConfig, machine: Machine, run: RunFolder, model: nn.Module, slots: int):
        self.config, self.machine, self.run, self.model, self.slots = config, machine, run, model, slots
        self.optimizer = torch.optim.Adam(model.parameters(), lr=config.learning_rate)
        self.forward: Network = torch.compile(model) if machine.compiled else model
        self.done = 0
        self.recent: list[float] = []

    def restore(self, parent: Checkpoint | None) -> None:
        """Continue from the run's newest checkpoint; a new run starts with the weights of `parent`."""
        found = self.run.latest_checkpoint(self.machine.device)
        if found is None:
            if parent is not None:
                fit_weights(self.model, parent, grow=True)
            return
        fit_weights(self.model, found)
        try:
            self.optimizer.load_state_dict(found.state["optimizer"])
            self.done, self.recent = found.step, [float(one) for one in found.state["recent"]]
        except (RuntimeError, TypeError, ValueError, AttributeError, LookupError) as error:
            why = " ".join(str(error).split())[:300]
            raise does_not_fit(found.path, f"its state is that of another run: {why}") from None

    def train(self, worlds: Worlds, tell: Callable[[TrainingProgress], None], save_seconds: float) -> None:
        """Train to the end. A signal is raised once a checkpoint is written, a second one at once."""
        device, store = self.machine.device, self.machine.store
        replay = Replay(
            worlds, self.config.data, seed=self.config.seed, device=device, store=store, folder=self.run.path
        )
        try:
            replay.go_to(self.done)
            self._iterate(replay, tell, save_seconds)
        finally:
            replay.close()

    def _iterate(self, replay: Replay, tell: Callable[[TrainingProgress], None], save_seconds: float) -> None:
        config, total = self.config, self.config.iterations
        loss, simulated, making = None, 0.0, 0.0
        saved = since = time.monotonic()
        self.model.train()
        # An iteration is never left half done.
        with self.run.metrics(self.done) as metrics, held_back() as interrupted:
            while self.done < total and not interrupted():
                self.recent.append(self.step(*replay.batch(self.done, config.batch)))
                began = time.monotonic()
                replay.advance()
                making += time.monotonic() - began
                self.done += 1
                if self.done % LOG_EVERY == 0 or self.done == total:
                    loss = sum(self.recent) / len(self.recent)
                    self.recent = []
                    if not loss < float("inf"):
                        raise diverged(self.run.path, self.done, config.learning_rate)
                    took = time.monotonic() - since
                    simulated = making / took
                    speed = {"time/pairs_a_second": LOG_EVERY * config.batch / took}
                    metrics.write(self.done, {"loss/train": loss, **speed, "time/simulation": simulated})
                    since, making = time.monotonic(), 0.0
                tell(TrainingProgress(self.done, total, loss, simulated))
                if time.monotonic() - saved > save_seconds:
                    self.save()
                    saved = time.monotonic()
            self.save()

    def step(self, starts: Tensor, ends: Tensor) -> float:
        """One step of Adam; the loss before it: cross-entropy a cell, in nats."""
        cuda = torch.device(self.machine.device).type == "cuda"
        with torch.autocast("cuda", torch.bfloat16, enabled=cuda):
            logits = self.forward(starts)
        expected = (len(starts), self.slots, *starts.shape[1:])
        if logits.shape != expected:
            raise ValueError(f"the network must give logits {list(expected)}, found {list(logits.shape)}")
        loss = F.cross_entropy(logits.float(), ends.long())
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        self.optimizer.step()
        return loss.item()

    def save(self) -> None:
        model, optimizer = self.model.state_dict(), self.optimizer.state_dict()
        self.run.save_checkpoint(
            self.done, {"model": model, "optimizer": optimizer, "recent": [*self.recent]}
        )


def load_rules_of(config: DataConfig, palette: Palette) -> Ruleset:
    """The rules that a configuration speaks of, with the ids of a palette. Raises CompileError."""
    if config.rules:
        return load(config.rules, params=config.params, palette=palette)
    return load_task(config.task, knobs=config.knobs, params=config.params, palette=palette).ruleset


def palette_of(config: DataConfig, slots: int = 0) -> tuple[str | None, ...]:
    """The qualified name of the element of each slot: those of the task's own rules, and of the rules.

    Packs that are left out have slots too, so those that come later need no others. `slots` is how many there are at
    least. Raises CompileError.
    """
    found = list(whole_palette(*load_task(config.task, knobs=config.knobs).rules))
    found += [name for name in whole_palette(config.rules) if name not in found] if config.rules else []
    return (*found, *[None] * (slots - len(found)))


def extended_palette(palette: Palette, rules: Ruleset) -> tuple[str | None, ...]:
    """A palette with the elements of rules that were loaded with it: in its free slots, then behind its end."""
    ids = [element.id for element in rules.elements]
    found = [*palette, *[None] * (max(ids) + 1 - len(palette))]
    for element in rules.elements:
        found[element.id] = element.qualified
    return tuple(found)


def _palette_for(config: TrainConfig, folder: Path, worlds: Worlds | None) -> tuple[str | None, ...]:
    """The slots of a run: as asked for, as recorded in its folder, or those that its rules need."""
    if config.palette:
        return config.palette
    if worlds is not None:
        found = worlds.rules.palette
        return (*found, *[None] * (config.slots - len(found)))
    palette = palette_of(config.data, config.slots)
    try:
        recorded = _recorded_palette(read_run(folder, KIND))
    except (CompileError, KeyError, TypeError):
        return palette  # a new run; or another one, which `open_run` refuses
    fits = len(recorded) >= config.slots and {*palette} <= {*recorded, None}
    return recorded if fits else palette


def _recorded_palette(run: RunFolder) -> tuple[str | None, ...]:
    """Raises KeyError, TypeError."""
    return tuple(None if one is None else str(one) for one in run.config["palette"])


def check_palette(folder: Path, palette: Palette, rules: Ruleset) -> None:
    """Whether a run's network has slots for the elements of some rules.

    Raises:
        CompileError: PD623, with every element that has no slot, or whose slot is another's.
    """
    why, lacking = [], 0
    for element in rules.elements:
        if element.id >= len(palette):
            lacking += 1
            why.append(f"there is no free slot for `{element.qualified}`: the network has {len(palette)}")
        elif palette[element.id] not in (None, element.qualified):
            why.append(f"id {element.id} is `{palette[element.id]}` there, `{element.qualified}` here")
    if why:
        helps = (
            f"train with `--slots {len(palette) + lacking}` to leave room for packs that come later",
            "or teach the network those packs: `powderdsl wm finetune RUN --packs PACK`",
        )
        raise does_not_fit(folder, *why, helps=helps if lacking else ())


def fit_weights(model: nn.Module, checkpoint: Checkpoint, *, grow: bool = False) -> None:
    """Give a network the weights of a checkpoint.

    Args:
        grow: the network may be larger: what the checkpoint lacks keeps the weights that it has.

    Raises:
        CompileError: PD623 if they are those of another network.
    """
    found = _weights(checkpoint)
    try:
        model.load_state_dict(_grown(found, model) if grow else found)
    except (RuntimeError, TypeError, AttributeError) as error:
        words = [line.strip()[:200] for line in str(error).splitlines()[:4]]
        raise does_not_fit(checkpoint.path, "its weights are those of another network", *words) from None


def _weights(checkpoint: Checkpoint) -> dict[str, Any]:
    """The weights in a checkpoint, which may hold anything; none if it has no weights."""
    state = checkpoint.state.get("model") if isinstance(checkpoint.state, dict) else None
    return dict(state) if isinstance(state, dict) else {}


def _grown(state: dict[str, Any], model: nn.Module) -> dict[str, Any]:
    """Weights in the shapes of a network that has more slots, first in each dimension."""
    for name, fresh in model.state_dict().items():
        old = state.get(name)
        if (
            isinstance(old, Tensor)
            and old.ndim == fresh.ndim
            and old.shape != fresh.shape
            and all(a <= b for a, b in zip(old.shape, fresh.shape, strict=True))
        ):
            state[name] = fresh.clone()
            state[name][tuple(slice(size) for size in old.shape)] = old
    return state


@dataclass(frozen=True)
class Trained:
    """A network from a run, with its configuration and its slots."""

    run: RunFolder
    config: TrainConfig
    palette: tuple[str | None, ...]
    network: nn.Module
    checkpoint: Checkpoint


def load_trained(
    path: str | Path | RunFolder, *, device: str = "cpu", network: nn.Module | None = None
) -> Trained:
    """The network of a run, with its newest weights, ready to predict.

    Raises:
        CompileError: PD620 if there is no run, or no checkpoint that can be read; PD623 if the weights do not fit.
    """
    run = path if isinstance(path, RunFolder) else find_run(path, KIND)
    try:
        config, palette = TrainConfig.of(run.config), _recorded_palette(run)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise no_run(run.path, str(error)) from None
    checkpoint = run.checkpoint(device)
    if network is None:
        _check_size(run, config, palette, checkpoint)
    model = network or UNet(len(palette), config.width).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    fit_weights(model, checkpoint)
    return Trained(run, config, palette, model.to(device).eval(), checkpoint)


def _check_size(
    run: RunFolder, config: TrainConfig, palette: tuple[str | None, ...], checkpoint: Checkpoint
) -> None:
    """Compare sizes before a network takes the memory that a damaged run.json asks for. Raises CompileError."""
    if type(config.width) is not int or not 1 <= config.width <= MAX_WIDTH or not 1 <= len(palette) <= 256:
        raise no_run(run.path, "its network has sizes that no training gives")
    with torch.device("meta"):
        wanted = {name: one.shape for name, one in UNet(len(palette), config.width).state_dict().items()}
    found = {name: getattr(one, "shape", None) for name, one in _weights(checkpoint).items()}
    if wanted != found:
        raise does_not_fit(checkpoint.path, "its weights are those of another network")


def diverged(folder: Path, done: int, learning_rate: float) -> CompileError:
    """The error for a loss that is no longer finite (PD624)."""
    return failure(
        "PD624",
        f"the loss is no longer finite after {done:,} iterations",
        notes=(f"in {folder}",),
        helps=(f"choose a smaller learning rate than {learning_rate:g}",),
    )


# Transfer: packs that a network has not seen are added to its rules, and it continues from its weights

SIMPLER = "kinds"
"""The knob that says how many elements are drawn: other packs' elements come after all of these."""


def finetuned(
    trained: Trained, packs: Sequence[str], *, iterations: int = 100, **changes: Any
) -> TrainConfig:
    """The configuration that continues from a network, on worlds in which elements of `packs` alone are drawn.

    The rules are those of the run with the packs added. Elements that the network knows keep their slots; others get
    its free slots, and where none are left the network grows. A knob for the number of elements is left at its default,
    for its list may end before the packs' elements. Rulesets are not varied.

    Args:
        packs: names of shipped packs or of packs that the run left out, or files.
        changes: other fields of `TrainConfig`.

    Raises:
        CompileError: what `load` raises.
    """
    config = trained.config
    data = config.data
    own = data.rules or "+".join(load_task(data.task).rules)
    rules, names = add(own, packs), pack_names(own, packs)
    knobs = {name: value for name, value in data.knobs.items() if name != SIMPLER}
    data = replace(data, rules=rules, only=names, knobs=knobs, rulesets=0)
    palette = extended_palette(trained.palette, load_rules_of(data, trained.palette))
    values = {"iterations": iterations, "parent": trained.checkpoint.path.name, **changes}
    return replace(config, data=data, palette=palette, **values)
