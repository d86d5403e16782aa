"""Rulesets drawn from a distribution: other chances, swapped properties, packs left out. A number determines each."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import torch

from powderdsl.compiler import read
from powderdsl.diagnostics import CompileError, Reporter, suggest
from powderdsl.model.check import check
from powderdsl.model.composition.compose import Palette
from powderdsl.model.composition.names import with_stand_ins
from powderdsl.model.declarations import ElementDecl, PackDecl
from powderdsl.model.definitions import set_params
from powderdsl.model.types import Ruleset
from powderdsl.system.random import MASK, base_keys, mix
from powderdsl.system.writing import failure
from powderdsl.worldmodel.config import Variety

TRIES = 8
"""How often a swap or a selection of packs is drawn again if the rules are inconsistent."""

UNSEEN_RULESETS = 1 << 32
"""The first number of rulesets that models are tested on. Training takes numbers below it."""

_DRAW = 0x9F1D
"""The number of the hash by which rulesets are drawn."""


@dataclass(frozen=True)
class Drawn:
    """A ruleset that was drawn. `left_out`: packs; `swapped`: property and two elements; `params`: other chances."""

    number: int
    left_out: tuple[str, ...] = ()
    swapped: tuple[tuple[str, str, str], ...] = ()
    params: tuple[tuple[str, float], ...] = ()

    @property
    def structure(self) -> tuple[Any, ...]:
        """The changes that decide the compiled code. Parameters, which are inputs of each world, are not among them."""
        return self.left_out, self.swapped


def check_properties(rules: Ruleset, names: Sequence[str]) -> None:
    """Raise CompileError (PD301) for a property that rules do not have."""
    for name in names:
        if rules.property(name) is None:
            helps = suggest(name, [prop.name for prop in rules.properties], "properties")
            raise failure("PD301", f"the rules {rules.name} have no property `{name}`", helps=helps)


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
        self.variety, self.params, self.palette = variety, params or {}, palette
        self.base = self._checked(self.packs)
        self._models = {Drawn(0).structure: self.base}
        self.palette = palette or self.base.palette  # ids stay where they are when packs are left out
        check_properties(self.base, variety.swaps)

    def draw(self, number: int) -> Drawn:
        """Ruleset `number`, 0 or more. Inconsistent rulesets are drawn again."""
        draws = _draws(number)
        for _ in range(TRIES):
            left_out = self._left_out(draws)
            drawn = Drawn(number, left_out, self._swapped(draws, left_out))
            try:
                model = self.model(drawn)
            except CompileError:
                continue
            return replace(drawn, params=self._chances(draws, model))
        return Drawn(number, params=self._chances(draws, self.base))

    def model(self, drawn: Drawn) -> Ruleset:
        """The checked model of a ruleset, with the base's parameters. Raises CompileError for inconsistent rules."""
        if drawn.structure not in self._models:
            packs = [pack for pack in self.packs if pack.name.text not in drawn.left_out]
            for prop, first, second in drawn.swapped:
                packs = _exchanged(packs, prop, first, second)
            self._models[drawn.structure] = self._checked(packs)
        return self._models[drawn.structure]

    def _checked(self, packs: Sequence[PackDecl]) -> Ruleset:
        reporter = Reporter()
        model = check(list(packs), self.ruleset_decl, reporter, self.palette)
        left_out = {pack.name.text for pack in self.packs} - {pack.name.text for pack in packs}
        params = {
            name: value for name, value in self.params.items() if name.partition(".")[0] not in left_out
        }
        model = set_params(model, params, reporter) if params else model
        reporter.raise_if_errors()
        return model

    def _left_out(self, draws: Iterator[float]) -> tuple[str, ...]:
        """The packs that are left out, drawn one at a time; packs that others need stay."""
        if not self.variety.leave_out:
            return ()
        needed = {name.text for pack in with_stand_ins(self.packs).values() for name in pack.needs}
        loose = [pack.name.text for pack in self.packs if pack.name.text not in needed]
        return tuple(name for name in loose if next(draws) < self.variety.leave_out)

    def _swapped(self, draws: Iterator[float], left_out: tuple[str, ...]) -> tuple[tuple[str, str, str], ...]:
        """For each property, two elements with different values."""
        packs = [pack for pack in self.packs if pack.name.text not in left_out]
        swapped = []
        for prop in self.variety.swaps:
            values = _values(packs, prop)
            pairs = [pair for pair in combinations(values, 2) if values[pair[0]] != values[pair[1]]]
            if pairs:
                swapped.append((prop, *pairs[int(next(draws) * len(pairs))]))
        return tuple(swapped)

    def _chances(self, draws: Iterator[float], model: Ruleset) -> tuple[tuple[str, float], ...]:
        """The chances of the model, each multiplied by a factor. All chances of the base draw one."""
        if self.variety.chances == 1:
            return ()
        spread, names = math.log(self.variety.chances), {param.name for param in model.params}
        chances = []
        for param in self.base.params:
            if param.kind.name == "chance":
                factor = math.exp(spread * (2 * next(draws) - 1))
                if param.name in names:
                    chances.append((param.name, min(1.0, float(param.default) * factor)))
        return tuple(chances)


def _draws(number: int) -> Iterator[float]:
    """Endless numbers from 0 to 1 that depend on `number` alone."""
    keys = base_keys(torch.tensor([number]), torch.tensor([_DRAW]))
    key, count = int(mix(keys[0] ^ keys[1])[0]), 0
    while True:
        yield int(mix(torch.tensor((key + count * 0x9E3779B1) & MASK))) / 2**32
        count += 1


def _values(packs: Iterable[PackDecl], prop: str) -> dict[str, Any]:
    """The values of a property as elements declare them, by name."""
    return {
        element.name.text: syntax
        for pack in packs
        for element in pack.elements
        for name, syntax in element.values
        if name.text == prop
    }


def _exchanged(packs: Sequence[PackDecl], prop: str, first: str, second: str) -> list[PackDecl]:
    """Packs in which two elements have exchanged their values of a property."""
    values = _values(packs, prop)
    new = {first: values[second], second: values[first]}

    def exchanged(element: ElementDecl) -> ElementDecl:
        swapped = tuple(
            (name, new.get(element.name.text, syntax) if name.text == prop else syntax)
            for name, syntax in element.values
        )
        return replace(element, values=swapped)

    return [replace(pack, elements=tuple(map(exchanged, pack.elements))) for pack in packs]
