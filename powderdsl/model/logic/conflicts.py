"""Static checks of rules: collisions, conflicting writes, rules that never fire."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from math import lcm
from typing import TYPE_CHECKING

from powderdsl.diagnostics import Label, Reporter, Span
from powderdsl.model.builtins import MAX_SIDE_MULTIPLE
from powderdsl.model.composition.added_packs import AddedPacks, Cause
from powderdsl.model.expressions.operators import (
    ELEMENT_HERE,
    TRUE,
    conjunction,
    disjunction,
    look,
    member,
    negation,
)
from powderdsl.model.logic.satisfy import (
    MAX_QUESTION,
    Answers,
    Budget,
    Conditions,
    Facts,
    Lets,
    decide,
    example,
    satisfiable,
    single_domains,
)
from powderdsl.model.operations import OPERATIONS
from powderdsl.model.text import one_line
from powderdsl.model.types import (
    FLAG,
    HERE,
    Assign,
    Expr,
    Move,
    Offset,
    Pass,
    Rule,
    Substep,
    Swap,
    Transform,
    footprint,
    minus,
    plus,
)

if TYPE_CHECKING:
    from powderdsl.model.elaborate import Elaborator

COMPARISONS = 1_000_000
"""Work for comparing the rules of all substeps, in nodes: about a second."""

GLANCE = 3
"""The cost of a comparison of two rules, in nodes."""

MAX_PARTS = 64
"""Maximum number of parts of a condition derived from a value; dropping a longer one is still correct."""


@dataclass(frozen=True)
class Conflict:
    """Two rules (or two copies of one) that may claim one cell. It is a value, since iterations of a loop repeat it.

    `first` and `second` are the spans of the rules without their conditions; it is reported at the second.
    """

    code: str
    message: str
    first: Span
    second: Span
    notes: tuple[str, ...]
    helps: tuple[str, ...]
    assigns: bool = False

    def report(self, labels: list[str], example: str, reporter: Reporter) -> None:
        """Report it once for all iterations. `example` is for the first one."""
        where = f" ({labels[0]})" if labels[0] else ""
        notes = [*filter(None, [example]), *self.notes]
        if len(labels) > 1:
            more = "1 more copy" if len(labels) == 2 else f"{len(labels) - 1} more copies"
            notes.append(f"the same applies to {more} of the rule, made by its loop or symmetry")
        is_same = self.first == self.second
        reporter.error(
            self.code, self.message + where, self.second, "two of these can overlap" if is_same else "claims it too",
            secondary=[] if is_same else [Label(self.first, "claims a cell")], notes=notes, helps=self.helps,
        )  # fmt: skip

    def report_added(
        self, causes: Sequence[Cause], pass_name: str, example: str, settled: bool, reporter: Reporter
    ) -> None:
        """Report the conflict at its cause in added packs, as a warning if it is `settled`, so that one rule wins."""
        first, *more = causes
        secondary = [Label(cause.span, "and this") for cause in more]
        secondary.append(Label(self.first, "claims the cell"))
        if self.second != self.first:
            secondary.append(Label(self.second, "claims it too"))
        words = " or ".join(dict.fromkeys(f"`{cause.span.text}`" for cause in causes))
        helps = [f"remove {words} here, or make sure that the element meets the conditions of only one rule"]
        notes = [example] if example else []
        if not settled:
            helps.append(f"or ask the author of `{pass_name}` for a policy, such as `conflicts: first_wins`")
        elif self.assigns:
            notes.append("the last assignment wins")
        else:
            notes.append("the first rule wins, as with `conflicts: first_wins`")
        message = f"`{first.pack}` {first.does}: two rules of `{pass_name}` may claim one cell with it"
        reporter.report(
            "PD517" if settled else self.code, message, first.span, "because of this",
            secondary=secondary, notes=notes, helps=helps,
        )  # fmt: skip


def _claim(rule: Rule) -> Span:
    """The part of a rule's text to underline: the rule without its condition."""
    span = rule.span
    rest = re.search(r",?\s+(if|where|with|then)\b", span.text)
    return Span(span.source, span.start, span.start + rest.start()) if rest and rest.start() else span


Conflicts = dict[Conflict, tuple[dict[Offset, int], list[tuple[int, int]]]]
"""Conflicts with an example of each, and their locations: passes and substeps by number."""


def check_logic(
    passes: tuple[Pass, ...],
    facts: Facts,
    elaborated: Elaborator,
    reporter: Reporter,
    added: AddedPacks | None = None,
) -> tuple[tuple[Pass, ...], list[Span]]:
    """Report conflicts (errors), rules that never fire or do nothing (warnings), and inactive rules (notes).

    Conflicts that come from `added` packs alone are resolved. Returns the passes, with how conflicts are resolved, and
    the rules of which it takes too much work to decide whether they fire or do anything.
    """
    fires: Answers[Span] = Answers()
    useful: Answers[Span] = Answers()
    silent: dict[Span, list[tuple[Expr, Lets]]] = {}
    conflicts: Conflicts = {}
    lists: list[tuple[int, Pass]] = []
    limited = replace(facts, budget=Budget(COMPARISONS))
    for at, pass_ in enumerate(passes):
        earlier: Lets = {}
        for number, substep in enumerate(pass_.substeps):
            lets = earlier | substep.values
            earlier = flags_for_later(lets)
            live = []
            for rule in substep.rules:
                happens = decide(facts, [(rule.mask, HERE)], lets)
                fires.add(rule.span, happens)
                changes = happens
                if happens and isinstance(rule, Transform) and rule.target.op == "const" and not rule.effects:
                    other = negation(member(ELEMENT_HERE, (rule.target.value,)))
                    changes = decide(facts, [(rule.mask, HERE), (other, HERE)], lets)
                useful.add(rule.span, changes)
                if happens is False:
                    silent.setdefault(rule.span, []).append((rule.mask, lets))
                else:
                    live.append(rule)
            if substep.policy == "prove":
                lists.append((len(live), pass_))
                for conflict, elements in _check_substep(live, limited, lets):
                    conflicts.setdefault(conflict, (elements, []))[1].append((at, number))
    if limited.budget.left < 0:
        count, longest = max(lists, key=lambda rules: rules[0])
        message = f"comparing the rules of `{longest.name}` with each other takes too much work"
        label = f"{count:,} rules in one list are {count * (count + 1) // 2:,} pairs"
        helps = [
            "choose the outcome of conflicts, so that nothing is compared: `conflicts: first_wins`",
            "or split the list: move rules that need not fire in the same substep under `then:`",
        ]
        reporter.error("PD508", message, longest.span, label, helps=helps)
        return passes, []
    if conflicts:
        passes = _report_conflicts(conflicts, passes, facts, added, reporter)
    for span in useful.where(False):
        if fires[span]:
            label = "the cell already has that element"
            fix = "remove it, or name another element after `->`"
            reporter.report("PD509", "this rule changes nothing", span, label, helps=[fix])
        else:
            _report_silent(span, silent[span], facts, elaborated, reporter)
    return passes, useful.where(None)


def _report_silent(
    span: Span, copies: list[tuple[Expr, Lets]], facts: Facts, elaborated: Elaborator, reporter: Reporter
) -> None:
    """Report a rule that never fires, and why."""
    relaxed = facts.relaxed()
    if span in elaborated.inactive:
        reason = f"`{elaborated.inactive[span]}` is not loaded"
    elif span in elaborated.empty:
        reason = f"no element is in `{elaborated.empty[span]}`"
    elif any(decide(relaxed, [(mask, HERE)], lets) for mask, lets in copies):
        reason = "no loaded element has the properties that it needs"
    else:
        _report_impossible(span, copies[0], facts, reporter)
        return
    label = "cannot fire with these packs"
    fix = "it becomes active with a pack that provides them"
    reporter.report("PD506", f"this rule is inactive: {reason}", span, label, helps=[fix])


def _report_impossible(span: Span, copy: tuple[Expr, Lets], facts: Facts, reporter: Reporter) -> None:
    """Report the conditions of a rule that exclude each other, as few as possible."""
    mask, lets = copy
    parts = [mask]
    while any(part.op == "and" for part in parts):
        parts = [inner for part in parts for inner in (part.args if part.op == "and" else (part,))]
    for part in [*parts]:
        others = [other for other in parts if other is not part]
        if others and decide(facts, [(other, HERE) for other in others], lets) is False:
            parts = others
    notes = [
        f"`{one_line(arg.span)}` is in {arg.kind.lo:g}..{arg.kind.hi:g}"
        for part in parts
        for arg in part.args
        if part.op in ("lt", "le", "eq")
        and arg.op != "const"
        and arg.kind.name in ("int", "real")
        and arg.span
    ]
    places = [part.span for part in parts if part.span is not None]
    label = "this is never true" if len(parts) == 1 else "not together with the others"
    reporter.report(
        "PD503",
        "this rule can never fire",
        span,
        "no cell can meet all of its conditions",
        secondary=[Label(place, label) for place in places if place != span],
        notes=notes,
        helps=["change the underlined conditions, or remove the rule"],
    )


def _report_conflicts(
    conflicts: Conflicts, passes: tuple[Pass, ...], facts: Facts, added: AddedPacks | None, reporter: Reporter
) -> tuple[Pass, ...]:
    """Report conflicts; return the passes with those caused by added packs resolved."""
    resolved: set[tuple[int, int]] = set()
    for conflict, (elements, places) in conflicts.items():
        words = _example_text(facts, elements)
        pass_, substeps = passes[places[0][0]], [passes[at].substeps[number] for at, number in places]
        causes = (
            added.causes(pass_.pack, conflict.second, list(elements.values()) or facts.ids) if added else ()
        )
        if not causes:
            conflict.report([substep.label for substep in substeps], words, reporter)
            continue
        settled = conflict.assigns or all(map(_allows_first_wins, substeps))
        if settled and not conflict.assigns:
            resolved.update(places)
        conflict.report_added(causes, pass_.name, words, settled, reporter)
    changed = [list(pass_.substeps) for pass_ in passes]
    for at, number in sorted(resolved):
        changed[at][number] = replace(changed[at][number], policy="first_wins")
    pairs = zip(passes, changed, strict=True)
    return tuple([replace(pass_, substeps=tuple(substeps)) for pass_, substeps in pairs])


def _allows_first_wins(substep: Substep) -> bool:
    """True if `first_wins` changes nothing where no two rules conflict.

    Without the policy, moves may go where another one leaves, and transforms into one element may all have their
    effects.
    """
    transforms = [rule for rule in substep.rules if isinstance(rule, Transform)]
    targets = [rule.target for rule in transforms]
    return all(targets.count(rule.target) == 1 for rule in transforms if rule.effects) and not any(
        isinstance(rule, Move) for rule in substep.rules
    )


def _check_substep(
    rules: list[Rule], facts: Facts, lets: Lets
) -> Iterator[tuple[Conflict, dict[Offset, int]]]:
    """The conflicts of one substep, with an example: of rules that move or transform, of assignments, of effects."""
    movers: list[tuple[Rule, Expr]] = []
    writes: list[tuple[Rule, Expr]] = []
    effects: list[tuple[Rule, Expr]] = []
    for rule in rules:
        if not isinstance(rule, Assign):
            movers.append((rule, rule.mask))
            effects += [(effect, rule.mask) for effect in rule.effects if effect.op == ":="]
        elif rule.op == ":=":
            writes.append((rule, rule.mask))
    for claims in (movers, writes, effects):
        yield from _conflicts_of(claims, facts, lets)


def _conflicts_of(
    rules: Sequence[tuple[Rule, Expr]], facts: Facts, lets: Lets
) -> Iterator[tuple[Conflict, dict[Offset, int]]]:
    """The conflict of each rule with the first rule, possibly itself, with which it may claim the same cell.

    Rules come with their conditions. Each conflict has an example of elements by place.
    """
    domains = list(_domains((mask for _, mask in rules), facts, lets))
    for i, (second, mask) in enumerate(rules):
        undecided = None
        pairs = (
            (rules[j][0], ((rules[j][1], HERE), (mask, at)))
            for j in (i, *range(i))
            for at in _claim_offsets(rules[j][0], second)
            if not _are_disjoint(domains[j], domains[i], at, facts.budget)
        )
        for first, question in pairs:
            if facts.budget.left < 0:
                return
            answer = decide(facts, question, lets)
            if answer:
                conflict = _conflict(first, second)
                yield _suggest_side_multiple(conflict, question, facts, lets), example(facts, question, lets)
                break
            if answer is None and undecided is None:
                undecided = first
        else:
            if undecided is not None and facts.budget.left >= 0:
                # Mutually exclusive conditions would not help.
                note = "their conditions combine too many values to decide whether both can hold"
                choice = "choose the outcome if they can: `conflicts: first_wins`"
                helps = (choice, "or put one of them under `then:`")
                yield replace(_conflict(undecided, second), notes=(note,), helps=helps), {}


_PLACES = {(0, 0): "here", (-1, 0): "above", (1, 0): "below", (0, -1): "on the left", (0, 1): "on the right"}


def _example_text(facts: Facts, elements: dict[Offset, int]) -> str:
    """An example of elements for which two rules conflict, such as `x` here and `y` below."""
    names = [(at, facts.names[number]) for at, number in sorted(elements.items()) if number in facts.names]
    if not names or len(elements) > 4:
        return ""
    *places, last = [f"`{name}` {_PLACES.get(at) or f'at({at[0]}, {at[1]})'}" for at, name in names]
    return "for example with " + " and ".join(filter(None, [", ".join(places), last]))


def _claim_offsets(first: Rule, second: Rule) -> Iterator[Offset]:
    """The offsets from the first rule's cell to cells in which the second rule would claim a cell of the first."""
    if isinstance(first, Assign) and isinstance(second, Assign):
        if first.field == second.field and first.value != second.value:
            yield minus(first.offset, second.offset)
        return
    if isinstance(first, Transform) and isinstance(second, Transform):
        if first is not second and first.target != second.target:
            yield HERE
        return
    if isinstance(first, Move) and isinstance(second, Move):
        # A move into a place that is being left is fine: its contents leave first.
        if first is not second:
            yield HERE
            yield minus(first.offset, second.offset)
        return
    shifts = {minus(a, b): None for a in footprint(first) for b in footprint(second)}
    if first is second:
        del shifts[HERE]
    yield from shifts


_EXCLUDE = "make their conditions exclude each other, or put one under `then:`"


def _conflict(first: Rule, second: Rule) -> Conflict:
    here, there = _claim(first), _claim(second)
    if isinstance(first, Assign):
        message = f"two rules may assign `{first.field}` of one cell in the same substep"
        return Conflict("PD502", message, here, there, (), (_EXCLUDE,), assigns=True)
    if first is second or first.span == second.span:
        message = "a cell may be both mover and target"
        note = "the moves of one substep happen at once: no cell may take part in two of them"
        fix = "add a condition that targets cannot meet, such as a comparison of densities"
        helps = (fix, "or choose a policy: `conflicts: drop_both`")
        return Conflict("PD501", message, here, here, (note,), helps)
    code = "PD501" if isinstance(first, (Swap, Move)) or isinstance(second, (Swap, Move)) else "PD502"
    message = "two rules may claim the same cell in one substep"
    choice = "or choose a policy: `conflicts: first_wins` or `conflicts: drop_both`"
    return Conflict(code, message, here, there, (), (_EXCLUDE, choice))


def _suggest_side_multiple(conflict: Conflict, question: Conditions, facts: Facts, lets: Lets) -> Conflict:
    """The conflict with the fix for rules that alternate by row or column, which only meet at a seam of the world."""
    exprs = [*(condition for condition, _ in question), *lets.values()]
    nodes = [node for expr in exprs for node in expr.walk()]
    moduli = [node.value[1] for node in nodes if node.op == "coordinate" and node.value[0] != "step"]
    multiple = lcm(facts.side_multiple, *moduli)
    if multiple in (1, facts.side_multiple) or multiple > MAX_SIDE_MULTIPLE:
        return conflict
    seamless = replace(facts, side_multiple=multiple, budget=Budget(MAX_QUESTION))
    if satisfiable(seamless, question, lets):
        return conflict
    note = f"they meet only at the seam of a world whose sides are not multiples of {multiple}"
    fix = f"allow only worlds without a seam: `side_multiple: {multiple}`, a key of the pack"
    return replace(conflict, notes=(*conflict.notes, note), helps=(fix, *conflict.helps[1:]))


Domains = dict[tuple[int, Offset], frozenset[object]]
"""The values of single variables (elements, fields and counts) that a condition allows, by number and place."""


def _domains(masks: Iterable[Expr], facts: Facts, lets: Lets) -> Iterator[Domains]:
    numbers: dict[tuple[str, object], int] = {}
    for mask in masks:
        domains = single_domains(facts, mask, lets)
        yield {
            (numbers.setdefault((what, name), len(numbers)), at): values
            for (what, name, at), values in domains.items()
        }


def _are_disjoint(first: Domains, second: Domains, at: Offset, budget: Budget) -> bool:
    """True if the first condition and the second one, `at` away, allow no common value of some variable."""
    budget.left -= GLANCE
    for (number, place), values in second.items():
        known = first.get((number, plus(place, at)))
        if known is not None and known.isdisjoint(values):
            return True
    return False


def flags_for_later(lets: Lets) -> Lets:
    """The flags among some values, in the order in which they were fixed, as later substeps may use them.

    Each becomes an unknown flag and the condition on coordinates that follows from the value.
    """
    flags: Lets = {}
    follow: Lets = {}
    for name, value in lets.items():
        if value.kind != FLAG:
            continue
        condition = _follows(value, follow)
        if condition != TRUE and sum(1 for _ in islice(condition.walk(), MAX_PARTS + 1)) <= MAX_PARTS:
            follow[name] = condition
            flags[name] = conjunction([Expr("let", FLAG, value=f"{name} before"), condition])
    return flags


def _follows(expr: Expr, follow: Lets) -> Expr:
    """A condition on coordinates alone that the expression implies. `follow` has those of earlier values."""
    if all(node.op in _COORDINATES for node in expr.walk()):
        return expr
    match expr.op:
        case "and":
            return conjunction([*dict.fromkeys(_follows(arg, follow) for arg in expr.args)])
        case "or":
            return disjunction([*dict.fromkeys(_follows(arg, follow) for arg in expr.args)])
        case "look":
            return look(_follows(expr.args[0], follow), expr.value)
        case "let":
            return follow.get(str(expr.value), TRUE)
    return TRUE


_COORDINATES = frozenset(("const", "coordinate", *(row.name for row in OPERATIONS.values() if row.evaluate)))
