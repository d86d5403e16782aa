"""Training: batches out of the buffer, Adam, and a run folder that any kill leaves in order."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from powderdsl.compiler import load
from powderdsl.model.fingerprint import fingerprint
from powderdsl.model.types import Ruleset
from powderdsl.runs import Checkpoint, RunFolder, find_run, open_run
from powderdsl.tasks.shipped_tasks import load_task
from powderdsl.worldmodel.pairs import DataConfig, task_worlds
from powderdsl.worldmodel.replay import Replay
from powderdsl.worldmodel.unet import UNet, fresh_unet
from powderdsl.worlds.files import failure

KIND = "worldmodel"

LOG_EVERY = 10
"""Iterations whose mean loss makes a line of the metrics."""

Network = Callable[[Tensor], Tensor]
"""Ids uint8 [B, H, W] -> logits [B, slots, H, W]."""


@dataclass(frozen=True)
class TrainConfig:
    """All that decides which weights come out (on one kind of device). The defaults are the paper's.

    `parent` is the name of the checkpoint that a fine-tuned network starts from; without it weights are random.
    """

    data: DataConfig = field(default_factory=DataConfig)
    width: int = 32
    iterations: int = 5000
    batch: int = 256
    learning_rate: float = 0.005
    seed: int = 0
    parent: str | None = None

    def __post_init__(self) -> None:
        """Raises ValueError for numbers that cannot be."""
        for name in ("width", "iterations", "batch"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be 1 or more, found {getattr(self, name)}")
        if not 0 < self.learning_rate < float("inf"):
            raise ValueError(f"learning_rate must be above 0, found {self.learning_rate}")
        if not 0 <= self.seed < 2**63:
            raise ValueError(f"seed must be 0 or more, found {self.seed}")

    @staticmethod
    def of(values: Mapping[str, Any]) -> TrainConfig:
        """From what JSON gave back; what belongs to the run besides is left out. Raises TypeError, ValueError."""
        own = {name: value for name, value in values.items() if name not in ("palette", "rules_fingerprint")}
        return TrainConfig(**{**own, "data": DataConfig.of(own["data"])})


PAPER = TrainConfig()
"""5,000 iterations of 256 pairs, width 32, a buffer of 1024·256: for a GPU."""

SMALL = TrainConfig(
    data=DataConfig(capacity=4096, refresh=8), width=16, iterations=1200, batch=8, learning_rate=0.002
)
"""The same network, narrower, on fewer pairs: minutes on one CPU core."""

PRESETS = {"paper": PAPER, "small": SMALL}


@dataclass(frozen=True)
class Machine:
    """Where a run is computed. It takes no part in what a run is: one may go on elsewhere.

    `compiled` runs the network through ``torch.compile``. `store` is that of `Replay`.
    """

    device: str = "cpu"
    threads: int = 1
    backend: str = "auto"
    store: str = "auto"
    compiled: bool = False


HERE = Machine()
"""One thread of this CPU."""


@dataclass(frozen=True)
class Moment:
    """What training says of itself, after each iteration: how many are done, and the last loss that was logged."""

    done: int
    of: int
    loss: float | None


def train(
    config: TrainConfig,
    folder: str | Path,
    *,
    machine: Machine = HERE,
    network: nn.Module | None = None,
    parent: Checkpoint | None = None,
    note: Mapping[str, Any] | None = None,
    tell: Callable[[Moment], None] | None = None,
    save_seconds: float = 60,
) -> RunFolder:
    """Train a network until `config.iterations`, or go on with the run that is in the folder.

    On one device and one thread the weights are the same however often a run is killed and goes on.

    Args:
        network: your own, with ids uint8 [B, H, W] -> logits [B, slots, H, W]; the paper's U-net otherwise.
        parent: weights to start from, see `parent_of`.
        note: more for ``run.json``, such as where the parent lies.
        save_seconds: how often a checkpoint is written, besides the last one.

    Raises:
        CompileError: from `task_worlds` and `open_run`; PD622 if another process trains there; PD623 if weights do not
            fit the network, or the loss is no longer finite.
        KeyboardInterrupt: Ctrl-C, after a last checkpoint.
    """
    worlds = task_worlds(config.data, device=machine.device, threads=machine.threads, backend=machine.backend)
    palette = palette_of(config.data, worlds.rules)
    plain = {**asdict(config), "palette": palette, "rules_fingerprint": fingerprint(worlds.rules)}
    run = open_run(folder, KIND, plain, note={"machine": asdict(machine), **(note or {})})
    torch.set_num_threads(machine.threads)
    with run.locked():
        model = network or fresh_unet(len(palette), config.width, config.seed)
        model.to(machine.device)
        optimizer = torch.optim.Adam(model.parameters(), lr=config.learning_rate)
        done, recent = _restore(run, model, optimizer, parent, machine.device)
        if done < config.iterations:
            replay = Replay(
                worlds,
                config.data,
                seed=config.seed,
                device=machine.device,
                store=machine.store,
                folder=run.path,
            )
            try:
                replay.go_to(done)
                trainer = _Trainer(config, machine, run, model, optimizer, replay, done, recent)
                trainer.go(tell or (lambda progress: None), save_seconds)
            finally:
                replay.close()
    return run


def _restore(
    run: RunFolder,
    model: nn.Module,
    optimizer: torch.optim.Optimizer,
    parent: Checkpoint | None,
    device: str,
) -> tuple[int, list[float]]:
    """Iterations that are done, and the losses since the last line of metrics."""
    found = run.latest_checkpoint(device)
    if found is None:
        if parent is not None:
            fit_weights(model, parent)
        return 0, []
    fit_weights(model, found)
    optimizer.load_state_dict(found.state["optimizer"])
    return found.step, list(found.state["recent"])


class _Trainer:
    """One call of `train`, from `done` iterations on."""

    def __init__(
        self,
        config: TrainConfig,
        machine: Machine,
        run: RunFolder,
        model: nn.Module,
        optimizer: torch.optim.Optimizer,
        replay: Replay,
        done: int,
        recent: list[float],
    ):
        self.config, self.machine, self.run = config, machine, run
        self.model, self.optimizer, self.replay = model, optimizer, replay
        self.done, self.recent = done, recent
        self.forward: Network = torch.compile(model) if machine.compiled else model
        self.cuda = torch.device(machine.device).type == "cuda"

    def go(self, tell: Callable[[Moment], None], save_seconds: float) -> None:
        """To the end. Raises KeyboardInterrupt once a checkpoint is written."""
        total, saved, loss = self.config.iterations, time.monotonic(), None
        self.model.train()
        with self.run.metrics(self.done) as metrics, _interruptible() as interrupted:
            while self.done < total and not interrupted.is_set():
                starts, ends = self.replay.batch(self.done, self.config.batch)
                self.recent.append(self.step(starts, ends))
                self.replay.advance()
                self.done += 1
                if self.done % LOG_EVERY == 0 or self.done == total:
                    loss = sum(self.recent) / len(self.recent)
                    self.recent = []
                    if not loss < float("inf"):
                        raise _diverged(self.run, self.done, self.config)
                    metrics.write(self.done, {"loss/train": loss})
                tell(Moment(self.done, total, loss))
                if time.monotonic() - saved > save_seconds:
                    self.save()
                    saved = time.monotonic()
            self.save()
            if interrupted.is_set():
                raise KeyboardInterrupt

    def step(self, starts: Tensor, ends: Tensor) -> float:
        """One step of Adam; the loss before it: cross-entropy a cell, in nats."""
        with torch.autocast("cuda", torch.bfloat16, enabled=self.cuda):
            logits = self.forward(starts)
        loss = F.cross_entropy(logits.float(), ends.long())
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        self.optimizer.step()
        return loss.item()

    def save(self) -> None:
        state = {
            "model": self.model.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "recent": list(self.recent),
        }
        self.run.save_checkpoint(self.done, state)


@contextmanager
def _interruptible() -> Iterator[threading.Event]:
    """Set by the first Ctrl-C, so that an iteration is never left half done; the second one ends the process at once."""
    pressed = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield pressed  # signals reach the main thread alone
        return

    def press(number: int, frame: Any) -> None:
        pressed.set()
        signal.signal(signal.SIGINT, before)

    before = signal.signal(signal.SIGINT, press)
    try:
        yield pressed
    finally:
        signal.signal(signal.SIGINT, before)


def load_rules_of(config: DataConfig) -> Ruleset:
    """The rules that a configuration speaks of. Raises CompileError."""
    if config.rules:
        return load(config.rules, params=config.params)
    return load_task(config.task, knobs=config.knobs, params=config.params).ruleset


def palette_of(config: DataConfig, rules: Ruleset) -> list[str | None]:
    """The qualified name of the element of each slot: those of the rules, and of the task's own rules.

    So slots stay where they are when packs are left out, and those of packs that come later are there already.
    """
    task = load_task(config.task, knobs=config.knobs)
    palette: list[str | None] = [None] * max(task.ruleset.slots, rules.slots)
    for element in (*task.ruleset.elements, *rules.elements):
        palette[element.id] = element.qualified
    return palette


def check_palette(palette: list[str | None], rules: Ruleset) -> None:
    """Whether a network with these slots can see worlds of some rules.

    Raises:
        CompileError: PD623, with every element that has no slot, or whose slot is another's.
    """
    notes = []
    for element in rules.elements:
        if element.id >= len(palette):
            notes.append(f"`{element.qualified}` has id {element.id}; the network has {len(palette)} slots")
        elif palette[element.id] not in (None, element.qualified):
            notes.append(f"id {element.id} is `{element.qualified}` here, `{palette[element.id]}` there")
    if notes:
        raise failure(
            "PD623",
            f"the network was not trained for the elements of {rules.name}",
            notes=tuple(notes),
            helps=("choose the rules it was trained with, or packs of theirs", "or train another network"),
        )


def fit_weights(model: nn.Module, checkpoint: Checkpoint) -> None:
    """Give a network the weights of a checkpoint.

    Raises:
        CompileError: PD623 if they are those of another network.
    """
    state = checkpoint.state.get("model") if isinstance(checkpoint.state, dict) else None
    try:
        model.load_state_dict(state if isinstance(state, dict) else {})
    except RuntimeError as error:
        lines = tuple(line.strip() for line in str(error).splitlines()[1:4])
        helps = ("a network of your own must be given again, as it was trained",)
        message = f"the weights in {checkpoint.path} are those of another network"
        raise failure("PD623", message, notes=lines, helps=helps) from None


@dataclass(frozen=True)
class Trained:
    """A network out of a run: what it was trained on, and its slots."""

    run: RunFolder
    config: TrainConfig
    palette: list[str | None]
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
        config = TrainConfig.of(run.config)
        palette = [None if one is None else str(one) for one in run.config["palette"]]
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise failure("PD620", f"{run.path} is no run that can be used here", notes=(str(error),)) from None
    checkpoint = run.checkpoint(device)
    model = network or UNet(len(palette), config.width).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    fit_weights(model, checkpoint)
    return Trained(run, config, palette, model.to(device).eval(), checkpoint)


def _diverged(run: RunFolder, done: int, config: TrainConfig) -> Exception:
    return failure(
        "PD623",
        f"the loss is no longer finite after {done} iterations",
        notes=(f"in {run.path}",),
        helps=(f"choose a smaller learning rate than {config.learning_rate:g}",),
    )
