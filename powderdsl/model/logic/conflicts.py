"""The logic of rules, decided before anything runs: collisions, writes that clash, rules that never fire."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from math import lcm
from typing import TYPE_CHECKING

from powderdsl.diagnostics import Label, Reporter, Span
from powderdsl.model.added_conflicts import AddedPacks, may_settle, report_added
from powderdsl.model.builtins import MAX_SIDE_MULTIPLE
from powderdsl.model.expressions.operands import ELEMENT_HERE, negation
from powderdsl.model.expressions.operands import member as member_of
from powderdsl.model.logic.apart import Glances
from powderdsl.model.logic.budget import BUDGET, MAX_QUESTION, Budget
from powderdsl.model.logic.lasting import lasting
from powderdsl.model.logic.satisfy import Facts, decide, example, satisfiable
from powderdsl.model.types import Assign, Expr, Moment, Move, Offset, Pass, Rule, Swap, Transform

if TYPE_CHECKING:
    from powderdsl.model.elaborate import Elaborated

HERE: Offset = (0, 0)

ASSIGN = "two rules may assign"

ALL_MOMENTS = 3
"""Work for the conflicts of all substeps together, as a multiple of that for one."""


@dataclass(frozen=True)
class Conflict:
    """Two rules (or two copies of one) that may claim one cell. Rounds of a loop repeat it, so it is a value."""

    code: str
    message: str
    first: Span
    second: Span
    notes: tuple[str, ...]
    helps: tuple[str, ...]

    @property
    def claims(self) -> tuple[Span, Span]:
        """What the two rules claim: the second is where it is reported."""
        return claim(self.first), claim(self.second)

    def report(self, labels: list[str], example: str, reporter: Reporter) -> None:
        """Report it once, whatever the number of rounds that have it. `example` is for the first of them."""
        where = f" ({labels[0]})" if labels[0] else ""
        notes = [*filter(None, [example]), *self.notes]
        if len(labels) > 1:
            more = "copy" if len(labels) == 2 else "copies"
            notes.append(
                f"the same in {len(labels) - 1} more {more} of the rule that its loop or symmetry makes"
            )
        one = self.first == self.second
        reporter.error(
            self.code, self.message + where, claim(self.second), "two of these can meet" if one else "claims it too",
            secondary=[] if one else [Label(claim(self.first), "claims a cell")], notes=notes, helps=self.helps,
        )  # fmt: skip


def claim(span: Span) -> Span:
    """What a rule does, without its condition: the part of its text to underline."""
    rest = re.search(r",?\s+(if|where|with|then)\b", span.text)
    return Span(span.source, span.start, span.start + rest.start()) if rest and rest.start() else span


@dataclass
class _Found:
    """A conflict as it was met first, with an example, and where it was met: passes and substeps by number."""

    example: dict[Offset, int]
    labels: list[str]
    places: list[tuple[int, int]]


def check_logic(
    passes: tuple[Pass, ...],
    facts: Facts,
    elaborated: Elaborated,
    reporter: Reporter,
    added: AddedPacks | None = None,
) -> tuple[tuple[Pass, ...], list[Span]]:
    """Report conflicts (errors), rules that never fire or do nothing (warnings), and those that sleep (notes).

    Conflicts that come from `added` packs alone are settled.

    Returns:
        The passes, which say how conflicts are settled, and the rules that may never fire or do nothing: to tell takes
        too much work.
    """
    relaxed = replace(facts.relaxed(), budget=Budget())
    silent: dict[Span, list[tuple[Expr, dict[str, Expr]]]] = {}
    alive: dict[Span, bool | None] = {}
    useful: dict[Span, bool | None] = {}
    conflicts: dict[Conflict, _Found] = {}
    work: list[tuple[int, int, Pass]] = []
    left = ALL_MOMENTS * BUDGET
    for at, pass_ in enumerate(passes):
        earlier: dict[str, Expr] = {}
        for number, moment in enumerate(pass_.moments):
            lets = earlier | {let.name: let.value for let in moment.lets}
            earlier = lasting(lets)
            live = []
            for rule in moment.rules:
                fires = rule.mask is None or decide(facts, [(rule.mask, HERE)], lets)
                alive[rule.span] = _either(alive.get(rule.span, False), fires)
                changes = _changes(rule, facts, lets) if fires else fires is False or None
                useful[rule.span] = _either(useful.get(rule.span, False), changes)
                if fires is not False:
                    live.append(rule)
                elif rule.mask is not None:
                    silent.setdefault(rule.span, []).append((rule.mask, lets))
            if moment.policy == "prove":
                given = min(BUDGET, left)
                asked = replace(facts, budget=Budget(given))
                for conflict, found in _check_moment(live, asked, lets):
                    known = conflicts.setdefault(conflict, _Found(found, [], []))
                    known.labels.append(moment.label)
                    known.places.append((at, number))
                work.append((given - asked.budget.left, len(live), pass_))
                left -= work[-1][0]
    if _too_much(work, reporter):
        return passes, []
    passes = _report_conflicts(conflicts, passes, facts, added, reporter)
    for span, fires in alive.items():
        if fires is None or (fires and useful[span] is None):
            continue
        if not fires and span in elaborated.asleep:
            _report_sleep(f"`{elaborated.asleep[span]}` is not loaded", span, reporter)
        elif not fires and span in elaborated.empty:
            _report_sleep(f"no element is in `{elaborated.empty[span]}`", span, reporter)
        elif not fires and any(decide(relaxed, [(mask, HERE)], lets) for mask, lets in silent.get(span, [])):
            _report_sleep("no loaded element has the properties it asks for", span, reporter)
        elif not fires:
            reporter.report(
                "PD503",
                "this rule can never fire",
                span,
                "no cell can fulfill all of it",
                helps=["look for conditions that exclude each other, or that no element's properties meet"],
            )
        elif not useful[span]:
            reporter.report(
                "PD509", "this rule changes nothing", span, "the cell already is what it becomes",
                helps=["remove it, or name another element after `->`"],
            )  # fmt: skip
    undecided = [span for span, fires in alive.items() if fires is None or (fires and useful[span] is None)]
    return passes, undecided


def _report_conflicts(
    conflicts: dict[Conflict, _Found],
    passes: tuple[Pass, ...],
    facts: Facts,
    added: AddedPacks | None,
    reporter: Reporter,
) -> tuple[Pass, ...]:
    """Report conflicts; the passes with those settled that added packs bring about."""
    settled: set[tuple[int, int]] = set()
    for conflict, found in conflicts.items():
        words = _in_words(facts, found.example)
        pass_ = passes[found.places[0][0]]
        place, ids = conflict.claims[1], list(found.example.values())
        causes = added.causes(pass_.pack, place, ids or facts.ids) if added else ()
        if not causes:
            conflict.report(found.labels, words, reporter)
            continue
        assigns = conflict.message.startswith(ASSIGN)
        settles = assigns or all(may_settle(passes[at].moments[number]) for at, number in found.places)
        if settles and not assigns:
            settled.update(found.places)
        notes = [words] if words else []
        report_added(conflict.code, conflict.claims, notes, causes, pass_.name, settles, assigns, reporter)
    return tuple(
        replace(
            pass_,
            moments=tuple(
                replace(moment, policy="first_wins") if (at, number) in settled else moment
                for number, moment in enumerate(pass_.moments)
            ),
        )
        if any(one == at for one, _ in settled)
        else pass_
        for at, pass_ in enumerate(passes)
    )


def _either(first: bool | None, second: bool | None) -> bool | None:
    """Whether one of two copies does; None if neither is known to, and one may."""
    return first or second or (None if None in (first, second) else False)


def _too_much(work: list[tuple[int, int, Pass]], reporter: Reporter) -> bool:
    """Report substeps whose rules take too much work to compare. Work is counted: the same rules always take the same.

    Args:
        work: for each substep the work that was spent, the number of its rules, and its pass.
    """
    hard = {pass_.name: (count, pass_) for spent, count, pass_ in work if spent > BUDGET}
    together = sum(spent for spent, _, _ in work) > ALL_MOMENTS * BUDGET
    if together and not hard:
        _, count, most = max(work, key=lambda one: one[0])
        hard = {most.name: (count, most)}
    for count, pass_ in hard.values():
        reporter.error(
            "PD508", f"comparing the rules of `{pass_.name}` with each other takes too much work", pass_.span,
            f"{count:,} rules in one list are {count * (count + 1) // 2:,} pairs",
            helps=[
                "choose what happens to conflicts, then nothing is compared: `conflicts: first_wins`",
                "or divide the list until its parts are short enough: rules that need not happen at once go under `then:`",
            ],
        )  # fmt: skip
    return bool(hard)


def _report_sleep(reason: str, span: Span, reporter: Reporter) -> None:
    reporter.report(
        "PD506", f"this rule is inactive: {reason}", span, "cannot happen with these packs",
        helps=["it becomes active with a pack that brings what it asks for"],
    )  # fmt: skip


def _changes(rule: Rule, facts: Facts, lets: dict[str, Expr]) -> bool | None:
    if isinstance(rule, Transform) and rule.target.op == "const" and not rule.effects:
        same = member_of(ELEMENT_HERE, (rule.target.value,))
        return decide(facts, [(rule.mask, HERE), (negation(same), HERE)], lets)
    return True


def _check_moment(
    rules: list[Rule], facts: Facts, lets: dict[str, Expr]
) -> Iterator[tuple[Conflict, dict[Offset, int]]]:
    """The conflicts of one substep, with an example: for each rule the first one, maybe itself, that it meets."""
    movers = [rule for rule in rules if not isinstance(rule, Assign)]
    glances = Glances([rule.mask for rule in movers], facts, lets)
    for i, second in enumerate(movers):
        undecided = None
        for first in (second, *movers[:i]):
            if facts.budget.is_exhausted:
                return
            answer, question = _meet(first, second, glances, facts, lets)
            if answer:
                yield (
                    _parity(_conflict(first, second), question, facts, lets),
                    example(facts, question, lets),
                )
                break
            if answer is None and undecided is None:
                undecided = first
        else:
            if undecided is not None and not facts.budget.is_exhausted:
                yield _undecided(_conflict(undecided, second)), {}
    plain: list[tuple[Assign, Expr | None]] = [
        (rule, rule.mask) for rule in rules if isinstance(rule, Assign)
    ]
    effects: list[tuple[Assign, Expr | None]] = [
        (effect, rule.mask) for rule in movers for effect in rule.effects
    ]
    for assigns in (plain, effects):
        yield from _check_assigns(assigns, facts, lets)


def _meet(
    first: Rule, second: Rule, glances: Glances, facts: Facts, lets: dict[str, Expr]
) -> tuple[bool | None, Sequence[tuple[Expr, Offset]]]:
    """Whether two rules may claim one cell, and the conditions with which they do; None if that is too hard."""
    answer: bool | None = False
    assert first.mask is not None
    assert second.mask is not None
    for at in _claims(first, second):
        if glances.apart(first.mask, second.mask, at):
            continue
        question = ((first.mask, HERE), (second.mask, at))
        found = decide(facts, question, lets)
        if found:
            return True, question
        if found is None:
            answer = None
    return answer, ()


def _check_assigns(
    assigns: list[tuple[Assign, Expr | None]], facts: Facts, lets: dict[str, Expr]
) -> Iterator[tuple[Conflict, dict[Offset, int]]]:
    """Two `:=` of one field must not meet in a cell with different values."""
    sets = [(assign, mask) for assign, mask in assigns if assign.op == ":=" and mask is not None]
    glances = Glances([mask for _, mask in sets], facts, lets)
    for i, (b, second) in enumerate(sets):
        for a, first in sets[:i]:
            if a.field != b.field or a.value == b.value or facts.budget.is_exhausted:
                continue
            shift = (a.offset[0] - b.offset[0], a.offset[1] - b.offset[1])
            if glances.apart(first, second, shift):
                continue
            question = ((first, HERE), (second, shift))
            answer = decide(facts, question, lets)
            if answer is not False and not facts.budget.is_exhausted:
                message = f"{ASSIGN} `{a.field}` of one cell in the same substep"
                conflict = Conflict("PD502", message, a.span, b.span, (), (_EXCLUDE,))
                if answer:
                    yield conflict, example(facts, question, lets)
                else:
                    yield _undecided(conflict), {}
                break


_PLACES = {(0, 0): "here", (-1, 0): "above", (1, 0): "below", (0, -1): "on the left", (0, 1): "on the right"}


def _in_words(facts: Facts, elements: dict[Offset, int]) -> str:
    """What may stand where two rules meet, such as `x` here and `y` below."""
    found = sorted(elements.items())
    if not 0 < len(found) <= 4:
        return ""
    places = [
        f"`{facts.names[n]}` {_PLACES.get(at) or f'at({at[0]}, {at[1]})'}"
        for at, n in found
        if n in facts.names
    ]
    return (
        "for example with " + " and ".join(filter(None, [", ".join(places[:-1]), places[-1]]))
        if places
        else ""
    )


def _claims(first: Rule, second: Rule) -> Iterator[Offset]:
    """Where, relative to the first rule's cell, the second would claim one of the same cells."""
    if isinstance(first, Transform) and isinstance(second, Transform):
        if first is not second and first.target != second.target:
            yield HERE
        return
    if isinstance(first, Move) and isinstance(second, Move):
        # A move into a place that is being left is fine: what stands there goes first.
        if first is not second:
            yield HERE
            yield (first.offset[0] - second.offset[0], first.offset[1] - second.offset[1])
        return
    seen = set()
    for a in _footprint(first):
        for b in _footprint(second):
            shift = (a[0] - b[0], a[1] - b[1])
            if shift not in seen and not (first is second and shift == HERE):
                seen.add(shift)
                yield shift


def _footprint(rule: Rule) -> tuple[Offset, ...]:
    return (HERE, rule.offset) if isinstance(rule, (Swap, Move)) else (HERE,)


_EXCLUDE = "make their conditions exclude each other, or put one under `then:`"


def _conflict(first: Rule, second: Rule) -> Conflict:
    if first is second or first.span == second.span:
        note = "the moves of one substep happen at once: no cell may take part in two of them"
        helps = (
            "add a condition that a target cannot fulfill, such as a comparison of densities",
            "or choose what happens then: `conflicts: drop_both`",
        )
        return Conflict(
            "PD501", "a cell may be both mover and target", first.span, first.span, (note,), helps
        )
    movement = isinstance(first, (Swap, Move)) or isinstance(second, (Swap, Move))
    message = "two rules may claim one cell in the same substep"
    choice = "or choose what happens then: `conflicts: first_wins` or `conflicts: drop_both`"
    return Conflict(
        "PD501" if movement else "PD502", message, first.span, second.span, (), (_EXCLUDE, choice)
    )


def _parity(
    conflict: Conflict, question: Sequence[tuple[Expr, Offset]], facts: Facts, lets: dict[str, Expr]
) -> Conflict:
    """The conflict with the fix for rules that alternate by row or column: worlds without a seam keep them apart."""
    asked = [*(condition for condition, _ in question), *lets.values()]
    nodes = [node for one in asked for node in one.walk()]
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


def _undecided(conflict: Conflict) -> Conflict:
    """The conflict of two rules whose conditions are too hard: to say that they must exclude each other is not a help."""
    note = "their conditions combine too many values to decide whether they can meet"
    helps = ("choose what happens if they do: `conflicts: first_wins`", "or put one of them under `then:`")
    return replace(conflict, notes=(note,), helps=helps)


def overridden_ids(passes: tuple[Pass, ...], names: Iterable[str], facts: Facts) -> dict[str, frozenset[int]]:
    """For each of these properties the ids whose cells may hold their own value: those that some rule assigns it to.

    A value of its own may fulfill the condition of another such rule: this continues until nothing is added.
    """
    found: dict[str, frozenset[int]] = {name: frozenset() for name in names}
    while True:
        more = {name: found[name] | _overridden_ids(passes, name, facts) for name in found}
        if more == found:
            return found
        found = more
        stored = {name: replace(facts.properties[name], stored=ids) for name, ids in found.items()}
        facts = replace(facts, properties={**facts.properties, **stored})


def _overridden_ids(passes: tuple[Pass, ...], name: str, facts: Facts) -> frozenset[int]:
    """The ids that some rule assigns a property to, if cells hold values of their own as `facts` say."""
    found: set[int] = set()
    for pass_ in passes:
        for moment in pass_.moments:
            lets = {let.name: let.value for let in moment.lets}
            for rule in moment.rules:
                assigns = [rule] if isinstance(rule, Assign) else list(rule.effects)
                for assign in assigns:
                    if assign.field != name:
                        continue
                    if assign.mask is None or assign.offset != HERE:
                        return frozenset(facts.ids)
                    found |= {
                        i for i in facts.ids if i not in found
                        and satisfiable(facts, [(member_of(ELEMENT_HERE, (i,)), HERE), (assign.mask, HERE)], lets)
                    }  # fmt: skip
    return frozenset(found)


def produced_ids(passes: tuple[Pass, ...], facts: Facts) -> frozenset[int]:
    """The ids that some rule may bring about."""
    found: set[int] = set()
    for pass_ in passes:
        for moment in pass_.moments:
            for rule in moment.rules:
                target = (
                    rule.target
                    if isinstance(rule, Transform)
                    else rule.leaving
                    if isinstance(rule, Move)
                    else None
                )
                if target is not None:
                    found |= {target.value} if target.op == "const" else set(facts.ids)
    return frozenset(found)


def without_dead_overrides(passes: tuple[Pass, ...], dead: frozenset[str]) -> tuple[Pass, ...]:
    """The passes without assignments to properties that no cell can come to override: there is no place for them."""

    def kept(moment: Moment) -> Moment:
        return replace(
            moment, rules=tuple(r for r in moment.rules if not (isinstance(r, Assign) and r.field in dead))
        )

    return tuple(replace(pass_, moments=tuple(kept(moment) for moment in pass_.moments)) for pass_ in passes)
