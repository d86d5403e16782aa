"""Values of a ruleset's parameters for batches of worlds: defaults, and given ones after their checks."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from powderdsl.model.types import Ruleset
from powderdsl.simulation.state_checks import given_tensor, unknown_name

BATCH_SIZES = 16
"""How many batch sizes the defaults are kept for."""


class Parameters:
    """Parameters of one ruleset as float64 [B] on one device."""

    def __init__(self, ruleset: Ruleset, device: torch.device):
        self._known = {param.name: param for param in ruleset.params}
        self._device = device
        self._defaults: dict[int, Mapping[str, Tensor]] = {}

    def defaults(self, batch: int) -> Mapping[str, Tensor]:
        """The defaults for a batch: the same mapping for the same size, which programs recognize. Nobody writes to it."""
        found = self._defaults.get(batch)
        if found is None:
            values = {name: float(param.default) for name, param in self._known.items()}
            found = {
                name: torch.full((batch,), value, dtype=torch.float64, device=self._device)
                for name, value in values.items()
            }
            kept = list(self._defaults.items())[1 - BATCH_SIZES :]
            self._defaults = dict(
                [*kept, (batch, found)]
            )  # a new one: another thread may be reading the old one
        return found

    def checked(self, params: Mapping[str, Any], batch: int) -> Mapping[str, Tensor]:
        """All parameters: copies of given values, and defaults. Raises KeyError, TypeError, ValueError."""
        values = self.defaults(batch)
        if not params:
            return values
        values = dict(values)
        for name, value in params.items():
            if name not in self._known:
                raise unknown_name("parameter", name, self._known)
            kind = self._known[name].kind
            lo, hi = (0.0, 1.0) if kind.name in ("chance", "flag") else (kind.lo, kind.hi)
            tensor = given_tensor(value, name, self._device).to(torch.float64)
            if tensor.ndim > 1 or (tensor.ndim == 1 and len(tensor) != batch):
                raise ValueError(f"{name} takes one value or {batch}, found shape {list(tensor.shape)}")
            if not bool(((tensor >= lo) & (tensor <= hi)).all()):
                raise ValueError(f"{name} takes {lo:g}..{hi:g}")
            if kind.name in ("int", "flag") and not bool((tensor == tensor.round()).all()):
                raise ValueError(f"{name} takes integers")
            values[name] = tensor.expand(batch).clone()
        return values
