"""Where an expression stands: its pack, its local names, and how a symmetry turns it."""

from __future__ import annotations

from dataclasses import dataclass, replace

from powderdsl.model.expressions.operands import Operand
from powderdsl.model.types import Offset

Matrix = tuple[tuple[int, int], tuple[int, int]]
IDENTITY: Matrix = ((1, 0), (0, 1))


@dataclass(frozen=True)
class Scope:
    """Where an expression stands: its pack, the local names, and how it is turned by a symmetry."""

    pack: str
    locals: dict[str, Operand]
    orientation: Matrix = IDENTITY

    def bind(self, **names: Operand) -> Scope:
        return replace(self, locals={**self.locals, **names})


def turned(offset: Offset, matrix: Matrix) -> Offset:
    (a, b), (c, d) = matrix
    return (a * offset[0] + b * offset[1], c * offset[0] + d * offset[1])
