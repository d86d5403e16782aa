"""Cases: rules, start worlds and a target to compare with the reference."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from powderdsl.model.state import slots
from powderdsl.model.types import Ruleset
from powderdsl.testing.generators.cases import Start


@dataclass(frozen=True)
class Case:
    """Rules, worlds and a number of steps to run on a backend and compare with the reference."""

    text: str
    start: Start
    steps: int
    backend: str


def fitted(start: Start, ruleset: Ruleset) -> Start:
    """The same worlds for a ruleset from which something went: without what it does not have."""
    known = sorted(element.id for element in ruleset.elements)
    ids = np.where(np.isin(start.ids, known), start.ids, known[0]).astype(np.uint8)
    names = {slot.name for slot in slots(ruleset)[1:]}
    params = {param.name for param in ruleset.params}
    return replace(
        start,
        ids=ids,
        fields={name: values for name, values in start.fields.items() if name in names},
        params={name: values for name, values in start.params.items() if name in params},
    )
