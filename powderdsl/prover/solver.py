"""A SAT solver in plain Python that learns clauses from conflicts.

Internally, literal v is the code 2 v and -v is 2 v + 1, so `code ^ 1` is the negation. False codes are stored.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from heapq import heapify, heappop, heappush
from itertools import chain
from math import inf

RUN = 64  # conflicts before a restart, times Luby's sequence
KEPT = 1_000  # conflicts before the worse half of the learned clauses is dropped
DECAY = 0.95  # of the weight of a conflict, with each later one


class OutOfWork(Exception):
    """The solver's budget of work is spent."""


class Solver:
    """An incremental SAT solver; literals are non-zero integers as in DIMACS: v or -v.

    The same calls take the same steps; `work` counts the clauses and literals visited in all calls.
    """

    def __init__(self) -> None:
        self.work = 0
        self._consistent = True
        self._model: frozenset[int] = frozenset()  # the false literals
        # By literal: 1 + the level at which it became false, 0 if it is not; the clause that made it so, () if none did.
        self._falsified: list[int] = []
        self._reasons: list[Sequence[int]] = []
        # What to check when a literal becomes false. In clauses of two literals, the negation of the other; of three, both
        # others; of more, if it is one of the first two, the clause with the negation of one of its literals.
        self._pairs: defaultdict[int, list[int]] = defaultdict(list)
        self._triples: defaultdict[int, list[tuple[int, int]]] = defaultdict(list)
        self._watches: defaultdict[int, list[tuple[int, list[int]]]] = defaultdict(list)
        # By variable: its score (the lowest is decided first); its score in the heap, inf if absent, -inf if it must not be
        # decided; the literal that was last false.
        self._scores: list[float] = []
        self._queued: list[float] = []
        self._phases: list[int] = []
        self._choice: list[int] = []  # the variables to decide
        self._heap: list[tuple[float, int]] = []
        self._weight = 1.0
        self._trail: list[int] = []  # the false literals in order
        self._starts: list[int] = []  # of each level but the first, in the trail
        self._next = 0  # in the trail, the first literal whose consequences have not been drawn
        self._conflicts = 0
        self._due = KEPT
        self._learned: list[tuple[int, list[int]]] = []  # clauses with the number of their levels
        self._used: set[int] = set()  # ids of clauses in conflicts since clauses were last dropped

    def add_clause(self, literals: Iterable[int]) -> None:
        """Require that one of the literals is true; variables are created on demand."""
        codes = dict.fromkeys(map(self._code, literals))
        clause = [code for code in codes if not self._falsified[code]]
        if any(self._falsified[code ^ 1] or code ^ 1 in codes for code in clause):
            return
        self._consistent &= bool(clause)
        if len(clause) > 1:
            self._attach(clause)
        elif clause:
            self._falsify(clause[0] ^ 1, ())

    def solve(
        self, assumptions: Sequence[int] = (), limit: int | None = None, decide: Iterable[int] | None = None
    ) -> bool:
        """Return whether all clauses and assumptions can be true.

        With `decide`, only these variables are decided, and the answer is yes if they have values without a conflict.
        This is correct if clauses define all other variables, as those of gates do.

        Raises:
            OutOfWork: `work` has passed `limit`; learned clauses are kept, so `solve` can be called again.
        """
        assumed = [self._code(literal) for literal in assumptions]
        for variable in self._choice:
            self._queued[variable] = -inf
        codes = (
            chain(self._pairs, self._triples, self._watches) if decide is None else map(self._code, decide)
        )
        self._choice = list({code >> 1: None for code in codes})
        self._heap = [(self._scores[variable], variable) for variable in self._choice]
        heapify(self._heap)
        for score, variable in self._heap:
            self._queued[variable] = score
        self.work += len(self._heap)
        try:
            return self._consistent and self._search(assumed, limit)
        finally:
            self._undo(0)

    def holds(self, literal: int) -> bool:
        """Return whether a literal is true in the last model that `solve` found; variables without a value are False."""
        return (2 * abs(literal) + 1 in self._model) == (literal > 0)

    def _code(self, literal: int) -> int:
        if not literal:
            raise ValueError("a literal is v or -v, never 0")
        code = 2 * literal if literal > 0 else 1 - 2 * literal
        if code >= len(self._falsified):
            old, size = len(self._scores), code + 1  # twice the required size
            self._scores += [0.0] * (size - old)
            self._queued += [-inf] * (size - old)
            self._phases += range(2 * old, 2 * size, 2)
            self._falsified += [0] * (2 * (size - old))
            self._reasons += [()] * (2 * (size - old))
        return code

    def _attach(self, clause: list[int]) -> None:
        if len(clause) == 2:
            self._pairs[clause[0]].append(clause[1] ^ 1)
            self._pairs[clause[1]].append(clause[0] ^ 1)
        elif len(clause) == 3:
            for place, code in enumerate(clause):
                self._triples[code].append((clause[place - 1], clause[place - 2]))
        else:
            lists = [self._watches[code] for code in clause]  # created here: each may be watched later
            for watching in lists[:2]:
                watching.append((clause[2] ^ 1, clause))

    def _falsify(self, code: int, reason: Sequence[int]) -> None:
        self._falsified[code] = len(self._starts) + 1
        self._reasons[code] = reason
        self._trail.append(code)

    def _search(self, assumed: Sequence[int], limit: int | None) -> bool:
        falsified, starts = self._falsified, self._starts
        run, factor, stop = 1, 1, self._conflicts + RUN
        while limit is None or self.work <= limit:
            if conflict := self._propagate():
                if not starts:
                    self._consistent = False
                    return False
                self._learn(conflict)
            elif self._conflicts >= stop:
                run, factor = (run + 1, 1) if run & -run == factor else (run, 2 * factor)
                stop = self._conflicts + RUN * min(factor, 64)  # prevents overflow of scores
                self._undo(0)
            elif self._conflicts >= self._due and not starts:
                self._drop()
            else:
                code = 0
                if len(starts) < len(assumed):
                    code = assumed[len(starts)] ^ 1
                    if falsified[code ^ 1]:
                        return False
                while not code and self._heap:
                    variable = heappop(self._heap)[1]
                    self._queued[variable] = inf
                    if not falsified[2 * variable] and not falsified[2 * variable + 1]:
                        code = self._phases[variable]
                if not code:
                    self._model = frozenset(self._trail)
                    return True
                starts.append(len(self._trail))
                if not falsified[code]:
                    self._falsify(code, ())
        raise OutOfWork

    def _undo(self, level: int) -> None:
        falsified, phases, queued, scores = self._falsified, self._phases, self._queued, self._scores
        while len(self._starts) > level:
            self._next = self._starts.pop()
            for code in self._trail[self._next :]:
                falsified[code] = 0
                variable = code >> 1
                phases[variable] = code
                if queued[variable] > scores[variable]:
                    queued[variable] = scores[variable]
                    heappush(self._heap, (scores[variable], variable))
            del self._trail[self._next :]

    def _propagate(self) -> Sequence[int]:
        """Draws all consequences; returns a clause that became false, or () if none did."""
        falsified, reasons, watches = self._falsified, self._reasons, self._watches
        level = len(self._starts) + 1
        queue = self._trail[self._next :]
        conflict: Sequence[int] = ()
        for false in queue:  # the trail grows during the loop
            pairs = self._pairs.get(false, ())
            triples = self._triples.get(false, ())
            watching = watches.get(false, ())
            self.work += 1 + len(pairs) + len(triples) + len(watching)
            for other in pairs:
                if not falsified[other]:
                    if falsified[other ^ 1]:
                        conflict = (false, other ^ 1)
                    else:
                        falsified[other] = level
                        reasons[other] = (false,)
                        queue.append(other)
            for left, right in triples:
                if falsified[right]:
                    left, right = right, left
                if falsified[left] and not falsified[right ^ 1]:
                    if falsified[right]:
                        conflict = (false, left, right)
                    else:
                        falsified[right ^ 1] = level
                        reasons[right ^ 1] = (false, left)
                        queue.append(right ^ 1)
            kept: list[tuple[int, list[int]]] = []
            if watching:
                watches[false] = kept
            for watch in watching:
                true, clause = watch
                if not falsified[true]:
                    if clause[0] == false:
                        clause[0], clause[1] = clause[1], false
                    true = clause[0] ^ 1
                    if not falsified[true]:
                        for place in range(2, len(clause)):
                            other = clause[place]
                            if not falsified[other]:
                                clause[1], clause[place] = other, false
                                watches[other].append((true, clause))
                                break
                        else:
                            kept.append(watch)
                            if falsified[clause[0]]:
                                conflict = clause
                            else:
                                falsified[true] = level
                                reasons[true] = clause
                                queue.append(true)
                        continue
                    watch = (true, clause)
                kept.append(watch)
            if conflict:
                break
        self._trail[self._next :] = queue
        self._next = len(self._trail)
        return conflict

    def _learn(self, conflict: Sequence[int]) -> None:
        """Learns a clause from a conflict, and returns to the level where the clause has a consequence.

        It has one literal of the conflict's level: the last one through which all paths from the decision led.
        """
        falsified, reasons, trail = self._falsified, self._reasons, self._trail
        current = len(self._starts) + 1
        seen: set[int] = set()
        place, here = len(trail), 0
        while True:
            if len(conflict) > 3:
                self._used.add(id(conflict))
            for code in conflict:
                if falsified[code] > 1 and code not in seen:
                    seen.add(code)
                    here += falsified[code] == current
            place -= 1
            while trail[place] not in seen:
                place -= 1
            here -= 1
            if not here:
                break
            conflict = reasons[trail[place]]
        self._conflicts += 1
        self.work += len(seen)
        for code in seen:
            self._scores[code >> 1] -= self._weight
        self._weight /= DECAY
        clause = [trail[place]]
        for code in sorted(seen, key=falsified.__getitem__, reverse=True):
            causes = reasons[code]
            if falsified[code] < current and (
                not causes or any(falsified[cause] > 1 and cause not in seen for cause in causes)
            ):
                clause.append(code)  # it does not follow from the others
        levels = len({falsified[code] for code in clause})
        if len(clause) > 1:
            self._attach(clause)
        if len(clause) > 3 and levels > 2:
            self._learned.append((levels, clause))
        self._undo(falsified[clause[1]] - 1 if len(clause) > 1 else 0)
        self._falsify(clause[0] ^ 1, clause)

    def _drop(self) -> None:
        """Drops the worse half of the learned clauses: those not used recently, with many levels, and long."""
        self._learned.sort(key=lambda pair: (id(pair[1]) not in self._used, pair[0], len(pair[1])))
        half = len(self._learned) // 2
        worse = {id(clause) for _, clause in self._learned[half:]}
        for code, watching in self._watches.items():
            self._watches[code] = [watch for watch in watching if id(watch[1]) not in worse]
        del self._learned[half:]
        self._used = set()
        self._due = self._conflicts + KEPT
        self._scores = [score / self._weight for score in self._scores]
        self._queued = [score / self._weight for score in self._queued]
        self._heap = [(score / self._weight, variable) for score, variable in self._heap]
        self._weight = 1.0
