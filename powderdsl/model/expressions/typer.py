"""Syntax of one expression -> operand: names looked up, kinds checked, constants folded."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from itertools import product
from math import prod

from powderdsl.diagnostics import Reporter, Span
from powderdsl.model.builtins import COORDINATES, FUNCTIONS, KERNEL_SHAPES, KERNELS
from powderdsl.model.expressions import arithmetic
from powderdsl.model.expressions.calls import call
from powderdsl.model.expressions.literals import read_bounds, read_number
from powderdsl.model.expressions.membership import holds
from powderdsl.model.expressions.operands import (
    FALSE,
    TRUE,
    Absent,
    Bounds,
    Broken,
    Coercer,
    Items,
    Number,
    Operand,
    Place,
    Poisoned,
    SetOf,
    Unresolved,
    conjunction,
    disjunction,
    look,
    negation,
)
from powderdsl.model.expressions.qualified import is_own_word, of_pack, optional_attribute
from powderdsl.model.expressions.scope import IDENTITY, Scope, turned
from powderdsl.model.expressions.symbols import Symbols
from powderdsl.model.expressions.unknown import UnknownNames
from powderdsl.model.logic.needless import report_repeated
from powderdsl.model.types import CHANCE, DIRECTION, DRAW, ELEMENT, FLAG, Expr, Kernel
from powderdsl.syntax.ast import Syntax

MAX_ROUNDS = 4096
"""Rounds of one loop over several variables."""

MAX_RULE_WORK = 5_000
"""Parts of expressions that one rule may come to, quantifiers written out."""

MAX_WORK = 60_000
"""Parts of expressions that all rules may come to: a second or two."""

MAX_SET_DEPTH = 24
"""How many sets may be defined by each other in a row."""


class Typer(Coercer):
    """Checks expressions against the symbols of a composition."""

    def __init__(self, symbols: Symbols, reporter: Reporter):
        super().__init__(reporter)
        self.symbols = symbols
        self.used: set[str] = set()
        self.absent: set[str] = set()
        self.empty: set[str] = set()
        """Tags and sets without elements that the rule asks for."""
        self.set_definitions: dict[str, tuple[str, Syntax]] = {}
        self.resolving: list[str] = []
        self.unknown = UnknownNames(symbols, reporter)
        self._sets_too_deep = False
        self._work = self._rule_start = 0
        self._rule_span: Span | None = None

    def evaluate(self, syntax: Syntax, scope: Scope) -> Operand:
        """What the syntax stands for. Raises Poisoned after reporting, Unresolved if it depends on an absent name."""
        self._work += 1
        if self._work > MAX_WORK + 1:
            raise Poisoned  # that has been said, and is true of all that follows
        if self._work - self._rule_start > MAX_RULE_WORK or self._work > MAX_WORK:
            self._rule_start = self._work  # once for a rule is enough
            raise self.fail(
                "PD508", "a rule that expands to too much" if self._work <= MAX_WORK else "rules that expand to too much",
                self._rule_span or syntax.span, "written out, it has thousands of parts",
                "loop over fewer things, or name parts under `let:`")  # fmt: skip
        return HANDLERS[syntax.kind](self, syntax, scope)

    def start_rule(self, span: Span) -> None:
        """From here on the work of the rule or value at `span` is counted."""
        self._rule_start, self._rule_span = self._work, span
        self.empty.clear()

    def condition(self, syntax: Syntax, scope: Scope) -> Expr:
        return self.flag(self.evaluate(syntax, scope), syntax.span)

    # Names

    def lookup(self, name: str, span: Span, scope: Scope, *, after_dot: bool = False) -> Operand:
        """The operand of a name. An unknown one is reported once, with all its places, by `unknown.report`."""
        found = self.find(name, span, scope)
        if found is not None:
            return found
        if self.symbols.is_declared(name, scope.pack):
            raise Poisoned  # what is wrong with its declaration has been reported
        self.unknown.add(name, span, scope.locals, after_dot=after_dot)
        raise Poisoned

    def find(self, name: str, span: Span, scope: Scope) -> Operand | None:
        """The operand of a name, or None if there is none."""
        symbols = self.symbols
        self.used.add(name)
        if name in scope.locals:
            if isinstance(scope.locals[name], Broken):
                raise Poisoned
            return self.turn(scope.locals[name], scope)
        param = symbols.params.get(f"{scope.pack}.{name}")
        if param is not None:  # a name that hides no other that its pack knows
            self.used.add(param.name)
            return Expr("param", param.kind, value=param.name, span=span)
        name = symbols.composition.names.of(scope.pack, name)
        self.used.add(name)
        if name in self.set_definitions and name not in symbols.constants:
            return self.resolve_set(name, span)
        if name in symbols.constants:
            if isinstance(symbols.constants[name], Broken):
                raise Poisoned
            constant = symbols.constants[name]
            if isinstance(constant, SetOf) and not constant.ids:
                self.empty.add(name)
            return self.turn(constant, scope)
        if name in symbols.properties:
            return Expr("property", symbols.properties[name].kind, value=name, span=span)
        if name in symbols.fields:
            return Expr("field", symbols.fields[name].kind, value=name, span=span)
        if name in symbols.streams:
            return Expr("draw", DRAW, value=name, span=span)
        return None

    def hides(self, name: str, span: Span, scope: Scope) -> bool:
        """Whether a new local name would hide one that its pack knows. What strangers' packs define may be hidden."""
        if name in scope.locals:
            return True
        found = self.find(name, span, Scope(scope.pack, {}))
        names = self.symbols.composition.names
        return found is not None and names.knows(scope.pack, names.of(scope.pack, name))

    def resolve_set(self, name: str, span: Span) -> Operand:
        if name in self.resolving:
            path = " -> ".join(
                f"`{other}`" for other in [*self.resolving[self.resolving.index(name) :], name]
            )
            raise self.fail(
                "PD307", f"the set `{name}` is defined by itself", span, path, "list elements or tags"
            )
        if len(self.resolving) >= MAX_SET_DEPTH:
            for waiting in self.resolving:
                self.symbols.constants[waiting] = Broken()
            if self._sets_too_deep:
                raise Poisoned
            self._sets_too_deep = True
            raise self.fail(
                "PD508", f"more than {MAX_SET_DEPTH} sets that depend on each other", span, "too many in a row",
                "list elements or tags")  # fmt: skip
        pack, syntax = self.set_definitions[name]
        self.resolving.append(name)
        try:
            result = self.set_of(self.evaluate(syntax, Scope(pack, {})), syntax.span)
        finally:
            self.resolving.pop()
        result = SetOf(result.ids)
        self.symbols.constants[name] = result
        return result

    def turn(self, operand: Operand, scope: Scope) -> Operand:
        """Places and kernels as the scope's symmetry turns them."""
        if scope.orientation == IDENTITY:
            return operand
        match operand:
            case Place():
                return Place(turned(operand.offset, scope.orientation))
            case Items():
                return Items(tuple(self.turn(item, scope) for item in operand.items))
            case Kernel():
                weights = sorted((*turned((dy, dx), scope.orientation), w) for dy, dx, w in operand.weights)
                return replace(operand, weights=tuple(weights))
        return operand

    def name(self, syntax: Syntax, scope: Scope) -> Operand:
        if syntax.text in COORDINATES:
            raise self.fail(
                "PD406",
                f"`{syntax.text}` stands without `mod`",
                syntax.span,
                "endless by itself",
                f"write `{syntax.text} mod 2`: rules are the same everywhere and always, up to a pattern",
            )
        shape = syntax.text in KERNEL_SHAPES and syntax.text not in KERNELS
        if shape and self.find(syntax.text, syntax.span, scope) is None:
            label, fix = "its radius is missing", (f"write `{syntax.text}(3)`",)
            raise self.fail("PD406", f"`{syntax.text}` needs a radius", syntax.span, label, *fix)
        if syntax.text in FUNCTIONS:
            raise self.fail(
                "PD406",
                f"`{syntax.text}` is a function",
                syntax.span,
                "its values are missing",
                f"write `{FUNCTIONS[syntax.text].signature}`",
            )
        return self.lookup(syntax.text, syntax.span, scope)

    def optional_name(self, syntax: Syntax, scope: Scope) -> Operand:
        found = self.find(syntax.text, syntax.span, scope)
        if found is None:
            self.absent.add(syntax.text)
            return Absent(syntax.text)
        return found

    def attribute(self, syntax: Syntax, scope: Scope) -> Operand:
        base_syntax = syntax.children[0]
        if base_syntax.kind == "name":
            qualified = f"{base_syntax.text}.{syntax.text}"
            if qualified in self.symbols.params and not is_own_word(self, base_syntax, scope):
                self.used.add(qualified)
                param = self.symbols.params[qualified]
                return Expr("param", param.kind, value=qualified, span=syntax.span)
        own = of_pack(self, syntax, scope)
        if own is not None:
            return own
        base = self.evaluate(base_syntax, scope)
        word = Span(syntax.span.source, syntax.span.end - len(syntax.text), syntax.span.end)
        if isinstance(base, Absent):
            raise Unresolved(base.name)
        if isinstance(base, Expr) and base.kind.name == "vec2":
            if syntax.text in ("row", "column"):
                return arithmetic.part(base, syntax.text, syntax.span)
            raise self.fail(
                "PD301",
                f"a vector has no `{syntax.text}`",
                word,
                "not a part of it",
                "parts of a vector: `.row`, `.column`",
            )
        if not isinstance(base, Place):
            raise self.wrong(base, "a neighbor before the dot", base_syntax.span, "such as `below.FIELD`")
        value = self.lookup(syntax.text, word, scope, after_dot=True)
        match value:
            case Place():
                offset = (base.offset[0] + value.offset[0], base.offset[1] + value.offset[1])
                return Place(self.offset(offset, syntax.span))
            case Expr():
                return look(value, self.offset(base.offset, syntax.span), syntax.span)
            case SetOf():
                text = f"{base_syntax.span.text} is {syntax.text}"
                raise self.fail(
                    "PD401",
                    f"`{syntax.text}` is not a field or property",
                    word,
                    f"this is {'an element' if value.name else 'a set of elements'}",
                    f"write `{text}`",
                )
        raise self.wrong(value, "a field, property or neighbor after the dot", word)

    # Literals and lists

    def number(self, syntax: Syntax, scope: Scope) -> Operand:
        return Number(read_number(syntax, self))

    def truth(self, syntax: Syntax, scope: Scope) -> Operand:
        return TRUE if syntax.kind == "yes" else FALSE

    def range_(self, syntax: Syntax, scope: Scope) -> Operand:
        return Bounds(*read_bounds(syntax, self))

    def tuple_(self, syntax: Syntax, scope: Scope) -> Operand:
        items = tuple(self.evaluate(child, scope) for child in syntax.children)
        if all(isinstance(item, (SetOf, Absent)) for item in items):
            return self.set_of(Items(items), syntax.span)
        return Items(items)

    def any_(self, syntax: Syntax, scope: Scope) -> Operand:
        return SetOf(self.symbols.ids)

    def any_but(self, syntax: Syntax, scope: Scope) -> Operand:
        left_out = self.set_of(self.evaluate(syntax.children[0], scope), syntax.children[0].span)
        return SetOf(tuple(i for i in self.symbols.ids if i not in left_out.ids))

    # Logic

    def logic(self, syntax: Syntax, scope: Scope) -> Operand:
        operands = [self.evaluate(child, scope) for child in syntax.children]
        report_repeated(syntax.children, self.reporter)
        if all(isinstance(operand, (SetOf, Absent)) for operand in operands):
            sets = [set(self.set_of(operand, syntax.span).ids) for operand in operands]
            ids = sets[0] | sets[1] if syntax.kind == "or_" else sets[0] & sets[1]
            return SetOf(tuple(sorted(ids)))
        flags = [
            self.flag(operand, child.span) for operand, child in zip(operands, syntax.children, strict=True)
        ]
        return (disjunction if syntax.kind == "or_" else conjunction)(flags, syntax.span)

    def not_(self, syntax: Syntax, scope: Scope) -> Operand:
        return negation(self.condition(syntax.children[0], scope), syntax.span)

    def compare(self, syntax: Syntax, scope: Scope) -> Operand:
        operands = [self.evaluate(child, scope) for child in syntax.children]
        report_repeated(syntax.children, self.reporter)
        self._no_sets(operands, syntax)
        headings = any(isinstance(operand, Expr) and operand.kind == DIRECTION for operand in operands)
        values = [
            self.direction(operand, child.span)
            if headings and isinstance(operand, Place)
            else self.value(operand, child.span)
            for operand, child in zip(operands, syntax.children, strict=True)
        ]
        parts = []
        for i, operator in enumerate(syntax.text.split()):
            span = syntax.children[i].span.to(syntax.children[i + 1].span)
            places = (syntax.children[i].span, syntax.children[i + 1].span)
            parts.append(arithmetic.compare(self, operator, values[i], values[i + 1], span, places))
        return conjunction(parts, syntax.span)

    def _no_sets(self, operands: list[Operand], syntax: Syntax) -> None:
        """`below == fluid` would ask whether the two hold alike; what is meant is `below is fluid`."""
        places = any(
            isinstance(operand, Place) or (isinstance(operand, Expr) and operand.kind == ELEMENT)
            for operand in operands
        )
        for operand, child in zip(operands, syntax.children, strict=True):
            if places and isinstance(operand, (SetOf, Items)) and getattr(operand, "name", None) is None:
                fix = "write `is` or `is not` instead of `==` or `!=`"
                raise self.wrong(operand, "one element to compare with", child.span, fix)

    def is_(self, syntax: Syntax, scope: Scope) -> Operand:
        positive = syntax.kind in ("is_", "in_")
        left, right = (self.evaluate(child, scope) for child in syntax.children)
        result = holds(self, left, right, syntax)
        return result if positive else negation(result, syntax.span)

    def choose(self, syntax: Syntax, scope: Scope) -> Operand:
        yes, condition, no = syntax.children
        report_repeated((yes, no), self.reporter)
        chosen = self.condition(condition, scope)
        if chosen in (TRUE, FALSE):
            return self.evaluate(yes if chosen == TRUE else no, scope)
        first, second = self.evaluate(yes, scope), self.evaluate(no, scope)
        return arithmetic.choose(self, chosen, (first, yes.span), (second, no.span), syntax.span)

    def quantifier(self, syntax: Syntax, scope: Scope) -> Operand:
        body, binding = syntax.children
        flags = [self.condition(body, inner) for inner in self.bindings((binding,), scope)]
        return (disjunction if syntax.kind == "any_of" else conjunction)(flags, syntax.span)

    def bindings(self, bindings: tuple[Syntax, ...], scope: Scope) -> list[Scope]:
        """The scopes of a loop's rounds: the first variable turns slowest."""
        domains: list[list[tuple[str, Operand]]] = []
        for binding in bindings:
            variable, domain = binding.children
            if self.hides(variable.text, variable.span, scope) or any(
                d and d[0][0] == variable.text for d in domains
            ):
                raise self.fail(
                    "PD308",
                    f"`{variable.text}` already means something here",
                    variable.span,
                    "hides the other meaning",
                    "choose another name",
                )
            self.used.add(variable.text)
            straight = replace(
                scope, orientation=IDENTITY
            )  # a variable is turned where it is used, and only there
            domains.append([(variable.text, value) for value in self.domain(domain, straight)])
        rounds = prod(len(domain) for domain in domains)
        if rounds > MAX_ROUNDS:
            place = bindings[0].span.to(bindings[-1].span)
            raise self.fail(
                "PD508",
                f"a loop of {rounds:,} rounds",
                place,
                f"the limit is {MAX_ROUNDS:,}",
                "loop over fewer things",
            )
        return [scope.bind(**dict(choice)) for choice in product(*domains)]

    def domain(self, syntax: Syntax, scope: Scope) -> list[Operand]:
        operand = self.evaluate(syntax, scope)
        match operand:
            case Bounds():
                if operand.hi - operand.lo >= 64:
                    raise self.fail(
                        "PD508",
                        f"a loop of {operand.hi - operand.lo + 1:,} rounds",
                        syntax.span,
                        "the limit is 64",
                        "loop over fewer things",
                    )
                return [Number(Fraction(i)) for i in range(operand.lo, operand.hi + 1)]
            case SetOf():
                composition = self.symbols.composition
                names = {element.id: name for name, element in composition.elements.items()}
                ids = sorted(operand.ids, key=composition.order.__getitem__)
                return [SetOf((i,), names[i]) for i in ids]
            case Items():
                return list(operand.items)
            case Absent():
                return []
        raise self.wrong(
            operand, "a range, a set or a list", syntax.span, "such as `0..4`, a tag, or `(left, right)`"
        )

    def binary(self, syntax: Syntax, scope: Scope) -> Operand:
        left, right = (self.value(self.evaluate(child, scope), child.span) for child in syntax.children)
        return arithmetic.binary(self, syntax.kind, left, right, syntax)

    def negate(self, syntax: Syntax, scope: Scope) -> Operand:
        value = self.value(self.evaluate(syntax.children[0], scope), syntax.children[0].span)
        return arithmetic.negate(self, value, syntax.span)

    def chance_draw(self, stream: str, syntax: Syntax, scope: Scope) -> Expr:
        """`with chance P`: a draw of the rule's own stream below P."""
        threshold = self.chance(self.evaluate(syntax, scope), syntax.span)
        draw = Expr("draw", DRAW, value=stream, span=syntax.span)
        if threshold.kind == CHANCE:
            return arithmetic.compare(self, "<", draw, threshold, syntax.span)
        return Expr("lt", FLAG, (Expr("to_real", threshold.kind, (draw,)), threshold), span=syntax.span)


HANDLERS: dict[str, Callable[[Typer, Syntax, Scope], Operand]] = {
    "name": Typer.name,
    "optional_name": Typer.optional_name,
    "attribute": Typer.attribute,
    "optional_attribute": optional_attribute,
    "integer": Typer.number,
    "decimal": Typer.number,
    "percent": Typer.number,
    "yes": Typer.truth,
    "no": Typer.truth,
    "range": Typer.range_,
    "tuple": Typer.tuple_,
    "any": Typer.any_,
    "any_but": Typer.any_but,
    "or_": Typer.logic,
    "and_": Typer.logic,
    "not_": Typer.not_,
    "compare": Typer.compare,
    "is_": Typer.is_,
    "is_not": Typer.is_,
    "in_": Typer.is_,
    "not_in": Typer.is_,
    "choose": Typer.choose,
    "any_of": Typer.quantifier,
    "all_of": Typer.quantifier,
    "call": call,
    "add": Typer.binary,
    "subtract": Typer.binary,
    "multiply": Typer.binary,
    "divide": Typer.binary,
    "negate": Typer.negate,
    "quotient": arithmetic.quotient,
    "mod": arithmetic.modulo,
}
"""One handler for every kind of syntax node that can stand in an expression."""
