"""Transfer: packs that a network has not seen are plugged into its rules, and it continues from its weights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from powderdsl.tasks.shipped import load_task
from powderdsl.worldmodel.rule_words import add, pack_names
from powderdsl.worldmodel.training import TrainConfig, Trained, extended_palette, load_rules_of

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
