"""Memory of variables: when they are released, what is written in place, numbered buffers, and barriers between threads."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

from powderdsl.ir.ops import FLAG, REAL, Graph, Node, Offset
from powderdsl.schedule.join import keeps_values
from powderdsl.schedule.types import (
    ANSWER,
    Block,
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
    backwards,
    combined,
    drop_unread,
    field_reads,
    flat,
    in_order,
    is_zero,
    load,
    loaded,
    map_blocks,
    map_each,
    planes_at_neighbors,
    read_elsewhere,
    reads_of,
    rewritten,
)


def release(schedule: Schedule) -> Schedule:
    """Release every variable exactly once, even if nothing reads it; planes overwrite old planes that end.

    `swap by m: b = a`, where `a` is not read again → `b = a into a`; the same where a loop over words changes some words.
    """
    namer, graph = Namer(schedule), schedule.graph

    def change(statement: Statement, after: set[str]) -> list[Statement]:
        used = statement.reads | {name for name, var in statement.vars.items() if var.type != ANSWER}
        if isinstance(statement, Guard):
            # Outer variables are released after the guard, whether its body runs or not.
            body, _ = backwards(statement.body, after | used, change)
            statement = replace(statement, body=body)
        elif isinstance(statement, Move):
            statement = _overwrite_planes(statement, after)
        elif isinstance(statement, Compute) and statement.region is not None:
            statement = _update_in_place(statement, after)
        elif isinstance(statement, Sweeps) and keeps_values(statement.body[0]):
            statement = replace(statement, body=(_update_in_place(statement.body[0], after),))
        elif isinstance(statement, Sweeps):
            statement = _overwrite_fields(_postpone_stores(statement, after, namer, graph), after)
        gone = used - after - statement.ended
        return [statement, Release(frees=tuple(in_order(gone)))] if gone else [statement]

    body, _ = backwards(schedule.body, set(loaded(schedule.results)), change)
    return replace(schedule, body=body)


def _overwrite_planes(move: Move, after: set[str]) -> Move:
    """A movement that overwrites a plane that ends with it: the old plane, or the plane where no mover arrives."""
    reads = Counter(loaded([move.region]))
    for out in move.outs:
        reads.update(set(loaded([out.value, move.olds[out.var.name]])))
    outs = []
    for out in move.outs:
        stays = out.value if out.value.op in ("load", "const") else move.olds[out.var.name]
        free = stays.op == "load" and stays.attr not in after and reads[stays.attr] == 1
        outs.append(replace(out, into=stays.attr if free else None))
    return replace(move, outs=tuple(outs))


def _update_in_place(loop: Compute, after: set[str]) -> Compute:
    """A loop that changes some words or rows in place, if nothing reads the old values later or elsewhere."""
    needed = after | {read.name for read in reads_of(loop.values) if read.far and not read.live}
    olds = Counter(old.attr for old in loop.olds.values() if old.op == "load")
    ended = {name for name, count in olds.items() if count == 1} - needed
    outs = []
    for out in loop.outs:
        old = out.otherwise.attr if out.otherwise else None
        outs.append(replace(out, into=old) if old in ended else out)
    return replace(loop, outs=tuple(outs))


def _postpone_stores(sweeps: Sweeps, after: set[str], namer: Namer, graph: Graph) -> Sweeps:
    """Add a loop that stores the result of choices over their old fields, once no loop reads those rows any more.

    `loop choices: b = m ? f(a[-1,0]) : a` → `b'` in its place, and `loop cells, 2 behind: b = b' into a`.
    """
    loop = sweeps.body[0]
    lasting = [out for out in loop.outs if out.var.name not in sweeps.frees]
    free = [lag for lag, reader in _last_reads(sweeps, after).values() if reader == 0]
    choices = loop.over == "choices" and loop.region is not None and not sweeps.body[-1].part
    if not choices or not lasting or len(free) < len(lasting):
        return sweeps
    waiting = {out.var.name: namer.var(REAL) for out in lasting}
    olds = {name: load(graph, var) for name, var in waiting.items()}
    loops = []
    for part in sweeps.body:
        new = rewritten(part.values, graph, lambda node: olds.get(node.attr))
        loops.append(part.with_values(new))
    outs = tuple(replace(out, var=waiting.get(out.var.name, out.var)) for out in loop.outs)
    zero = graph.real(0.0)
    region = combined("or", [graph.node("live", FLAG, (old,), (0, 0)) for old in olds.values()], graph)
    stored = tuple(Out(out.var, olds[out.var.name], zero) for out in lasting)
    last = Compute(stored, loop.place, region, over="cells", lag=max(free))
    return Sweeps(
        frees=(*sweeps.frees, *(var.name for var in waiting.values())),
        body=(replace(loops[0], outs=outs), *loops[1:], last),
    )


def _last_reads(sweeps: Sweeps, after: set[str]) -> dict[str, tuple[int, int]]:
    """The fields that may be overwritten, each with the least lag at which a loop may overwrite a row and its last reader."""
    reads: dict[str, tuple[int, int]] = {}
    needed = after.union(sweeps.vars)
    for number, loop in enumerate(sweeps.body):
        for read in field_reads(loop):
            if loop.part > 0 or (read.live and read.dy):
                needed.add(read.name)
            reads[read.name] = max(reads.get(read.name, (0, 0))[0], loop.lag - read.dy + 1), number
    return {name: last for name, last in reads.items() if name not in needed}


def _overwrite_fields(sweeps: Sweeps, after: set[str]) -> Sweeps:
    """Let fields overwrite fields that earlier loops of the part have read in all rows so far."""
    reads = _last_reads(sweeps, after)
    loops = []
    for number, loop in enumerate(sweeps.body):
        free, outs = list[str](), []
        for name, (least, reader) in reads.items() if loop.part == 0 else ():
            free += [name] if least <= loop.lag and reader < number else []
        for out in loop.outs:
            lasts = out.var.type == REAL and out.var.name not in sweeps.frees
            into = free.pop(0) if lasts and free else None
            reads.pop(into or "", None)
            outs.append(replace(out, into=into))
        loops.append(replace(loop, outs=tuple(outs)))
    return replace(sweeps, body=tuple(loops))


def swap_fields(schedule: Schedule) -> Schedule:
    """Replace loops over cells that exchange values of fields, by the movers of a swap of planes, by swaps of fields.

    `swap by m [+1,+0]: …`, `b = clamp(m ? a[1,0] : (m[-1,0] ? a[-1,0] : a))` → `swap by m [+1,+0]: b = a`. Moved values of
    a slot stay within its bounds. If some become zero afterwards, a loop over their rows follows.
    """
    moves = [statement for statement in flat(schedule.body) if isinstance(statement, Move)]
    offsets = {move.region.attr: move.offset for move in moves if move.op == "swap"}
    if not offsets:
        return schedule
    shifted = planes_at_neighbors(schedule)
    slots = {node.attr: slot for slot, node in schedule.outputs if node.op == "load"}
    clamped = {var.name: slot for slot, var in schedule.inputs if var.type == REAL}
    """The slot to whose bounds the values of a field have been clamped."""
    namer, graph = Namer(schedule), schedule.graph

    def change(loop: Compute) -> list[Statement]:
        """The loop as a movement, and a loop that clears what enters, if all its values are such a choice."""
        swaps = [_match_swap(out.value, offsets, shifted) for out in loop.outs]
        ways = dict.fromkeys(swap and swap[0] for swap in swaps)
        if loop.over == "words" or len(ways) != 1 or swaps[0] is None:
            return [loop]
        movers, offset, fresh = swaps[0][0]
        planes, outs = [], []
        for out, (_, old) in zip(loop.outs, filter(None, swaps), strict=True):
            slot = clamped.get(old.attr)
            if out.value.op == "clamp" and (slot is None or slots.get(out.var.name) != slot):
                return [loop]
            moved = namer.var(REAL) if fresh else out.var
            if slot is not None:
                clamped[moved.name] = clamped[out.var.name] = slot
            planes.append(Out(moved, old, old))
            value = last = load(graph, moved)
            for mask in fresh:
                value = graph.node("select", REAL, (mask, graph.real(0.0), value))
            outs.append(Out(out.var, value, last))
        move = Move(tuple(planes), loop.place, region=movers, op="swap", offset=offset)
        region = combined("or", fresh, graph)
        return [move, Compute(tuple(outs), loop.place, region, over="cells")] if fresh else [move]

    return drop_unread(map_each(schedule, Compute, change))


Way = tuple[Node, Offset, tuple[Node, ...]]
"""The movers of a swap, their offset, and the flags under which values are zero afterwards, innermost first."""


def _match_swap(
    value: Node, offsets: Mapping[str, Offset], shifted: Mapping[str, tuple[str, tuple[int, int, bool]]]
) -> tuple[Way, Node] | None:
    """Match the result of a swap: the swap, and the field whose values it exchanges.

    Choices on movers and on targets may come in either order: no cell is both.
    """
    value = value.args[0] if value.op == "clamp" else value
    fresh: tuple[Node, ...] = ()
    while value.op == "select" and value.args[0].op == "load" and is_zero(value.args[1]):
        fresh, value = (value.args[0], *fresh), value.args[2]
    if value.op != "select" or value.args[2].op != "select":
        return None
    first, yes, second, no, field = *value.args[:2], *value.args[2].args
    if field.op != "load" or {first.op, second.op} != {"load"}:
        return None
    for movers, there, targets, back in ((first, yes, second, no), (second, no, first, yes)):
        dy, dx = offset = offsets.get(movers.attr, (0, 0))
        ways = (dy, dx, True), (-dy, -dx, True)
        reads = [(node.op, node.args[:1], node.attr) for node in (there, back)]
        exchanged = reads == [("shift", (field,), way) for way in ways]
        if offset != (0, 0) and exchanged and shifted.get(targets.attr) == (movers.attr, ways[1]):
            return (movers, offset, fresh), field
    return None


FOREVER = 1 << 30

Buffer = tuple[str, int]
"""Kind (`flag` or `real`) and number."""


@dataclass
class Pool:
    """The number of buffers by kind: those that belong to slots, and all."""

    slots: dict[str, int]
    size: dict[str, int]


def assign_buffers(schedule: Schedule, homes: Mapping[str, int], pool: Pool, *, in_place: bool) -> Schedule:
    """Assign a buffer to every variable; outputs become loads from the slots' own buffers.

    Args:
        homes: the number of each slot's own buffer.
        pool: shared by all passes; it grows.
        in_place: if true, a loop may overwrite planes that it reads at neighbors, by storing only after all reads.
    """
    numbers = _Assignment(schedule, homes, pool, in_place).assign()
    graph, namer = schedule.graph, Namer(schedule)

    def moves(name: str, old: Node) -> bool:
        """True if the old value of a variable lies in another buffer, so that it must be copied."""
        return old.op == "load" and numbers[old.attr] != numbers[name]

    def change(body: Block) -> Block:
        """The statements with the copies that the assignment requires."""
        result: list[Statement] = []
        for statement in body:
            if isinstance(statement, Guard):
                vars, olds = statement.vars, statement.olds.items()
                pairs = [(vars[name], old) for name, old in olds if old.op != "load" or moves(name, old)]
                statement = replace(statement, otherwise=tuple(copies(pairs, graph)))
            elif isinstance(statement, Compute):
                across = {numbers[name] for name in read_elsewhere(statement.values)}
                stores_last = any(numbers.get(name) in across for name in statement.vars)
                moved = any(moves(*pair) for pair in statement.olds.items())
                region = None if moved else statement.region
                statement = replace(statement, stores_last=stores_last, region=region)
            result.append(statement)
        return tuple(result)

    schedule = map_blocks(schedule, change)
    outputs, pairs = [], []
    for slot, node in schedule.outputs:
        home = (node.type.name, homes[slot])
        if node.op != "load" or numbers[node.attr] != home:
            var = namer.var(node.type)
            numbers[var.name] = home
            pairs.append((var, node))
            node = load(graph, var)
        outputs.append((slot, node))
    body = (*schedule.body, *copies(pairs, graph))
    return replace(schedule, body=body, outputs=tuple(outputs), buffers=tuple(sorted(numbers.items())))


class _Assignment:
    """Assigns buffers in the order of the statements; a guard comes after its body."""

    def __init__(self, schedule: Schedule, homes: Mapping[str, int], pool: Pool, in_place: bool):
        self.pool, self.in_place = pool, in_place
        inputs = schedule.inputs
        self.buffer: dict[str, Buffer] = {var.name: (var.type.name, homes[slot]) for slot, var in inputs}
        self.open = {(node.type.name, homes[slot]) for slot, node in schedule.outputs}
        """Buffers of the slots that the pass changes; until its end they may hold other values."""
        self.home_of: dict[str, int] = {}
        """The slot's buffer in which a variable must end up."""
        self.last: dict[str, int] = {}
        """The position at which each variable is last read."""
        self.follows: dict[str, str] = {}
        """The variable whose value each variable has if its statement is skipped."""
        self.ends: dict[str, int] = {}
        """The position at which that value must be in place."""
        self.order = list(_inner_first(schedule.body))
        defined: dict[str, int] = {}
        for position, statement in enumerate(self.order):
            if isinstance(statement, Compute):
                self.read(position, *statement.reads)
                defined |= dict.fromkeys(statement.vars, position)
            self.read(position, *statement.vars)
            for name, old in statement.olds.items():
                self.ends[name] = position
                if old.op == "load":
                    self.follows[name] = old.attr
        changed = {slot for slot, _ in schedule.outputs}
        self.read(FOREVER, *(var.name for slot, var in schedule.inputs if slot not in changed))
        for slot, node in schedule.outputs:
            if node.op == "load":
                self.home_of.setdefault(node.attr, homes[slot])
                self.read(len(self.order), node.attr)
        for name, before in self.follows.items():
            self.read(defined[name], before)

    def read(self, position: int, *names: str) -> None:
        self.last |= {name: max(self.last.get(name, -1), position) for name in names}

    def assign(self) -> dict[str, Buffer]:
        busy = {number: name for name, number in self.buffer.items()}
        for position, statement in enumerate(self.order):
            busy = {key: name for key, name in busy.items() if self.last.get(name, -1) >= position}
            if not isinstance(statement, Compute):
                continue
            for var in (var for var in statement.vars.values() if var.type != ANSWER):
                number = self.reusable(var, statement, position, busy)
                if number is None:
                    number = self.free(var, busy)
                    if old := self.follows.get(var.name):  # the old value is copied, so it must still exist
                        self.read(self.ends[var.name], old)
                kind, count = number
                self.pool.size[kind] = max(self.pool.size[kind], count + 1)
                self.buffer[var.name] = number
                busy[number] = var.name
        return self.buffer

    def reusable(self, var: Var, loop: Compute, position: int, busy: Mapping[Buffer, str]) -> Buffer | None:
        """The buffer to reuse: that of the replaced variable, or the slot's, if nothing reads it after this loop."""
        near, far = loop.reads, read_elsewhere(loop.values)
        home = busy.get((var.type.name, self.home_of.get(var.name, -1)))
        for old in filter(None, (self.follows.get(var.name), home)):
            if self.last.get(old, -1) > position or busy.get(self.buffer[old]) != old:
                continue
            shared = old in far and not (self.in_place and loop.over == "words")
            # A thread that computes cells would write a word that others read.
            if not shared and not (old in near and loop.over == "cells" and var.type == FLAG):
                return self.buffer[old]
        return None

    def free(self, var: Var, busy: Mapping[Buffer, str]) -> Buffer:
        """The buffer of the slot in which the variable ends up, or the first free one."""
        kind = var.type.name
        home = self.home_of.get(var.name)
        if home is not None and (kind, home) not in busy:
            return kind, home
        slots = {number for number in range(self.pool.slots[kind]) if (kind, number) not in self.open}
        return kind, next(n for n in range(FOREVER) if (kind, n) not in busy and n not in slots)


def _inner_first(body: Sequence[Statement]) -> Iterator[Statement]:
    """All statements, each after those in its body."""
    for statement in body:
        yield from _inner_first(statement.body)
        yield statement


def copies(pairs: Sequence[tuple[Var, Node]], graph: Graph) -> Iterator[Compute]:
    """Loops that assign values to variables; each reads everything before it writes anything."""
    flags = tuple(Out(var, value) for var, value in pairs if var.type == FLAG)
    if flags:
        yield Compute(flags, over="words")
    floats = [(var, value) for var, value in pairs if var.type == REAL]
    if floats:
        lives = (graph.node("live", FLAG, (old,), (0, 0)) for _, old in floats if old.op == "load")
        outs = tuple(Out(var, value, graph.real(0.0)) for var, value in floats)
        yield Compute(outs, region=combined("or", lives, graph), over="cells")


Access = tuple[bool, bool]
"""Two flags of an access: it is in a loop over words, to the thread's own word only; it is a write."""


@dataclass
class Pending:
    """The accesses to each buffer since the last barrier."""

    done: dict[Buffer, set[Access]] = field(default_factory=dict)

    def add(self, accesses: Sequence[tuple[Buffer, Access]]) -> bool:
        """Record the accesses of a loop. True if the loop needs a barrier before it."""
        # A thread computes the same words in all loops, so it need not wait for itself.
        wait = any(
            (written or before_written) and not (own and before_own)
            for buffer, (own, written) in accesses
            for before_own, before_written in self.done.get(buffer, ())
        )
        if wait:
            self.done.clear()
        for buffer, access in accesses:
            self.done.setdefault(buffer, set()).add(access)
        return wait


def insert_barriers(schedule: Schedule, pending: Pending) -> Schedule:
    """Insert barriers. `pending` is passed from pass to pass; computing an answer is a barrier too."""
    numbers = dict(schedule.buffers)

    def block(body: Block) -> Block:
        result: list[Statement] = []
        for statement in body:
            if isinstance(statement, Guard):
                before = {buffer: set(accesses) for buffer, accesses in pending.done.items()}
                inner = block(statement.body)
                after, pending.done = pending.done, before
                statement = replace(statement, body=inner, otherwise=block(statement.otherwise))
                for buffer, done in after.items():
                    pending.done[buffer] = done | pending.done.get(buffer, set())
            elif isinstance(statement, Compute):
                words = statement.over == "words"
                accesses = reads_of(statement.values)
                reads = [(numbers[read.name], (words and not read.far, False)) for read in accesses]
                stored = [var for var in statement.vars.values() if var.type != ANSWER]
                writes = [(numbers[var.name], (words, True)) for var in stored]
                if pending.add(reads if statement.stores_last else [*reads, *writes]):
                    result.append(Sync())
                if statement.stores_last:  # it contains a barrier between reading and storing
                    pending.done.clear()
                    pending.add(writes)
                if len(stored) < len(statement.outs):
                    pending.done.clear()
            result.append(statement)
        return tuple(result)

    return replace(schedule, body=block(schedule.body))
