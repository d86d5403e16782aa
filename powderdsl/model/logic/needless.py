"""Rules and parts of them that decide nothing: comparisons with one outcome, rules that others always overrule, writes
that no cell keeps.

Rules are legal with these, so they are warnings. Loops and symmetries write a rule out many times: a warning is
given only if all its copies deserve it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace

from powderdsl.diagnostics import Label, Reporter, Span
from powderdsl.model.expressions.operators import ELEMENT_HERE, look, member, negation
from powderdsl.model.logic.satisfy import (
    HERE,
    Budget,
    Exhausted,
    Facts,
    Lets,
    can_hold,
    decide,
    substeps,
    writes_of,
)
from powderdsl.model.operations import OPS
from powderdsl.model.text import place_of
from powderdsl.model.types import (
    Assign,
    Expr,
    Field,
    Moment,
    Move,
    Offset,
    Pass,
    Property,
    Rule,
    Ruleset,
    Swap,
    Transform,
)
from powderdsl.syntax.ast import Syntax

BUDGET = 100_000
"""Nodes evaluated for each kind of these warnings: a quarter of a second. After that nothing more is found, and a note
reports it."""

GLANCES = 10
"""Rules of a substep that are looked at for the work of one node."""

MAX_LISTED = 20
"""Rules that are named; the others are counted."""

SILENT = ("PD503", "PD506", "PD509")
"""Rules already reported with these codes get no second warning."""


def report_needless(passes: tuple[Pass, ...], facts: Facts, reporter: Reporter) -> list[Span]:
    """Report comparisons that ranges decide, and rules that others always overrule.

    Returns:
        The rules that may be overruled, which takes too much work to decide.
    """
    known = silent_rules(reporter)
    _report_decided(passes, known, reporter)
    return _report_overruled(passes, _quick(facts), known, reporter)


def _quick(facts: Facts) -> Facts:
    return replace(facts, budget=Budget(BUDGET, BUDGET // 4))


def silent_rules(reporter: Reporter) -> list[Span]:
    """The rules that were reported already as never happening."""
    return [one.primary.span for one in reporter.diagnostics if one.code in SILENT and one.primary.span]


# Comparisons


def _report_decided(passes: tuple[Pass, ...], known: Sequence[Span], reporter: Reporter) -> None:
    outcomes: dict[Span, set[bool | None]] = {}
    for _, moment, lets in substeps(passes):
        parts = [*lets.values(), *(part for rule in moment.rules for part in _parts(rule))]
        for node in (node for part in parts for node in part.walk()):
            if node.op in ("eq", "lt", "le") and node.span is not None:
                outcomes.setdefault(node.span, set()).add(decided(node))
    for span, found in outcomes.items():
        if found in ({True}, {False}) and not _inside_any(span, known):
            reporter.report(
                "PD513", "this comparison decides nothing", span, "its result is the same in every world",
                helps=["look at the bounds of both sides", "remove it, if it is meant so"],
            )  # fmt: skip


def _parts(rule: Rule) -> Iterator[Expr]:
    """The expressions of a rule."""
    if rule.mask is not None:
        yield rule.mask
    if isinstance(rule, Assign):
        yield rule.value
        return
    if isinstance(rule, Transform):
        yield rule.target
    yield from (effect.value for effect in rule.effects)


def decided(node: Expr) -> bool | None:
    """The outcome of a comparison of integers by their ranges alone; None if it depends on the world."""
    kinds, bounds = [arg.kind for arg in node.args], OPS[node.op].bounds
    if (
        bounds is None
        or any(kind.name != "int" for kind in kinds)
        or all(arg.op == "const" for arg in node.args)
    ):
        return None
    low, high = bounds(node, *((kind.lo, kind.hi) for kind in kinds))
    return bool(low) if low == high else None


def _inside_any(span: Span, others: Sequence[Span]) -> bool:
    return any(span.source == o.source and o.start <= span.start and span.end <= o.end for o in others)


def report_repeated(children: Sequence[Syntax], reporter: Reporter) -> None:
    """Report that parts of a condition, a comparison or a choice are the same words twice."""
    texts = [" ".join(child.span.text.split()) for child in children]
    for number, child in enumerate(children):
        if texts[number] in texts[:number]:
            reporter.report(
                "PD513", "the same is said twice", child.span, "this stands there already",
                helps=["look for a word that should be another one", "remove it, if it is meant so"],
            )  # fmt: skip


# Rules that others overrule


def _report_overruled(
    passes: tuple[Pass, ...], facts: Facts, known: Sequence[Span], reporter: Reporter
) -> list[Span]:
    found: dict[Span, Rule] = {}
    matter: dict[Span, None] = {}
    undecided: dict[Span, None] = {}
    for _, moment, lets in substeps(passes):
        for place, rule in enumerate(moment.rules):
            if rule.span in matter:
                continue
            try:
                winner = _overruling(rule, place, moment, facts, lets)
            except Exhausted:
                undecided[rule.span] = None
                continue
            if winner is None:
                matter[rule.span] = None
            else:
                found.setdefault(rule.span, winner)
    for span, winner in found.items():
        if span in matter or span in undecided or winner.span == span or _inside_any(span, known):
            continue
        words = "writes over it, always" if isinstance(winner, Assign) else "always comes before it"
        reporter.report(
            "PD514", "this rule is always overruled", span, "it has no effect",
            secondary=[Label(winner.span, words)],
            helps=["make their conditions exclude each other", "or remove one of them"],
        )  # fmt: skip
    return [span for span in undecided if span not in matter and not _inside_any(span, known)]


def _overruling(rule: Rule, place: int, moment: Moment, facts: Facts, lets: Lets) -> Rule | None:
    """One of the rules of a substep that never leave anything to this one; None if it matters. Raises Exhausted."""
    if rule.mask is None:
        return None
    facts.budget.spend(len(moment.rules) // GLANCES)
    rivals = [other for other in _rivals(rule, place, moment) if other.mask is not None]
    if not rivals or decide(facts, [(rule.mask, HERE)], lets) is False:
        return None
    conditions = [(rule.mask, HERE), *((negation(other.mask), HERE) for other in rivals if other.mask)]
    return None if can_hold(facts, conditions, lets) else rivals[0]


def _rivals(rule: Rule, place: int, moment: Moment) -> Iterator[Rule]:
    """The rules of a substep that keep this one from having an effect where they happen."""
    if isinstance(rule, Assign):
        for other in moment.rules[place + 1 :]:
            if not isinstance(other, Assign) or other.op != ":=" or other.span == rule.span:
                continue
            if (other.field, other.offset) == (rule.field, rule.offset):
                yield other
        return
    if not isinstance(rule, Transform):
        return
    for number, other in enumerate(moment.rules):
        if not isinstance(other, Transform) or number == place or other.span == rule.span:
            continue
        same = other.target == rule.target and other.effects == rule.effects
        if moment.policy == "drop_both" or (number < place and (same or moment.policy == "first_wins")):
            yield other


# Chances that nothing draws


def report_undrawn(
    ruleset: Ruleset, given: Sequence[tuple[str, int, Span]], facts: Facts, reporter: Reporter
) -> list[Span]:
    """Report chances of elements against which no rule draws there: mostly a tag is missing.

    Args:
        given: property, element id, and the place of an element's value of it.

    Returns:
        The chances that perhaps no rule draws, which takes too much work to decide.
    """
    quick = _quick(facts)
    undecided = []
    shown = {channel.source for channel in ruleset.matrix}
    chances = {p.name: p for p in ruleset.properties if p.kind.name == "chance" and p.name not in shown}
    for name, number, span in given:
        if name not in chances or chances[name].values[number] == 0:
            continue
        try:
            drawn = _drawn(chances[name], number, ruleset, quick)
        except Exhausted:
            undecided.append(span)
            continue
        if not drawn:
            element = facts.names.get(number, "?")
            reporter.report(
                "PD507", f"`{name}` of `{element}` is never used", span, f"no rule asks `{element}` for it",
                helps=["look for a tag that it lacks, or remove the value"],
            )  # fmt: skip
    return undecided


def _drawn(prop: Property, number: int, ruleset: Ruleset, facts: Facts) -> bool:
    """Whether some rule that reads the property may happen where this element stands. Raises Exhausted."""
    for pass_ in ruleset.passes:
        everywhere = {let.name: let.value for moment in pass_.moments for let in moment.lets}
        for _, moment, lets in substeps([pass_]):
            for rule in moment.rules:
                reads = _Reads(prop.name, lets, everywhere)
                for part in _parts(rule):
                    reads.find(part, HERE)
                if reads.places and (reads.many or rule.mask is None):
                    return True
                for at in reads.places:
                    here = (member(ELEMENT_HERE, (number,)), at)
                    if can_hold(facts, [(rule.mask, HERE), here], lets):  # type: ignore[list-item]
                        return True
    return False


@dataclass
class _Reads:
    """Where expressions read a property. `many`: also of cells whose places or substeps are not told apart."""

    name: str
    lets: Lets
    everywhere: Lets
    places: dict[Offset, None] = field(default_factory=dict)
    many: bool = False
    _opened: set[tuple[str, Offset, bool]] = field(default_factory=set)

    def find(self, expr: Expr, at: Offset, unclear: bool = False) -> None:
        """Add the places of one expression that is asked at `at`."""
        args = expr.args
        if expr.op == "property" and expr.value == self.name:
            self.places[at] = None
            self.many |= unclear
        elif expr.op == "let":
            name = str(expr.value)
            unclear |= name not in self.lets  # fixed before: what stood there then may be elsewhere now
            if (name, at, unclear) in self._opened:
                return
            self._opened.add((name, at, unclear))
            args = (self.everywhere[name],)
        elif expr.op == "look":
            at = (at[0] + expr.value[0], at[1] + expr.value[1])
        unclear |= expr.op in ("count", "sum")
        for arg in args:
            self.find(arg, at, unclear)


# Writes that are lost: `of:` limits a field to other elements


def report_lost_writes(
    passes: tuple[Pass, ...], fields: dict[str, Field], facts: Facts, known: list[Span], reporter: Reporter
) -> list[Span]:
    """Warn of assignments and effects that are lost wherever their rule happens, in all its copies.

    Args:
        known: rules that have been reported already.

    Returns:
        The writes that may be lost, which takes too much work to decide.
    """
    limited = {name: field for name, field in fields.items() if field.of is not None}
    quick = _quick(facts)
    lost: dict[tuple[Span, str], bool | None] = {}
    for _, moment, lets in substeps(passes) if limited else ():
        for rule in moment.rules:
            for write in writes_of(rule):
                key = write.span, write.field
                if write.field in limited and lost.get(key, True) is not False and rule.span not in known:
                    ids = limited[write.field].of or frozenset()
                    try:
                        here = not _arrives(write, rule, ids, moment, quick, lets)
                    except Exhausted:
                        here = None
                    lost[key] = None if here and lost.get(key, True) is None else here
    for (span, name), always in lost.items():
        if always:
            reporter.report(
                "PD516", f"this write to `{name}` is always lost", span, f"no cell that it reaches has a `{name}`",
                secondary=[Label(limited[name].span, "`of:` says which elements have it")],
                helps=["widen `of:`, or write to a cell that holds one of its elements"],
            )  # fmt: skip
    return [span for (span, _), always in lost.items() if always is None]


def _arrives(
    write: Assign, rule: Rule, ids: frozenset[int], moment: Moment, facts: Facts, lets: Lets
) -> bool:
    """Whether the cell may hold one of these elements when the write lands. Effects come after all that moves.

    Raises Exhausted if that takes too much work to decide.
    """
    if rule.mask is None:
        return True

    def may(mask: Expr, what: Expr) -> bool:
        return can_hold(facts, [(mask, HERE), (member(what, tuple(sorted(ids))), HERE)], lets)

    if isinstance(rule, Assign):
        return may(rule.mask, look(ELEMENT_HERE, write.offset))
    if isinstance(rule, Transform) and write.offset == HERE:
        return may(rule.mask, rule.target)
    if isinstance(rule, Swap) and write.offset in (HERE, rule.offset):
        other = rule.offset if write.offset == HERE else HERE
        return may(rule.mask, look(ELEMENT_HERE, other))
    if isinstance(rule, Move) and write.offset == rule.offset:
        return may(rule.mask, ELEMENT_HERE)
    if any(may(mask, what) for mask, what in _brought(moment)):
        return True
    if isinstance(rule, Move) and rule.leaving is None and write.offset == HERE:
        return may(rule.mask, _left(rule))
    if isinstance(rule, Move) and write.offset == HERE:
        return False  # what leaves is gone, and nothing brings one
    return may(rule.mask, look(ELEMENT_HERE, write.offset))


def _brought(moment: Moment) -> Iterator[tuple[Expr, Expr]]:
    """What the rules of a substep may bring into some cell, with the condition under which they do."""
    for rule in moment.rules:
        if isinstance(rule, Transform):
            yield rule.mask, rule.target
        elif isinstance(rule, Swap):
            yield rule.mask, ELEMENT_HERE
            yield rule.mask, look(ELEMENT_HERE, rule.offset)
        elif isinstance(rule, Move):
            yield rule.mask, ELEMENT_HERE
            yield rule.mask, _left(rule)


def _left(rule: Move) -> Expr:
    """The element that a move leaves behind."""
    return look(ELEMENT_HERE, rule.offset) if rule.leaving is None else rule.leaving


# What could not be decided


def report_undecided(spans: Iterable[Span], reporter: Reporter) -> None:
    """Note the rules for which it is not known whether they ever have an effect.

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
