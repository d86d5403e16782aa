"""Syntax of an expression -> operand of the required kind, with names resolved, kinds checked and constants folded."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from fractions import Fraction
from itertools import pairwise, product, takewhile
from math import prod

from powderdsl.diagnostics import Label, Reporter, Span
from powderdsl.model.builtins import COORDINATES, KERNEL_SHAPES, KERNELS, MAX_MAGNITUDE, MAX_OFFSET, OCTANTS
from powderdsl.model.composition.compose import Composition
from powderdsl.model.declarations import SetDecl
from powderdsl.model.expressions.operators import (
    ELEMENT_HERE,
    FALSE,
    IDENTITY,
    TRUE,
    Absent,
    Bounds,
    Broken,
    Items,
    Operand,
    Place,
    PlaceChoice,
    Poisoned,
    Scope,
    SetOf,
    Unresolved,
    calculation,
    call,
    choose,
    compare,
    conjunction,
    disjunction,
    kind_name,
    look,
    member,
    membership,
    modulo,
    negation,
    number,
    rotate,
)
from powderdsl.model.expressions.symbols import read_bounds, read_number
from powderdsl.model.logic.needless import report_repeated
from powderdsl.model.operations import FUNCTIONS
from powderdsl.model.reuse import MAX_WORK, Reuse
from powderdsl.model.types import (
    CHANCE,
    DIRECTION,
    DRAW,
    ELEMENT,
    FLAG,
    REAL,
    VEC2,
    Expr,
    Kernel,
    Kind,
    Offset,
    integer,
    plus,
)
from powderdsl.model.types import Value as Constant
from powderdsl.syntax.parse import Syntax
from powderdsl.syntax.yaml_tree import Scalar

MAX_ROUNDS = 4096
"""Maximum number of iterations of a loop over several variables."""

MAX_RULE_WORK = 5_000
"""Maximum number of parts of expressions in one rule, with quantifiers unrolled."""

MAX_SET_DEPTH = 24
"""Maximum length of a chain of sets defined by one another."""


_KINDS = {
    "int": "an integer",
    "flag": "a condition",
    "element": "an element",
    "direction": "a direction",
    "chance": "a chance",
    "draw": "a random draw",
    "real": "a float",
    "vec2": "a vector",
}
_HELPS: dict[str, tuple[str, ...]] = {
    "chance": ("such as `5%`, or a parameter",),
    "vec2": ("such as `vector(1, 0)`: rows down, columns right",),
    "direction": ("such as `left`, or `octant(…)`",),
}
"""The fix if a value of a kind is needed."""

_OPERANDS: dict[type, str] = {
    Place: "a place",
    PlaceChoice: "a choice between places",
    Bounds: "a range",
    Items: "a list",
    Kernel: "a kernel",
}


def describe(operand: Operand) -> str:
    """An operand's kind in words, for messages."""
    match operand:
        case Expr():
            return _KINDS.get(operand.kind.name, "a number")
        case SetOf():
            return "an element" if operand.name else "a set of elements"
        case Absent():
            return f"`{operand.name}`, which is not loaded"
    return _OPERANDS.get(type(operand), "something broken")


class Typer:
    """Checks expressions against the symbols of a composition."""

    def __init__(self, symbols: Composition, reporter: Reporter):
        self.symbols, self.reporter = symbols, reporter
        self.sets = symbols.names.declared(SetDecl)
        self._misused: set[tuple[Span, str]] = set()
        self.used: set[str] = set()
        self.absent: set[str] = set()
        self.empty: set[str] = set()
        """Empty tags and sets that the rule tests for."""
        self.resolving: list[str] = []
        self.unknown: dict[tuple[str, bool], dict[Span, Iterable[str]]] = {}
        """By unknown name and whether it follows a dot: its places, each with the local names there."""
        self.undeclared: dict[tuple[str, str], Span] = {}
        """The first places of names used by a pack but not defined by a pack that it needs."""
        self._sets_too_deep = False
        self.work = self._rule_start = 0
        self._rule_span: Span | None = None
        self.reuse = Reuse()

    def evaluate(self, syntax: Syntax, scope: Scope) -> Operand:
        """The operand of some syntax. Raises Poisoned after reporting, Unresolved if it depends on an absent name."""
        self.spend(1, syntax.span)
        return HANDLERS[syntax.kind](self, syntax, scope)

    def operands(self, syntax: Syntax, scope: Scope) -> list[Operand]:
        return [self.evaluate(child, scope) for child in syntax.children]

    def spend(self, parts: int, span: Span) -> None:
        """Count parts of expressions. Raises Poisoned if a rule, or all rules together, have too many."""
        if self.work > MAX_WORK:
            raise Poisoned  # already reported, and true for everything that follows
        self.work += parts
        if self.work - self._rule_start > MAX_RULE_WORK or self.work > MAX_WORK:
            self._rule_start = self.work  # once per rule is enough
            what = "a rule that expands" if self.work <= MAX_WORK else "rules that expand"
            fix = "loop over fewer things, or name parts under `let:`"
            label = "unrolled, it has thousands of parts"
            raise self.fail("PD508", f"{what} to too much", self._rule_span or span, label, fix)

    def start_rule(self, span: Span) -> None:
        """Start counting the work of the rule or value at `span`."""
        self._rule_start, self._rule_span = self.work, span
        self.empty.clear()

    def condition(self, syntax: Syntax, scope: Scope) -> Expr:
        """The value of syntax as a flag: a bare element tests the cell itself."""
        return self.flag(self.evaluate(syntax, scope), syntax.span)

    def value_of(self, syntax: Syntax, scope: Scope) -> Expr:
        return self.value(self.evaluate(syntax, scope), syntax.span)

    def constant(self, syntax: Syntax, kind: Kind, scope: Scope) -> Constant:
        """The value of a constant expression. Raises Poisoned after reporting a mistake."""
        try:
            value = self.of_kind(self.evaluate(syntax, scope), kind, syntax.span)
        except Unresolved as missing:
            raise self.fail("PD301", f"unknown name `{missing.name}`", syntax.span) from None
        return self.constant_of(value, syntax.span)

    def constant_of(self, value: Expr, span: Span) -> Constant:
        """The number, or the pair, that an expression is if it is constant."""
        parts = value.args if value.op == "vector" else (value,)
        if any(part.op != "const" for part in parts):
            raise self.fail("PD405", "expected a constant", span, "depends on the world")
        numbers = tuple(part.value for part in parts)
        return numbers if value.op == "vector" else numbers[0]

    # Operands of the required kind, or a report

    def fail(
        self,
        code: str,
        message: str,
        span: Span,
        label: str = "",
        *helps: str,
        secondary: Sequence[Label] = (),
    ) -> Poisoned:
        """Report an error; the exception to raise after it."""
        self.reporter.error(code, message, span, label, secondary=secondary, helps=helps)
        return Poisoned()

    def wrong(self, operand: Operand, wanted: str, span: Span, *helps: str) -> Poisoned:
        """Report an operand of the wrong kind; the exception to raise after it."""
        secondary: tuple[Label, ...] = ()
        if isinstance(operand, Expr) and operand.op == "let" and operand.span and operand.span != span:
            if (operand.span, wanted) in self._misused:
                return Poisoned()  # a value of the wrong kind is one mistake, however often it is used
            self._misused.add((operand.span, wanted))
            secondary = (Label(operand.span, "its value, set here"),)
        description = describe(operand)
        message, label = f"expected {wanted}, found {description}", f"this is {description}"
        return self.fail("PD401", message, span, label, *helps, secondary=secondary)

    def flag(self, operand: Operand, span: Span) -> Expr:
        match operand:
            case Expr() if operand.kind == FLAG:
                return operand
            case SetOf() | Items():
                return member(ELEMENT_HERE, self.set_of(operand, span).ids, span)
            case Absent():
                return FALSE
        kind = operand.kind.name if isinstance(operand, Expr) else type(operand).__name__
        fix = {
            "int": "compare it: `… > 0`",
            "draw": "compare it with a chance: `… < 5%`",
            "Place": "name the element at that place: `… is ELEMENT`",
        }.get(kind)
        raise self.wrong(operand, "a condition", span, *([fix] if fix else []))

    def set_of(self, operand: Operand, span: Span) -> SetOf:
        match operand:
            case SetOf():
                return operand
            case Absent():
                return SetOf(())
            case Items():
                ids = {number for item in operand.items for number in self.set_of(item, span).ids}
                return SetOf(tuple(sorted(ids)))
        raise self.wrong(operand, "a set of elements", span)

    def place(self, operand: Operand, span: Span) -> Place:
        if isinstance(operand, Place):
            return operand
        if isinstance(operand, Absent):
            raise Unresolved(operand.name)
        raise self.wrong(operand, "a neighbor", span, "such as `below`, `above.left`, or `at(2, -1)`")

    def value(self, operand: Operand, span: Span) -> Expr:
        """A runtime value or a number, as arithmetic and comparisons need."""
        match operand:
            case Expr():
                return operand
            case SetOf(_, None):
                return self.flag(operand, span)
            case SetOf() | Place() | PlaceChoice() | Absent():
                return self.of_kind(operand, ELEMENT, span)
        raise self.wrong(operand, "a value", span)

    def of_kind(self, operand: Operand, kind: Kind, span: Span) -> Expr:
        """A value of a kind, as arguments and fields need it. Constants out of its range are reported."""
        match kind.name, operand:
            case "flag", Expr(kind=Kind(name="number")) if operand.value in (0, 1):
                return Expr("const", FLAG, value=int(operand.value), span=span)
            case "flag", _:
                return self.flag(operand, span)
            case _, Absent():
                raise Unresolved(operand.name)
            case "element" | "direction", PlaceChoice():
                ways = (self.of_kind(operand.yes, kind, span), self.of_kind(operand.no, kind, span))
                return Expr("choose", kind, (operand.condition, *ways), span=span)
            case "element", Place():
                return look(ELEMENT_HERE, operand.offset, span)
            case "element", SetOf():
                if operand.name is None:
                    raise self.wrong(operand, "one element", span, "name the element itself")
                return Expr("const", ELEMENT, value=operand.ids[0], span=span)
            case "direction", Place():
                if operand.offset not in OCTANTS:
                    raise self.fail(
                        "PD401", "not a direction", span, "directions are those of the eight neighbors"
                    )
                return Expr("const", DIRECTION, value=OCTANTS.index(operand.offset), span=span)
        value = operand if kind.name in ("element", "direction") else self.value(operand, span)
        helps = _HELPS.get(kind.name, ())
        if isinstance(value, Expr):
            source = value.kind.name
            if source == "number" or (source == kind.name == "int" and value.op == "const"):
                return self._constant(Fraction(value.value), kind, span)
            if source == kind.name or (source == "real" and kind.name == "chance"):
                return value
            if kind.name == "real" and source == "draw" and value.op in ("add", "sub", "look"):
                # Draws plus integers are rounded after each operation.
                args = tuple(self.of_kind(arg, REAL, span) for arg in value.args)
                return Expr(value.op, REAL, args, value.value, span)
            if source in {"real": ("int", "chance", "draw", "flag"), "chance": ("int",)}.get(kind.name, ()):
                return Expr("to_real", REAL, (value,), span=span)
            helps = _integer_helps(value, span) if kind.name == "int" else helps
        raise self.wrong(value, "a number" if kind.name == "real" else _KINDS[kind.name], span, *helps)

    def _constant(self, value: Fraction, kind: Kind, span: Span) -> Expr:
        """A number written in a rule, as a constant of a kind."""
        match kind.name:
            case "vec2" if value == 0:
                zero = Expr("const", REAL, value=0.0, span=span)
                return Expr("vector", VEC2, (zero, zero), span=span)
            case "chance" if 0 <= value <= 1:
                return Expr("const", CHANCE, value=value, span=span)
            case "chance":
                fix = "write a chance from `0%` to `100%`"
                if 1 < value <= 100 and "%" not in span.text:
                    fix = f"did you mean `{float(value):g}%`?"
                message = f"a chance of {float(value * 100):g}%"
                raise self.fail("PD403", message, span, "chances are from 0% to 100%", fix)
            case "int" if value.denominator != 1:
                label = f"{float(value):g} is not an integer"
                fix = "write an integer; a field may also be declared as `real(LOW..HIGH)`"
                raise self.fail("PD401", "expected an integer", span, label, fix)
            case "int" | "real":
                if kind != REAL and not kind.lo <= value <= kind.hi:
                    label = f"the range is {kind.lo:g}..{kind.hi:g}"
                    fix = "write a number in this range, or widen its declaration"
                    raise self.fail("PD402", f"{float(value):g} is out of range {kind}", span, label, fix)
                if kind.name == "int":
                    whole = int(value)
                    return Expr("const", integer(whole, whole), value=whole, span=span)
                return Expr("const", REAL, value=float(value), span=span)
        raise self.wrong(number(value), _KINDS[kind.name], span, *_HELPS.get(kind.name, ()))

    def offset(self, offset: Offset, span: Span) -> Offset:
        if max(abs(offset[0]), abs(offset[1])) > MAX_OFFSET:
            label = f"an offset is at most {MAX_OFFSET} cells"
            raise self.fail("PD409", "the neighbor is too far away", span, label)
        return offset

    def check_range(self, value: Expr, span: Span) -> Expr:
        """An integer; reports a range that is too large."""
        most = max(abs(value.kind.lo), abs(value.kind.hi))
        if most > MAX_MAGNITUDE:
            raise self.fail("PD402", f"numbers up to {most:,}", span, f"the limit is {MAX_MAGNITUDE:,}")
        return value

    # Names

    def lookup(self, name: str, span: Span, scope: Scope, *, after_dot: bool = False) -> Operand:
        """The operand of a name. An unknown one is reported once, with all its places, by `report_unknown_names`."""
        operand = self.find(name, span, scope)
        if operand is not None:
            names, may_be_absent = self.symbols.names, span.source.text[span.end : span.end + 1] == "?"
            is_known = name in scope.locals or names.knows(scope.pack, names.of(scope.pack, name))
            if not is_known and not may_be_absent:
                self.undeclared.setdefault((scope.pack, name), span)
            return operand
        if self.symbols.is_declared(name, scope.pack):
            raise Poisoned  # mistakes in its declaration have been reported
        self.unknown.setdefault((name, after_dot), {})[span] = scope.locals
        self.reporter.reports += 1
        raise Poisoned

    def find(self, name: str, span: Span, scope: Scope) -> Operand | None:
        """The operand of a name, or None if there is none."""
        symbols = self.symbols
        self.used.add(name)
        if name in scope.locals:
            return self.turn(scope.locals[name], scope)
        param = symbols.params.get(name) or symbols.params.get(f"{scope.pack}.{name}")
        if param is not None:  # a name that hides no other that its pack knows
            self.used.add(param.name)
            return Expr("param", param.kind, value=param.name, span=span)
        name = symbols.names.of(scope.pack, name)
        self.used.add(name)
        if name in self.sets and name not in symbols.constants:
            return self.resolve_set(name, span)
        if name in symbols.constants:
            if symbols.constants[name] == SetOf(()):
                self.empty.add(name)
            return self.turn(symbols.constants[name], scope)
        for op, table in (("property", symbols.properties), ("field", symbols.fields)):
            if name in table:
                return Expr(op, table[name].kind, value=name, span=span)
        if name in symbols.streams:
            return Expr("draw", DRAW, value=name, span=span)
        if scope.pack:
            return None
        # Outside of packs, such as in a task, a parameter that only one pack has may be written without it.
        ends = [qualified for qualified in symbols.params if qualified.endswith(f".{name}")]
        if len(ends) != 1:
            return None
        return Expr("param", symbols.params[ends[0]].kind, value=ends[0], span=span)

    def is_new(self, name: Scalar | Syntax, scope: Scope) -> bool:
        """True if a local name is new. Reports reserved words, and names that hide one the pack can use."""
        names, word = self.symbols.names, name.text
        if not names.check_word(name, "anything"):
            return False
        other = scope.locals.get(word) or self.find(word, name.span, Scope(scope.pack, {}))
        if other is None or (
            word not in scope.locals and not names.knows(scope.pack, names.of(scope.pack, word))
        ):
            return True
        self.fail(
            "PD308",
            f"`{word}` is already defined here",
            name.span,
            "hides that definition",
            "choose another name",
        )
        return False

    def resolve_set(self, name: str, span: Span) -> Operand:
        if name in self.resolving:
            cycle = [*self.resolving[self.resolving.index(name) :], name]
            path = " -> ".join(f"`{set_name}`" for set_name in cycle)
            message = f"the set `{name}` is defined in terms of itself"
            raise self.fail("PD307", message, span, path, "list elements or tags")
        if len(self.resolving) >= MAX_SET_DEPTH:
            for waiting in self.resolving:
                self.symbols.constants[waiting] = Broken()
            if self._sets_too_deep:
                raise Poisoned
            self._sets_too_deep = True
            message = f"more than {MAX_SET_DEPTH} sets that depend on each other"
            raise self.fail("PD508", message, span, "too many in a row", "list elements or tags")
        decl = self.sets[name]
        self.resolving.append(name)
        try:
            members = self.evaluate(decl.members, Scope(decl.pack, {}))
            result = SetOf(self.set_of(members, decl.members.span).ids)
        finally:
            self.resolving.pop()
        self.symbols.constants[name] = result
        return result

    def turn(self, operand: Operand, scope: Scope) -> Operand:
        """The operand with its places and kernels turned by the scope's symmetry. Raises Poisoned if it is broken."""
        if isinstance(operand, Broken):
            raise Poisoned
        if scope.orientation == IDENTITY:
            return operand
        match operand:
            case Place():
                return Place(rotate(operand.offset, scope.orientation))
            case Items():
                return Items(tuple(self.turn(item, scope) for item in operand.items))
            case Kernel():
                weights = sorted((*rotate((dy, dx), scope.orientation), w) for dy, dx, w in operand.weights)
                return replace(operand, weights=tuple(weights))
        return operand

    # Names as written

    def name(self, syntax: Syntax, scope: Scope) -> Operand:
        word, span = syntax.text, syntax.span
        if word in COORDINATES:
            fix = f"write `{word} mod 2`: rules may depend on place and time only periodically"
            raise self.fail("PD406", f"`{word}` may only be used inside `mod`", span, "outside of `mod`", fix)
        if word in KERNEL_SHAPES and word not in KERNELS and self.find(word, span, scope) is None:
            label, fix = "its radius is missing", f"write `{word}(3)`"
            raise self.fail("PD406", f"`{word}` needs a radius", span, label, fix)
        if word in FUNCTIONS:
            fix = f"write `{FUNCTIONS[word].usage}`"
            raise self.fail("PD406", f"`{word}` is a function", span, "its values are missing", fix)
        return self.lookup(word, span, scope)

    def optional_name(self, syntax: Syntax, scope: Scope) -> Operand:
        operand = self.find(syntax.text, syntax.span, scope)
        if operand is None:
            self.absent.add(syntax.text)
            return Absent(syntax.text)
        return operand

    def attribute(self, syntax: Syntax, scope: Scope) -> Operand:
        """``place.name``, ``vector.row``, ``pack.name`` or ``place.pack.name``."""
        (before,) = syntax.children
        name, value = self._global_name(syntax), None
        if name and before.kind in ("name", "attribute") and not self._is_own_word(before, scope):
            value = self.find(name, syntax.span, Scope("", {}, scope.orientation))
            if value is not None and before.kind == "name":
                return value
            before = before.children[0] if value is not None else before
        base = self.evaluate(before, scope)
        word = Span(syntax.span.source, syntax.span.end - len(syntax.text), syntax.span.end)
        if isinstance(base, Absent):
            raise Unresolved(base.name)
        if isinstance(base, Expr) and base.kind.name == "vec2":
            if syntax.text in ("row", "column"):
                return Expr(f"{syntax.text}_part", REAL, (base,), span=syntax.span)
            message, fix = f"a vector does not have `{syntax.text}`", "parts of a vector: `.row`, `.column`"
            raise self.fail("PD301", message, word, "not a part of it", fix)
        if not isinstance(base, Place):
            raise self.wrong(base, "a neighbor before the dot", before.span, "such as `below.FIELD`")
        value = value or self.lookup(syntax.text, word, scope, after_dot=True)
        match value:
            case Place():
                return Place(self.offset(plus(base.offset, value.offset), syntax.span))
            case Expr():
                return look(value, self.offset(base.offset, syntax.span), syntax.span)
            case SetOf():
                message = f"`{syntax.text}` is not a field or property"
                label = f"this is {'an element' if value.name else 'a set of elements'}"
                raise self.fail("PD401", message, word, label, f"write `{before.span.text} is {syntax.text}`")
        raise self.wrong(value, "a field, property or neighbor after the dot", word)

    def _global_name(self, syntax: Syntax) -> str | None:
        """The global name of ``pack.name``; None if it names nothing."""
        (pack,) = syntax.children
        qualified = f"{pack.text}.{syntax.text}"
        if qualified in self.symbols.params:
            return qualified
        return self.symbols.names.known.get(qualified)

    def _is_own_word(self, word: Syntax, scope: Scope) -> bool:
        """True if a word before a dot is a place, a vector or a local name, not the name of a pack.

        Elements, tags and numbers have no attributes: `salt.salt` is the element of the pack `salt`.
        """
        operand = self.find(word.text, word.span, Scope("", scope.locals, scope.orientation))
        return word.text in scope.locals or isinstance(operand, Place) or kind_name(operand) == "vec2"

    def optional_attribute(self, syntax: Syntax, scope: Scope) -> Operand:
        """``pack.name?``, ``below.name?``: absent unless a loaded pack defines it."""
        try:
            return self.attribute(self.without_mark(syntax, scope), scope)
        except Unresolved as missing:
            self.absent.add(missing.name)
            return Absent(missing.name)

    def without_mark(self, syntax: Syntax, scope: Scope) -> Syntax:
        """An attribute without its question mark. Raises Unresolved if no loaded pack defines its name."""
        (before,) = syntax.children
        span = syntax.span
        if self._global_name(syntax) is None:
            if before.kind in ("name", "attribute"):
                operand = self.find(before.text, before.span, scope)
                if operand is None or isinstance(operand, SetOf):  # a pack with an element of its own name
                    raise Unresolved(f"{before.text}.{syntax.text}")
            if self.find(syntax.text, span, scope) is None:
                raise Unresolved(syntax.text)
        return replace(syntax, kind="attribute", span=Span(span.source, span.start, span.end - 1))

    # Literals and lists

    def tuple_(self, syntax: Syntax, scope: Scope) -> Operand:
        items = tuple(self.operands(syntax, scope))
        if all(isinstance(item, (SetOf, Absent)) for item in items):
            return self.set_of(Items(items), syntax.span)
        return Items(items)

    def any_but(self, syntax: Syntax, scope: Scope) -> Operand:
        left_out = self.set_of(self.evaluate(syntax.children[0], scope), syntax.children[0].span)
        return SetOf(tuple(i for i in self.symbols.names_by_id if i not in left_out.ids))

    # Logic

    def logic(self, syntax: Syntax, scope: Scope) -> Operand:
        if syntax.kind == "or_":
            self.check_alternatives(syntax, scope)
        operands = self.operands(syntax, scope)
        report_repeated(syntax.children, self.reporter)
        if all(isinstance(operand, (SetOf, Absent)) for operand in operands):
            sets = [set(self.set_of(operand, syntax.span).ids) for operand in operands]
            ids = sets[0] | sets[1] if syntax.kind == "or_" else sets[0] & sets[1]
            return SetOf(tuple(sorted(ids)))
        pairs = zip(operands, syntax.children, strict=True)
        flags = [self.flag(operand, child.span) for operand, child in pairs]
        return (disjunction if syntax.kind == "or_" else conjunction)(flags, syntax.span)

    def check_alternatives(self, syntax: Syntax, scope: Scope) -> None:
        """Report `PLACE is A or B`, which looks like one test of a place, although a bare `B` tests the cell itself."""
        choices = [syntax]
        while choices[0].kind == "or_":
            choices[:1] = choices[0].children
        for index, test in enumerate(choices):
            if test.kind not in ("is_", "is_not") or test.children[0].text == "here":
                continue
            others = list(takewhile(lambda choice: self.is_set(choice, scope), choices[index + 1 :]))
            if not others or not self.is_set(test.children[1], scope):
                continue
            if ")" in test.span.source.text[test.span.end : others[0].span.start]:
                continue
            place, first = (child.span.text for child in test.children)
            names = [first.strip("()"), *(other.span.text for other in others)]
            words = "is not" if test.kind == "is_not" else "is"
            raise self.fail(
                "PD410",
                f"`{names[-1]}` is not part of the test of `{place}`",
                Span(test.span.source, test.span.start, others[-1].span.end),
                f"as written, `{names[-1]}` tests the cell itself",
                f"write `{place} {words} ({', '.join(names)})`, or `({test.span.text}) or {' or '.join(names[1:])}`",
            )

    def is_set(self, syntax: Syntax, scope: Scope) -> bool:
        """True for the name of an element, tag or set, and for a list of such names."""
        if syntax.kind == "tuple":
            return all(self.is_set(child, scope) for child in syntax.children)
        named = syntax.kind in ("name", "optional_name")
        return named and isinstance(self.find(syntax.text, syntax.span, scope), SetOf)

    def compare(self, syntax: Syntax, scope: Scope) -> Operand:
        operands = self.operands(syntax, scope)
        report_repeated(syntax.children, self.reporter)
        kinds = {kind_name(operand) or type(operand) for operand in operands}
        values: list[tuple[Expr, Span]] = []
        for operand, child in zip(operands, syntax.children, strict=True):
            is_set = isinstance(operand, Items) or (isinstance(operand, SetOf) and operand.name is None)
            if is_set and not kinds.isdisjoint(("element", Place)):
                # `below == fluid` would compare two conditions; `below is fluid` is meant.
                fix = "write `is` or `is not` instead of `==` or `!=`"
                raise self.wrong(operand, "one element to compare with", child.span, fix)
            if "direction" in kinds and isinstance(operand, (Place, PlaceChoice)):
                operand = self.of_kind(operand, DIRECTION, child.span)
            values.append((self.value(operand, child.span), child.span))
        parts = [
            compare(self, sign, left, right, left[1].to(right[1]))
            for sign, (left, right) in zip(syntax.text.split(), pairwise(values), strict=True)
        ]
        return conjunction(parts, syntax.span)

    def is_(self, syntax: Syntax, scope: Scope) -> Operand:
        left, right = self.operands(syntax, scope)
        result = membership(self, left, right, syntax)
        return result if syntax.kind in ("is_", "in_") else negation(result, syntax.span)

    def choose(self, syntax: Syntax, scope: Scope) -> Operand:
        yes, condition, no = syntax.children
        report_repeated((yes, no), self.reporter)
        chosen = self.condition(condition, scope)
        if chosen in (TRUE, FALSE):
            return self.evaluate(yes if chosen == TRUE else no, scope)
        first, second = self.evaluate(yes, scope), self.evaluate(no, scope)
        return choose(self, chosen, (first, yes.span), (second, no.span), syntax.span)

    def quantifier(self, syntax: Syntax, scope: Scope) -> Operand:
        body, binding = syntax.children
        flags = [self.condition(body, inner) for inner in self.bindings((binding,), scope)]
        return (disjunction if syntax.kind == "any_of" else conjunction)(flags, syntax.span)

    def bindings(self, bindings: tuple[Syntax, ...], scope: Scope) -> list[Scope]:
        """The scopes of a loop's iterations; the first variable changes slowest."""
        domains: dict[str, list[Operand]] = {}
        for binding in bindings:
            variable, domain = binding.children
            if not self.is_new(variable, scope.bind(**dict.fromkeys(domains, Broken()))):
                raise Poisoned
            self.used.add(variable.text)
            # A variable is turned only where it is used.
            domains[variable.text] = self.domain(domain, replace(scope, orientation=IDENTITY))
        rounds = prod(len(domain) for domain in domains.values())
        if rounds > MAX_ROUNDS:
            raise self._too_long(rounds, bindings[0].span.to(bindings[-1].span), f"{MAX_ROUNDS:,}")
        choices = product(*domains.values())
        return [scope.bind(**dict(zip(domains, values, strict=True))) for values in choices]

    def _too_long(self, rounds: int, span: Span, limit: str) -> Poisoned:
        label, fix = f"the limit is {limit}", "loop over fewer things"
        return self.fail("PD508", f"a loop of {rounds:,} iterations", span, label, fix)

    def domain(self, syntax: Syntax, scope: Scope) -> list[Operand]:
        operand = self.evaluate(syntax, scope)
        match operand:
            case Bounds():
                rounds = operand.hi - operand.lo + 1
                if rounds > 64:
                    raise self._too_long(rounds, syntax.span, "64")
                return [number(i) for i in range(operand.lo, operand.hi + 1)]
            case SetOf():
                ids = sorted(operand.ids, key=self.symbols.order.__getitem__)
                return [SetOf((i,), self.symbols.names_by_id[i]) for i in ids]
            case Items():
                return list(operand.items)
            case Absent():
                return []
        fix = "such as `0..4`, a tag, or `(left, right)`"
        raise self.wrong(operand, "a range, a set or a list", syntax.span, fix)

    def chance_draw(self, stream: str, syntax: Syntax, scope: Scope) -> Expr:
        """`with chance P`: a draw from the rule's own stream is below P."""
        span = syntax.span
        threshold = self.of_kind(self.evaluate(syntax, scope), CHANCE, span)
        draw = Expr("draw", DRAW, value=stream, span=span)
        return compare(self, "<", (draw, span), (threshold, span), span)


def _integer_helps(value: Expr, span: Span) -> tuple[str, ...]:
    """The fix for a float where an integer is needed."""
    if value.kind.name != "real":
        return ()
    declared = "or declare the target as `real(LOW..HIGH)`"
    if all(arg.op in ("to_real", "const") for arg in value.args):
        if quotient := re.fullmatch(r"([^/]+?) */ *([^/]+)", span.text):
            return (f"integer division rounds down: `{quotient[1]} div {quotient[2]}`", declared)
        if scaled := re.fullmatch(r"([^*]+?) *[*] *([0-9]*[.][0-9]+)", span.text):
            ratio = Fraction(scaled[2])
            times = f" * {ratio.numerator}" if ratio.numerator > 1 else ""
            return (f"write it with integers: `{scaled[1]}{times} div {ratio.denominator}`", declared)
    return ("`a div b` divides integers and rounds down", declared)


HANDLERS: dict[str, Callable[[Typer, Syntax, Scope], Operand]] = {
    "yes": lambda typer, syntax, scope: TRUE,
    "no": lambda typer, syntax, scope: FALSE,
    **dict.fromkeys(
        ("integer", "decimal", "percent"), lambda typer, syntax, scope: number(read_number(syntax, typer))
    ),
    "range": lambda typer, syntax, scope: Bounds(*read_bounds(syntax, typer)),
    "any": lambda typer, syntax, scope: SetOf(tuple(typer.symbols.names_by_id)),
    "not_": lambda typer, syntax, scope: negation(typer.condition(syntax.children[0], scope), syntax.span),
    "name": Typer.name,
    "optional_name": Typer.optional_name,
    "attribute": Typer.attribute,
    "optional_attribute": Typer.optional_attribute,
    "tuple": Typer.tuple_,
    "any_but": Typer.any_but,
    **dict.fromkeys(("or_", "and_"), Typer.logic),
    "compare": Typer.compare,
    **dict.fromkeys(("is_", "is_not", "in_", "not_in"), Typer.is_),
    "choose": Typer.choose,
    **dict.fromkeys(("any_of", "all_of"), Typer.quantifier),
    "call": call,
    **dict.fromkeys(("add", "sub", "mul", "div", "quotient", "neg"), calculation),
    "mod": modulo,
}
"""The function that evaluates each kind of syntax node."""
