"""Warnings about what decides nothing: who gets them, and who does not."""

from __future__ import annotations

import pytest

from powderdsl.compiler import load_with_diagnostics
from powderdsl.diagnostics import Severity
from tests.diagnostics.test_budgets import remarks
from tests.semantics.test_differential import compositions

YARD = """pack: yard
tags: {soft: gives way}
properties:
  weight: {type: 0..7, default: 1}
  rots: {type: chance, default: 0%}
fields:
  age: {type: 0..9, at: place}
elements:
  air: {id: 0, color: "#FFFFFF"}
  soil: {id: 1, color: "#806040", weight: 3}
  weed: {id: 2, color: "#30A030", tags: soft}
streams: [coin]
"""


def found_in(text: str, *codes: str) -> list[tuple[str, str]]:
    """Diagnostics with these codes, each with what is underlined."""
    spans = [(one.code, one.primary.span) for one in remarks(text) if one.code in codes]
    return [(code, span.text) for code, span in spans if span is not None]


def rules(*lines: str, policy: str = "prove") -> str:
    head = f"    conflicts: {policy}\n" if policy != "prove" else ""
    return f"{YARD}passes:\n  grow:\n{head}    do:\n" + "".join(f"      - {line}\n" for line in lines)


@pytest.mark.parametrize(
    ("rule", "caret"),
    [
        ("soil -> weed if count(weed) >= 0", "count(weed) >= 0"),
        ("soil -> weed if count(weed) != 10", "count(weed) != 10"),
        ("soil -> weed if above is weed or count(weed) > 9", "count(weed) > 9"),
        ("soil -> weed if weight < 8 and above is weed", "weight < 8"),
        ("soil -> weed if above.weight == above.weight", "above.weight"),
        ("soil -> weed if above is weed and above  is weed", "above  is weed"),
        ("age := 3 if above is weed else 3 where soil", "3"),
    ],
)
def test_parts_that_decide_nothing(rule: str, caret: str) -> None:
    assert found_in(rules(rule), "PD503", "PD513", "PD514") == [("PD513", caret)]


@pytest.mark.parametrize(
    "rule",
    [
        "soil -> weed if count(weed) >= 1",
        "soil -> weed if age < 9 and count(weed) < 9",
        "soil -> weed if coin < 5% or above is weed",
        "age += 2 if above is weed else 1 where soil",
        "soil -> weed if any(i == 3 and count(weed) == i for i in 0..8)",
        "soil -> weed if any(count(weed) >= i for i in 0..8)",  # one copy of many
        "soil -> weed if count(weed) == 10",  # that it never fires is enough
    ],
)
def test_parts_that_matter(rule: str) -> None:
    assert found_in(rules(rule), "PD513", "PD514") == []


SEEN, DEEP = "above is weed", "above is weed and below is air"


@pytest.mark.parametrize(
    ("policy", "first", "second", "overruled"),
    [
        ("prove", f"soil -> weed if {SEEN}", f"soil -> weed if {DEEP}", 1),
        ("prove", f"soil -> weed if {DEEP}", f"soil -> weed if {SEEN}", None),
        ("prove", f"soil -> weed if {SEEN}", f"soil -> weed if {DEEP}, then age := 1", None),
        ("first_wins", f"soil -> weed if {SEEN}", f"soil -> air if {DEEP}", 1),
        ("first_wins", f"soil -> weed if {DEEP}", f"soil -> air if {SEEN}", None),
        ("drop_both", f"soil -> weed if {DEEP}", f"soil -> air if {SEEN}", 0),
        # A policy is for movement alone.
        ("drop_both", "age := 3 where soil", "age := 4 where soil or weed", 0),
        ("drop_both", "age := 3 where soil or weed", "age := 4 where soil", None),
        ("prove", "age += 3 where soil", "age -= 4 where soil", None),
    ],
)
def test_rules_that_others_overrule(policy: str, first: str, second: str, overruled: int | None) -> None:
    found = found_in(rules(first, second, policy=policy), "PD514")
    wanted = [] if overruled is None else [(first, second)[overruled]]
    assert [caret for _, caret in found] == [text.partition(" where")[0] for text in wanted]


def test_a_chance_whose_tag_is_lost() -> None:
    passes = "passes:\n  grow:\n    let: {old: age > 3}\n    do: soft -> air if old and coin < rots\n"
    tagged = YARD.replace("tags: soft", "tags: soft, rots: 5%")
    assert found_in(tagged + passes, "PD507") == []
    assert found_in(tagged.replace("weight: 3", "rots: 7%") + passes, "PD507") == [("PD507", "7%")]
    counted = passes.replace("coin < rots", "count(coin < rots) > 1")
    assert found_in(tagged.replace("weight: 3", "rots: 7%") + counted, "PD507") == []


def test_fields_and_values_that_no_rule_names() -> None:
    passes = "passes:\n  grow:\n    let: {old: weight > 3, ripe: old, green: weight > 4}\n    do: soft -> air if ripe\n"
    assert found_in(YARD + passes, "PD507") == [("PD507", "age"), ("PD507", "green")]


@pytest.mark.parametrize("name", [*compositions(), "core+fire+gas", "powderworld-fire"])
def test_shipped_rules_give_no_false_alarm(name: str) -> None:
    _, remarks = load_with_diagnostics(name)
    assert [one for one in remarks if one.severity is not Severity.NOTE] == []
