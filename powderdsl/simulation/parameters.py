"""Values of a ruleset's parameters for batches of worlds: defaults, and given ones after their checks."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from powderdsl.model.types import Ruleset
from powderdsl.simulation.state_checks import unknown_name
from powderdsl.targets.array_kind import Array, ArrayKind

BATCH_SIZES = 16
"""How many batch sizes the defaults are kept for."""


class Parameters:
    """Parameters of one ruleset as float64 [B]."""

    def __init__(self, ruleset: Ruleset, kind: ArrayKind):
        self._known = {param.name: param for param in ruleset.params}
        self._kind = kind
        self._defaults: dict[int, Mapping[str, Array]] = {}

    def defaults(self, batch: int) -> Mapping[str, Array]:
        """The defaults for a batch: the same mapping for the same size, which programs recognize. Nobody writes to it."""
        found = self._defaults.get(batch)
        if found is None:
            values = {name: float(param.default) for name, param in self._known.items()}
            found = {name: self._kind.put([value] * batch, "float64") for name, value in values.items()}
            kept = list(self._defaults.items())[1 - BATCH_SIZES :]
            self._defaults = dict(
                [*kept, (batch, found)]
            )  # a new one: another thread may be reading the old one
        return found

    def checked(self, params: Mapping[str, Any], batch: int) -> Mapping[str, Array]:
        """All parameters: copies of given values, and defaults. Raises KeyError, TypeError, ValueError."""
        values = self.defaults(batch)
        if not params:
            return values
        values, xp = dict(values), self._kind.xp
        for name, value in params.items():
            if name not in self._known:
                raise unknown_name("parameter", name, self._known)
            kind = self._known[name].kind
            lo, hi = (0.0, 1.0) if kind.name in ("chance", "flag") else (kind.lo, kind.hi)
            array = xp.asarray(self._kind.given(value, name), dtype=xp.float64)
            if array.ndim > 1 or (array.ndim == 1 and len(array) != batch):
                raise ValueError(f"{name} takes one value or {batch}, found shape {list(array.shape)}")
            if not bool(((array >= lo) & (array <= hi)).all()):
                raise ValueError(f"{name} takes {lo:g}..{hi:g}")
            if kind.name in ("int", "flag") and not bool((array == xp.floor(array)).all()):
                raise ValueError(f"{name} takes integers")
            values[name] = self._kind.copied(xp.broadcast_to(array, (batch,)))
        return values
