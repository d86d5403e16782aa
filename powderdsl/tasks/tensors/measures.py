"""Measures on tensors: cell expressions lowered to one generated function, and sums of what it gives."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from powderdsl.ir.bits import NotBits, lower_bits
from powderdsl.ir.lower import Inputs, ir_type, lower_expression, part_names
from powderdsl.ir.ops import FLAG, Graph, PassGraph, Program, SlotType, Type, component_of
from powderdsl.ir.stages import run_passes
from powderdsl.model.state import slots
from powderdsl.model.types import Expr, Ruleset
from powderdsl.simulation.simulator import World
from powderdsl.targets.cpp.counts import CellCounts, Counted
from powderdsl.targets.cpp.program import NativeProgram, PackedState
from powderdsl.targets.tensor_kind import pack
from powderdsl.targets.torch.program import DTYPES, Kernels, PassFunction, compiled
from powderdsl.targets.torch.source import pass_source
from powderdsl.tasks.goals import REGION_LET, parts_of
from powderdsl.tasks.task import NOTHING, Goal, Measure
from powderdsl.worlds.raster import Size


def scalars_of(goal: Goal) -> list[Expr]:
    """Every part of a goal's expressions."""
    scalars = [scalar for scalar in (goal.each, goal.final, goal.success, goal.failure) if scalar is not None]
    return [part for scalar in scalars for part in parts_of(scalar)]


def measures_in(scalars: Iterable[Expr]) -> tuple[Measure, ...]:
    """Every measure among parts of expressions, once."""
    return tuple(dict.fromkeys(part.value for part in scalars if part.op == "measure"))


class Meter:
    """Measures made executable for one ruleset and size.

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
        self._counts: tuple[NativeProgram, CellCounts | None] | None = None
        values = [(number, measure) for number, measure in enumerate(measures) if measure.value is not None]
        self._cells = _Cells(ruleset, values, size, device) if values else None

    def take(
        self,
        world: World,
        regions: Mapping[str, Tensor],
        targets: Mapping[str, Tensor],
        params: Mapping[str, Any] | None,
    ) -> Tensor:
        """The numbers of all measures: float64 [B, n]. `params` are those that differ from the rules' own."""
        state, batch = world.state, len(world)
        if isinstance(state, PackedState):
            if self._counts is None or self._counts[0] is not state.program:
                self._counts = state.program, self._cell_counts(state.program)
            counts = self._counts[1]
            if counts is not None:
                return counts.of(state.program.library, state.handle, batch)
        cells = self._cells.of(world, regions, params) if self._cells is not None else {}
        columns = []
        for number, measure in enumerate(self.measures):
            if measure.target is None:
                columns.append(self._reduced(measure, cells[number], regions))
                continue
            target = targets[measure.target]
            size = (target != NOTHING).sum((1, 2)).double()
            same = (world.state["element"] == target).sum((1, 2)).double()
            columns.append(same / size.clamp(min=1))
        if not columns:
            return torch.zeros(batch, 0, dtype=torch.float64, device=self.device)
        return torch.stack([column.expand(batch) for column in columns], 1)

    def _cell_counts(self, program: NativeProgram) -> CellCounts | None:
        """Return a counter of all measures in packed worlds, if bit planes show all cells that are counted."""
        counted_ways = ("count", "share", "highest")
        values = [(i, measure) for i, measure in enumerate(self.measures) if measure.how in counted_ways]
        regions = {measure.region for measure in self.measures if measure.region is not None}
        if not values or len(values) < len(self.measures) or not regions <= self._fixed.keys():
            return None
        try:
            (pass_,) = lower_bits(_lowered(self.ruleset, values)).passes
            flags, counted = dict(pass_.outputs), []
            for i, measure in values:
                flag, is_highest = flags[f"measure {i}"], measure.how == "highest"
                counted.append(Counted(flag, measure.region, is_highest, self._cells_of(measure)))
            masks = {name: pack(cells[0]) for name, cells in self._fixed.items()}
            masks |= {REGION_LET + name: words for name, words in masks.items()}
            everywhere = torch.ones(1, *self.size, dtype=torch.bool, device=self.device)
            cells = torch.cat([self._fixed.get(str(measure.region), everywhere) for _, measure in values])
            counted_rows = cells.any(2).any(0).nonzero()[:, 0].tolist() or [0]
            rows = counted_rows[0], counted_rows[-1] + 1
            return CellCounts(counted, program.layout.planes, masks, rows)
        except (NotBits, KeyError, ValueError):
            return None  # floats, neighbors, other regions: tensors show them

    def _cells_of(self, measure: Measure) -> float:
        """Return the divisor of a number of cells."""
        if measure.how != "share":
            return 1.0
        region = measure.region
        cells = self.size[0] * self.size[1] if region is None else int(self._fixed[region].sum())
        return float(max(1, cells))

    def cells(self, number: int, world: World, regions: Mapping[str, Tensor]) -> Tensor:
        """The cells that a measure counts, bool [B, H, W]."""
        assert self._cells is not None
        cells = self._cells.of(world, regions, None)[number].expand(len(world.step), *self.size)
        region = self.measures[number].region
        return cells if region is None else cells & regions[region]

    def _reduced(self, measure: Measure, cells: Tensor, regions: Mapping[str, Tensor]) -> Tensor:
        """One number a world, float64 [B], of cells [B, H, W]."""
        mask = None if measure.region is None else regions[measure.region]
        if mask is not None:
            cells = cells & mask if cells.dtype == torch.bool else cells * mask
        exact = torch.int32 if cells.dtype == torch.bool else torch.int64  # counts: half the time
        total = cells.sum((1, 2), dtype=torch.float64 if cells.dtype.is_floating_point else exact).double()
        match measure.how:
            case "share" | "mean":
                count = self.size[0] * self.size[1] if mask is None else mask.sum((1, 2))
                return total / torch.as_tensor(count, device=self.device).clamp(min=1)
            case "highest":
                height = self.size[0] - torch.arange(self.size[0], device=self.device)
                return (cells.any(2) * height).amax(1).double()
        return total


def _types(ruleset: Ruleset) -> dict[str, Type]:
    """The slots that cell expressions read, by name."""
    return {
        name: ir_type(slot.kind, ruleset.slots)
        for slot in slots(ruleset)
        for name in part_names(slot.name, slot.kind)
    }


def _lets(measures: Sequence[Measure]) -> list[str]:
    """The regions that cell expressions name."""
    exprs = [measure.value for measure in measures if measure.value is not None]
    return sorted({str(part.value) for expr in exprs for part in expr.walk() if part.op == "let"})


def _lowered(ruleset: Ruleset, measures: Sequence[tuple[int, Measure]]) -> Program:
    """The cell expressions of numbered measures as a program of one pass, with an output each: ``measure 3``."""
    build = Graph()
    types, regions = _types(ruleset), _lets([measure for _, measure in measures])
    state = {name: build.input(name, type) for name, type in types.items()}
    state |= {f"let {name}": build.input(name, FLAG) for name in regions}
    outputs = []
    for number, measure in measures:
        assert measure.value is not None
        (node,) = lower_expression(measure.value, Inputs(ruleset, build, state))
        outputs.append((f"measure {number}", node))
    every = {**types, **dict.fromkeys(regions, FLAG), **{name: node.type for name, node in outputs}}
    rows = [SlotType(name, type, 0, False) for name, type in every.items()]
    params = tuple((p.name, p.kind.name) for p in ruleset.params)
    streams = tuple((s.name, s.ident, s.bits) for s in ruleset.streams)
    graph = PassGraph("measures", ruleset.name, (), tuple(outputs))
    return run_passes(Program(ruleset.name, tuple(rows), params, streams, (graph,)))


class _Cells:
    """The cell expressions of measures as one generated function."""

    def __init__(
        self, ruleset: Ruleset, measures: list[tuple[int, Measure]], size: Size, device: torch.device
    ):
        self.ruleset, self.size, self.device = ruleset, size, device
        self.numbers = [number for number, _ in measures]
        source, name, constants = pass_source(_lowered(ruleset, measures).passes[0], 0)
        self.types = _types(ruleset)
        self.slots = [name for name in self.types if f"state[{name!r}]" in source]
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
        for name in self.slots:
            vector, component = component_of(name)
            plane = world.state[name] if component is None else world.state[vector][:, component]
            planes[name] = plane.to(DTYPES[self.types[name].name])
        for name in self.regions:
            planes[name] = regions[name.removeprefix(REGION_LET)]
        cells = self.run(kernels, planes)
        return {number: cells[f"measure {number}"] for number in self.numbers}


@dataclass(frozen=True)
class Facts:
    """The inputs of a scalar: measures now, at the start and before the action, float64 [B, n]; and the action."""

    measures: Mapping[Measure, int]
    now: Tensor
    start: Tensor
    before: Tensor
    action: Mapping[str, Tensor]


def scalar_value(scalar: Expr, facts: Facts) -> Tensor:
    """The value of an expression in each world: float64 [B]; conditions are 0 or 1."""
    value = _value(scalar, facts)
    return value if value.ndim else value.expand(len(facts.now)).clone()


def _value(scalar: Expr, facts: Facts) -> Tensor:
    """The value as `scalar_value` gives it, or float64 [] where all worlds have the same."""
    match scalar.op:
        case "const":
            return torch.full((), float(scalar.value), dtype=torch.float64, device=facts.now.device)
        case "measure":
            return facts.now[:, facts.measures[scalar.value]]
        case "action":
            return facts.action[scalar.value].double()
        case "start" | "before":
            then = facts.start if scalar.op == "start" else facts.before
            return _value(scalar.args[0], replace(facts, now=then))
    args = [_value(arg, facts) for arg in scalar.args]
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
