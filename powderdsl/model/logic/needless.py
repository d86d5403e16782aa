"""Warnings about rules and definitions without effect: comparisons with one outcome, rules that are always overruled,
lost writes, unused chances and names.

Such rules are legal, so these are warnings. Loops and symmetries make many copies of a rule: a warning is given only if
it applies to all of them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import chain
from typing import TYPE_CHECKING

from powderdsl.diagnostics import Label, Reporter, Span
from powderdsl.model.composition.added_packs import pack_words
from powderdsl.model.composition.compose import Composition
from powderdsl.model.composition.names import words_of
from powderdsl.model.declarations import FieldDecl, KernelDecl, SetDecl
from powderdsl.model.expressions.operators import ELEMENT_HERE, look, member, negation
from powderdsl.model.logic.satisfy import Answers, Budget, Facts, Lets, decide, satisfiable, some
from powderdsl.model.operations import COMPARISONS, OPERATIONS, Bounds
from powderdsl.model.text import place_of
from powderdsl.model.types import (
    CHANCE,
    HERE,
    Assign,
    Expr,
    Field,
    Move,
    Offset,
    Pass,
    Rule,
    Ruleset,
    Substep,
    Transform,
    alike,
    plus,
    substeps,
    writes_of,
)
from powderdsl.syntax.parse import Syntax

if TYPE_CHECKING:
    from powderdsl.model.expressions.typer import Typer

BUDGET = 100_000
"""Nodes evaluated for each kind of these warnings, about a quarter of a second. The rest is reported by a note."""

GLANCES = 10
"""Rules of a substep that count as the work of one node."""

MAX_LISTED = 20
"""Maximum number of rules to list; the others are counted."""

SILENT = ("PD503", "PD506", "PD509")
"""Rules already reported with these codes get no second warning."""


def report_needless(
    passes: tuple[Pass, ...], fields: dict[str, Field], facts: Facts, reporter: Reporter
) -> list[Span]:
    """Report comparisons that ranges decide, rules that others always overrule, and writes that are always lost.

    Returns the rules and writes for which deciding takes too much work.
    """
    silent = [d.primary.span for d in reporter.diagnostics if d.code in SILENT and d.primary.span]
    _report_decided(passes, silent, reporter)
    undecided = _report_overruled(passes, _limited(facts), silent, reporter)
    return undecided + _report_lost_writes(passes, fields, _limited(facts), silent, reporter)


def _limited(facts: Facts) -> Facts:
    return replace(facts, budget=Budget(BUDGET, BUDGET // 4))


def _inside_any(span: Span, others: Sequence[Span]) -> bool:
    return any(span.source == o.source and o.start <= span.start and span.end <= o.end for o in others)


# Comparisons


def _report_decided(passes: tuple[Pass, ...], silent: Sequence[Span], reporter: Reporter) -> None:
    """Report comparisons of integers whose ranges alone decide them."""
    outcomes: dict[Span, set[Bounds | None]] = {}
    for _, substep in substeps(passes):
        for part in (*substep.values.values(), *_parts(substep.rules)):
            for node in part.walk():
                if node.op in COMPARISONS.values() and node.span is not None:
                    left, right = node.args
                    outcome = None
                    if left.kind.name == right.kind.name == "int" and not left.op == right.op == "const":
                        bounds = (left.kind.lo, left.kind.hi), (right.kind.lo, right.kind.hi)
                        outcome = OPERATIONS[node.op].between(*bounds)
                    outcomes.setdefault(node.span, set()).add(outcome)
    for span, known in outcomes.items():
        if known in ({(True, True)}, {(False, False)}) and not _inside_any(span, silent):
            reporter.report(
                "PD513", "this comparison decides nothing", span, "its result is the same in every world",
                helps=["check the bounds of both sides", "remove it if this is intended"],
            )  # fmt: skip


def _parts(rules: Iterable[Rule]) -> Iterator[Expr]:
    for rule in rules:
        yield rule.mask
        if isinstance(rule, Transform):
            yield rule.target
        for write in writes_of(rule):
            yield write.value


def report_repeated(children: Sequence[Syntax], reporter: Reporter) -> None:
    """Report that a condition, a comparison or a choice has the same part twice."""
    texts = [" ".join(child.span.text.split()) for child in children]
    for number, child in enumerate(children):
        if texts[number] in texts[:number]:
            reporter.report(
                "PD513", "this part is repeated", child.span, "it is already here",
                helps=["check whether one of them should differ", "remove it if this is intended"],
            )  # fmt: skip


# Rules that others overrule


def _report_overruled(
    passes: tuple[Pass, ...], facts: Facts, silent: Sequence[Span], reporter: Reporter
) -> list[Span]:
    matters: Answers[Span] = Answers()
    winners: dict[Span, Rule] = {}
    for _, substep in substeps(passes):
        for place, rule in enumerate(substep.rules):
            if not matters.get(rule.span):
                rivals = _rivals(rule, place, substep)
                matters.add(rule.span, _may_matter(rule, rivals, substep, facts))
                if rivals:
                    winners.setdefault(rule.span, rivals[0])
    for span in matters.where(False):
        if not _inside_any(span, silent):
            winner = winners[span]
            words = "always overwrites it" if isinstance(winner, Assign) else "always comes before it"
            reporter.report(
                "PD514", "this rule is always overruled", span, "it has no effect",
                secondary=[Label(winner.span, words)],
                helps=["make their conditions exclude each other", "or remove one of them"],
            )  # fmt: skip
    return [span for span in matters.where(None) if not _inside_any(span, silent)]


def _may_matter(rule: Rule, rivals: Sequence[Rule], substep: Substep, facts: Facts) -> bool | None:
    """False if the rivals of a rule always overrule it; None if deciding takes too much work."""
    facts.budget.left -= len(substep.rules) // GLANCES
    if facts.budget.left < 0:
        return None
    here = rule.mask, HERE
    if not rivals or decide(facts, [here], substep.values) is False:
        return True
    return decide(facts, [here, *((negation(other.mask), HERE) for other in rivals)], substep.values)


def _rivals(rule: Rule, place: int, substep: Substep) -> list[Rule]:
    """The rules of a substep that overrule a rule wherever they fire."""
    rivals: list[Rule] = []
    for number, other in enumerate(substep.rules):
        earlier = number < place
        match rule, other:
            case Assign(), Assign(op=":="):
                wins = not earlier and (other.field, other.offset) == (rule.field, rule.offset)
            case Transform(), Transform():
                settled = alike(rule, other) or substep.policy == "first_wins"
                wins = substep.policy == "drop_both" or (earlier and settled)
            case _:
                wins = False
        if wins and other.span != rule.span:
            rivals.append(other)
    return rivals


# Chances that nothing draws


def report_undrawn(
    ruleset: Ruleset, element_values: Sequence[tuple[str, int, Span]], facts: Facts, reporter: Reporter
) -> list[Span]:
    """Report chances of elements that no rule ever draws there, usually because a tag is missing.

    Element values are property, element id, and span. Returns the chances for which deciding takes too much work.
    """
    quick = _limited(facts)
    undecided = []
    shown = {channel.source for channel in ruleset.matrix}
    for name, number, span in element_values:
        prop = facts.properties[name]
        if prop.kind != CHANCE or name in shown or prop.values[number] == 0:
            continue
        drawn = some(_may_draw(name, number, ruleset, quick))
        if drawn is None:
            undecided.append(span)
        elif not drawn:
            element = facts.names.get(number, "?")
            reporter.report(
                "PD507", f"`{name}` of `{element}` is never used", span, f"no rule draws it for `{element}`",
                helps=["check whether the element lacks a tag, or remove the value"],
            )  # fmt: skip
    return undecided


def _may_draw(name: str, number: int, ruleset: Ruleset, facts: Facts) -> Iterator[bool | None]:
    """For each rule that reads the property, whether it can fire where this element is."""
    for pass_ in ruleset.passes:
        everywhere = {let.name: let.value for substep in pass_.substeps for let in substep.lets}
        for substep in pass_.substeps:
            for rule in substep.rules:
                for at in _reads(name, _parts([rule]), substep.values, everywhere):
                    here = [(member(ELEMENT_HERE, (number,)), at)] if at is not None else []
                    yield not here or decide(facts, [(rule.mask, HERE), *here], substep.values)


def _reads(name: str, parts: Iterable[Expr], lets: Lets, everywhere: Lets) -> dict[Offset | None, None]:
    """The offsets at which expressions read a property; None stands for reads at unknown places."""
    places: dict[Offset | None, None] = {}
    opened = set()
    waiting: list[tuple[Expr, Offset | None]] = [(part, HERE) for part in parts]
    while waiting:
        expr, at = waiting.pop()
        args = expr.args
        match expr.op:
            case "property" if expr.value == name:
                places[at] = None
            case "let":
                if expr.value not in lets:
                    at = None  # fixed in an earlier substep: the element may be elsewhere now
                args = (everywhere[str(expr.value)],) if (expr.value, at) not in opened else ()
                opened.add((expr.value, at))
            case "look":
                at = at and plus(at, expr.value)
            case "count" | "sum":
                at = None
        waiting += [(arg, at) for arg in args]
    return places


# Writes that are lost: `of:` limits a field to other elements


def _report_lost_writes(
    passes: tuple[Pass, ...], fields: dict[str, Field], facts: Facts, silent: list[Span], reporter: Reporter
) -> list[Span]:
    """Warn of assignments and effects that are lost wherever their rule happens, in all its copies."""
    arrives: Answers[tuple[Span, str]] = Answers()
    for _, substep in substeps(passes):
        for rule in substep.rules:
            for write in writes_of(rule):
                key, field = (write.span, write.field), fields.get(write.field)
                if field and field.of is not None and rule.span not in silent and not arrives.get(key):
                    arrives.add(key, _may_land(write, rule, tuple(sorted(field.of)), substep, facts))
    for span, name in arrives.where(False):
        reporter.report(
            "PD516", f"this write to `{name}` is always lost", span, f"no target cell has a `{name}`",
            secondary=[Label(fields[name].span, "`of:` lists the elements that have it")],
            helps=["widen `of:`, or write to a cell that holds one of its elements"],
        )  # fmt: skip
    return [span for span, _ in arrives.where(None)]


def _may_land(write: Assign, rule: Rule, ids: tuple[int, ...], substep: Substep, facts: Facts) -> bool | None:
    """True if the cell may hold one of these elements when the write lands; None if deciding takes too much work.

    Assignments come before movements, effects after them.
    """
    brought = _brings(rule).get(write.offset)
    stays = rule.mask, look(ELEMENT_HERE, write.offset)
    if isinstance(rule, Assign):
        landing = [stays]
    elif brought is not None and not (isinstance(rule, Move) and write.offset == HERE):
        landing = [(rule.mask, brought)]
    else:  # other rules may bring an element there, also to the place that a move leaves
        landing = [(other.mask, what) for other in substep.rules for what in _brings(other).values()]
        landing += [stays] if brought is None else []
    return some(
        decide(facts, [(mask, HERE), (member(what, ids), HERE)], substep.values) for mask, what in landing
    )


def _brings(rule: Rule) -> dict[Offset, Expr]:
    """The elements that a rule brings, by the offset of the cell that gets them."""
    match rule:
        case Assign():
            return {}
        case Transform():
            return {HERE: rule.target}
        case Move(leaving=Expr() as left):
            return {HERE: left, rule.offset: ELEMENT_HERE}
    return {HERE: look(ELEMENT_HERE, rule.offset), rule.offset: ELEMENT_HERE}


# What could not be decided


def report_undecided(spans: Iterable[Span], reporter: Reporter) -> None:
    """Report the rules that took too much work to decide.

    `spans`: rules, writes and values; repetitions count once.
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
        notes=["no mistake was found; warnings about them, such as PD503 and PD514, may be missing"],
        helps=["`powderdsl test` lists the rules that never fire; you can also write a test for a rule"],
    )  # fmt: skip


# Definitions that nothing uses


def report_unused(composition: Composition, typer: Typer) -> None:
    """Report definitions that no rule uses (warnings), and what the loaded packs lack (notes)."""
    reporter = typer.reporter
    values = [str(value) for prop in typer.symbols.properties.values() for value in prop.values]
    for qualified, param in composition.param_decls.items():
        if qualified not in typer.used and qualified not in values:
            _unused("parameter", qualified, param.span, reporter)
    for name, named_set in composition.names.declared(SetDecl).items():
        if name not in typer.used:
            _unused("set", name, named_set.span, reporter)
        elif not typer.set_of(typer.symbols.constants[name], named_set.span).ids:
            reporter.report(
                "PD505", f"the set `{name}` is empty", named_set.members.span, "no element of the loaded packs is in it",
                helps=["load a pack with such elements, or widen the set"],
            )  # fmt: skip
    for name, kernel in composition.names.declared(KernelDecl).items():
        if name not in typer.used:
            _unused("kernel", name, kernel.span, reporter)
    _report_unwritten(composition, reporter)


def _unused(what: str, name: str, span: Span, reporter: Reporter) -> None:
    message = f"the {what} `{name}` is never used"
    reporter.report("PD507", message, span, "no rule reads it", helps=["remove it"])


def _report_unwritten(composition: Composition, reporter: Reporter) -> None:
    """Report fields and values under `let` whose names are in no rule, not even an inactive one.

    Tasks and programs may read a field that a ruleset lists as a channel. Streams and tags are left out: packs declare
    them for others.
    """
    names = composition.names
    words = {names.of(name, word) for name, pack in composition.packs.items() for word in pack_words(pack)}
    for ruleset in composition.ruleset.lineage:
        words |= {word for line in ruleset.invariants for word in words_of(line)}
        words |= {scalar.word.partition(".")[0] for scalar in ruleset.matrix}
    for name, field in names.declared(FieldDecl).items():
        if name not in words and field.name.text not in words:
            _unused("field", name, field.span, reporter)
    passes = chain.from_iterable(pack.passes for pack in composition.packs.values())
    for block in chain.from_iterable(pass_.walk() for pass_ in passes):
        inner = [line for nested in block.walk() if nested is not block for line in nested.lines]
        later = {word for line in (*block.lines[len(block.lets) :], *inner) for word in words_of(line)}
        for scalar, value in reversed(block.lets):
            if scalar.text not in later:
                _unused("value", scalar.text, scalar.span, reporter)
            later |= set(words_of(value))


# What rules produce and override


def overridden_ids(passes: tuple[Pass, ...], names: Sequence[str], facts: Facts) -> dict[str, frozenset[int]]:
    """The ids, by property, whose cells may hold their own value: those that some rule assigns it to.

    A cell's own value may meet the condition of another such rule, so this repeats until nothing is added.
    """
    writes: list[tuple[Assign, Lets]] = []
    for _, substep in substeps(passes):
        for rule in substep.rules:
            writes += [(write, substep.values) for write in writes_of(rule) if write.field in names]
    ids_of: dict[str, frozenset[int]] = {}
    more: dict[str, frozenset[int]] = {name: frozenset() for name in names}
    while more != ids_of:
        ids_of = more.copy()
        stored = {name: replace(facts.properties[name], stored=ids) for name, ids in ids_of.items()}
        now = replace(facts, properties={**facts.properties, **stored})
        for write, lets in writes:
            for number in facts.ids:
                question = (member(ELEMENT_HERE, (number,)), write.offset), (write.mask, HERE)
                if number not in more[write.field] and satisfiable(now, question, lets):
                    more[write.field] |= {number}
    return ids_of


def without_dead_overrides(passes: tuple[Pass, ...], dead: frozenset[str]) -> tuple[Pass, ...]:
    """The passes without assignments to properties that no cell can override, which are not stored."""

    def alive(substep: Substep) -> Substep:
        rules = [r for r in substep.rules if not (isinstance(r, Assign) and r.field in dead)]
        return replace(substep, rules=tuple(rules))

    return tuple(replace(pass_, substeps=tuple(map(alive, pass_.substeps))) for pass_ in passes)
