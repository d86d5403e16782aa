"""What happens when the work for a check is used up: what is said is true, and what is proposed helps."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from powderdsl.diagnostics import CompileError, Diagnostic, Reporter, Severity, Source
from powderdsl.model.check import check
from powderdsl.model.declarations import PackDecl, read_file
from powderdsl.model.logic.satisfy import Facts, decide, satisfiable
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


def remarks(text: str) -> list[Diagnostic]:
    """Warnings and notes on a pack without errors."""
    reporter = Reporter()
    pack = read_file(Source("yard.yaml", text), reporter)
    assert isinstance(pack, PackDecl)
    check([pack], None, reporter)
    return list(reporter.diagnostics)


def reported(body: str) -> list[tuple[str, tuple[str, ...]]]:
    """Codes and helps of the errors that a pass has."""
    try:
        remarks(HEAD + body)
    except CompileError as error:
        return [(one.code, one.helps) for one in error.diagnostics]
    return []


def listed(rules: Sequence[str], indent: int) -> str:
    return "".join(f"{' ' * indent}- {rule}\n" for rule in rules)


RULES = [f"soil -> {'weed' if n % 2 else 'air'} if d + 10 * e == {n}" for n in range(99)]
"""Each keeps apart from each, as only a search shows."""


@pytest.mark.slow
def test_many_rules_are_too_much_work_and_each_help_helps() -> None:
    [(code, helps)] = reported("    do:\n" + listed(RULES, 6))
    assert code == "PD508"
    assert "conflicts: first_wins" in helps[0]
    assert "then:" in helps[1]
    assert reported("    conflicts: first_wins\n    do:\n" + listed(RULES, 6)) == []
    parts = [f"      - do:\n{listed(RULES[n : n + 33], 10)}" for n in range(0, 99, 33)]
    assert reported("    do:\n" + "".join(parts)) == []


def test_rules_that_are_too_hard_are_called_undecided() -> None:
    hard = [f"soil -> {one} if sum(a * b in ring) * c mod 61 == {n}" for n, one in enumerate(("weed", "air"))]
    sums = [f"soil -> {one} if (a + b * c) mod 61 == {n}" for n, one in enumerate(("weed", "air"))]
    assert reported("    do:\n" + listed(hard, 6))
    [(code, helps)] = reported("    do:\n" + listed(sums, 6))
    assert code == "PD502"
    assert helps == (
        "choose the outcome if they can: `conflicts: first_wins`",
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


def test_one_hard_question_leaves_work_for_the_next() -> None:
    names = [Expr("field", integer(0, 250), value=name) for name in "abc"]
    total = Expr("add", integer(0, 750), (Expr("add", integer(0, 500), (names[0], names[1])), names[2]))
    odd = Expr("mod", integer(0, 63), (total,), 64)
    never = [Expr("eq", FLAG, (odd, Expr("const", integer(n, n), value=n))) for n in (1, 2)]
    facts = Facts((0, 1), {}, {})
    assert decide(facts, [(one, (0, 0)) for one in never]) is None
    assert satisfiable(facts, [(one, (0, 0)) for one in never])
    assert decide(facts, [(above(A, B, 199), (0, 0)), (above(B, A, 1), (0, 0))]) is False


ONE, MORE = "(a + b * c) mod 61 == 5", "(a + b * c) mod 61 in (5, 6)"
NEVER = f"{ONE} and (a + b * c) mod 61 == 6"
"""No cell fulfills it, and every cell that fulfills ONE fulfills MORE, as only a long search would show."""


def on_rules(text: str) -> list[Diagnostic]:
    """Warnings and notes on the rules of a pack."""
    return [one for one in remarks(text) if one.code != "PD507"]


@pytest.mark.parametrize(
    "body",
    [
        f"    do: soil -> weed if {NEVER}",
        f"    do: soil -> (weed if a > 3 else air) if {NEVER}",
        f"    do: soil -> soil if {NEVER}",
        f"    do: soil -> weed if {NEVER} with chance 5%",
        f"    for k in (1, 2): {{do: 'soil -> weed if {NEVER}'}}",
        f"    do: ['d := 3 where {ONE}', 'd := 3 where {MORE}']",
        f"    do: load := 1 where {MORE} and not weed or {NEVER}",
        f"    conflicts: first_wins\n    do: ['soil -> weed if {MORE}', 'soil -> air if {ONE}']",
    ],
)
def test_what_is_not_decided_is_told_once(body: str) -> None:
    head = HEAD.replace("fields:", "fields:\n  load: {type: 0..9, at: element, of: weed}")
    line = len((head + body).splitlines())
    (found,) = on_rules(head + body)
    assert (found.code, found.severity) == ("PD518", Severity.NOTE)
    assert found.message.endswith(f"any effect: yard.yaml:{line}")


def test_chances_that_are_not_decided_are_told() -> None:
    head = HEAD.replace("elements:", "properties: {bite: {type: chance, weed: 5%}}\nelements:")
    hard = f"soil -> air if {NEVER} and below is weed with chance below.bite"
    (found,) = on_rules(f"{head}    do: {hard}\n")
    assert [label.span.text for label in (found.primary, *found.secondary)] == ["5%", hard]


def test_a_copy_that_is_decided_speaks_for_the_others() -> None:
    """A loop's rule that fires in one round is alive, however hard the other rounds are."""
    assert on_rules(f"{HEAD}    for k in (1, 2): {{do: 'soil -> weed if k == 1 or {NEVER}'}}\n") == []
    (found,) = on_rules(f"{HEAD}    do: soil -> weed if a == 3 and a == 4 and {NEVER}\n")
    assert found.code == "PD503"


def test_many_undecided_lines_are_counted() -> None:
    rules = [f"d += 1 where {NEVER} and e == {n}" for n in range(9)] * 3
    (found,) = on_rules(HEAD + "    do:\n" + listed(rules, 6))
    assert found.message.endswith("yard.yaml:34 and 7 more")
    assert len(found.secondary) == 19


def test_a_hard_rule_leaves_work_for_the_warnings_of_others() -> None:
    hard = f"    do:\n      - d := 3 where {ONE}\n      - d := 3 where {MORE}\n"
    easy = "  later:\n    do:\n      - d := 1 where soil\n      - d := 1 where any\n"
    assert [one.code for one in on_rules(HEAD + hard + easy)] == ["PD518", "PD514"]


def test_no_rule_of_a_long_list_is_left_out_in_silence() -> None:
    rules = [f"d := 1 where soil and a == {n % 60}" for n in range(120)] + ["d := 1 where any"]
    *overruled, undecided = on_rules(HEAD + "    do:\n" + listed(rules, 6))
    assert {one.code for one in overruled} == {"PD514"}
    assert undecided.code == "PD518"
    named, more = undecided.message.removesuffix(" more").split(" and ")
    assert len(overruled) + len(named.split(", ")) + int(more) == len(rules)
