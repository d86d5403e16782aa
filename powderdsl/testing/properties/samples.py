"""Start worlds for tests: batches of one shape in which every world has a seed of its own."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from powderdsl.analysis.reactions import unchanging_ids
from powderdsl.model.state import Slot, slots
from powderdsl.model.types import Ruleset
from powderdsl.testing.generators.cases import Start, random_start
from powderdsl.testing.generators.choices import Choices

Array = np.ndarray[Any, Any]
State = dict[str, Array]

SHAPES = ((3, 3), (2, 3), (4, 4), (1, 5), (5, 4), (6, 6), (3, 8), (1, 1), (8, 8), (2, 2), (7, 5), (5, 1))
"""Rows and columns of small worlds: tiny ones, where neighbors coincide, come often."""

LARGE = (16, 33)
"""Rows and columns of a few larger worlds, of odd width."""

ALIKE = 8
"""Worlds that are drawn from the same elements."""


@dataclass(frozen=True)
class Sample:
    """Start worlds. `ids` is uint8 [B, H, W], `fields` are [B, H, W] or [B, 2, H, W] by slot; other slots are fresh.

    `seeds` and `clock`, int64 [B], are each world's seed and what its clock says; `params` are float64 [B].
    """

    ids: Array
    seeds: Array
    clock: Array
    fields: Mapping[str, Array] = field(default_factory=dict)
    params: Mapping[str, Array] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns)."""
        return self.ids.shape[1], self.ids.shape[2]

    def select(self, worlds: Any) -> Sample:
        """Some worlds of the batch, by anything that indexes an array."""
        return Sample(
            self.ids[worlds],
            self.seeds[worlds],
            self.clock[worlds],
            {name: values[worlds] for name, values in self.fields.items()},
            {name: values[worlds] for name, values in self.params.items()},
        )

    def without(self, gone: frozenset[int], ruleset: Ruleset) -> Sample:
        """The same worlds with the first other element where one of these is, in cells and in fields."""
        if not gone:
            return self
        other = min(element.id for element in ruleset.elements if element.id not in gone)
        names = {slot.name for slot in slots(ruleset) if slot.kind.name == "element"}

        def kept(values: Array) -> Array:
            return np.where(np.isin(values, sorted(gone)), values.dtype.type(other), values)

        fields = {name: kept(values) if name in names else values for name, values in self.fields.items()}
        return replace(self, ids=kept(self.ids), fields=fields)

    def one(self, world: int) -> Sample:
        return self.select(slice(world, world + 1))

    def repeated(self, count: int) -> Sample:
        """One world, many times over."""
        return self.select(np.zeros(count, np.int64))


def sample_of(start: Start) -> Sample:
    """What Hypothesis or a case drew. Seeds count up from its own."""
    batch = len(start.ids)
    return Sample(
        start.ids,
        start.seed + np.arange(batch, dtype=np.int64),
        np.full(batch, start.step, np.int64),
        start.fields,
        {name: np.asarray(values, np.float64) for name, values in start.params.items()},
    )


def single(ids: Sequence[Sequence[int]] | Array, seed: int = 0) -> Sample:
    """One fresh world."""
    return Sample(np.asarray(ids, np.uint8)[None], np.array([seed], np.int64), np.zeros(1, np.int64))


def joined(samples: Sequence[Sample], ruleset: Ruleset) -> Sample:
    """Samples of one shape as one batch."""
    names = {name for sample in samples for name in sample.fields}
    table = {slot.name: slot for slot in slots(ruleset)}
    defaults = {param.name: float(param.default) for param in ruleset.params}
    given = {name for sample in samples for name in sample.params}
    return Sample(
        np.concatenate([sample.ids for sample in samples]),
        np.concatenate([sample.seeds for sample in samples]),
        np.concatenate([sample.clock for sample in samples]),
        {
            name: np.concatenate([s.fields.get(name, fresh(ruleset, table[name], s.ids)) for s in samples])
            for name in sorted(names)
        },
        {
            name: np.concatenate([s.params.get(name, np.full(len(s), defaults[name])) for s in samples])
            for name in sorted(given)
        },
    )


def fresh(ruleset: Ruleset, slot: Slot, ids: Array) -> Array:
    """A slot's values in fresh cells of these elements."""
    prop = ruleset.property(slot.name)
    if prop is not None:
        defaults = {param.name: param.default for param in ruleset.params}
        table = np.zeros(256, slot.dtype)
        table[: len(prop.values)] = [defaults[v] if isinstance(v, str) else v for v in prop.values]
        return table[ids]
    values = np.array([slot.fresh(identity) for identity in range(256)], slot.dtype)[ids]
    return np.moveaxis(values, -1, 1) if slot.planes == 2 else values


def holders(ruleset: Ruleset, slot: Slot) -> frozenset[int] | None:
    """The elements whose cells may hold values of their own in a slot; None: all."""
    prop = ruleset.property(slot.name)
    return prop.stored if prop is not None else slot.of


def full_state(ruleset: Ruleset, sample: Sample) -> State:
    """All slots of the start worlds in their storage dtypes. Cells that cannot hold a value have their usual one."""
    state: State = {"element": sample.ids}
    for slot in slots(ruleset)[1:]:
        given = sample.fields.get(slot.name)
        state[slot.name] = fresh(ruleset, slot, sample.ids) if given is None else given
    return settled(ruleset, state)


def settled(ruleset: Ruleset, state: State) -> State:
    """The state with the usual value of a slot in cells that cannot hold another one."""
    kept = dict(state)
    for slot in slots(ruleset)[1:]:
        limited = holders(ruleset, slot)
        if limited is not None:
            may = np.isin(state["element"], sorted(limited))
            usual = fresh(ruleset, slot, state["element"])
            values = np.where(may[:, None] if slot.planes == 2 else may, state[slot.name], usual)
            kept[slot.name] = values.astype(slot.dtype)
    return kept


def random_samples(ruleset: Ruleset, seed: int, count: int) -> Iterator[Sample]:
    """Batches of random worlds of a ruleset, `count` worlds in all, the same for the same seed.

    Every other group of worlds starts with fresh fields; every fourth is framed by something that never changes, as
    worlds are that must not wrap around.
    """
    frames = sorted(unchanging_ids(ruleset))
    batch = 64
    left, number = count, 0
    while left > 0:
        shape = SHAPES[number % len(SHAPES)]
        groups = []
        for group in range(min(batch, left + ALIKE - 1) // ALIKE):
            choices = Choices.seeded((seed * 1_000_003 + number) * batch + group)
            sample = sample_of(random_start(ruleset, choices, (ALIKE, *shape)))
            if group % 2:
                sample = replace(sample, fields={}, params={})
            if group % 4 == 1 and frames and min(shape) > 2:
                sample = replace(sample, ids=_framed(sample.ids, choices.pick(frames)))
            groups.append(sample)
        yield joined(groups, ruleset)
        left -= batch
        number += 1
    choices = Choices.seeded(seed)
    yield sample_of(random_start(ruleset, choices, (4, *LARGE)))


def _framed(ids: Array, number: int) -> Array:
    framed = ids.copy()
    framed[:, [0, -1], :] = number
    framed[:, :, [0, -1]] = number
    return framed
