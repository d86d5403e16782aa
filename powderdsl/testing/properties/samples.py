"""Start worlds for tests: batches of one shape in which every world has a seed of its own."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

from powderdsl.analysis.reactions import unchanging_ids
from powderdsl.arrays import np
from powderdsl.model.state import Slot, slots
from powderdsl.model.types import Ruleset
from powderdsl.testing.generators.cases import Array, Start, clamped_to_holders, fresh, random_start
from powderdsl.testing.generators.choices import Choices

State = dict[str, Array]

SHAPES = ((3, 3), (2, 3), (4, 4), (1, 5), (5, 4), (6, 6), (3, 8), (1, 1), (8, 8), (2, 2), (7, 5), (5, 1))
"""Rows and columns of small worlds: tiny ones, where neighbors coincide, come often."""

LARGE = (16, 33)
"""Rows and columns of a few larger worlds, of odd width."""

ALIKE = 8
"""Worlds that are drawn from the same elements."""


def joined(samples: Sequence[Start], ruleset: Ruleset) -> Start:
    """Starts of one shape as one batch."""
    names = {name for sample in samples for name in sample.fields}
    table = {slot.name: slot for slot in slots(ruleset)}
    defaults = {param.name: float(param.default) for param in ruleset.params}
    given = {name for sample in samples for name in sample.params}
    return Start(
        np.concatenate([sample.ids for sample in samples]),
        np.concatenate([sample.seed for sample in samples]),
        np.concatenate([sample.index for sample in samples]),
        np.concatenate([sample.step for sample in samples]),
        {
            name: np.concatenate(
                [s.fields[name] if name in s.fields else fresh(ruleset, table[name], s.ids) for s in samples]
            )
            for name in sorted(names)
        },
        {
            name: np.concatenate([s.params.get(name, np.full(len(s), defaults[name])) for s in samples])
            for name in sorted(given)
        },
    )


def full_state(ruleset: Ruleset, sample: Start) -> State:
    """All slots of the start worlds in their storage dtypes. Cells that cannot hold a value have their usual one."""
    state: State = {"element": sample.ids}
    for slot in slots(ruleset)[1:]:
        given = sample.fields.get(slot.name)
        state[slot.name] = fresh(ruleset, slot, sample.ids) if given is None else given
    return flushed(ruleset, state)


def flushed(ruleset: Ruleset, state: State) -> State:
    """The state with the usual value of a slot in cells that cannot hold another one."""
    kept = {"element": state["element"]}
    for slot in slots(ruleset)[1:]:
        kept[slot.name] = clamped_to_holders(ruleset, slot, state[slot.name], state["element"])
    return kept


def random_samples(ruleset: Ruleset, seed: int, count: int) -> Iterator[Start]:
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
            sample = random_start(ruleset, choices, (ALIKE, *shape)).seeded()
            if group % 2:
                sample = replace(sample, fields={}, params={})
            if group % 4 == 1 and frames and min(shape) > 2:
                sample = replace(sample, ids=_framed(sample.ids, choices.pick(frames)))
            groups.append(sample)
        yield joined(groups, ruleset)
        left -= batch
        number += 1
    choices = Choices.seeded(seed)
    yield random_start(ruleset, choices, (4, *LARGE)).seeded()


def _framed(ids: Array, number: int) -> Array:
    framed = ids.copy()
    framed[:, [0, -1], :] = number
    framed[:, :, [0, -1]] = number
    return framed


# Worlds seen in a mirror or turned by a quarter: directions and vectors turn with their cells


def turned_cells(values: Array, turn: str) -> Array:
    """An array [..., H, W]: left and right exchanged (``mirrored``), or a quarter turn clockwise (``rotated``)."""
    if turn == "mirrored":
        return values[..., ::-1].copy()
    return np.rot90(values, -1, (-2, -1)).copy()


def turned_back(values: Array, turn: str) -> Array:
    """The inverse of `turned_cells`."""
    return turned_cells(values, turn) if turn == "mirrored" else np.rot90(values, 1, (-2, -1)).copy()


def turned_values(slot: Slot, values: Array, turn: str) -> Array:
    """A slot's array, turned."""
    cells = turned_cells(values, turn)
    if slot.kind.name == "direction":  # octants count clockwise from the right
        return ((4 - cells.astype(np.int64)) % 8 if turn == "mirrored" else (cells + 2) % 8).astype(
            slot.dtype
        )
    if slot.planes == 2:
        rows, columns = cells[:, 0], cells[:, 1]
        parts = (rows, -columns) if turn == "mirrored" else (columns, -rows)
        return np.stack(parts, 1) + np.float32(0)  # one zero only
    return cells


def turned_state(ruleset: Ruleset, state: State, turn: str) -> State:
    """All slots, turned. Cells that cannot hold a value keep the usual one, which does not turn."""
    found = {slot.name: turned_values(slot, state[slot.name], turn) for slot in slots(ruleset)}
    return flushed(ruleset, found)


def turned_sample(ruleset: Ruleset, sample: Start, turn: str) -> Start:
    """The start worlds, turned, with the same seeds."""
    state = turned_state(ruleset, full_state(ruleset, sample), turn)
    return replace(sample, ids=state.pop("element"), fields=state)
