"""Places barriers between loops of which one reads or writes what the other wrote."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from powderdsl.schedule.buffers import Buffer, neighbors
from powderdsl.schedule.types import ANSWER, Compute, Guard, Schedule, Statement, Sync

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
