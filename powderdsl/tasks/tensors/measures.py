"""Measures on tensors: cell expressions lowered to one generated function, and sums of its results."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from powderdsl.ir.bits import NotBits, lower_bits, plane_slots
from powderdsl.ir.lower import lower_values, program_of, state_slots
from powderdsl.ir.ops import FLAG, Graph, Node, Program, SlotType, plane_name
from powderdsl.ir.stages import run_passes
from powderdsl.model.types import Expr, Ruleset
from powderdsl.simulation.simulator import World
from powderdsl.targets.cpp.counts import CellCounts, Counted
from powderdsl.targets.cpp.program import PackedState, Places
from powderdsl.targets.tensor_kind import pack
from powderdsl.targets.torch.program import DTYPES, Kernels, PassFunction, compiled
from powderdsl.targets.torch.source import pass_source
from powderdsl.tasks.goals import REGION_LET
from powderdsl.tasks.task import NOTHING, Measure
from powderdsl.tasks.tensors.actions import put_rows
from powderdsl.worlds.raster import Size


@dataclass(frozen=True)
class Masks:
    """Inputs of counts of packed worlds besides planes. A single row is shared by all worlds.

    `words`, int64 [B or 1, m, H, ⌈W/64⌉], are regions and targets; `sizes`, float64 [B or 1, n], are what the sums of
    measures are divided by.
    """

    words: Tensor
    sizes: Tensor

    def put(self, places: Tensor, new: Masks, worlds: int, reuse: bool) -> Masks:
        """Return the masks of `worlds` worlds with those of numbers `places` replaced."""
        if len(self.sizes) < worlds:
            return self
        return Masks(
            put_rows(self.words, places, new.words, reuse), put_rows(self.sizes, places, new.sizes, reuse)
        )


class Meter:
    """Executable measures for one ruleset and size.

    `fixed`: the regions that are the same in all worlds, bool [1, H, W].
    """

    def __init__(
        self,
        ruleset: Ruleset,
        measures: tuple[Measure, ...],
        size: Size,
        fixed: Mapping[str, Tensor],
        device: torch.device,
    ):
        self.ruleset, self.measures, self.size, self.device = ruleset, measures, size, device
        self._fixed = fixed
        self._counts: tuple[Places, CellCounts | None] | None = None
        values = [(number, measure) for number, measure in enumerate(measures) if measure.value is not None]
        self._cells = _Cells(ruleset, values, size, device) if values else None
        self._bits = range(state_slots(ruleset)[0].type.bits)
        """Of element ids."""
        named = {measure.region for measure in measures if measure.region is not None}
        self._regions = sorted(named | {name.removeprefix(REGION_LET) for name in _lets(measures)})
        self._targets = sorted({measure.target for measure in measures if measure.target is not None})
        self.own = bool(self._targets) or not {*self._regions} <= fixed.keys()
        """True if each world has its own masks."""

    def take(
        self,
        world: World,
        regions: Mapping[str, Tensor],
        targets: Mapping[str, Tensor],
        params: Mapping[str, Any] | None,
        masks: Masks,
        known: Tensor | None = None,
    ) -> Tensor:
        """The numbers of all measures: float64 [B, n]. `params` are those that differ from the rules' own.

        Packed worlds are not unpacked for measures on bit planes. `known`: completed if it has these already.
        """
        values, state, counts = known, world.state, None
        if values is None:
            values = torch.empty(len(world), len(self.measures), dtype=torch.float64, device=self.device)
        if isinstance(state, PackedState) and (counts := self.counts(state.program)) and known is None:
            counts.take(state.program.library, state.handle, masks.words, masks.sizes, values)
        left = [number for number in range(len(self.measures)) if not counts or number not in counts.numbers]
        cells = self._cells.of(world, regions, params) if self._cells is not None and left else {}
        for number in left:
            measure = self.measures[number]
            target = measure.target
            own = cells[number] if target is None else world.state["element"] == targets[target]
            values[:, number] = self._total(measure, own, regions) / masks.sizes[:, number]
        return values

    def masks(self, regions: Mapping[str, Tensor], targets: Mapping[str, Tensor]) -> Masks:
        """Return the masks of worlds, in the order of `_mask_numbers`."""
        planes = [regions[name] for name in self._regions]
        for name in self._targets:
            planes.append(targets[name] != NOTHING)
            planes += [(targets[name] >> bit & 1) != 0 for bit in self._bits]
        worlds = max(map(len, planes), default=1)
        sizes = [self._sizes(measure, regions, targets).expand(worlds) for measure in self.measures]
        words = [pack(plane.expand(worlds, *self.size)) for plane in planes]
        return Masks(
            torch.stack(words, 1) if words else torch.zeros(1, 0, dtype=torch.int64),
            torch.stack(sizes, 1) if sizes else torch.zeros(1, 0, dtype=torch.float64),
        )

    def _sizes(
        self, measure: Measure, regions: Mapping[str, Tensor], targets: Mapping[str, Tensor]
    ) -> Tensor:
        """Return the divisor of a measure's sum: float64 [B or 1]."""
        if measure.target is not None:
            size = (targets[measure.target] != NOTHING).sum((1, 2))
        elif measure.how in ("share", "mean") and measure.region is not None:
            size = regions[measure.region].sum((1, 2))
        else:
            whole = self.size[0] * self.size[1] if measure.how in ("share", "mean") else 1
            size = torch.tensor([whole], device=self.device)
        return size.clamp(min=1).double()

    def counts(self, program: Places) -> CellCounts | None:
        """Return a counter of the measures on bit planes of packed worlds; None if there are none."""
        if self._counts is None or self._counts[0] is not program:
            self._counts = program, self._counter(program.layout.planes, self.on_planes)
        return self._counts[1]

    @cached_property
    def on_planes(self) -> tuple[int, ...]:
        """The numbers of the measures on bit planes."""
        planes = {slot.name: 0 for slot in plane_slots(_lowered(self.ruleset, ()).slots)}
        return tuple(number for number in range(len(self.measures)) if self._counter(planes, [number]))

    def _counter(self, planes: Mapping[str, int], numbers: Sequence[int]) -> CellCounts | None:
        """Return a counter of some measures, or None if some need more than bit planes."""
        names = [*self._regions]
        for name in self._targets:
            names += [f"target {name}", *(plane_name(f"target {name}", bit) for bit in self._bits)]
        masks = {name: number for number, name in enumerate(names)}
        masks |= {REGION_LET + name: masks[name] for name in self._regions}
        values = [(i, self.measures[i]) for i in numbers if self.measures[i].value is not None]
        try:
            lowered = _lowered(self.ruleset, values)
            types = {slot.name: slot.type for slot in lowered.slots}
            flags = dict(lower_bits(lowered).passes[0].outputs) if values else {}
            counted = []
            for i in numbers:
                measure, name = self.measures[i], f"measure {i}"
                if measure.target is not None:
                    counted.append(Counted(self._same(f"target {measure.target}"), i))
                elif types[name] == FLAG:
                    counted.append(Counted(flags[name], i, measure.region, measure.how == "highest"))
                else:
                    bits, signed = types[name].bits, types[name].signed
                    for bit in range(bits):
                        weight = float(-(1 << bit) if signed and bit == bits - 1 else 1 << bit)
                        counted.append(
                            Counted(flags[plane_name(name, bit)], i, measure.region, False, weight)
                        )
            return CellCounts(counted, len(self.measures), planes, masks, self._rows(numbers))
        except (NotBits, KeyError, ValueError):
            return None  # floats, neighbors, too many gates: use tensors

    def _same(self, target: str) -> Node:
        """Return the cells that match a target, as a node on planes and masks."""
        build = Graph()
        same = build.input(target, FLAG)
        for bit in self._bits:
            here = build.input(plane_name("element", bit), FLAG)
            differs = build.node("xor", FLAG, (here, build.input(plane_name(target, bit), FLAG)))
            same = build.node("and", FLAG, (same, build.node("not", FLAG, (differs,))))
        return same

    def _rows(self, numbers: Sequence[int]) -> tuple[int, int]:
        """Return the first row that some measures count, and the row after the last."""
        regions = [str(self.measures[number].region) for number in numbers]
        if not regions or not {*regions} <= self._fixed.keys():
            return 0, self.size[0]
        rows = torch.cat([self._fixed[name] for name in regions]).any(2).any(0).nonzero()[:, 0].tolist() or [
            0
        ]
        return rows[0], rows[-1] + 1

    def cells(self, number: int, world: World, regions: Mapping[str, Tensor]) -> Tensor:
        """The cells that a measure counts, bool [B, H, W]."""
        assert self._cells is not None
        cells = self._cells.of(world, regions, None)[number].expand(len(world.step), *self.size)
        region = self.measures[number].region
        return cells if region is None else cells & regions[region]

    def _total(self, measure: Measure, cells: Tensor, regions: Mapping[str, Tensor]) -> Tensor:
        """The sum of cells, [B, H, W], of a measure: float64 [B]."""
        if measure.region is not None:
            mask = regions[measure.region]
            cells = cells & mask if cells.dtype == torch.bool else cells * mask
        if measure.how == "highest":
            height = self.size[0] - torch.arange(self.size[0], device=self.device)
            return (cells.any(2) * height).amax(1).double()
        exact = torch.int32 if cells.dtype == torch.bool else torch.int64  # counts: half the time
        return cells.sum((1, 2), dtype=torch.float64 if cells.dtype.is_floating_point else exact).double()


def _lets(measures: Sequence[Measure]) -> list[str]:
    """The regions that cell expressions name."""
    exprs = [measure.value for measure in measures if measure.value is not None]
    return sorted({str(part.value) for expr in exprs for part in expr.walk() if part.op == "let"})


def _lowered(ruleset: Ruleset, measures: Sequence[tuple[int, Measure]]) -> Program:
    """The cell expressions of numbered measures as a program of one pass, with an output for each: ``measure 3``."""
    regions = _lets([measure for _, measure in measures])
    values = {f"measure {i}": measure.value for i, measure in measures if measure.value is not None}
    graph = lower_values(ruleset, values, regions)
    others = {**dict.fromkeys(regions, FLAG), **{name: node.type for name, node in graph.outputs}}
    rows = [*state_slots(ruleset), *(SlotType(name, type, 0, False) for name, type in others.items())]
    return run_passes(program_of(ruleset, rows, [graph]))


class _Cells:
    """The cell expressions of measures as one generated function."""

    def __init__(
        self, ruleset: Ruleset, measures: list[tuple[int, Measure]], size: Size, device: torch.device
    ):
        self.ruleset, self.size, self.device = ruleset, size, device
        self.numbers = [number for number, _ in measures]
        source, name, constants = pass_source(_lowered(ruleset, measures).passes[0], 0)
        self.slots = [slot for slot in state_slots(ruleset) if f"state[{slot.name!r}]" in source]
        self.regions = _lets([measure for _, measure in measures])
        self.run: PassFunction = compiled(source, name, constants, device)

    def of(
        self, world: World, regions: Mapping[str, Tensor], params: Mapping[str, Any] | None
    ) -> dict[int, Tensor]:
        """The value of each cell, [B, H, W], by the measure's number. `params` are those that differ from the rules' own."""
        every = {}
        for param in self.ruleset.params:
            value = (params or {}).get(param.name, float(param.default))
            values = torch.as_tensor(value, dtype=torch.float64, device=self.device)
            every[param.name] = values.expand(len(world))
        none = torch.zeros(0, dtype=torch.int64, device=self.device)
        kernels = Kernels((len(world), *self.size), self.device, every, {}, {}, none, none, world.step)
        planes: dict[str, Tensor] = {}
        for slot in self.slots:
            planes[slot.name] = slot.of(world.state[slot.state]).to(DTYPES[slot.type.name])
        for name in self.regions:
            planes[name] = regions[name.removeprefix(REGION_LET)]
        cells = self.run(kernels, planes)
        return {number: cells[f"measure {number}"] for number in self.numbers}


@dataclass(frozen=True)
class ScalarInputs:
    """The inputs of a scalar: measures now, at the start and before the action, float64 [B, n]; and the action."""

    measures: Mapping[Measure, int]
    now: Tensor
    start: Tensor
    before: Tensor
    action: Mapping[str, Tensor]


def scalar_value(scalar: Expr, inputs: ScalarInputs) -> Tensor:
    """The value of an expression in each world: float64 [B]; conditions are 0 or 1."""
    value = _value(scalar, inputs)
    return value if value.ndim else value.expand(len(inputs.now)).clone()


def _value(scalar: Expr, inputs: ScalarInputs) -> Tensor:
    """The result of `scalar_value`, or float64 [] if all worlds have the same value."""
    match scalar.op:
        case "const":
            return torch.full((), float(scalar.value), dtype=torch.float64, device=inputs.now.device)
        case "measure":
            return inputs.now[:, inputs.measures[scalar.value]]
        case "action":
            return inputs.action[scalar.value].double()
        case "start" | "before":
            then = inputs.start if scalar.op == "start" else inputs.before
            return _value(scalar.args[0], replace(inputs, now=then))
    args = [_value(arg, inputs) for arg in scalar.args]
    value = _VALUES[scalar.op](*args)
    if scalar.op not in ("div", "quotient", "mod") or (scalar.args[1].op == "const" and scalar.args[1].value):
        return value
    return value.masked_fill(args[1] == 0, 0)


_VALUES: Mapping[str, Callable[..., Tensor]] = {
    "add": torch.add,
    "sub": torch.sub,
    "mul": torch.mul,
    "div": torch.div,
    "quotient": lambda a, b: torch.floor(a / b),
    "mod": torch.remainder,
    "neg": torch.neg,
    "abs": torch.abs,
    "min": torch.minimum,
    "max": torch.maximum,
    "lt": lambda a, b: (a < b).double(),
    "le": lambda a, b: (a <= b).double(),
    "eq": lambda a, b: (a == b).double(),
    "and": torch.mul,
    "or": torch.maximum,
    "not": lambda a: 1 - a,
    "choose": lambda condition, yes, no: torch.where(condition != 0, yes, no),
}
"""Operations on float64 [B]; flags are 0 or 1. `scalar_value` turns divisions by 0 into 0."""
