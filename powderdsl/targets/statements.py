"""The statements of schedules that C++ and WebAssembly print."""

from __future__ import annotations

from typing import Any, Protocol

from powderdsl.schedule.types import Compute, Forget, Guard, Move, Out, Release, Statement, Sweeps
from powderdsl.schedule.words import is_whole


class Printer(Protocol):
    """A method for each kind of statement that the stages of the CPU leave.

    `whole` is an operation on whole planes (`empty.is_whole`), `words` a loop that computes planes anew, and `update` one
    that changes them where a mask holds.
    """

    def whole(self, out: Out) -> Any: ...
    def words(self, loop: Compute) -> Any: ...
    def update(self, loop: Compute) -> Any: ...
    def sweeps(self, sweeps: Sweeps) -> Any: ...
    def move(self, move: Move) -> Any: ...
    def guard(self, guard: Guard) -> Any: ...
    def release(self, names: tuple[str, ...]) -> Any: ...
    def forget(self) -> Any: ...


def printed(printer: Printer, statement: Statement) -> Any:
    """What a printer makes of a statement."""
    match statement:
        case Compute((out,), _, "words") if is_whole(out.value):
            return printer.whole(out)
        case Compute(region=None):
            return printer.words(statement)
        case Compute():
            return printer.update(statement)
        case Sweeps():
            return printer.sweeps(statement)
        case Move():
            return printer.move(statement)
        case Guard():
            return printer.guard(statement)
        case Release(names):
            return printer.release(names)
        case Forget():
            return printer.forget()
    raise AssertionError(f"no text for {statement}")
