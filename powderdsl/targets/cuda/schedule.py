"""Statements of a generated kernel, the buffers of their variables, and the barriers between them.

A variable is a plane (``p7``) or a field (``f7``, with ``n7``: where it is not zero). Each gets a buffer for as long
as it is needed. A variable that follows on another takes over its buffer, so a moment that is skipped costs nothing.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

FOREVER = 1 << 30


@dataclass(frozen=True)
class WordPhase:
    """A loop over words. All outputs are stored at its end."""

    lines: tuple[str, ...]
    outputs: tuple[tuple[str, str], ...]
    """Variable and the expression for its word."""
    reads: Mapping[str, bool]
    """Variables that it reads, and whether also at other words."""
    some: str = ""
    """An expression: is it true for any word?"""


@dataclass(frozen=True)
class CellOutput:
    """What a loop over cells fills: a field, or the plane of a flag."""

    name: str
    value: str
    quiet: str
    """A plane's word where nothing is going on."""
    keeps: str = ""
    """The field that this one is where nothing is going on; else that is zero."""


@dataclass(frozen=True)
class CellPhase:
    """A loop over cells, left out where nothing is going on."""

    words: tuple[str, ...]
    lines: tuple[str, ...]
    outputs: tuple[CellOutput, ...]
    reads: Mapping[str, bool]
    busy: str
    """An expression for a word: is anything going on?"""
    asked: str
    """The same about the words of variables alone: if no word of the block says yes, nothing is."""


@dataclass(frozen=True)
class Guarded:
    """Statements that run only if something in their masks holds. Each stage ends with the question."""

    stages: tuple[tuple[Statement, ...], ...]
    body: tuple[Statement, ...]
    keeps: tuple[tuple[str, str], ...]
    """What the body writes, and the variable that it is otherwise; nothing holds if that is ``""``."""


@dataclass(frozen=True)
class Finish:
    """Variables into the buffers of the slots that they are from now on."""

    pairs: tuple[tuple[str, int], ...]


Statement = WordPhase | CellPhase | Guarded | Finish


@dataclass
class Pool:
    """Buffers by kind, ``p`` and ``f``: how many are the slots' own, and how many there are in all."""

    slots: dict[str, int]
    size: dict[str, int]


@dataclass
class Plan:
    """Buffers of one pass: what each variable's is, and where it is needed last."""

    buffer: dict[str, int] = field(default_factory=dict)
    last: dict[str, int] = field(default_factory=dict)
    position: dict[int, int] = field(default_factory=dict)
    """Of statements, by their identity."""
    defined: dict[str, int] = field(default_factory=dict)
    follows: dict[str, str] = field(default_factory=dict)
    """What a variable is where its statement is skipped."""
    ends: dict[str, int] = field(default_factory=dict)
    """Where that is made good."""
    wanted: dict[str, int] = field(default_factory=dict)
    """The slot's buffer in which a variable ends."""


def flat(statements: Sequence[Statement]) -> Iterator[Statement]:
    """All statements in order of place; a guarded one after what it holds."""
    for statement in statements:
        if isinstance(statement, Guarded):
            for stage in statement.stages:
                yield from flat(stage)
            yield from flat(statement.body)
        yield statement


def names_of(phase: WordPhase | CellPhase) -> list[str]:
    """The variables that a phase fills."""
    if isinstance(phase, WordPhase):
        return [name for name, _ in phase.outputs]
    return [output.name for output in phase.outputs]


def make_plan(
    statements: Sequence[Statement],
    homes: Mapping[str, int],
    changed: frozenset[str],
    open_homes: frozenset[tuple[str, int]],
    prefers: Mapping[str, str],
    pool: Pool,
    inplace: bool,
) -> Plan:
    """Gives every variable a buffer.

    Args:
        homes: the slots' buffers of variables that the pass finds there.
        changed: those of them whose slots the pass leaves changed: their buffers may be taken over.
        open_homes: buffers of all slots that the pass changes: until its end they may hold anything.
        prefers: whose buffer a variable would take over best, besides what the statements say.
        inplace: whether a phase may write planes whose other words it reads, holding back all it writes.
    """
    plan = Plan(buffer=dict(homes))
    order = list(flat(statements))
    for position, statement in enumerate(order):
        plan.position[id(statement)] = position
        _number(statement, position, plan)
    for name in homes:
        if name not in changed:
            plan.last[name] = FOREVER
    for name, old in plan.follows.items():
        if old and name in plan.defined:
            plan.last[old] = max(plan.last.get(old, -1), plan.defined[name])
    busy: dict[tuple[str, int], str] = {(name[0], number): name for name, number in homes.items()}
    for position, statement in enumerate(order):
        busy = {key: name for key, name in busy.items() if plan.last.get(name, -1) >= position}
        if isinstance(statement, WordPhase | CellPhase):
            for name in names_of(statement):
                number = _taken_over(name, prefers, statement, position, plan, busy, inplace)
                if number is None:
                    number = _free(name, plan, busy, pool, open_homes)
                    if old := plan.follows.get(name, ""):  # it must still be there to be copied
                        plan.last[old] = max(plan.last.get(old, -1), plan.ends[name])
                pool.size[name[0]] = max(pool.size[name[0]], number + 1)
                plan.buffer[name] = number
                busy[name[0], number] = name
    return plan


def _number(statement: Statement, position: int, plan: Plan) -> None:
    """First and last places of variables, what they follow on, and which slot they end in."""
    if isinstance(statement, WordPhase | CellPhase):
        for name in statement.reads:
            plan.last[name] = position
        for name in names_of(statement):
            plan.defined[name] = position
            plan.last.setdefault(name, position)
        if isinstance(statement, CellPhase):
            for output in statement.outputs:
                if output.keeps:
                    plan.follows[output.name], plan.ends[output.name] = output.keeps, position
    elif isinstance(statement, Guarded):
        for name, old in statement.keeps:
            plan.follows[name], plan.ends[name] = old, position
            if old:
                plan.last[name] = max(plan.last.get(name, -1), position)
    else:
        for name, number in statement.pairs:
            plan.last[name] = position
            plan.wanted.setdefault(name, number)


def _taken_over(
    name: str,
    prefers: Mapping[str, str],
    phase: WordPhase | CellPhase,
    position: int,
    plan: Plan,
    busy: Mapping[tuple[str, int], str],
    inplace: bool,
) -> int | None:
    """The buffer of another variable that nobody needs after this phase: of what it follows on, or in its slot's home."""
    home = busy.get((name[0], plan.wanted.get(name, -1)), "")
    for old in (plan.follows.get(name, ""), prefers.get(name, ""), home):
        if not old or plan.last.get(old, -1) > position:
            continue
        number = plan.buffer[old]
        if busy.get((old[0], number)) != old:
            continue
        across = phase.reads.get(old, False)
        if across and not (inplace and isinstance(phase, WordPhase)):
            continue
        if old in phase.reads and isinstance(phase, CellPhase) and old[0] == "p":
            continue  # one lane writes what the others read
        return number
    return None


def _free(
    name: str,
    plan: Plan,
    busy: Mapping[tuple[str, int], str],
    pool: Pool,
    open_homes: frozenset[tuple[str, int]],
) -> int:
    """The buffer of the slot that the variable ends in, or the first that nobody needs."""
    kind = name[0]
    home = plan.wanted.get(name)
    if home is not None and (kind, home) not in busy:
        return home
    return next(
        n
        for n in range(FOREVER)
        if (kind, n) not in busy and (n >= pool.slots[kind] or (kind, n) in open_homes)
    )
