"""What happens when the work for a check is used up: what is said is true, and what is proposed helps."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from powderdsl.diagnostics import CompileError, Reporter, Source
from powderdsl.model.check import check
from powderdsl.model.declarations import PackDecl
from powderdsl.model.logic.budget import BUDGET, Budget
from powderdsl.model.logic.satisfy import Facts, decide, satisfiable
from powderdsl.model.packs import read_file
from powderdsl.model.types import FLAG, Expr, integer

HEAD = """pack: yard
fields:
  a: {type: 0..60, at: place}
  b: {type: 0..60, at: place}
  c: {type: 0..250, at: place}
  d: {type: 0..9, at: place}
  e: {type: 0..9, at: place}
elements:
  air: {id: 0, color: "#FFFFFF"}
  soil: {id: 1, color: "#806040"}
  weed: {id: 2, color: "#30A030"}
passes:
  grow:
"""


def reported(body: str) -> list[tuple[str, tuple[str, ...]]]:
    """Codes and helps of the errors that a pass has."""
    reporter = Reporter()
    try:
        pack = read_file(Source("yard.yaml", HEAD + body), reporter)
        assert isinstance(pack, PackDecl)
        check([pack], None, reporter)
    except CompileError as error:
        return [(one.code, one.helps) for one in error.diagnostics]
    return []


def listed(rules: Sequence[str], indent: int) -> str:
    return "".join(f"{' ' * indent}- {rule}\n" for rule in rules)


RULES = [f"soil -> {'weed' if n % 2 else 'air'} if d + 10 * e == {n}" for n in range(99)]
"""Each keeps apart from each, as only a search shows."""


def test_many_rules_are_too_much_work_and_each_help_helps() -> None:
    [(code, helps)] = reported("    do:\n" + listed(RULES, 6))
    assert code == "PD508"
    assert "conflicts: first_wins" in helps[0]
    assert "then:" in helps[1]
    assert reported("    conflicts: first_wins\n    do:\n" + listed(RULES, 6)) == []
    parts = [f"      - do:\n{listed(RULES[n : n + 33], 10)}" for n in range(0, 99, 33)]
    assert reported("    do:\n" + "".join(parts)) == []


def test_rules_that_one_value_keeps_apart_are_cheap() -> None:
    rules = [f"soil -> {'weed' if n % 2 else 'air'} if a == {n % 60} and b == {n // 60}" for n in range(500)]
    assert reported("    do:\n" + listed(rules, 6)) == []


def test_rules_that_are_too_hard_are_called_undecided() -> None:
    hard = [f"soil -> {one} if sum(a * b in ring) * c mod 61 == {n}" for n, one in enumerate(("weed", "air"))]
    sums = [f"soil -> {one} if (a + b * c) mod 61 == {n}" for n, one in enumerate(("weed", "air"))]
    assert reported("    do:\n" + listed(hard, 6))
    [(code, helps)] = reported("    do:\n" + listed(sums, 6))
    assert code == "PD502"
    assert helps == (
        "choose what happens if they do: `conflicts: first_wins`",
        "or put one of them under `then:`",
    )
    assert reported("    conflicts: first_wins\n    do:\n" + listed(sums, 6)) == []
    assert reported(f"    do: {sums[0]}\n    then: {sums[1]}\n") == []


@pytest.mark.parametrize("order", [("a", "b"), ("b", "a")])
def test_adding_up_needs_no_search(order: tuple[str, str]) -> None:
    """`+=` commutes: however many such rules there are, and whatever they ask, they are accepted."""
    x, y = order
    rules = f"      - c += 1 where right.{x} * {y} - left.{y} * {x} > 7 * k and sum({x} in box) mod 59 == k\n"
    assert reported("    for side in octants, k in 0..60:\n" + rules) == []


A, B = (Expr("field", integer(0, 200), value=name) for name in "ab")


def above(first: Expr, second: Expr, least: int) -> Expr:
    """first - second >= least"""
    number = Expr("const", integer(least, least), value=least)
    return Expr("le", FLAG, (number, Expr("sub", integer(-200, 200), (first, second))))


@pytest.mark.parametrize("conditions", [(above(A, B, 150),), (above(B, A, 150),)])
def test_work_does_not_depend_on_the_side(conditions: tuple[Expr, ...]) -> None:
    budget = Budget()
    facts = Facts((0, 1), {}, {}, {}, {}, budget)
    assert decide(facts, [(one, (0, 0)) for one in conditions]) is True
    assert BUDGET - budget.left < 3_000


def test_one_hard_question_leaves_work_for_the_next() -> None:
    names = [Expr("field", integer(0, 250), value=name) for name in "abc"]
    total = Expr("add", integer(0, 750), (Expr("add", integer(0, 500), (names[0], names[1])), names[2]))
    odd = Expr("mod", integer(0, 63), (total,), 64)
    never = [Expr("eq", FLAG, (odd, Expr("const", integer(n, n), value=n))) for n in (1, 2)]
    facts = Facts((0, 1), {}, {}, {})
    assert decide(facts, [(one, (0, 0)) for one in never]) is None
    assert satisfiable(facts, [(one, (0, 0)) for one in never])
    assert decide(facts, [(above(A, B, 199), (0, 0)), (above(B, A, 1), (0, 0))]) is False
