"""A ruleset from text, and start worlds that are random in everything a world holds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from powderdsl.diagnostics import Reporter, Source
from powderdsl.model.check import check
from powderdsl.model.declarations import PackDecl
from powderdsl.model.packs import read_file
from powderdsl.model.state import SNAP, Slot, fitting, slots
from powderdsl.model.types import Ruleset
from powderdsl.testing.generators.choices import Choices

if TYPE_CHECKING:
    from powderdsl.simulation.simulator import Simulator, World

SIDES = (1, 2, 3, 4, 5, 7, 9, 16, 31, 32, 33, 63, 64, 65, 97)
"""Lengths of sides: tiny ones, where neighbors coincide, and the borders of words of 32 and 64 columns."""

CLOCKS = (0, 0, 0, 1, 6, 1 << 20, (1 << 32) - 1, 1 << 40)
"""Steps at which worlds start: the clock runs on beyond 32 bits."""

FEW_CELLS = 12
"""Worlds of so few cells are chosen cell by cell, so that Hypothesis can shrink them; others are filled by a seed."""


def load_text(text: str, name: str = "random.yaml") -> Ruleset:
    """The checked model of one pack given as text. Raises CompileError."""
    reporter = Reporter()
    pack = read_file(Source(name, text), reporter)
    reporter.raise_if_errors()
    if not isinstance(pack, PackDecl):
        raise ValueError("the text is no pack")
    return check([pack], None, reporter)


@dataclass(frozen=True)
class Start:
    """A batch of start worlds, free of any backend.

    `ids` is uint8 [B, H, W]; `fields` are arrays by slot name, [B, H, W] or [B, 2, H, W]; `params` are values for
    all of a ruleset's parameters, one a world, or none; `step` is what the clock says.
    """

    ids: np.ndarray
    fields: dict[str, np.ndarray] = field(default_factory=dict)
    seed: int = 0
    params: dict[str, list[float]] = field(default_factory=dict)
    step: int = 0

    def world(self, simulator: Simulator) -> World:
        """The same worlds for any simulator of the ruleset."""
        world = simulator.world(self.ids.astype(np.int64), seed=self.seed)
        world = replace(world, step=world.step + self.step)
        return simulator.replace(world, **self.fields) if self.fields else world

    def __str__(self) -> str:
        shape = "×".join(map(str, self.ids.shape))
        told = [
            f"worlds {shape}, seed {self.seed}, step {self.step}, ids {self.ids.tolist() if self.ids.size <= 80 else '…'}"
        ]
        told += [
            f"{name} {values.tolist() if values.size <= 160 else '…'}" for name, values in self.fields.items()
        ]
        return "\n".join([*told, *(f"{name} = {values}" for name, values in self.params.items())])


def random_start(
    ruleset: Ruleset,
    choices: Choices,
    shape: Sequence[int] | None = None,
    max_batch: int = 3,
    max_side: int = 65,
) -> Start:
    """Random worlds: any shape up to the bounds, any ids, and any values that the ruleset's fields can hold."""
    if shape is None:
        shape = (choices.whole(1, max_batch), *_sides(choices, max_side))
    palette = [e.id for e in ruleset.elements]
    palette = choices.some(palette, 1, len(palette)) if choices.maybe(40) else palette
    shape = (shape[0], *(fitting(ruleset, side) for side in shape[1:]))
    fill = _Fill(choices, tuple(shape))
    ids = fill.choose(palette).astype(np.uint8)
    fields: dict[str, np.ndarray] = {}
    for slot in slots(ruleset)[1:]:
        if not choices.maybe(15):  # else it stays fresh
            fields[slot.name] = _values(ruleset, slot, ids, fill)
    params = (
        {p.name: [_param(p.kind, choices) for _ in range(shape[0])] for p in ruleset.params}
        if choices.maybe(25)
        else {}
    )
    return Start(ids, fields, choices.below(1 << 31), params, choices.pick(CLOCKS))


def _sides(choices: Choices, max_side: int) -> tuple[int, int]:
    lengths = [side for side in SIDES if side <= max_side]
    height, width = choices.pick(lengths[:6]), choices.pick(lengths)
    return (width, height) if choices.maybe(20) else (height, width)


class _Fill:
    """Fills arrays of one shape with random values, cell by cell or from one seed."""

    def __init__(self, choices: Choices, shape: tuple[int, ...]):
        self.choices = choices
        self.shape = shape
        self.generator = (
            None if np.prod(shape) <= FEW_CELLS else np.random.default_rng(choices.below(1 << 31))
        )

    def choose(self, options: Sequence[Any], planes: int = 1) -> np.ndarray:
        """An array of the shape (with an axis of planes, if there are two) whose cells are options."""
        shape = self.shape if planes == 1 else (self.shape[0], planes, *self.shape[1:])
        if self.generator is not None:
            return np.asarray(options)[self.generator.integers(0, len(options), shape)]
        picks = [self.choices.below(len(options)) for _ in range(int(np.prod(shape)))]
        return np.asarray(options)[np.reshape(picks, shape)]


def _values(ruleset: Ruleset, slot: Slot, ids: np.ndarray, fill: _Fill) -> np.ndarray:
    """Values for a slot: extremes are frequent; where the element cannot hold one, its usual value."""
    kind, choices = slot.kind, fill.choices
    prop = ruleset.property(slot.name)
    if slot.is_real:
        values = fill.choose(_reals(kind.lo, kind.hi, choices), slot.planes).astype(np.float32)
    else:
        lo, hi = {"flag": (0, 1), "direction": (0, 7)}.get(kind.name, (int(kind.lo), int(kind.hi)))
        options = [e.id for e in ruleset.elements] if kind.name == "element" else _wholes(lo, hi, choices)
        values = fill.choose(options).astype(slot.dtype)
    limited = prop.stored if prop is not None else slot.of
    if limited is None:
        return values
    holders = np.isin(ids, sorted(limited))
    if prop is not None:
        defaults = {p.name: p.default for p in ruleset.params}
        table = np.zeros(256, values.dtype)
        table[: len(prop.values)] = [defaults[v] if isinstance(v, str) else v for v in prop.values]
        return np.where(holders, values, table[ids])
    if slot.planes == 2:
        usual = np.asarray(slot.default, np.float32)[None, :, None, None]
        return np.where(holders[:, None], values, usual)
    return np.where(holders, values, np.asarray(slot.default, values.dtype))


def _wholes(lo: int, hi: int, choices: Choices) -> list[int]:
    near = {min(max(v, lo), hi) for v in (0, 1, -1, 2, lo, hi, lo + 1, hi - 1)}
    return sorted(sorted({*near, *(choices.whole(lo, hi) for _ in range(3))}), key=abs)


def _reals(lo: float, hi: float, choices: Choices) -> list[float]:
    """Zeros, bounds, SNAP and its neighbors, numbers that do not add up exactly."""
    wanted = [0.0, 1.0, -1.0, 0.1, -0.1, lo, hi, SNAP, -SNAP, 1.5 * SNAP, 0.3, 1 / 3, hi * 0.7, lo * 0.7]
    wanted += [lo + (hi - lo) * choices.below(1000) / 999 for _ in range(4)]
    return [value for value in wanted if lo <= value <= hi]


def _param(kind: Any, choices: Choices) -> float:
    match kind.name:
        case "flag":
            return choices.below(2)
        case "int":
            return choices.pick([int(kind.lo), int(kind.hi), choices.whole(int(kind.lo), int(kind.hi))])
        case "chance":
            return choices.pick([0.5, 0.0, 1.0, 2.0**-16, 0.3])
    return choices.pick(
        [float(kind.lo), float(kind.hi), 0.1, kind.lo + (kind.hi - kind.lo) * choices.below(1000) / 999]
    )
