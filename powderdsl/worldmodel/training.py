"""Training with a buffer of pairs and Adam, in a run folder that survives kills; and networks of runs."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryFile
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from powderdsl.compiler import load, read, split_names, whole_palette
from powderdsl.diagnostics import CompileError, Reporter
from powderdsl.experiments.runs import (
    ABOUT,
    Checkpoint,
    Metrics,
    RunFolder,
    check_palette,
    find_run,
    lock_folder,
    misfit,
    not_a_run,
    open_run,
    read_run,
    recorded_palette,
    reporting_misfits,
)
from powderdsl.model.composition.compose import Palette
from powderdsl.model.types import Ruleset
from powderdsl.system.interrupts import delay_signal
from powderdsl.system.random import MASK, base_keys, mix
from powderdsl.system.settings import fingerprint
from powderdsl.system.writing import failure
from powderdsl.tasks.shipped import load_task
from powderdsl.worldmodel.config import HERE, DataConfig, Machine, TrainConfig
from powderdsl.worldmodel.networks import CustomNetwork, encoder_of, fit_weights, network_of
from powderdsl.worldmodel.scores import score
from powderdsl.worldmodel.worlds import Pairs, TaskWorlds, Worlds, inputs_of, pairs_of, validation_pairs

if TYPE_CHECKING:
    from powderdsl.worldmodel.worlds import Recording

TOGETHER = 1 << 20
"""Maximum number of cells simulated together to fill the buffer."""

_BATCH, _FIRST = 0x57A7, 0x0FF5
"""The numbers of the hashes that choose batches and the first world."""


class Replay:
    """A buffer of pairs: `starts`, uint8 [size, H, W] or [size, 2, H, W], and `ends`, [size, H, W], for `iteration`.

    Its contents, and the pairs of a batch, are functions of the configuration, the seed and the iteration. So a
    checkpoint does not need to store it: `advance_to` recreates it exactly.

    Args:
        seed: the run's seed, which determines the first world and the pairs of each batch.
        store: ``memory`` (of `device`), ``disk``, or ``auto``: disk if the buffer would take more than half of memory.
        folder: the folder of its files; by default, that of temporary files.
    """

    def __init__(
        self,
        worlds: Worlds,
        config: DataConfig,
        *,
        seed: int = 0,
        device: str | torch.device = "cpu",
        store: str = "auto",
        folder: Path | None = None,
    ):
        self.worlds, self.config, self.device = worlds, config, torch.device(device)
        self.all_fit = config.states * config.pairs <= config.capacity
        self.size = config.states * config.pairs if self.all_fit else config.capacity
        keys = base_keys(torch.tensor([seed, seed]), torch.tensor([_BATCH, _FIRST]))
        self._key = int(mix(keys[0] ^ keys[1])[0])
        first = int((keys[0, 1] << 32 | keys[1, 1]) & (2**63 - 1))
        self._first = 0 if self.all_fit else first % config.states
        shape = (3 if config.observation == "laws" else 2, self.size, *worlds.size)
        if store == "auto":
            store = "disk" if math.prod(shape) > memory_of(self.device) // 2 else "memory"
        if store == "memory":
            pairs = torch.zeros(shape, dtype=torch.uint8, device=self.device)
        else:
            with TemporaryFile(dir=folder) as file:  # mapped memory outlives the file
                pairs = torch.from_numpy(np.memmap(file, dtype=np.uint8, mode="w+", shape=shape))
        self.starts, self.ends = pairs[:-1].movedim(0, 1) if len(pairs) == 3 else pairs[0], pairs[-1]
        self.iteration = -1
        self._live: Any = None

    def advance_to(self, iteration: int) -> None:
        """Create the buffer's contents before an iteration, counted from 0."""
        config = self.config
        back = -(-self.size // config.refresh)  # pairs of older iterations have been overwritten
        begin = max(0, iteration - back) // config.pairs * config.pairs
        if self.all_fit or begin == 0:
            self._fill()
        self.iteration, self._live = begin, None
        while self.iteration < iteration:
            self.advance()

    def advance(self) -> None:
        """Advance to the next iteration: `refresh` worlds run some steps, and their pairs replace the oldest."""
        if not self.all_fit:
            config, many = self.config, self.config.refresh
            turn, moment = divmod(self.iteration, config.pairs)
            if moment == 0 or self._live is None:
                filled = -(-self.size // config.pairs)
                self._live = self.worlds.start(self._seeds(filled + turn * many, many))
            start = inputs_of(self._live)
            self._live = self.worlds.later(self._live, config.steps)
            place = self.size + self.iteration * many + torch.arange(many)
            self._write(place % self.size, (start, self._live.ids))
        self.iteration += 1

    def batch(self, iteration: int, count: int) -> Pairs:
        """The pairs of an iteration's batch, drawn uniformly: uint8 [count, …] each, on the buffer's device."""
        key = mix(torch.tensor((self._key + iteration * 0x9E3779B1) & MASK))
        drawn = mix((mix((key + torch.arange(count) * 0x85EBCA6B) & MASK) + (iteration >> 16)) & MASK)
        chosen = ((drawn * self.size) >> 32).to(self.starts.device)
        return self.starts[chosen].to(self.device), self.ends[chosen].to(self.device)

    def _fill(self) -> None:
        """The first pairs: world by world, in the order of time."""
        pairs = self.config.pairs
        height, width = self.worlds.size
        together = max(1, TOGETHER // (height * width))
        many = -(-self.size // pairs)
        for first in range(0, many, together):
            count = min(together, many - first)
            rollout = pairs_of(self.worlds, self._seeds(first, count), self.config.steps, pairs)
            for moment, pair in enumerate(rollout):
                place = (first + torch.arange(count)) * pairs + moment
                inside = place < self.size
                self._write(place[inside], (pair[0][inside], pair[1][inside]))

    def _seeds(self, first: int, count: int) -> Tensor:
        """The seeds of worlds by their number in the run: all states come equally often."""
        return (self._first + first + torch.arange(count)) % self.config.states

    def _write(self, place: Tensor, pair: Pairs) -> None:
        place = place.to(self.starts.device)
        for room, ids in zip((self.starts, self.ends), pair, strict=True):
            # If one iteration brings more pairs than fit, the newest stay.
            newest = slice(max(0, len(place) - self.size), None)
            room[place[newest]] = ids[newest].to(room.device)


def memory_of(device: torch.device) -> int:
    if device.type == "cuda":
        return int(torch.cuda.get_device_properties(device).total_memory)
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (ValueError, OSError, AttributeError):
        return 8 << 30


KIND = "worldmodel"

LOG_EVERY = 10
"""Number of iterations whose mean loss makes a line of the metrics."""

VALIDATED = 256
"""Maximum number of recorded transitions to validate a network on."""

MEASURED = ("accuracy", "changed_accuracy", "change_f1", "ece", "change_ece")
"""Measures of a validation besides the loss."""

Progress = Callable[[int, float | None, float | None], None]
"""Called after each iteration with their number so far, the last logged loss, and the last loss on held-out worlds."""


def train(
    config: TrainConfig,
    folder: str | Path,
    *,
    machine: Machine = HERE,
    worlds: Worlds | None = None,
    recording: Recording | None = None,
    network: nn.Module | CustomNetwork | None = None,
    parent: Checkpoint | None = None,
    note: Mapping[str, Any] | None = None,
    tell: Progress = lambda *_: None,
    save_seconds: float = 60,
    validate_every: int = 0,
) -> RunFolder:
    """Train a network until `config.iterations`, or resume the run in the folder.

    On one device and one thread, killing and resuming a run does not change its weights.

    Args:
        worlds: your own worlds, instead of those of `config.data`, whose rules and split are then ignored.
        recording: transitions with actions, instead of worlds: see `recordings.open_recording`.
        network: your own network, ids uint8 [B, H, W] -> logits [B, slots, H, W], or a `CustomNetwork`, whose name the
            run records. The default is the paper's U-net.
        parent: initial weights, of the run passed to `finetuned`.
        note: further entries of ``run.json``, such as the parent's path.
        save_seconds: seconds between checkpoints; the last state is always saved.
        validate_every: number of iterations between scores on held-out worlds (`validation_pairs`), also computed at
            the end; 0: never. It does not affect the weights, so it may change when a run is resumed.

    Raises:
        CompileError: from `TaskWorlds` and `open_run`; PD622 if another process trains there; PD623 if weights do not
            fit the network, or the run's custom network is not passed; PD624 if the loss is no longer finite; PD625 for
            a `CustomNetwork` that cannot be trained.
        ValueError: your own network returns logits of another shape.
        KeyboardInterrupt: Ctrl-C, after a last checkpoint.
    """
    path = Path(folder)
    if isinstance(network, CustomNetwork):
        config = replace(config, network=network.name)
    elif network is None and config.network is not None:
        raise network_missing(path, config.network)
    note = {"machine": asdict(machine), **(note or {})}
    if recording is not None:
        config = recording.configured(config)
        note["dataset"] = str(recording.dataset.folder)
    elif config.recorded is not None:
        raise misfit(path, "it needs its dataset")
    palette = _palette_for(config, path, worlds)
    identity: dict[str, Any] = {}
    if recording is None and worlds is None:
        worlds = own_worlds = TaskWorlds(config.data, **machine.simulation, palette=palette)
        identity["worlds"] = own_worlds.fingerprint
    source: Any = recording or worlds
    check_slots(path, palette, source.rules)
    identity |= {"palette": palette, "rules_fingerprint": fingerprint(source.rules)}
    slots = len(palette)
    if isinstance(network, CustomNetwork):
        network.check(encoder_of(config, slots), source.size, config.seed)
    run = open_run(path, KIND, {**config.plain, **identity}, note=note)
    with lock_folder(run.path):
        model = network_of(config, slots, network)
        trainer = _Trainer(config, machine, run, model.to(machine.device), slots)
        trainer.restore(parent)
        if trainer.done == config.iterations:
            return run
        trainer.validate_every = validate_every
        if recording is not None:
            trainer.batch = partial(recording.batch, seed=config.seed, device=machine.device)
            if validate_every:
                trainer.held_out = recording.spread(recording.parts[1], VALIDATED, machine.device)
        else:
            replay = Replay(
                source, config.data, seed=config.seed, device=machine.device, store=machine.store, folder=path
            )
            replay.advance_to(trainer.done)
            trainer.batch, trainer.advance = replay.batch, replay.advance
            if validate_every:
                trainer.held_out = validation_pairs(source, config.data, machine.device)
        with _random_numbers_kept(torch.device(machine.device)):
            trainer.train(tell, save_seconds)
    return run


def _random_numbers_kept(device: torch.device) -> AbstractContextManager[None]:
    """Restore torch's global generators afterwards."""
    return torch.random.fork_rng([device] if device.type == "cuda" else [])


class _Trainer:
    """A network in training: the iterations done, and the losses since the last line of metrics."""

    def __init__(self, config: TrainConfig, machine: Machine, run: RunFolder, model: nn.Module, slots: int):
        self.config, self.machine, self.run, self.model, self.slots = config, machine, run, model, slots
        self.optimizer = torch.optim.Adam(model.parameters(), lr=config.learning_rate)
        self.done = 0
        self.recent: list[float] = []
        self.batch: Callable[[int, int], Pairs]
        """The pairs of an iteration's batch, by the iteration and their number."""
        self.advance: Callable[[], None] = lambda: None
        """Create the worlds of the next iteration."""
        self.validate_every, self.held_out = 0, list[Pairs]()

    def restore(self, parent: Checkpoint | None) -> None:
        """Resume from the run's newest checkpoint; a new run starts with the weights of `parent`."""
        checkpoint = self.run.latest_checkpoint()
        if checkpoint is None:
            if parent is not None:
                fit_weights(self.model, parent, grow=True)
            return
        fit_weights(self.model, checkpoint)
        with reporting_misfits(checkpoint.path, "its state belongs to another run"):
            self.optimizer.load_state_dict(checkpoint.state["optimizer"])
            self.done, self.recent = checkpoint.step, [float(loss) for loss in checkpoint.state["recent"]]

    def train(self, tell: Progress, save_seconds: float) -> None:
        """Train to the end. A signal is raised after a checkpoint is written, a second one immediately."""
        config, total = self.config, self.config.iterations
        loss, held_out, making = None, None, 0.0
        saved = since = time.monotonic()
        self.model.train()
        # Iterations are never interrupted.
        with Metrics(self.run.path, self.done) as metrics, delay_signal() as interrupted:
            while self.done < total and not interrupted():
                self.recent.append(self.step(*self.batch(self.done, config.batch)))
                began = time.monotonic()
                self.advance()
                making += time.monotonic() - began
                self.done += 1
                values: dict[str, float] = {}
                if self.done % LOG_EVERY == 0 or self.done == total:
                    loss = sum(self.recent) / len(self.recent)
                    self.recent = []
                    if not loss < float("inf"):
                        raise failure(
                            "PD624",
                            f"the loss is no longer finite after {self.done:,} iterations",
                            notes=(f"in {self.run.path}",),
                            helps=(f"choose a smaller learning rate than {config.learning_rate:g}",),
                        )
                    seconds = time.monotonic() - since
                    values = {"loss/train": loss, "time/simulation": making / seconds}
                    values["time/pairs_a_second"] = LOG_EVERY * config.batch / seconds
                    since, making = time.monotonic(), 0.0
                every = self.validate_every
                if every and (self.done % every == 0 or self.done == total):
                    began = time.monotonic()
                    values |= self.validation()
                    held_out = values["loss/validation"]
                    since += time.monotonic() - began
                if values:
                    metrics.write(self.done, values)
                tell(self.done, loss, held_out)
                if time.monotonic() - saved > save_seconds:
                    self.save()
                    saved = time.monotonic()
            self.save()

    def step(self, starts: Tensor, ends: Tensor) -> float:
        """Take one step of Adam, and return the loss before it: cross-entropy per cell, in nats.

        Networks with random numbers, such as for dropout, draw the same ones after an interruption.
        """
        torch.manual_seed(int(mix(base_keys(torch.tensor([self.config.seed]), torch.tensor([self.done]))[0])))
        cuda = torch.device(self.machine.device).type == "cuda"
        with torch.autocast("cuda", torch.bfloat16, enabled=cuda):
            logits = self.model(starts)
        expected = (len(starts), self.slots, *starts.shape[-2:])
        if logits.shape != expected:
            raise ValueError(f"the network must return logits {list(expected)}, found {list(logits.shape)}")
        loss = F.cross_entropy(logits.float(), ends.long())
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        self.optimizer.step()
        return loss.item()

    def validation(self) -> dict[str, float]:
        """Metrics of the network on held-out pairs."""
        with _random_numbers_kept(next(self.model.parameters()).device):
            measured = score(self.model.eval(), self.held_out, self.slots).plain()
        self.model.train()
        named = {"loss/validation": measured["loss"]}
        named |= {f"validation/{name}": measured[name] for name in MEASURED}
        return {name: value for name, value in named.items() if value is not None}

    def save(self) -> None:
        model, optimizer = self.model.state_dict(), self.optimizer.state_dict()
        state = {"model": model, "optimizer": optimizer, "recent": [*self.recent]}
        self.run.save_checkpoint(self.done, state)


def network_missing(folder: Path, name: str) -> CompileError:
    """The error for a run whose network must be passed, since files must not determine what is executed (PD623)."""
    why = f"it was trained with the custom network `{name}`"
    helps = ("if you trust that code, pass `--network` as in training; otherwise it is not imported",)
    return misfit(folder, why, helps=helps)


def load_rules_of(config: DataConfig, palette: Palette) -> Ruleset:
    """The rules of a configuration, with the ids of a palette. Raises CompileError."""
    if config.rules:
        return load(config.rules, params=config.params, palette=palette)
    return load_task(config.task, knobs=config.knobs, params=config.params, palette=palette).ruleset


def palette_of(config: DataConfig, slots: int = 0) -> tuple[str | None, ...]:
    """The qualified name of the element of each slot: those of the task's own rules, and of the rules.

    Packs that are left out have slots too, which they use when added later. `slots` is the minimum number. Raises
    CompileError.
    """
    names = list(whole_palette(*load_task(config.task, knobs=config.knobs).rules))
    if config.rules:
        names += [name for name in whole_palette(config.rules) if name not in names]
    return (*names, *[None] * (slots - len(names)))


def _palette_for(config: TrainConfig, folder: Path, worlds: Worlds | None) -> tuple[str | None, ...]:
    """The slots of a run: as requested, as recorded in its folder, or as its rules need."""
    if config.palette:
        return config.palette
    if worlds is not None:
        names = worlds.rules.palette
        return (*names, *[None] * (config.slots - len(names)))
    palette = palette_of(config.data, config.slots)
    if not (folder / ABOUT).exists():
        return palette
    recorded = recorded_palette(read_run(folder))
    fits = len(recorded) >= config.slots and {*palette} <= {*recorded, None}
    return recorded if fits else palette  # `open_run` rejects another run


def check_slots(folder: Path, palette: Palette, rules: Ruleset) -> None:
    """Raise CompileError (PD623) if a run's network has no slots for elements of some rules."""
    fix = "or train the network on those packs: `powderdsl wm finetune RUN --packs PACK`"
    check_palette(folder, palette, {element.id: element.qualified for element in rules.elements}, fix)


# Trained networks: reading them from runs, and fine-tuning them on new packs


@dataclass(frozen=True)
class Trained:
    """A network from a run, with its configuration and its slots."""

    run: RunFolder
    config: TrainConfig
    palette: tuple[str | None, ...]
    network: nn.Module
    checkpoint: Checkpoint


def load_trained(
    path: str | Path | RunFolder, *, device: str = "cpu", network: nn.Module | CustomNetwork | None = None
) -> Trained:
    """The network of a run, with its newest weights, ready to predict.

    Args:
        network: the network of the training, unless it was the U-net. A run only records its name.

    Raises:
        CompileError: PD620 if there is no run, or no checkpoint that can be read; PD623 if the weights do not fit, or
            the network is missing or another one; PD625 if it cannot be created.
    """
    run = find_run(path, KIND)
    try:
        config = TrainConfig.of(run.config)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise not_a_run(run.path, str(error)) from None
    palette = recorded_palette(run)
    if network is None and config.network is not None:
        raise network_missing(run.path, config.network)
    if isinstance(network, CustomNetwork) and network.name != config.network:
        there = "the paper's U-net" if config.network is None else f"`{config.network}`"
        raise misfit(run.path, f"it was trained with {there}, not with `{network.name}`")
    checkpoint, model = run.checkpoint(), network_of(config, len(palette), network)
    fit_weights(model, checkpoint)
    return Trained(run, config, palette, model.to(device).eval(), checkpoint)


# Transfer: new packs are added to a network's rules, and training continues from its weights

SIMPLER = "kinds"
"""The knob for the number of elements to draw, among which other packs' elements come last."""


def finetuned(
    trained: Trained, packs: Sequence[str], *, iterations: int = 100, **changes: Any
) -> TrainConfig:
    """The configuration to continue training a network on worlds that draw only elements of `packs`.

    The rules are those of the run with the packs added. Elements with slots keep them; others get free slots, and if
    none are left, the network grows. A knob for the number of elements has its default, since its list may end before
    the packs' elements. Rulesets are not varied.

    Args:
        packs: names of shipped packs or of packs that the run left out, or files.
        changes: other fields of `TrainConfig`.

    Raises:
        CompileError: the errors of `load`.
    """
    config = trained.config
    if config.recorded is not None:
        raise misfit(trained.run.path, "it was trained on a dataset, which lacks other packs")
    own = config.data.rules or "+".join(load_task(config.data.task).rules)
    data = with_packs(config.data, own, packs)
    rules = load_rules_of(data, trained.palette)
    ids = [element.id for element in rules.elements]
    slots = [*trained.palette, *[None] * (max(ids) + 1 - len(trained.palette))]
    for element in rules.elements:
        slots[element.id] = element.qualified
    palette = tuple(slots)
    values = {"iterations": iterations, "parent": trained.checkpoint.path.name, **changes}
    return replace(config, data=data, palette=palette, **values)


def with_packs(data: DataConfig, own: str, packs: Sequence[str]) -> DataConfig:
    """The worlds of `data` under its own rules plus packs, drawing only these. Raises CompileError as `load`."""
    knobs = {name: value for name, value in data.knobs.items() if name != SIMPLER}
    return replace(data, rules=add(own, packs), only=pack_names(own, packs), knobs=knobs, rulesets=0)


# Rules with packs added and left out


def pack_names(rules: str, words: Iterable[str]) -> tuple[str, ...]:
    """The names of packs that are given by name or as files. Raises CompileError for a file that is not a pack.

    A name that a pack of the rules has, left out or not, means that pack.
    """
    known = _packs_named(rules)
    packs: dict[str, None] = {}
    for word in words:
        packs |= dict.fromkeys([word] if word in known else _names_of(word))
    return tuple(packs)


def leave_out(rules: str, packs: Iterable[str]) -> str:
    """The rules without some packs, given by name or as files."""
    plus, minus = split_names(rules)
    return _written(plus, [*minus, *pack_names(rules, packs)])


def add(rules: str, packs: Iterable[str]) -> str:
    """The rules with some packs, by name or as files: packs that were left out are restored, others are added."""
    plus, minus = split_names(rules)
    known = _packs_named(rules)
    for word in packs:
        names = [word] if word in known else _names_of(word)
        minus = [name for name in minus if name not in names]
        if not all(name in known for name in names):
            plus.append(word)
    return _written(plus, minus)


def keep(rules: str, packs: Sequence[str]) -> str:
    """The rules with only these packs. Packs that the rules do not have are added."""
    names = pack_names(rules, packs)
    others = [pack for pack in load(rules).packs if pack not in names]
    return add(leave_out(rules, others), packs)


def _packs_named(rules: str) -> tuple[str, ...]:
    """The packs that rules name, including those that are left out."""
    return _names_of(*split_names(rules)[0])


def _names_of(*words: str) -> tuple[str, ...]:
    reporter = Reporter()
    packs, _ = read(words, reporter)
    reporter.raise_if_errors()
    return tuple(pack.name.text for pack in packs)


def _written(plus: Sequence[str], minus: Iterable[str]) -> str:
    """Names joined by ``+``. Exclusions follow a name, since a file name may itself contain a ``-``."""
    names = list(plus)
    plain = [number for number, name in enumerate(names) if not name.endswith((".yaml", ".yml"))]
    place = plain[0] if plain else len(names) - 1
    names[place] += "".join(f"-{name}" for name in dict.fromkeys(minus))
    return "+".join(names)
