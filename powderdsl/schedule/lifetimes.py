"""Memory of variables: when they are released, what is written in place, numbered buffers, and barriers between threads."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

from powderdsl.ir.ops import FLAG, REAL, Graph, Node, Offset, ordered
from powderdsl.schedule.join import field_reads, keeps
from powderdsl.schedule.rewrite import with_values, without_unread
from powderdsl.schedule.types import (
    ANSWER,
    Carried,
    Compute,
    Guard,
    Move,
    Namer,
    Out,
    Release,
    Schedule,
    Statement,
    Sweeps,
    Sync,
    Var,
    combined,
    flat,
    in_order,
    is_zero,
    load,
    loaded,
    map_computes,
    planes_at_neighbors,
    read_elsewhere,
)


def release(schedule: Schedule) -> Schedule:
    """Every variable is released exactly once, even if nothing reads it; planes overwrite old ones that end.

    `swap by m: b = a`, where `a` is not read again → `b = a into a`; the same where a loop over words changes some words.
    """
    live = set(loaded(node for _, node in schedule.leaves))
    body = _block(schedule.body, live, Namer(schedule), schedule.graph)
    return replace(schedule, body=body)


def _block(
    body: Sequence[Statement], live_end: set[str], namer: Namer, graph: Graph
) -> tuple[Statement, ...]:
    lives: list[set[str]] = []
    live = set(live_end)
    for statement in reversed(body):
        lives.append(live)
        live = live_before(statement, live)
    result: list[Statement] = []
    for given, after in zip(body, reversed(lives), strict=True):
        statement = given
        written = {var.name for var in statement.defined() if var.type != ANSWER}
        gone = (reads(statement) | written) - after
        if isinstance(statement, Guard):
            outside = reads(statement) - made_in(statement.body)
            kept = {var.name for var, _ in statement.keeps}
            # Outer variables are released after the guard, whether its body runs or not.
            inner = _block(statement.body, after | kept | outside, namer, graph)
            statement = replace(statement, body=inner)
            gone = (outside | kept) - after
        elif isinstance(statement, Move):
            statement = _in_place(statement, after)
            gone -= {plane.into for plane in statement.planes if plane.into is not None}
        elif isinstance(statement, Sweeps) and keeps(statement.loops[0]):
            loop = _overwriting(statement.loops[0], after)
            statement = replace(statement, loops=(loop,))
            gone -= {out.into for out in loop.outs if out.into is not None}
        elif isinstance(statement, Sweeps):
            statement = _overtaken(_put_off(statement, after, namer, graph), after)
            gone -= {out.into for loop in statement.loops for out in loop.outs if out.into is not None}
        elif isinstance(statement, Compute) and statement.region is not None:
            statement = _updated(statement, after | read_elsewhere(statement.values()))
            gone -= {out.into for out in statement.outs if out.into is not None}
        result.append(statement)
        if gone:
            result.append(Release(tuple(in_order(gone))))
    return tuple(result)


def _in_place(move: Move, after: set[str]) -> Move:
    """A movement that overwrites what ends with it: the old plane, or the one whose flags stay where none arrives."""
    reads = Counter(loaded([move.movers]))
    for plane in move.planes:
        reads.update(set(loaded([plane.old, plane.leaves])))

    def overwritten(plane: Carried) -> str | None:
        stays = plane.leaves if plane.leaves.op in ("load", "const") else plane.old
        free = stays.op == "load" and stays.attr not in after and reads[str(stays.attr)] == 1
        return str(stays.attr) if free else None

    return replace(move, planes=tuple(replace(plane, into=overwritten(plane)) for plane in move.planes))


def _overwriting(loop: Compute, after: set[str]) -> Compute:
    """A loop that changes some rows of fields, in place where nothing reads the old one elsewhere."""
    far = {read.name for read in field_reads(loop) if (read.dy or read.dx) and not read.live}
    return _updated(loop, after | far)


def _put_off(sweeps: Sweeps, after: set[str], namer: Namer, graph: Graph) -> Sweeps:
    """Choices whose result waits for a loop that stores it over their old fields, when no row is missing any more.

    `loop choices: b = m ? f(a[-1,0]) : a` → `b'` in its place, and `loop cells, 2 behind: b = b' into a`.
    """
    loop = sweeps.loops[0]
    lasting = [out for out in loop.outs if out.var.name not in sweeps.passing]
    first, readers = _last_reads(sweeps, after)
    free = [name for name in first if first[name] < NEVER and readers[name] == 0]
    if (
        loop.over != "choices"
        or loop.region is None
        or any(sweeps.parts)
        or not lasting
        or len(free) < len(lasting)
    ):
        return sweeps
    waiting = {out.var.name: namer.var(REAL) for out in lasting}

    def rule(node: Node) -> Node | None:
        return load(graph, waiting[str(node.attr)]) if node.op == "load" and node.attr in waiting else None

    loops = [with_values(one, graph, rule) for one in sweeps.loops]
    outs = tuple(replace(out, var=waiting.get(out.var.name, out.var)) for out in loop.outs)
    zero = graph.node("const", REAL, (), 0.0)
    olds = [load(graph, waiting[out.var.name]) for out in lasting]
    region = combined("or", [graph.node("live", FLAG, (old,), (0, 0)) for old in olds], graph)
    stored = tuple(Out(out.var, old, None, zero) for out, old in zip(lasting, olds, strict=True))
    return Sweeps(
        (replace(loop, outs=outs), *(one for one in loops[1:] if isinstance(one, Compute)), Compute(stored, loop.place, "cells", region)),
        (*sweeps.parts, 0),
        (*sweeps.lags, max(first[name] for name in free)),
        (*sweeps.passing, *(var.name for var in waiting.values())),
    )  # fmt: skip


def _last_reads(sweeps: Sweeps, after: set[str]) -> tuple[dict[str, int], dict[str, int]]:
    """By field that loops read: the least lag with which a row of it may be written over, and the last loop that reads it."""
    made = {out.var.name for loop in sweeps.loops for out in loop.outs}
    first: dict[str, int] = {}
    readers: dict[str, int] = {}
    for number, (loop, part, lag) in enumerate(zip(sweeps.loops, sweeps.parts, sweeps.lags, strict=True)):
        for read in field_reads(loop):
            far = part > 0 or (read.live and read.dy != 0)
            least = NEVER if far or read.name in after or read.name in made else lag - read.dy + 1
            first[read.name] = max(first.get(read.name, 0), least)
            readers[read.name] = number
    return first, readers


def _overtaken(sweeps: Sweeps, after: set[str]) -> Sweeps:
    """Loops with fields that overwrite a field which earlier loops of the part have read in all rows so far."""
    first, readers = _last_reads(sweeps, after)
    loops = []
    for number, (loop, part, lag) in enumerate(zip(sweeps.loops, sweeps.parts, sweeps.lags, strict=True)):
        free = [name for name in first if first[name] <= lag and readers[name] < number and part == 0]
        outs = []
        for out in loop.outs:
            lasts = out.var.type == REAL and out.var.name not in sweeps.passing
            into = free.pop(0) if lasts and free else None
            if into is not None:
                first[into] = NEVER
            outs.append(replace(out, into=into))
        loops.append(replace(loop, outs=tuple(outs)))
    return replace(sweeps, loops=tuple(loops))


NEVER = 1 << 30


def _updated(loop: Compute, after: set[str]) -> Compute:
    olds = Counter(str(out.otherwise.attr) for out in loop.outs if out.otherwise is not None)
    outs = []
    for out in loop.outs:
        old = str(out.otherwise.attr) if out.otherwise is not None else ""
        ends = old and old not in after and olds[old] == 1
        outs.append(replace(out, into=old) if ends else out)
    return replace(loop, outs=tuple(outs))


def live_before(statement: Statement, after: set[str]) -> set[str]:
    """The variables that are live before a statement, given those that are live after it."""
    live = after - {var.name for var in statement.defined()}
    return live | (reads(statement) - made_in([statement]))


def reads(statement: Statement) -> set[str]:
    """The variables that a statement reads, including nested statements."""
    names: set[str] = set()
    for inner in flat([statement]):
        passing = inner.passing if isinstance(inner, Sweeps) else ()
        names |= set(loaded(inner.values())) - set(passing)
    return names


def made_in(body: Sequence[Statement]) -> set[str]:
    """The variables that statements define, including nested ones."""
    return {var.name for statement in flat(body) for var in statement.defined()}


@dataclass(frozen=True)
class _Swap:
    """The movers of a swap, where they go, and the field whose values they exchange.

    `fresh` lists the flags under which the value is zero afterwards, the last one first to be asked.
    """

    movers: Node
    offset: Offset
    field: Node
    fresh: tuple[tuple[Node, Node], ...]

    @property
    def kind(self) -> object:
        """What fields have in common that one loop exchanges."""
        return self.movers, self.offset, tuple(mask for mask, _ in self.fresh)


def swaps(schedule: Schedule) -> Schedule:
    """Loops over cells that exchange values of fields, by the movers of a swap of planes, become swaps themselves.

    `swap by m [+1,+0]: …`, `b = settle(m ? a[1,0] : (m[-1,0] ? a[-1,0] : a))` → `swap by m [+1,+0]: b = a`. Values of a
    slot stay within its bounds wherever they are. What becomes zero afterwards does so in a loop over rows where it does.
    """
    offsets = {
        str(one.movers.attr): one.offset
        for one in flat(schedule.body)
        if isinstance(one, Move) and one.op == "swap"
    }
    if not offsets:
        return schedule
    shifted = planes_at_neighbors(schedule)
    slots = {str(node.attr): slot for slot, node in schedule.leaves if node.op == "load"}
    settled = {var.name: slot for slot, var in schedule.finds if var.type == REAL}
    """Fields that hold values of a slot, with the slot."""

    namer, graph = Namer(schedule), schedule.graph

    def change(loop: Compute) -> list[Statement]:
        floats = loop.over in ("cells", "choices")
        found = [_swap(out, offsets, shifted) for out in loop.outs] if floats else []
        first = found[0] if found else None
        if first is None:
            return [loop]
        planes, outs = [], []
        for out, swap in zip(loop.outs, found, strict=True):
            if swap is None or swap.kind != first.kind:
                return [loop]
            slot = settled.get(str(swap.field.attr))
            if out.value.op == "settle" and (slot is None or slots.get(out.var.name) != slot):
                return [loop]
            moved = namer.var(REAL) if swap.fresh else out.var
            if slot is not None:
                settled[moved.name] = settled[out.var.name] = slot
            planes.append(Carried(moved, swap.field, swap.field))
            value = load(graph, moved)
            for mask, number in swap.fresh:
                value = graph.node("select", REAL, (mask, number, value))
            outs.append(Out(out.var, value, None, load(graph, moved)))
        statements: list[Statement] = [Move("swap", first.offset, first.movers, tuple(planes), loop.place)]
        if first.fresh:
            region = combined("or", [mask for mask, _ in first.fresh], graph)
            statements.append(Compute(tuple(outs), loop.place, "cells", region))
        return statements

    return without_unread(map_computes(schedule, change))


def _swap(
    out: Out, offsets: Mapping[str, Offset], shifted: Mapping[str, tuple[str, tuple[int, int, bool]]]
) -> _Swap | None:
    """The swap whose result a value is. Movers come before or after their targets: no cell is both."""
    value = out.value.args[0] if out.value.op == "settle" else out.value
    fresh: list[tuple[Node, Node]] = []
    while value.op == "select" and value.args[0].op == "load" and is_zero(value.args[1]):
        fresh.insert(0, (value.args[0], value.args[1]))
        value = value.args[2]
    if value.op != "select" or value.args[2].op != "select":
        return None
    field = value.args[2].args[2]
    chosen = [(one.args[0], one.args[1]) for one in (value, value.args[2])]
    if field.op != "load" or field.type != REAL or any(mask.op != "load" for mask, _ in chosen):
        return None
    for (movers, there), (targets, back) in (chosen, chosen[::-1]):
        dy, dx = offset = offsets.get(str(movers.attr), (0, 0))
        opposite = (-dy, -dx, True)
        if (
            offset != (0, 0)
            and shifted.get(str(targets.attr)) == (movers.attr, opposite)
            and _reads(there, field, (dy, dx, True))
            and _reads(back, field, opposite)
        ):
            return _Swap(movers, offset, field, tuple(fresh))
    return None


def _reads(value: Node, field: Node, where: tuple[int, int, bool]) -> bool:
    return value.op == "shift" and value.args[0] is field and value.attr == where


FOREVER = 1 << 30

Buffer = tuple[str, int]
"""Kind (`flag` or `real`) and number."""


@dataclass
class Pool:
    """Numbers of buffers by kind: those that belong to slots, and all."""

    slots: dict[str, int]
    size: dict[str, int]


def buffers(schedule: Schedule, homes: Mapping[str, int], pool: Pool, *, in_place: bool) -> Schedule:
    """The schedule with a buffer for every variable; `leaves` are loads from the slots' own buffers.

    Args:
        homes: the number of each slot's own buffer.
        pool: shared by all passes; it grows.
        in_place: whether a loop may overwrite planes that it reads at neighbors, by storing only after all reads.
    """
    found = {var.name: homes[slot] for slot, var in schedule.finds}
    types = {var.name: var.type.name for _, var in schedule.finds}
    changed = {slot for slot, _ in schedule.leaves}
    plan = _Plan(schedule, pool, in_place)
    plan.buffer = {name: (types[name], number) for name, number in found.items()}
    plan.open = {(node.type.name, homes[slot]) for slot, node in schedule.leaves}
    plan.wanted = {}
    for slot, node in schedule.leaves:
        if node.op == "load":
            plan.wanted.setdefault(node.attr, homes[slot])
    plan.run(kept=[var.name for slot, var in schedule.finds if slot not in changed])
    return _explicit(schedule, plan, homes)


@dataclass
class _Plan:
    schedule: Schedule
    pool: Pool
    in_place: bool
    buffer: dict[str, Buffer] = field(default_factory=dict)
    open: set[Buffer] = field(default_factory=set)
    """Buffers of the slots that the pass changes; until its end they may hold other values."""
    wanted: dict[str, int] = field(default_factory=dict)
    """The slot's buffer in which a variable must end up."""
    last: dict[str, int] = field(default_factory=dict)
    defined: dict[str, int] = field(default_factory=dict)
    follows: dict[str, str] = field(default_factory=dict)
    """The variable whose value each variable has if its statement is skipped."""
    ends: dict[str, int] = field(default_factory=dict)
    """The position at which that value must be in place."""

    def run(self, kept: Sequence[str]) -> None:
        """Assign all buffers; those of the variables `kept` hold slots that the pass does not change."""
        order = list(_in_order(self.schedule.body))
        for position, statement in enumerate(order):
            self.number(statement, position)
        self.last |= dict.fromkeys(kept, FOREVER)
        end = len(order)
        for _, node in self.schedule.leaves:
            if node.op == "load":
                self.last[node.attr] = max(self.last.get(node.attr, -1), end)
        for name, old in self.follows.items():
            if name in self.defined:
                self.last[old] = max(self.last.get(old, -1), self.defined[name])
        busy = {number: name for name, number in self.buffer.items()}
        for position, statement in enumerate(order):
            busy = {key: name for key, name in busy.items() if self.last.get(name, -1) >= position}
            if not isinstance(statement, Compute):
                continue
            reads = neighbors(statement)
            for out in statement.outs:
                if out.var.type == ANSWER:
                    continue
                found = self.taken_over(out.var, statement, reads, position, busy)
                if found is None:
                    found = self.free(out.var, busy)
                    if old := self.follows.get(
                        out.var.name, ""
                    ):  # it is copied there, so it must still exist
                        self.last[old] = max(self.last.get(old, -1), self.ends[out.var.name])
                kind, number = found
                self.pool.size[kind] = max(self.pool.size[kind], number + 1)
                self.buffer[out.var.name] = found
                busy[found] = out.var.name

    def number(self, statement: Statement, position: int) -> None:
        """Note where variables are defined and last read, and what they replace."""
        if isinstance(statement, Compute):
            for name in neighbors(statement):
                self.last[name] = position
            for out in statement.outs:
                self.defined[out.var.name] = position
                self.last.setdefault(out.var.name, position)
                if out.otherwise is not None and out.otherwise.op == "load":
                    self.follow(out.var.name, out.otherwise.attr, position)
        elif isinstance(statement, Guard):
            for var, value in statement.keeps:
                self.ends[var.name] = position
                if value.op == "load":
                    self.follow(var.name, value.attr, position)
                    self.last[var.name] = max(self.last.get(var.name, -1), position)

    def follow(self, name: str, old: str, position: int) -> None:
        self.follows[name], self.ends[name] = old, position

    def taken_over(
        self, var: Var, loop: Compute, reads: Mapping[str, bool], position: int, busy: Mapping[Buffer, str]
    ) -> Buffer | None:
        """The buffer to reuse: that of the variable it replaces, or its slot's, if nothing reads it after this loop."""
        home = busy.get((var.type.name, self.wanted.get(var.name, -1)), "")
        for old in (self.follows.get(var.name, ""), home):
            if not old or self.last.get(old, -1) > position:
                continue
            if busy.get(self.buffer[old]) != old:
                continue
            if reads.get(old) and not (self.in_place and loop.over == "words"):
                continue
            if old in reads and loop.over == "cells" and var.type == FLAG:
                continue  # one thread would write a word that others read
            return self.buffer[old]
        return None

    def free(self, var: Var, busy: Mapping[Buffer, str]) -> Buffer:
        """The buffer of the slot in which the variable ends up, or the first free one."""
        kind = var.type.name
        home = self.wanted.get(var.name)
        if home is not None and (kind, home) not in busy:
            return kind, home
        return kind, next(
            n
            for n in range(FOREVER)
            if (kind, n) not in busy and (n >= self.pool.slots[kind] or (kind, n) in self.open)
        )


def _in_order(body: Sequence[Statement]) -> Iterator[Statement]:
    """All statements in order; a guard comes after its body."""
    for statement in body:
        if isinstance(statement, Guard):
            yield from _in_order(statement.body)
        yield statement


def neighbors(statement: Statement) -> dict[str, bool]:
    """The variables that a statement reads, and whether it reads them at neighbors too."""
    found: dict[str, bool] = {}
    for node in ordered(statement.values()):
        if node.op == "load":
            found.setdefault(node.attr, False)
        elif node.op in ("shift", "live") and node.args[0].op == "load" and any(node.attr[:2]):
            found[node.args[0].attr] = True
    return found


def _explicit(schedule: Schedule, plan: _Plan, homes: Mapping[str, int]) -> Schedule:
    """The schedule with the copies that the assignment requires."""
    graph, namer = schedule.graph, Namer(schedule)
    numbers = dict(plan.buffer)

    def block(body: Sequence[Statement]) -> tuple[Statement, ...]:
        result: list[Statement] = []
        for statement in body:
            if isinstance(statement, Guard):
                pairs = [
                    (var, value)
                    for var, value in statement.keeps
                    if value.op != "load" or numbers[value.attr] != numbers[var.name]
                ]
                result.append(
                    replace(statement, body=block(statement.body), otherwise=tuple(copies(pairs, graph)))
                )
            elif isinstance(statement, Compute):
                across = {numbers[name] for name, far in neighbors(statement).items() if far}
                held = any(numbers.get(out.var.name) in across for out in statement.outs)
                moved = any(
                    out.otherwise is not None
                    and out.otherwise.op == "load"
                    and numbers[out.otherwise.attr] != numbers[out.var.name]
                    for out in statement.outs
                )
                result.append(replace(statement, held=held, region=None if moved else statement.region))
            else:
                result.append(statement)
        return tuple(result)

    body = block(schedule.body)
    leaves, pairs = [], []
    for slot, node in schedule.leaves:
        home = (node.type.name, homes[slot])
        if node.op == "load" and numbers[node.attr] == home:
            leaves.append((slot, node))
            continue
        var = namer.var(node.type)
        numbers[var.name] = home
        pairs.append((var, node))
        leaves.append((slot, load(graph, var)))
    end = tuple(copies(pairs, graph))
    return replace(schedule, body=(*body, *end), leaves=tuple(leaves), buffers=tuple(sorted(numbers.items())))


def copies(pairs: Sequence[tuple[Var, Node]], graph: Graph) -> Iterator[Compute]:
    """Loops that assign values to variables; each reads everything before it writes anything."""
    flags = tuple(Out(var, value) for var, value in pairs if var.type == FLAG)
    if flags:
        yield Compute(flags, "", "words")
    floats = [(var, value) for var, value in pairs if var.type == REAL]
    if floats:
        zero = graph.node("const", REAL, (), 0.0)
        region: Node = graph.node("const", FLAG, (), False)
        outs = []
        for var, value in floats:
            if value.op == "load":
                live = graph.node("live", FLAG, (value,), (0, 0))
                region = live if region.op == "const" else graph.node("or", FLAG, (region, live))
            outs.append(Out(var, value, None, zero))
        yield Compute(tuple(outs), "", "cells", region)


Access = tuple[bool, bool, bool]
"""Whether an access is in a loop over words, of the thread's own word only, and a write."""


@dataclass
class Pending:
    """The accesses to each buffer since the last barrier."""

    done: dict[Buffer, set[Access]] = field(default_factory=dict)

    def clashes(self, buffer: Buffer, access: Access) -> bool:
        """Whether an access needs a barrier before it. A thread has the same words in all loops over words."""
        words, own, written = access
        return any(
            (written or before_written) and not (words and before_words and own and before_own)
            for before_words, before_own, before_written in self.done.get(buffer, ())
        )

    def add(self, buffer: Buffer, access: Access) -> None:
        self.done.setdefault(buffer, set()).add(access)

    def join(self, other: Pending) -> None:
        for buffer, accesses in other.done.items():
            self.done.setdefault(buffer, set()).update(accesses)

    def copy(self) -> Pending:
        return Pending({buffer: set(accesses) for buffer, accesses in self.done.items()})


def barriers(schedule: Schedule, pending: Pending) -> Schedule:
    """The schedule with barriers. `pending` is handed from pass to pass; computing an answer is a barrier too."""
    placing = _Placing(dict(schedule.buffers), pending)
    return replace(schedule, body=placing.block(schedule.body))


@dataclass
class _Placing:
    buffers: dict[str, Buffer]
    pending: Pending

    def block(self, body: Sequence[Statement]) -> tuple[Statement, ...]:
        result: list[Statement] = []
        for statement in body:
            if isinstance(statement, Guard):
                before = self.pending.copy()
                inner = self.block(statement.body)
                after = self.pending.copy()
                self.pending.done = before.done
                otherwise = self.block(statement.otherwise)
                self.pending.join(after)
                result.append(replace(statement, body=inner, otherwise=otherwise))
                continue
            if isinstance(statement, Compute):
                if self.access(self.accesses(statement)):
                    result.append(Sync())
                if statement.held:
                    result.append(statement)
                    # It has a barrier of its own between reading and storing.
                    self.pending.done.clear()
                    self.access(self.writes(statement))
                else:
                    result.append(statement)
                if any(out.var.type == ANSWER for out in statement.outs):
                    self.pending.done.clear()
                continue
            result.append(statement)
        return tuple(result)

    def accesses(self, loop: Compute) -> list[tuple[Buffer, Access]]:
        words = loop.over == "words"
        reads = [(self.buffers[name], (words, not far, False)) for name, far in neighbors(loop).items()]
        return reads if loop.held else [*reads, *self.writes(loop)]

    def writes(self, loop: Compute) -> list[tuple[Buffer, Access]]:
        words = loop.over == "words"
        return [
            (self.buffers[out.var.name], (words, True, True)) for out in loop.outs if out.var.type != ANSWER
        ]

    def access(self, accesses: list[tuple[Buffer, Access]]) -> bool:
        """Note the accesses of a loop. True if it needs a barrier before it."""
        wait = any(self.pending.clashes(*one) for one in accesses)
        if wait:
            self.pending.done.clear()
        for one in accesses:
            self.pending.add(*one)
        return wait
