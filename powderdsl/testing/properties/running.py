"""Runs start worlds, and records their state after each step and the lines of rules that fired."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from typing import TYPE_CHECKING, Any

from powderdsl.analysis.changes import unchanging_ids
from powderdsl.arrays import np
from powderdsl.diagnostics import Span
from powderdsl.model import reference
from powderdsl.model.expressions.operators import TRUE
from powderdsl.model.state import Slot, slots
from powderdsl.model.types import FLAG, Assign, Field, Pass, Rule, Ruleset, Substep, substeps
from powderdsl.simulation.programs import starting_backend
from powderdsl.simulation.simulator import compile
from powderdsl.testing.generators.cases import Array, Choices, Start, fresh, full_state, random_start

if TYPE_CHECKING:
    from powderdsl.simulation.simulator import Simulator, World

MARK = "happened "
"""How the flags are called that lines of rules set. No rule file can have a name with a blank."""


class Runner:
    """Runs a ruleset on one backend. `happened` collects the lines of rules that changed or claimed some cell.

    `sim`: an existing simulator, which sets no flags, so that no fired lines are recorded.
    """

    def __init__(self, ruleset: Ruleset, backend: str | None = None, sim: Simulator | None = None):
        self.ruleset = ruleset
        self.backend = backend or starting_backend("cpu")
        self.lines = () if sim else rule_spans(ruleset)
        if sim is not None:
            self.sim = sim
        self.happened: set[Span] = set()
        self.worlds_run = 0

    @cached_property
    def sim(self) -> Simulator:
        """Runs the rules and sets flags for the lines that happen."""
        return compile(with_line_marks(self.ruleset), self.backend, tensors=False)

    def of(self, ruleset: Ruleset) -> Runner:
        """Runs other rules in the same way."""
        return Runner(ruleset, self.backend)

    def states(self, sample: Start, steps: int, random: Mapping[str, Array] | None = None) -> list[State]:
        """The state at the start and after each step, in storage dtypes. `random`: draws for all streams."""
        history, end = run_sample(self.sim, sample, steps, random, self.ruleset)
        self.worlds_run += len(sample)
        self.note(end.state)
        return history

    def note(self, state: Mapping[str, Any]) -> None:
        """Record which lines fired on the way to this state of `sim`."""
        for number, span in enumerate(self.lines):
            if span not in self.happened and bool(state[f"{MARK}{number}"].any()):
                self.happened.add(span)


def run_sample(
    sim: Simulator,
    sample: Start,
    steps: int,
    random: Mapping[str, Array] | None = None,
    ruleset: Ruleset | None = None,
) -> tuple[list[State], World]:
    """The state at the start and after each step, in storage dtypes, and the world after the last one.

    `ruleset`: whose slots are kept, if the simulator has more.
    """
    names = [slot.name for slot in slots(ruleset or sim.ruleset)]
    world, history = sample.world(sim, ruleset), list[State]()
    for step in range(steps + 1):
        if step:
            world = sim.step(world, random=random, params=dict(sample.params) or None)
        history.append({name: sim.kind.to_numpy(world.state[name]) for name in names})
    return history, world


def first_difference(
    first: Sequence[State], second: Sequence[State], names: Iterable[str] | None = None
) -> Array:
    """The first step after which each world of two runs differs in one of these slots or in any, 0 if none: int [B]."""
    when = np.zeros(len(first[0]["element"]), np.int64)
    for step in range(len(first) - 1, 0, -1):
        when[differences(first[step], second[step], names).any((1, 2))] = step
    return when


def differences(first: State, second: State, names: Iterable[str] | None = None) -> Array:
    """bool [B, H, W]: cells in which two states differ, in some slots or in any."""
    wrong = np.zeros(first["element"].shape, bool)
    for name in first if names is None else names:
        unequal = first[name] != second[name]
        wrong = wrong | (unequal.any(1) if unequal.ndim == 4 else unequal)
    return wrong


def context(ruleset: Ruleset, state: State, sample: Start, step: int) -> reference.Context:
    """The values that a condition reads: the state of worlds, parameters, the clock."""
    params = reference.parameters(ruleset, len(sample), sample.params)
    working = reference.widen(ruleset, {slot.name: state[slot.name] for slot in slots(ruleset)})
    clock = reference.Clock(sample.seed, sample.index, sample.step + step)
    return reference.Context(ruleset, working, params, {}, clock)


@dataclass(frozen=True)
class Oracle:
    """Runs worlds on the reference. `last`: the passes of the last step, if they are fewer."""

    ruleset: Ruleset
    last: tuple[Pass, ...] | None = None

    def of(self, ruleset: Ruleset) -> Oracle:
        """Runs other rules in the same way."""
        return Oracle(ruleset)

    def states(self, sample: Start, steps: int, random: Mapping[str, Array] | None = None) -> list[State]:
        """The state at the start and after each step, in storage dtypes. `random`: draws for all streams."""
        bits = {stream.name: stream.bits for stream in self.ruleset.streams}
        draws = {  # a draw counts as the one of the stream's resolution that it falls into
            name: (np.floor(values * 2.0 ** bits[name]) + 0.5) / 2.0 ** bits[name]
            for name, values in (random or {}).items()
        }
        params = reference.parameters(self.ruleset, len(sample), sample.params)
        states = [full_state(self.ruleset, sample)]
        for step in range(steps):
            rules = self.ruleset
            if self.last is not None and step == steps - 1:
                rules = replace(rules, passes=self.last)
            clock = reference.Clock(sample.seed, sample.index, sample.step + step)
            states.append(reference.step(rules, states[-1], clock, params, draws=draws))
        return states


Runs = Runner | Oracle
"""Runs worlds on a backend or on the oracle."""


# Which lines happen


def rule_spans(ruleset: Ruleset) -> tuple[Span, ...]:
    """The lines of rules, in the order in which they run first. Loops and symmetries make many rules of one."""
    return tuple(dict.fromkeys(rule.span for _, part in substeps(ruleset.passes) for rule in part.rules))


def with_line_marks(ruleset: Ruleset) -> Ruleset:
    """A copy of rules that each also set a flag of their line where they happen; nothing reads the flags."""
    names = {span: f"{MARK}{number}" for number, span in enumerate(rule_spans(ruleset))}
    home = ruleset.elements[0]
    flags = [Field(name, FLAG, 0, "place", False, None, home.pack, home.span) for name in names.values()]

    def flagged(rule: Rule) -> tuple[Rule, ...]:
        if isinstance(rule, Assign):
            return rule, Assign(names[rule.span], (0, 0), ":=", TRUE, rule.mask, rule.span)
        effect = Assign(names[rule.span], (0, 0), ":=", TRUE, TRUE, rule.span)
        return (replace(rule, effects=(*rule.effects, effect)),)

    def flagging(substep: Substep) -> Substep:
        return replace(substep, rules=tuple(chain.from_iterable(map(flagged, substep.rules))))

    passes = (replace(pass_, substeps=tuple(map(flagging, pass_.substeps))) for pass_ in ruleset.passes)
    return replace(ruleset, fields=(*ruleset.fields, *flags), passes=tuple(passes))


State = dict[str, Array]

SHAPES = ((3, 3), (2, 3), (4, 4), (1, 5), (5, 4), (6, 6), (3, 8), (1, 1), (8, 8), (2, 2), (7, 5), (5, 1))
"""Rows and columns of small worlds: tiny ones, where neighbors coincide, come often."""

LARGE = (16, 33)
"""Rows and columns of a few larger worlds, of odd width."""

ALIKE = 8
"""Worlds that are drawn from the same elements."""


def join_starts(samples: Sequence[Start], ruleset: Ruleset) -> Start:
    """Starts of one shape as one batch."""
    names = {name for sample in samples for name in sample.fields}
    table = {slot.name: slot for slot in slots(ruleset)}
    defaults = {param.name: float(param.default) for param in ruleset.params}
    params = {name for sample in samples for name in sample.params}
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
            for name in sorted(params)
        },
    )


def random_samples(ruleset: Ruleset, seed: int, count: int) -> Iterator[Start]:
    """Batches of random worlds of a ruleset, `count` worlds in all, the same for the same seed.

    Every other group of worlds starts with fresh fields; every fourth is framed by something that never changes, as
    worlds are that must not wrap around.
    """
    frames = sorted(unchanging_ids(ruleset))
    batch = 64
    for number, left in enumerate(range(count, 0, -batch)):
        shape = SHAPES[number % len(SHAPES)]
        groups = []
        for group in range(min(batch, left + ALIKE - 1) // ALIKE):
            choices = Choices.seeded((seed * 1_000_003 + number) * batch + group)
            sample = random_start(ruleset, choices, (ALIKE, *shape)).seeded()
            if group % 2:
                sample = replace(sample, fields={}, params={})
            if group % 4 == 1 and frames and min(shape) > 2:
                ids, frame = sample.ids.copy(), choices.pick(frames)
                ids[:, [0, -1], :] = ids[:, :, [0, -1]] = frame
                sample = replace(sample, ids=ids)
            groups.append(sample)
        yield join_starts(groups, ruleset)
    choices = Choices.seeded(seed)
    yield random_start(ruleset, choices, (4, *LARGE)).seeded()


# Worlds seen in a mirror or turned by a quarter: directions and vectors turn with their cells


def turned_cells(values: Array, turn: str) -> Array:
    """An array [..., H, W]: left and right exchanged (``mirrored``), or a quarter turn clockwise (``rotated``)."""
    return (values if turn == "mirrored" else np.moveaxis(values, -1, -2))[..., ::-1].copy()


def turned_back(values: Array, turn: str) -> Array:
    """The inverse of `turned_cells`."""
    if turn == "mirrored":
        return turned_cells(values, turn)
    return np.moveaxis(values, -1, -2)[..., ::-1, :].copy()


def turned_values(slot: Slot, values: Array, turn: str) -> Array:
    cells = turned_cells(values, turn)
    if slot.kind.name == "direction":  # octants count clockwise from the right
        octants = 4 - cells.astype(np.int64) if turn == "mirrored" else cells + 2
        return (octants % 8).astype(slot.dtype)
    if slot.planes == 2:
        rows, columns = cells[:, 0], cells[:, 1]
        parts = (rows, -columns) if turn == "mirrored" else (columns, -rows)
        return np.stack(parts, 1) + np.float32(0)  # one zero only
    return cells


def turned_sample(ruleset: Ruleset, sample: Start, turn: str) -> Start:
    """Worlds, turned, with the same seeds."""
    table = {slot.name: slot for slot in slots(ruleset)}
    state = {
        name: turned_values(table[name], values, turn) for name, values in full_state(ruleset, sample).items()
    }
    return replace(sample, ids=state.pop("element"), fields=state)


def turned_state(ruleset: Ruleset, state: State, turn: str) -> State:
    """All slots, turned. Cells that cannot hold a value keep the usual one, which does not turn."""
    fields = {name: values for name, values in state.items() if name != "element"}
    return full_state(ruleset, turned_sample(ruleset, Start.fresh(state["element"], fields=fields), turn))
