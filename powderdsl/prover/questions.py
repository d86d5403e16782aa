"""Questions about formulas: gates become clauses of a SAT solver, and comparisons of floats are kept consistent."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from powderdsl.ir.ops import OPS, Threshold
from powderdsl.prover.net import FALSE, TRUE, Literal
from powderdsl.prover.solver import OutOfWork, Solver
from powderdsl.prover.symbolic import LEAVES, Cell, Symbols, Term


@dataclass(frozen=True)
class Model:
    """A part of a world that answers a question: its content, and the random numbers that it draws.

    Places are relative to the cell in question. `numbers` are rows, columns and steps by (axis, modulus).
    """

    cells: Mapping[Cell, Mapping[str, bool]]
    draws: Mapping[tuple[str, int, int], int]
    params: Mapping[tuple[str, Threshold | None], int]
    numbers: Mapping[tuple[str, int], int]
    has_edges: bool
    floats: tuple[float, ...]
    """The constants among the floats, and the values between them."""


GATE = 10
"""Units of work to make a gate and its clauses."""

MAX_ROUNDS = 400
"""Maximum number of times that a question is repeated because its answer compared equal floats differently."""


class Questions:
    """One incremental solver for a net. Gates become clauses when they are first asked about."""

    def __init__(self, symbols: Symbols) -> None:
        self.symbols, self.net = symbols, symbols.net
        self.solver = Solver()
        self.same: dict[tuple[Term, Term], Literal] = {}
        """A literal for each pair of floats: the two are equal."""
        self._facts = self._size = 0
        self._encoded: set[int] = set()
        self._model: dict[int, bool] = {}

    def _number(self, literal: Literal) -> int:
        """The solver's literal."""
        self._encode(literal >> 1)
        return -(literal >> 1) if literal & 1 else literal >> 1

    def _encode(self, root: int) -> None:
        add, stack = self.solver.add_clause, [root]
        while stack:
            gate = stack.pop()
            if gate in self._encoded:
                continue
            self._encoded.add(gate)
            kind = self.net.kinds[gate]
            stack += self.net.inputs[gate]
            args = [-(literal >> 1) if literal & 1 else literal >> 1 for literal in self.net.args[gate]]
            if kind == "variable":
                continue
            if kind == "and":
                a, b = args
                clauses: tuple[tuple[int, ...], ...] = (-gate, a), (-gate, b), (gate, -a, -b)
            elif kind == "xor":
                a, b = args
                clauses = (-gate, a, b), (-gate, -a, -b), (gate, -a, b), (gate, a, -b)
            else:
                c, a, b = args
                clauses = (
                    (-c, -a, gate),
                    (-c, a, -gate),
                    (c, -b, gate),
                    (c, b, -gate),
                    (-a, -b, gate),
                    (a, b, -gate),
                )
            for clause in clauses:
                add(clause)

    def require(self, literals: Sequence[Literal]) -> None:
        """Require from now on that at least one of these is true."""
        if TRUE not in literals:
            self.solver.add_clause([self._number(literal) for literal in literals if literal != FALSE])

    def ask(self, literals: Sequence[Literal], concerned: Sequence[int]) -> bool:
        """Return whether all of these can be true at once; `holds` then has their values. Raises OutOfWork.

        `concerned`: the relevant gates; all others follow from these or are free.
        """
        known = self.symbols.facts
        while self._facts < len(known):
            self.require([known[self._facts]])
            self._facts += 1
        if FALSE in literals:
            return False
        assumptions = [self._number(literal) for literal in literals if literal != TRUE]
        for _ in range(MAX_ROUNDS):
            self._model = {}
            if not self._solve(assumptions, concerned):
                return False
            if not self._refine(concerned):
                return True
        raise OutOfWork

    def _solve(self, assumptions: Sequence[int], concerned: Sequence[int]) -> bool:
        budget, before = self.symbols.budget, self.solver.work
        budget.spend(GATE * (self.symbols.size - self._size))
        self._size = self.symbols.size
        try:
            return self.solver.solve(assumptions, limit=before + budget.left, decide=concerned)
        finally:
            budget.left -= self.solver.work - before

    def holds(self, literal: Literal) -> bool:
        """The value of a literal in the model of the last question; variables that were irrelevant to it are false."""
        return self._value(literal >> 1) ^ bool(literal & 1)

    def _value(self, gate: int) -> bool:
        if gate in self._encoded or not gate:
            return bool(gate) and self.solver.holds(gate)
        if gate not in self._model:
            kind, args = self.net.kinds[gate], self.net.args[gate]
            if kind == "choice":
                self._model[gate] = self.holds(args[1] if self.holds(args[0]) else args[2])
            else:  # a variable that no question used is false
                a, b = map(self.holds, args or (FALSE, FALSE))
                self._model[gate] = a and b if kind == "and" else a != b
        return self._model[gate]

    def model(self, concerned: Sequence[int]) -> Model:
        """The answer, restricted to what some gates read."""
        cells: dict[Cell, dict[str, bool]] = {}
        numbers: dict[str, dict[Any, int]] = {"draw": {}, "param": {}, "coordinate": {}}
        has_edges = False
        for gate in concerned:
            if gate not in self.net.names:
                continue
            kind, *name = self.net.names[gate]
            value = self._value(gate)
            if kind == "cell" and not name[0]:
                _, plane, y, x = name
                cells.setdefault((y, x), {})[plane] = value
            elif kind in numbers and (kind != "coordinate" or name[-2] in (0, name[1])):
                *key, bit = name
                key = key[:2] if kind == "coordinate" else key
                numbers[kind][(*key,)] = numbers[kind].get((*key,), 0) | value << bit
            has_edges |= kind == "outside"
        terms = self.symbols.terms
        known = {number for term in range(len(terms.terms)) if (number := terms.value(term)) is not None}
        floats = [min(known) - 1, *sorted(known), max(known) + 1] if known else []
        floats += [(low + high) / 2 for low, high in pairwise(floats)]
        return Model(cells, numbers["draw"], numbers["param"], numbers["coordinate"], has_edges, (*floats,))

    # Floats

    def equal_floats(self, a: Term, b: Term) -> Literal:
        """Return whether two floats are the same term for some choices."""
        if a == b:
            return TRUE
        key = (min(a, b), max(a, b))
        return self.same.setdefault(key, self.symbols.about("same", *key))

    def _refine(self, concerned: Sequence[int]) -> bool:
        """Add clauses that the model violates (equal terms are equal, equal comparisons agree); False if there is none."""
        terms, broken = self.symbols.terms, False
        resolved: dict[Term, tuple[Term, frozenset[Literal]]] = {}
        gates = set(concerned)
        known: dict[tuple[str, Term, Term], tuple[Literal, frozenset[Literal]]] = {}
        for (a, b), literal in self.same.items():
            if literal >> 1 in gates and not self.holds(literal):
                (first, why), (second, why_too) = self._resolve(a, resolved), self._resolve(b, resolved)
                if first == second:
                    self.require([literal, *(choice ^ 1 for choice in why | why_too)])
                    broken = True
        for (op, a, b), literal in self.symbols.comparisons.items():
            if literal >> 1 not in gates:
                continue
            (first, why), (second, why_too) = self._resolve(a, resolved), self._resolve(b, resolved)
            choices = why | why_too
            left, right = terms.value(first), terms.value(second)
            if left is not None and right is not None:
                wanted = TRUE if OPS[op].value(None, left, right) else FALSE
            elif first == second and op == "lt":
                wanted = FALSE
            else:  # NaN is not equal to itself
                wanted, others = known.setdefault((op, first, second), (literal, choices))
                choices |= others
            if self.holds(literal) != self.holds(wanted):
                self.require([*(choice ^ 1 for choice in choices), self.net.xor(literal, wanted) ^ 1])
                broken = True
        return broken

    def _resolve(
        self, term: Term, resolved: dict[Term, tuple[Term, frozenset[Literal]]]
    ) -> tuple[Term, frozenset[Literal]]:
        """The term that results from the model's choices, and the literals of these choices."""
        if term not in resolved:
            terms = self.symbols.terms
            kind, attr, *args = terms.terms[term]
            if kind == "select":
                condition: Literal = attr  # type: ignore[assignment]
                side = int(not self.holds(condition))
                result, why = self._resolve(args[side], resolved)  # type: ignore[arg-type]
                resolved[term] = result, why | {condition ^ side}
            elif kind in OPS and kind not in LEAVES:
                parts = [self._resolve(arg, resolved) for arg in args]  # type: ignore[arg-type]
                whole = terms.apply(str(kind), attr, [part for part, _ in parts])
                resolved[term] = whole, frozenset[Literal]().union(*(why for _, why in parts))
            else:
                resolved[term] = term, frozenset()
        return resolved[term]
