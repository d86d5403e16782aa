"""Networks that have been trained: read from their runs, and taught packs that they have not seen.

Rules are as written on the command line, with packs added and left out: ``ruleset-pack+pack``.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from torch import nn

from powderdsl.compiler import load, read, split_names
from powderdsl.diagnostics import Reporter
from powderdsl.experiments.runs import Checkpoint, RunFolder, does_not_fit, find_run, no_run, recorded_palette
from powderdsl.model.composition.palette import Palette
from powderdsl.model.types import Ruleset
from powderdsl.tasks.shipped import load_task
from powderdsl.worldmodel.config import DataConfig, TrainConfig
from powderdsl.worldmodel.networks import CustomNetwork, fit_weights, network_of
from powderdsl.worldmodel.training import KIND, load_rules_of, network_missing


@dataclass(frozen=True)
class Trained:
    """A network from a run, with its configuration and its slots."""

    run: RunFolder
    config: TrainConfig
    palette: tuple[str | None, ...]
    network: nn.Module
    checkpoint: Checkpoint


def load_trained(
    path: str | Path | RunFolder,
    *,
    device: str = "cpu",
    network: nn.Module | CustomNetwork | None = None,
) -> Trained:
    """The network of a run, with its newest weights, ready to predict.

    Args:
        network: that of the training, unless it was the U-net. A run only records its name.

    Raises:
        CompileError: PD620 if there is no run, or no checkpoint that can be read; PD623 if the weights do not fit, or the
            network is not given, or another one; PD625 if it cannot be made.
    """
    run = path if isinstance(path, RunFolder) else find_run(path, KIND)
    try:
        config = TrainConfig.of(run.config)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise no_run(run.path, str(error)) from None
    palette = recorded_palette(run)
    if network is None and config.network is not None:
        raise network_missing(run.path, config.network)
    if isinstance(network, CustomNetwork) and network.name != config.network:
        there = "the paper's U-net" if config.network is None else f"`{config.network}`"
        raise does_not_fit(run.path, f"it was trained with {there}, not with `{network.name}`")
    checkpoint, model = run.checkpoint(), network_of(config, len(palette), network)
    fit_weights(model, checkpoint)
    return Trained(run, config, palette, model.to(device).eval(), checkpoint)


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
    if config.recorded is not None:
        raise does_not_fit(trained.run.path, "it learned from a dataset, and other packs are not in it")
    data = config.data
    data = with_packs(data, data.rules or "+".join(load_task(data.task).rules), packs)
    palette = extended_palette(trained.palette, load_rules_of(data, trained.palette))
    values = {"iterations": iterations, "parent": trained.checkpoint.path.name, **changes}
    return replace(config, data=data, palette=palette, **values)


def with_packs(data: DataConfig, own: str, packs: Sequence[str]) -> DataConfig:
    """The worlds of `data` under its own rules with packs added, which alone are drawn. Raises CompileError as `load`."""
    knobs = {name: value for name, value in data.knobs.items() if name != SIMPLER}
    return replace(data, rules=add(own, packs), only=pack_names(own, packs), knobs=knobs, rulesets=0)


def extended_palette(palette: Palette, rules: Ruleset) -> tuple[str | None, ...]:
    """A palette with the elements of rules that were loaded with it: in its free slots, then behind its end."""
    ids = [element.id for element in rules.elements]
    found = [*palette, *[None] * (max(ids) + 1 - len(palette))]
    for element in rules.elements:
        found[element.id] = element.qualified
    return tuple(found)


# Rules with packs added and left out


def pack_names(rules: str, words: Iterable[str]) -> tuple[str, ...]:
    """The names of packs that are given by name or as files. Raises CompileError for a file that is not a pack.

    A name of a pack of the rules, left out or not, stands for that pack.
    """
    known = _known(rules)
    found: dict[str, None] = {}
    for word in words:
        found |= dict.fromkeys([word] if word in known else _names_of(word))
    return tuple(found)


def leave_out(rules: str, packs: Iterable[str]) -> str:
    """The rules without some packs, which are given by name or as files."""
    plus, minus = split_names(rules)
    return _written(plus, [*minus, *pack_names(rules, packs)])


def add(rules: str, packs: Iterable[str]) -> str:
    """The rules with some packs, by name or as files: those that were left out come back, others are added."""
    plus, minus = split_names(rules)
    known = _known(rules)
    for word in packs:
        names = [word] if word in known else _names_of(word)
        minus = [name for name in minus if name not in names]
        if not all(name in known for name in names):
            plus.append(word)
    return _written(plus, minus)


def keep(rules: str, packs: Sequence[str]) -> str:
    """The rules with these packs alone. Those that the rules do not have are added."""
    kept = pack_names(rules, packs)
    gone = [pack for pack in load(rules).packs if pack not in kept]
    return add(leave_out(rules, gone), packs)


def _known(rules: str) -> tuple[str, ...]:
    """The packs that rules name, including those that are left out."""
    return _names_of(*split_names(rules)[0])


def _names_of(*words: str) -> tuple[str, ...]:
    reporter = Reporter()
    packs, _ = read(words, reporter)
    reporter.raise_if_errors()
    return tuple(pack.name.text for pack in packs)


def _written(plus: Sequence[str], minus: Iterable[str]) -> str:
    """Names joined by ``+``. What is left out stands behind a name, for a file's name may have a ``-`` of its own."""
    names = list(plus)
    plain = [number for number, name in enumerate(names) if not name.endswith((".yaml", ".yml"))]
    place = plain[0] if plain else len(names) - 1
    names[place] += "".join(f"-{name}" for name in dict.fromkeys(minus))
    return "+".join(names)
