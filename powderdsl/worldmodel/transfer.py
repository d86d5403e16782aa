"""Transfer: packs that a network has not seen are plugged into its rules, and it goes on from its weights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from powderdsl.tasks.shipped_tasks import load_task
from powderdsl.worldmodel.rule_words import add
from powderdsl.worldmodel.training import TrainConfig, Trained, check_palette, load_rules_of

SIMPLER = "kinds"
"""The knob that says how many elements are drawn: other packs' elements come after all of these."""


def finetuned(
    trained: Trained, packs: Sequence[str], *, iterations: int = 100, **changes: Any
) -> TrainConfig:
    """The configuration that goes on from a network, on worlds in which elements of `packs` alone are drawn.

    The rules are those of the run with the packs added; ids and channels stay where they are. A knob for the number of
    elements is left at its default, for its list may end before the packs' elements. Rulesets are not varied.

    Args:
        changes: other fields of `TrainConfig`.

    Raises:
        CompileError: PD623 if the network has no slots for the packs' elements; what `load` raises.
    """
    config = trained.config
    data = config.data
    rules = add(data.rules or load_task(data.task).ruleset.name, packs)
    knobs = {name: value for name, value in data.knobs.items() if name != SIMPLER}
    data = replace(data, rules=rules, only=tuple(packs), knobs=knobs, rulesets=0)
    check_palette(trained.run.path, trained.palette, load_rules_of(data))
    values = {"iterations": iterations, "parent": trained.checkpoint.path.name, **changes}
    return replace(config, data=data, **values)
