"""Rulesets drawn from a distribution: other chances, swapped properties, packs left out. A number determines each."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import combinations
from typing import Any

import torch
from torch import Tensor

from powderdsl.compiler import read, starting_backend
from powderdsl.diagnostics import CompileError, Reporter, suggest
from powderdsl.model.check import check
from powderdsl.model.composition.names import with_stand_ins
from powderdsl.model.composition.palette import Palette
from powderdsl.model.declarations import ElementDecl, PackDecl
from powderdsl.model.parameter_values import set_params
from powderdsl.model.types import Ruleset
from powderdsl.simulation.simulator import World
from powderdsl.system.random import MASK, base_keys, mix
from powderdsl.system.writing import failure
from powderdsl.tasks.episodes import TaskProgram, compile_task
from powderdsl.tasks.task import Task
from powderdsl.worldmodel.watched import SplitWorlds, watched

TRIES = 8
"""How often a swap or a selection of packs is drawn again if the rules are inconsistent."""

MAX_RULESETS = 1024
"""The most rulesets of a run: each is checked before the first step, and each structure compiled."""

UNSEEN_RULESETS = 1 << 32
"""The first number of rulesets that models are tested on. Training takes numbers below it."""

_DRAW = 0x9F1D
"""The number of the hash by which rulesets are drawn."""


@dataclass(frozen=True)
class Variety:
    """How rulesets differ from the one that they are drawn around.

    `chances`: parameters that are chances are multiplied by a factor between 1/chances and chances, uniform in its
    logarithm, up to 1. `swaps`: for each of these properties, two elements exchange their values. `leave_out`: how
    likely each pack that no other one needs is to be left out.
    """

    chances: float = 1.0
    swaps: tuple[str, ...] = ()
    leave_out: float = 0.0

    def __post_init__(self) -> None:
        """Raises ValueError for values out of range."""
        if not 1 <= self.chances <= 1e6:
            raise ValueError(f"chances is a factor from 1 to 1,000,000, found {self.chances}")
        if not 0 <= self.leave_out < 1:
            raise ValueError(f"leave_out is a chance below 1, found {self.leave_out}")

    @staticmethod
    def of(values: Mapping[str, Any]) -> Variety:
        """The configuration in a run's JSON. Raises TypeError, ValueError."""
        return Variety(**{**values, "swaps": tuple(values.get("swaps", ()))})


@dataclass(frozen=True)
class Drawn:
    """A ruleset that was drawn. `left_out`: packs; `swapped`: property and two elements; `params`: other chances."""

    number: int
    left_out: tuple[str, ...]
    swapped: tuple[tuple[str, str, str], ...]
    params: tuple[tuple[str, float], ...]

    @property
    def structure(self) -> tuple[Any, ...]:
        """What decides the compiled code; parameters are inputs of each world."""
        return self.left_out, self.swapped


class RulesetSource:
    """Draws rulesets around one, which is `rules` as everywhere. The same number gives the same ruleset.

    `palette` has ids that were recorded, as `compiler.load` takes them.

    Raises:
        CompileError: what loading the rules raises; PD301 for a property that they do not have.
    """

    def __init__(
        self,
        rules: str | Sequence[str],
        variety: Variety,
        params: Mapping[str, Any] | None = None,
        palette: Palette | None = None,
    ):
        reporter = Reporter()
        self.packs, self.ruleset_decl = read([rules] if isinstance(rules, str) else rules, reporter)
        reporter.raise_if_errors()
        self.palette = palette
        self.base = self._checked(self.packs, params)
        self.variety, self.params = variety, params
        for name in variety.swaps:
            if self.base.property(name) is None:
                known = [one.name for one in self.base.properties]
                helps = suggest(name, known, "properties")
                raise failure("PD301", f"the rules {self.base.name} have no property `{name}`", helps=helps)

    def draw(self, number: int) -> Drawn:
        """Ruleset `number`, 0 or more. Inconsistent rulesets are drawn again."""
        draws = _draws(number)
        for _ in range(TRIES):
            left_out = self._left_out(draws)
            swapped = self._swapped(draws, left_out)
            try:
                model = self.model(Drawn(number, left_out, swapped, ()))
            except CompileError:
                continue
            params = self._chances(draws, model)
            return Drawn(number, left_out, swapped, params)
        return Drawn(number, (), (), self._chances(draws, self.base))

    def model(self, drawn: Drawn) -> Ruleset:
        """The checked model of a ruleset, with the base's parameters.

        Raises:
            CompileError: the rules are inconsistent.
        """
        return self._model(drawn.left_out, drawn.swapped)

    @lru_cache(maxsize=256)  # noqa: B019  a source lives as long as what it has checked
    def _model(self, left_out: tuple[str, ...], swapped: tuple[tuple[str, str, str], ...]) -> Ruleset:
        if not left_out and not swapped:
            return self.base
        packs = [pack for pack in self.packs if pack.name.text not in left_out]
        for prop, one, other in swapped:
            packs = _exchanged(packs, prop, one, other)
        there = {f"{pack.name.text}.{param.name.text}" for pack in packs for param in pack.params}
        return self._checked(
            packs, {name: value for name, value in (self.params or {}).items() if name in there}
        )

    def _checked(self, packs: Sequence[PackDecl], params: Mapping[str, Any] | None) -> Ruleset:
        reporter = Reporter()
        model = check(list(packs), self.ruleset_decl, reporter, self.palette)
        self.palette = self.palette or model.palette  # ids stay where they are when packs are left out
        if params:
            model = set_params(model, params, reporter)
        reporter.raise_if_errors()
        return model

    def _left_out(self, draws: Iterator[float]) -> tuple[str, ...]:
        """The packs that are left out, drawn one at a time; packs that others need stay."""
        if not self.variety.leave_out:
            return ()
        needed = {name.text for pack in with_stand_ins(self.packs) for name in pack.needs}
        loose = [pack.name.text for pack in self.packs if pack.name.text not in needed]
        return tuple(name for name in loose if next(draws) < self.variety.leave_out)

    def _swapped(self, draws: Iterator[float], left_out: tuple[str, ...]) -> tuple[tuple[str, str, str], ...]:
        """For each property, two elements with different values."""
        found = []
        for prop in self.variety.swaps:
            written = _written((pack for pack in self.packs if pack.name.text not in left_out), prop)
            pairs = [pair for pair in combinations(written, 2) if written[pair[0]] != written[pair[1]]]
            if pairs:
                found.append((prop, *pairs[int(next(draws) * len(pairs))]))
        return tuple(found)

    def _chances(self, draws: Iterator[float], model: Ruleset) -> tuple[tuple[str, float], ...]:
        """The chances of the model, each multiplied by a factor. All chances of the base draw one."""
        if self.variety.chances == 1:
            return ()
        spread, there = math.log(self.variety.chances), {param.name for param in model.params}
        found = []
        for param in self.base.params:
            if param.kind.name == "chance":
                factor = math.exp(spread * (2 * next(draws) - 1))
                if param.name in there:
                    found.append((param.name, min(1.0, float(param.default) * factor)))
        return tuple(found)


@dataclass(frozen=True)
class MixedPart:
    """Worlds of one structure: where they stand in the batch, and their chances, float64 [worlds] by parameter."""

    world: World
    places: Tensor
    params: Mapping[str, Tensor]


@dataclass(frozen=True)
class MixedWorld:
    """A batch of worlds of several rulesets."""

    parts: tuple[MixedPart, ...]

    @property
    def ids(self) -> Tensor:
        """Element ids, uint8 [B, H, W]."""
        order = torch.cat([part.places for part in self.parts]).argsort()
        return torch.cat([part.world.ids for part in self.parts])[order]


class VariedWorlds(SplitWorlds):
    """The worlds of a task's split, each under a ruleset of its own: world s under ruleset `first` + s mod `count`.

    Rulesets of one structure are compiled once and run together; their chances are parameters of each world.

    Args:
        task: under the source's own rules. only: as `DataConfig` has it.
        backend, device, threads: those of `powderdsl.compile`. ``auto`` takes what starts at once: compiling many
            rulesets would take longer than running them.

    Raises:
        CompileError: PD604 if worlds need an element that the rules do not have.
    """

    def __init__(
        self,
        task: Task,
        split: str,
        source: RulesetSource,
        count: int,
        *,
        first: int = 0,
        only: tuple[str, ...] = (),
        backend: str = "auto",
        device: str = "cpu",
        threads: int = 1,
    ):
        super().__init__(watched(task, split, source.base, only), torch.device(device))
        self.source, self.split, self.only, self._task = source, split, only, task
        self.drawn = [source.draw(first + number) for number in range(count)]
        self._machine: dict[str, Any] = {
            "backend": starting_backend(device) if backend == "auto" else backend,
            "device": device,
            "threads": threads,
        }
        self._programs: dict[tuple[Any, ...], TaskProgram] = {}

    def start(self, seeds: Tensor) -> MixedWorld:
        """The worlds of seeds, int64 [B]."""
        groups: dict[tuple[Any, ...], list[int]] = {}
        chosen = [self.drawn[seed % len(self.drawn)] for seed in seeds.tolist()]
        for number, one in enumerate(chosen):
            groups.setdefault(one.structure, []).append(number)
        parts = []
        for members in groups.values():
            places = torch.tensor(members, device=seeds.device)
            world = self._program(chosen[members[0]]).start(seeds[places]).world
            values = [dict(chosen[member].params) for member in members]
            params = {
                name: torch.tensor([one[name] for one in values], dtype=torch.float64, device=seeds.device)
                for name in values[0]
            }
            parts.append(MixedPart(world, places, params))
        return MixedWorld(tuple(parts))

    def later(self, world: MixedWorld, steps: int) -> MixedWorld:
        """The worlds some steps later."""
        later = [
            replace(part, world=part.world.sim.step(part.world, steps, params=part.params))
            for part in world.parts
        ]
        return MixedWorld(tuple(later))

    def _program(self, drawn: Drawn) -> TaskProgram:
        if drawn.structure not in self._programs:
            # Rules without some packs draw from the remaining elements; worlds that need others are replaced.
            found = watched(self._task, self.split, self.source.model(drawn), self.only, partly=True)
            self._programs[drawn.structure] = compile_task(found.task, split=self.split, **self._machine)
        return self._programs[drawn.structure]


def _draws(number: int) -> Iterator[float]:
    """Endless numbers from 0 to 1 that depend on `number` alone."""
    keys = base_keys(torch.tensor([number]), torch.tensor([_DRAW]))
    key, count = int(mix(keys[0] ^ keys[1])[0]), 0
    while True:
        yield int(mix(torch.tensor((key + count * 0x9E3779B1) & MASK))) / 2**32
        count += 1


def _written(packs: Iterable[PackDecl], prop: str) -> dict[str, Any]:
    """The values of a property as elements declare them, by name."""
    return {
        element.name.text: syntax
        for pack in packs
        for element in pack.elements
        for name, syntax in element.values
        if name.text == prop
    }


def _exchanged(packs: Sequence[PackDecl], prop: str, one: str, other: str) -> list[PackDecl]:
    """Packs in which two elements have exchanged their values of a property."""
    written = _written(packs, prop)
    new = {one: written[other], other: written[one]}

    def exchanged(element: ElementDecl) -> ElementDecl:
        values = tuple(
            (name, new.get(element.name.text, syntax) if name.text == prop else syntax)
            for name, syntax in element.values
        )
        return replace(element, values=values)

    return [replace(pack, elements=tuple(map(exchanged, pack.elements))) for pack in packs]
