"""Declarations -> checked model, in one straight function. Each step reports as much as it can.

Some packs of a composition are also checked alone, as their authors knew them, without added packs.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

from powderdsl.diagnostics import CompileError, Diagnostic, Reporter, Severity, Span, suggest
from powderdsl.model.composition.added_packs import AddedPacks, CheckAlone, ScopeDifference, pack_words
from powderdsl.model.composition.compose import Composition, Palette, compose, lay_out, title, with_optional
from powderdsl.model.composition.names import needs_of, report_misspelled, words_of
from powderdsl.model.declarations import PackDecl, RulesetDecl
from powderdsl.model.definitions import define_symbols, element_ramps
from powderdsl.model.elaborate import Elaborator
from powderdsl.model.examples import check_assigned, check_examples
from powderdsl.model.expressions.operators import (
    ELEMENT_HERE,
    FALSE,
    TRUE,
    Absent,
    Poisoned,
    Scope,
    SetOf,
    Unresolved,
    disjunction,
    kind_name,
    member,
)
from powderdsl.model.expressions.symbols import (
    add_constants,
    read_bounds,
    report_undeclared_needs,
    report_unknown_names,
)
from powderdsl.model.expressions.typer import Typer
from powderdsl.model.logic.conflicts import check_logic
from powderdsl.model.logic.needless import (
    overridden_ids,
    report_needless,
    report_undecided,
    report_undrawn,
    report_unused,
    without_dead_overrides,
)
from powderdsl.model.logic.satisfy import Facts
from powderdsl.model.reuse import Reuse
from powderdsl.model.text import one_line, place_of
from powderdsl.model.types import (
    Bounded,
    Claim,
    Declared,
    Expr,
    Invariant,
    Kernel,
    Local,
    Never,
    Ruleset,
    Stream,
    Symmetric,
    Total,
    Unchanging,
)
from powderdsl.syntax.parse import Syntax

OF_COMPOSITIONS = ("PD315", "PD316")
"""Warnings about a combination of packs: misspelled optional names, and values that another pack replaces."""

MISREAD = ("PD109", "PD302", "PD303", "PD305", "PD306", "PD307", "PD310", "PD311", "PD508")
"""Errors after which rules would be misread: names that clash, packs and elements that are missing."""


def resolve_names(
    packs: Sequence[PackDecl], ruleset: RulesetDecl | None, reporter: Reporter, palette: Palette | None = None
) -> tuple[Typer, list[tuple[str, int, Span]]]:
    """A typer that knows all names of some packs, and the locations of elements' own property values.

    Raises CompileError where names clash.
    """
    composition = compose(packs, ruleset, reporter, palette)
    if any(diagnostic.code in MISREAD for diagnostic in reporter.diagnostics):
        reporter.raise_if_errors()
    add_constants(composition)
    typer = Typer(composition, reporter)
    return typer, define_symbols(typer)


def check(
    packs: Sequence[PackDecl],
    ruleset: RulesetDecl | None,
    reporter: Reporter,
    palette: Palette | None = None,
    elsewhere: Callable[[], Mapping[str, str]] = dict,
    *,
    alone: bool = False,
    reuse: Reuse | None = None,
) -> Ruleset:
    """The checked model of some packs. Raises CompileError; warnings and notes stay with the reporter.

    Args:
        palette: ids that were recorded earlier, see `model/composition/compose.py`.
        elsewhere: words that packs define which are not loaded, with the pack.
        alone: treat no pack as added to others, so that conflicts are errors.
        reuse: results of earlier checks.
    """
    typer, element_values = resolve_names(packs, ruleset, reporter, palette)
    composition = typer.symbols
    if reuse is not None:
        typer.reuse = reuse
        reuse.begin(composition)
    elaborated = Elaborator(typer)
    elaborated.run(composition.passes)
    report_undeclared_needs(typer)  # tests and invariants only concern what is loaded
    examples = check_examples(typer)
    check_alone = partial(_check_some, Declared(tuple(packs), None), alone=True)
    invariants = check_invariants(composition, typer, check_alone)
    ramps = element_ramps(typer)
    report_unknown_names(typer, elsewhere)
    reporter.raise_if_errors()
    report_misspelled(packs, composition.ruleset, elsewhere, reporter)

    elements = tuple(replace(element, ramp=ramps.get(name)) for name, element in composition.elements.items())
    passes = tuple(elaborated.passes)
    names, properties, fields = composition.names_by_id, composition.properties, composition.fields
    facts = Facts(tuple(names), properties, fields, composition.side_multiple, names)
    stored = overridden_ids(passes, sorted(elaborated.overridden), facts)
    for name, ids in stored.items():
        properties[name] = replace(properties[name], stored=ids)
    facts = replace(facts)  # of other properties
    check_assigned(examples, composition, reporter)
    added = None if alone else AddedPacks(composition, check_alone)
    passes, undecided = check_logic(passes, facts, elaborated, reporter, added)
    report_unused(composition, typer)
    order, matrix = lay_out(composition, passes, reporter)
    reporter.raise_if_errors()
    undecided += report_needless(passes, composition.fields, facts, reporter)
    checked = Ruleset(
        name=title(composition.packs, composition.ruleset),
        about=ruleset.about if ruleset else (packs[0].about if len(packs) == 1 else ""),
        packs=tuple(composition.packs),
        elements=elements,
        slots=composition.slots,
        properties=tuple(composition.properties.values()),
        fields=tuple(composition.fields.values()),
        streams=_streams(composition, elaborated, reporter),
        params=tuple(composition.params.values()),
        passes=without_dead_overrides(passes, frozenset(name for name, ids in stored.items() if not ids)),
        matrix=matrix,
        side_multiple=composition.side_multiple,
        order=order,
        tests=examples,
        invariants=invariants,
        declared=Declared(tuple(packs), ruleset),
    )
    undecided += report_undrawn(checked, element_values, facts, reporter)
    report_undecided(undecided, reporter)
    return checked


def _streams(symbols: Composition, elaborated: Elaborator, reporter: Reporter) -> tuple[Stream, ...]:
    streams = [*symbols.streams.values(), *elaborated.streams.values()]
    by_ident: dict[int, str] = {}
    for stream in streams:
        other = by_ident.setdefault(stream.ident, stream.name)
        if other != stream.name:
            message = f"streams `{other}` and `{stream.name}` would draw the same numbers"
            reporter.error("PD302", message, None, helps=["rename one of them"])
    return tuple(streams)


# Some packs alone


def select_packs(ruleset: Ruleset, packs: Collection[str]) -> Ruleset | None:
    """The model of some of a ruleset's packs, with its parameters; None if they are not a ruleset of their own."""
    model = _check_some(ruleset.declared, packs, Reporter())
    if model is None:
        return None
    names = {param.name for param in model.params}
    return model.with_params({p.name: p.default for p in ruleset.params if p.name in names})


def without_pack(ruleset: Ruleset, pack: str) -> Ruleset | None:
    """The model without one pack and the packs that need it; None if the rest is not a ruleset."""
    needs = needs_of({decl.name.text: decl for decl in ruleset.declared.packs})
    return select_packs(ruleset, [name for name in needs if pack not in needs[name]])


def _check_some(
    declared: Declared, packs: Collection[str], reporter: Reporter, *, alone: bool = False
) -> Ruleset | None:
    """The model of some packs; None after reporting why they are not a ruleset of their own."""
    gone = {pack.name.text for pack in declared.packs} - set(packs)
    chosen = [pack for pack in declared.packs if pack.name.text not in gone]
    try:
        return check(chosen, _without_packs(declared.ruleset, gone), reporter, alone=alone)
    except CompileError:
        return None


def _without_packs(decl: RulesetDecl | None, gone: set[str]) -> RulesetDecl | None:
    """A ruleset without names of missing packs: no channels, and no invariants if one of its own packs is missing."""
    if decl is None:
        return None
    invariants = decl.invariants if gone.isdisjoint(decl.members) else ()
    beside = tuple(bare for other in decl.beside if (bare := _without_packs(other, gone)))
    base = _without_packs(decl.base, gone)
    return replace(decl, matrix=(), slots=None, invariants=invariants, base=base, beside=beside)


def demote_outgrown(ruleset: Ruleset, remarks: tuple[Diagnostic, ...]) -> tuple[Diagnostic, ...]:
    """The remarks, with warnings that only added packs cause turned into notes (PD515)."""
    warnings = {
        remark: span
        for remark in remarks
        if remark.severity is Severity.WARNING
        and (span := remark.primary.span)
        and remark.code not in OF_COMPOSITIONS
    }
    if not warnings or len(ruleset.packs) < 2:
        return remarks
    composition = compose(ruleset.declared.packs, ruleset.declared.ruleset, Reporter())
    notes: dict[Diagnostic, Diagnostic] = {}
    authors: list[PackDecl | RulesetDecl] = [*composition.packs.values(), *composition.ruleset.lineage]
    for author in authors:
        own = {remark: span for remark, span in warnings.items() if span.source == author.source}
        if not own:
            continue
        words = _known_words(author)
        scope = composition.scope(author.name.text if isinstance(author, PackDecl) else author, words)
        added, reporter = ruleset.added_to(scope), Reporter()
        if not added or _check_some(ruleset.declared, scope, reporter) is None:
            continue
        alone = {(remark.code, remark.primary.span) for remark in reporter.diagnostics}
        for remark, span in own.items():
            if (remark.code, span) not in alone:
                message = f"{ScopeDifference(added).with_packs}, {remark.message}: {place_of(span)}"
                notes[remark] = replace(remark, code="PD515", message=message, helps=())
    return tuple(notes.get(remark, remark) for remark in remarks)


def _known_words(author: PackDecl | RulesetDecl) -> list[str]:
    """The words that a pack's rules and elements, or a ruleset's invariants, use, which show what packs it knows."""
    if isinstance(author, RulesetDecl):
        return [word for line in author.invariants for word in words_of(line)]
    words = [*pack_words(author), *(also.name.word for also in author.also)]
    for entry in author.entries:
        words += [scalar.word for scalar in (*(key for key, _ in entry.values), *entry.tags)]
    return words


# Invariants: statements about all worlds, read as words and checked like conditions

MAX_STEPS = 1000
"""Maximum N of `never … for N steps`: each test runs all of them."""

MAX_RADIUS = 1000

TRENDS = {"rises": "never rises", "falls": "never falls", "changes": "constant"}


def check_invariants(
    composition: Composition, typer: Typer, check_alone: CheckAlone
) -> tuple[Invariant, ...]:
    """The invariants of all packs and of the ruleset, except invariants that need a pack which is not loaded.

    `check_alone`: checks the packs of the scope of an invariant that cannot hold.
    """
    written: list[tuple[str, Syntax, RulesetDecl | None]]
    written = [(name, line, None) for name, pack in composition.packs.items() for line in pack.invariants]
    for ruleset in composition.ruleset.lineage:
        for line in ruleset.invariants:
            marked = with_optional(line, composition.left_out) if composition.left_out else line
            written.append((ruleset.name.text, marked, ruleset))
    invariants = []
    reporter = typer.reporter
    for pack, line, author in written:
        typer.reporter = Reporter()
        try:
            run = partial(_invariant, typer, line, pack, author)
            invariants.append(typer.reuse.of(line.span, [*composition.names_by_id], typer, run))
        except Poisoned:
            pass
        except Unresolved as missing:
            typer.reporter.report(
                "PD506", f"this invariant is inactive: `{missing.name}` is not loaded", line.span, "left out",
                helps=[f"it becomes active with a pack that defines `{missing.name}`"],
            )  # fmt: skip
        for remark in typer.reporter.diagnostics:
            scope = composition.scope(author or pack, words_of(line))
            added = [name for name in composition.packs if name not in scope]
            if remark.code == "PD511" and added and check_alone(scope, Reporter()):
                names = ", ".join(f"`{name}`" for name in added)
                words_there = f"with {names}, `{one_line(line.span)}` can no longer hold"
                reporter.report("PD515", words_there, remark.primary.span, remark.primary.text)
            else:
                reporter.add(remark)
    typer.reporter = reporter
    return tuple(invariants)


def _invariant(typer: Typer, line: Syntax, pack: str, author: RulesetDecl | None) -> Invariant:
    """The invariant of a line. Raises Poisoned or Unresolved."""
    typer.absent.clear()
    typer.start_rule(line.span)
    scope, without, span, words = Scope(pack, {}), frozenset[int](), line.span, [*words_of(line)]
    if line.kind == "without":
        line, what = line.children
        without = frozenset(typer.set_of(typer.evaluate(what, scope), what.span).ids)
        if without == typer.symbols.names_by_id.keys():
            label = "every world has some of these"
            raise typer.fail("PD511", "this invariant cannot hold", what.span, label)
        typer.absent.clear()  # a world is without elements of packs that are not loaded
    known = typer.symbols.scope(author or pack, words)
    return Invariant(_Statement(typer, scope).claim(line), without, pack, span, known)


_FORMS = (
    "forms: `SET never changes`, `count(SET) is constant`, `count(SET) never rises`, `never CONDITION`, "
    "`FIELD stays in LOW..HIGH`, `nothing reaches beyond N cells`, `mirrored worlds agree`",
)


@dataclass(frozen=True)
class _Statement:
    """Reads the statement of an invariant. Its methods raise Poisoned after reporting, or Unresolved."""

    typer: Typer
    scope: Scope

    def claim(self, line: Syntax) -> Claim:
        typer, scope, parts = self.typer, self.scope, line.children
        match line.kind:
            case "trend":  # `SET never changes`, `count(…) never rises`, `count(…) never falls`
                is_total = parts[0].kind == "call" and parts[0].text in ("count", "sum")
                self.check_words(parts[1:], tuple(TRENDS) if is_total else ("changes",))
                if is_total:
                    return self.total(parts[0], TRENDS[parts[1].text])
                ids = typer.set_of(typer.evaluate(parts[0], scope), parts[0].span).ids
                if not ids:
                    self.report_trivial(parts[0].span, "no element matches", is_empty=True)
                return Unchanging(frozenset(ids))
            case "total":  # `count(…) is constant`, `sum(…) is constant`
                (what,) = parts
                if what.kind != "is_" or what.children[0].kind != "call" or what.children[1].kind != "name":
                    raise typer.fail("PD201", "this states nothing", what.span, "not an invariant", *_FORMS)
                self.check_words(what.children[1:], ("constant",))
                return self.total(what.children[0], "constant")
            case "never":  # `never CONDITION`, `never CONDITION for N steps`
                duration, steps = line.child("duration"), 1
                if duration is not None:
                    self.check_words(duration.children, ("steps", "step"))
                    steps = self.number(duration, 1, MAX_STEPS)
                condition = typer.condition(parts[0], scope)
                if condition == TRUE:
                    raise typer.fail(
                        "PD511", "this invariant cannot hold", parts[0].span, "every cell fulfills this",
                        "write a condition that no cell may meet")  # fmt: skip
                return Never(self.check_open(condition, parts[0].span), steps)
            case "reach":  # `nothing reaches beyond N cells`
                self.check_words(parts, ("nothing",), ("reaches",), ("beyond",), ("cells", "cell"))
                return Local(self.number(line, 0, MAX_RADIUS))
            case "agree":  # `mirrored worlds agree`, `rotated worlds agree`
                self.check_words(parts, ("mirrored", "rotated"), ("worlds",), ("agree",))
                return Symmetric(parts[0].text)
        return self.bounds(line)

    def total(self, call: Syntax, trend: str) -> Total:
        typer, scope = self.typer, self.scope
        if call.text not in ("count", "sum") or not call.children:
            raise typer.fail(
                "PD406", "a total is written `count(SET)` or `sum(VALUE)`", call.span, "not a total", *_FORMS
            )
        for child in call.children:
            if child.kind == "in_" and isinstance(typer.evaluate(child.children[1], scope), Kernel):
                raise typer.fail(
                    "PD406", "an invariant counts the whole world", call.span, "has a neighborhood"
                )
        operands = [(typer.evaluate(child, scope), child.span) for child in call.children]
        if all(isinstance(operand, (SetOf, Absent)) for operand, _ in operands):
            ids = frozenset(
                number for operand, span in operands for number in typer.set_of(operand, span).ids
            )
            if not ids:
                self.report_trivial(call.span, "no element is counted", is_empty=True)
            elif ids == typer.symbols.names_by_id.keys():
                self.report_trivial(call.span, "all cells are counted")
            return Total(member(ELEMENT_HERE, tuple(sorted(ids)), call.span), trend, ids)
        if call.text == "sum" and len(operands) == 1:
            (operand, span), *_ = operands
            value = typer.value(operand, span)
            if value.kind.name == "number":
                raise typer.wrong(value, "something that worlds have", span)
            if value.kind.name not in ("int", "flag"):
                fix = "floats are rounded: their sums are constant for no rule"
                raise typer.wrong(value, "an integer", span, fix)
            return Total(value, trend, None)
        flags = [typer.flag(operand, span) for operand, span in operands]
        return Total(self.check_open(disjunction(flags, call.span), call.span), trend, None)

    def bounds(self, line: Syntax) -> Claim:
        """`FIELD stays in LOW..HIGH`."""
        typer = self.typer
        what, bounds = line.children
        operand = typer.evaluate(what, self.scope)
        if isinstance(operand, Absent):
            raise Unresolved(operand.name)
        numbers = kind_name(operand) in ("int", "real", "vec2")
        if not isinstance(operand, Expr) or operand.op not in ("field", "property") or not numbers:
            raise typer.wrong(
                operand, "a field of numbers", what.span, "for anything else write `never CONDITION`"
            )
        lo, hi = read_bounds(bounds, typer)
        name, kind = str(operand.value), operand.kind
        field = typer.symbols.fields.get(name)
        outside = hi < kind.lo or lo > kind.hi
        defaults = field.defaults if field else ()
        parts = [
            (value, part) for value in defaults for part in (value if isinstance(value, tuple) else (value,))
        ]
        beyond = [value for value, part in parts if not lo <= part <= hi]
        if outside or beyond:
            label = f"`{name}` holds {kind}" if outside else f"a fresh cell has {beyond[0]}"
            raise typer.fail("PD511", "this invariant cannot hold", bounds.span, label, "widen the bounds")
        return Bounded(name, lo, hi)

    def check_open(self, condition: Expr, span: Span) -> Expr:
        """The condition, after reporting one that is always true or always false."""
        if condition == FALSE:
            self.report_trivial(span, "no cell can fulfill this", is_empty=True)
        elif condition == TRUE:
            self.report_trivial(span, "every cell fulfills this")
        return condition

    def report_trivial(self, span: Span, label: str, *, is_empty: bool = False) -> None:
        """Report an invariant that no world can break. Raises Unresolved if an empty one may need an absent pack."""
        if is_empty and self.typer.absent:
            raise Unresolved(", ".join(sorted(self.typer.absent)))
        message = "this invariant is always true"
        self.typer.reporter.report("PD510", message, span, label, helps=["remove it"])

    def check_words(self, words: tuple[Syntax, ...], *wanted: tuple[str, ...]) -> None:
        """Report the first word that is not allowed in its position."""
        for word, options in zip(words, wanted, strict=True):
            if word.text not in options:
                listed = " or ".join(f"`{option}`" for option in options)
                close = tuple(fix for fix in suggest(word.text, options) if fix.startswith("did"))
                message, label = f"unexpected `{word.text}`", f"expected {listed}"
                raise self.typer.fail("PD201", message, word.span, label, *close or _FORMS)

    def number(self, line: Syntax, least: int, most: int) -> int:
        text = line.text
        if len(text) > 6 or not least <= int(text) <= most:
            message = f"{text[:12]} lies outside {least}..{most}"
            fix = f"write a number from {least} to {most}"
            raise self.typer.fail("PD402", message, line.span, "out of range", fix)
        return int(text)
