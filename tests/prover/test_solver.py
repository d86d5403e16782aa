"""The SAT solver: against enumeration, against python-sat where that is installed, and within its budget of work.

`make test-all` compares more formulas: SOLVER_FORMULAS of them, 10,000 if it is not set.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from itertools import combinations
from random import Random

import pytest

from powderdsl.prover.solver import OutOfWork, Solver

FORMULAS = int(os.environ.get("SOLVER_FORMULAS", "10000"))
CHUNKS = 10

Clause = tuple[int, ...]


def enumerated(clauses: Iterable[Sequence[int]], variables: int) -> int:
    """The models of clauses, as a set of bits: bit i stands for the values that are the bits of i."""
    size = 1 << variables
    everything = (1 << size) - 1
    columns = [0]
    for variable in range(variables):
        half = 1 << variable  # so many values without it, then as many with it
        columns.append(everything // ((1 << 2 * half) - 1) * (((1 << half) - 1) << half))
    models = everything
    for clause in clauses:
        satisfied = 0
        for literal in clause:
            satisfied |= columns[literal] if literal > 0 else everything ^ columns[-literal]
        models &= satisfied
    return models


def random_clause(random: Random, variables: int, length: int) -> Clause:
    return tuple(random.choice((-1, 1)) * random.randint(1, variables) for _ in range(length))


def random_formula(random: Random, variables: int, mixed: bool) -> list[Clause]:
    """Clauses of three literals around the threshold, or of one to five; literals repeat and contradict themselves."""
    if not mixed:
        return [
            random_clause(random, variables, 3) for _ in range(round(variables * random.uniform(3.5, 5.5)))
        ]
    lengths = random.choices(range(1, 6), (1, 6, 8, 8, 8), k=round(variables * random.uniform(2, 7)))
    return [random_clause(random, variables, length) for length in lengths]


def compared(seed: int) -> Iterator[bool]:
    """The answers about a random formula that grows, each with other assumptions, once enumeration says the same."""
    random = Random(seed)
    variables = random.randint(1, 12)
    clauses = random_formula(random, variables, mixed=seed % 2 == 1)
    solver = Solver()
    known: list[Clause] = []
    while clauses:
        some = random.randint(1, len(clauses))
        for clause in clauses[:some]:
            solver.add_clause(clause)
        known += clauses[:some]
        del clauses[:some]
        for most in (3, 0, 4):
            assumptions = random_clause(random, variables, random.randint(0, most))
            demands = [*known, *((literal,) for literal in assumptions)]
            answer = solver.solve(assumptions)
            assert answer == (enumerated(demands, variables) != 0), (seed, known, assumptions)
            if answer:
                assert all(any(map(solver.holds, clause)) for clause in demands), (seed, known, assumptions)
            yield answer


def pigeons(count: int, holes: int) -> list[Clause]:
    """Each pigeon has a hole, and no hole has two."""
    rooms = [[pigeon * holes + hole + 1 for hole in range(holes)] for pigeon in range(count)]
    shared = [(-one[hole], -two[hole]) for one, two in combinations(rooms, 2) for hole in range(holes)]
    return [*map(tuple, rooms), *shared]


def solver_of(clauses: Iterable[Sequence[int]]) -> Solver:
    solver = Solver()
    for clause in clauses:
        solver.add_clause(clause)
    return solver


def threshold(seed: int, variables: int) -> list[Clause]:
    """Clauses of three variables, as hard as they get."""
    random = Random(seed)
    triples = (random.sample(range(1, variables + 1), 3) for _ in range(round(4.26 * variables)))
    return [tuple(random.choice((-1, 1)) * variable for variable in triple) for triple in triples]


def test_enumeration_finds_the_models() -> None:
    assert enumerated([], 2) == 0b1111
    assert enumerated([(1,)], 2) == 0b1010
    assert enumerated([(-1, 2)], 2) == 0b1101
    assert enumerated([(2,), (-2, -1)], 3) == 0b01000100
    assert enumerated([(1,), (-1,)], 3) == enumerated([()], 3) == 0


def test_small_formulas_against_enumeration() -> None:
    answers = [answer for seed in range(1_000) for answer in compared(seed)]
    assert min(answers.count(True), answers.count(False)) > len(answers) // 5


@pytest.mark.slow
@pytest.mark.parametrize("chunk", range(CHUNKS))
def test_many_small_formulas_against_enumeration(chunk: int) -> None:
    for seed in range(chunk, FORMULAS, CHUNKS):
        for _ in compared(seed):
            pass


def test_no_clauses_and_the_empty_clause() -> None:
    solver = Solver()
    assert solver.solve()
    assert not solver.holds(3)
    assert solver.holds(-3)
    assert solver.solve([3, -7])
    assert solver.holds(3)
    assert not solver.holds(7)
    assert not solver.solve([3, -3])
    assert solver.holds(3), "the last model, which answers of no leave alone"
    solver.add_clause([])
    assert not solver.solve()
    assert not solver.solve([3])


def test_zero_is_no_literal() -> None:
    with pytest.raises(ValueError, match="never 0"):
        Solver().add_clause([1, 0])


def test_literals_that_do_not_watch_are_decided_too() -> None:
    solver = solver_of([(1, 2, 3, 4, 5)])
    assert solver.solve([-1, -2])
    assert any(map(solver.holds, (3, 4, 5)))


@pytest.mark.parametrize(("count", "holes"), [(5, 4), (6, 5)])
def test_pigeons_without_enough_holes(count: int, holes: int) -> None:
    assert not solver_of(pigeons(count, holes)).solve()
    assert solver_of(pigeons(holes, holes)).solve()


def test_hard_formulas_agree_whatever_is_assumed_first() -> None:
    """Long enough for restarts; without a model there is none with a variable true, nor with it false."""
    answers = []
    for seed in range(8):
        clauses = threshold(seed, 60)
        whole, halves = solver_of(clauses), solver_of(clauses)
        answers.append(whole.solve())
        assert answers[-1] == (halves.solve([1]) | halves.solve([-1]))
        if answers[-1]:
            assert all(any(map(whole.holds, clause)) for clause in clauses)
            assert all(any(map(halves.holds, clause)) for clause in clauses)
    assert set(answers) == {True, False}


def test_dropping_learned_clauses_changes_no_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    formulas = [threshold(seed, 50) for seed in range(6)]
    answers = [solver_of(clauses).solve() for clauses in formulas]
    monkeypatch.setattr("powderdsl.prover.solver.KEPT", 20)
    monkeypatch.setattr("powderdsl.prover.solver.RUN", 4)
    dropping = [solver_of(clauses) for clauses in formulas]
    assert [solver.solve() for solver in dropping] == answers
    for solver, clauses, answer in zip(dropping, formulas, answers, strict=True):
        assert not answer or all(any(map(solver.holds, clause)) for clause in clauses)


def test_work_is_bounded_and_goes_on() -> None:
    clauses = pigeons(7, 6)
    solver = solver_of(clauses)
    with pytest.raises(OutOfWork):
        solver.solve(limit=solver.work)
    stops = 0
    while True:
        before = solver.work
        try:
            answer = solver.solve(limit=before + 5_000)
            break
        except OutOfWork:
            stops += 1
            assert 5_000 < solver.work - before < 10_000
    assert not answer
    assert stops > 2, "what was learned before is kept, but takes more than one call"


def test_after_work_is_spent_other_questions_are_answered() -> None:
    solver = solver_of(pigeons(8, 7)[1:])  # the first pigeon may stay away
    with pytest.raises(OutOfWork):
        solver.solve([1], limit=solver.work + 1_000)
    assert solver.solve(limit=solver.work + 1_000_000)
    assert not any(map(solver.holds, range(1, 8)))
    solver.add_clause([1])
    with pytest.raises(OutOfWork):
        solver.solve(limit=solver.work + 1_000)


def test_the_same_calls_take_the_same_steps() -> None:
    works, models = set(), set()
    for _ in range(2):
        solver = solver_of(threshold(0, 70))
        solver.solve([5, -6])
        solver.add_clause([7, 8])
        solver.solve()
        works.add(solver.work)
        models.add(tuple(solver.holds(variable) for variable in range(1, 71)))
    assert len(works) == len(models) == 1


def adder(solver: Solver, ones: Sequence[int], others: Sequence[int], fresh: Iterator[int]) -> list[int]:
    """The clauses of gates that add two numbers; the literals of the sum."""
    carry, total = next(fresh), []
    solver.add_clause([-carry])
    for one, other in zip(ones, others, strict=True):
        result, carried = next(fresh), next(fresh)
        for bits in range(8):
            values = [one, other, carry]
            signs = [1 if bits >> place & 1 else -1 for place in range(3)]
            differ = [-sign * value for sign, value in zip(signs, values, strict=True)]
            solver.add_clause([*differ, result if bits.bit_count() % 2 else -result])
        for pair in combinations((one, other, carry), 2):
            solver.add_clause([*(-value for value in pair), carried])
            solver.add_clause([*pair, -carried])
        total.append(result)
        carry = carried
    return total


def test_only_some_variables_are_decided() -> None:
    """Gates outside of a question stay without values, and those inside of it have theirs."""
    solver = Solver()
    fresh = iter(range(1, 1_000))
    inputs = [[next(fresh) for _ in range(8)] for _ in range(4)]
    first = adder(solver, inputs[0], inputs[1], fresh)
    cone = [*inputs[0], *inputs[1], *range(33, next(fresh))]
    second = adder(solver, inputs[2], inputs[3], fresh)
    odd = [first[0], first[7], -inputs[0][7]]
    assert solver.solve(odd, decide=cone)
    assert all(map(solver.holds, odd))
    numbers = [sum(solver.holds(bit) << place for place, bit in enumerate(bits)) for bits in (*inputs, first)]
    assert (numbers[0] + numbers[1]) % 256 == numbers[4]
    before = solver.work
    assert solver.solve(odd, decide=cone)
    part = solver.work - before
    assert solver.solve(odd)
    assert solver.work - before - part > 1.5 * part, "all gates get values if none are named"
    assert not solver.solve([*odd, -inputs[1][0], -inputs[0][0]], decide=cone)
    assert solver.solve([inputs[3][1]])
    assert solver.solve([second[0], -inputs[2][0]])
    assert solver.holds(inputs[3][1]), "what had a value gets it again"
    assert solver.solve([second[0], -inputs[2][0]], decide=[])
    assert solver.holds(inputs[3][0]), "this follows"
    assert not solver.holds(inputs[3][1]), "this is neither decided nor follows"


def test_large_formulas_against_python_sat() -> None:
    solvers = pytest.importorskip("pysat.solvers", reason="python-sat is not installed")
    answers = []
    for seed in range(300):
        random = Random(seed)
        clauses = threshold(seed, random.randint(60, 150))
        assumptions = random_clause(random, 60, random.randint(0, 5))
        solver = solver_of(clauses)
        with solvers.Cadical153(bootstrap_with=clauses) as other:
            for assumed in (assumptions, ()):
                answers.append(solver.solve(assumed))
                assert answers[-1] == other.solve(assumptions=assumed), seed
                if answers[-1]:
                    demands = [*clauses, *((literal,) for literal in assumed)]
                    assert all(any(map(solver.holds, clause)) for clause in demands), seed
    assert min(answers.count(True), answers.count(False)) > 100
