"""What the search for needless rules could not tell within its work: said once, so that silence means something."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from powderdsl.diagnostics import Label, Reporter, Span
from powderdsl.model.logic.budget import Exhausted
from powderdsl.model.logic.satisfy import Facts, decide
from powderdsl.model.text import place_of
from powderdsl.model.types import Expr, Offset

MAX_LISTED = 20
"""Rules that are named; the others are counted."""


def settled(facts: Facts, conditions: Sequence[tuple[Expr, Offset]], lets: dict[str, Expr]) -> bool:
    """Whether the conditions may hold together. False is a proof. Raises Exhausted if that takes too much work."""
    answer = decide(facts, conditions, lets)
    if answer is None:
        raise Exhausted
    return answer


def report_undecided(spans: Iterable[Span], reporter: Reporter) -> None:
    """Note the rules of which it is not known whether they ever have an effect.

    Args:
        spans: rules, writes and values; repetitions count once.
    """
    places = sorted(dict.fromkeys(spans), key=lambda span: (span.source.name, span.start))
    if not places:
        return
    listed = places[:MAX_LISTED]
    words = ", ".join(dict.fromkeys(place_of(span) for span in listed))
    more = f" and {len(places) - len(listed):,} more" if len(places) > len(listed) else ""
    reporter.report(
        "PD518", f"it takes too much work to decide whether these lines have any effect: {words}{more}", listed[0],
        "its conditions combine too many values",
        secondary=[Label(span, "this too") for span in listed[1:]],
        notes=["nothing wrong was found; warnings about them, such as PD503 and PD514, may be missing"],
        helps=["`powderdsl test` lists the rules that never happen; a test of your own shows what one does"],
    )  # fmt: skip
