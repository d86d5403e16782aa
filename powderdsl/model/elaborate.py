"""Passes as written -> passes of the checked model: loops unrolled, symmetries written out, every rule typed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial

from powderdsl.diagnostics import Span, suggest
from powderdsl.model.builtins import DIRECTION_SETS, DIRECTIONS
from powderdsl.model.declarations import Block, PassDecl, ScratchDecl
from powderdsl.model.expressions.operators import (
    FALSE,
    IDENTITY,
    TRUE,
    Absent,
    Broken,
    Matrix,
    Operand,
    Place,
    Poisoned,
    Scope,
    SetOf,
    Unresolved,
    conjunction,
    kind_name,
    rotate,
)
from powderdsl.model.expressions.symbols import default_of, read_kind
from powderdsl.model.expressions.typer import Typer
from powderdsl.model.types import (
    ELEMENT,
    REAL,
    VEC2,
    Assign,
    Expr,
    Field,
    Kind,
    Let,
    Move,
    Offset,
    Pass,
    Rule,
    Stream,
    Substep,
    Swap,
    Transform,
)
from powderdsl.syntax.parse import Syntax
from powderdsl.system.random import name_number

MAX_SUBSTEPS = 1000
MAX_RULES = 5000
MAX_TRIED = 4 * MAX_RULES
"""Rules, with all their copies, and loops, including wrong, inactive and repeated ones."""

_QUARTERS: tuple[Matrix, ...] = (IDENTITY, ((0, 1), (-1, 0)), ((-1, 0), (0, -1)), ((0, -1), (1, 0)))
_MIRRORED: tuple[Matrix, ...] = tuple((rows, (-a, -b)) for rows, (a, b) in _QUARTERS)

ORIENTATIONS: dict[str | None, tuple[Matrix, ...]] = {
    None: (IDENTITY,),
    "mirror": (IDENTITY, _MIRRORED[0]),
    "rotations": _QUARTERS,
    "all": _QUARTERS + _MIRRORED,
}
"""The orientations in which a rule under `symmetry:` holds."""


class Elaborator:
    """Turns declared passes into checked ones, in order, and collects facts about rules for later checks."""

    def __init__(self, typer: Typer):
        self.typer = typer
        self.passes: list[Pass] = []
        self.streams: dict[str, Stream] = {}
        self.overridden: set[str] = set()
        self.inactive: dict[Span, str] = {}
        """Rules with a copy that needs a name that is not loaded, and that name."""
        self.empty: dict[Span, str] = {}
        """Rules that read an empty set or tag, and its name."""
        self.active: set[Span] = set()
        """Rules with a copy whose names are all loaded."""
        self._rules = self._tried = 0

    def run(self, passes: Mapping[str, PassDecl]) -> None:
        collected = [(self, name, 0) for name in ("streams", "overridden", "inactive", "empty", "active")]
        effects = (*collected, (self, "_rules", MAX_RULES), (self, "_tried", MAX_TRIED))
        for name, decl in passes.items():
            with suppress(Poisoned):
                run = partial(self._pass, name, decl)
                self.passes.append(self.typer.reuse.of(decl.span, name, self.typer, run, *effects))
        for span, name in self.inactive.items():
            if span not in self.active:
                helps = [f"it becomes active with a pack that defines `{name}`"]
                message = f"this rule is inactive: `{name}` is not loaded"
                self.typer.reporter.report("PD506", message, span, "left out", helps=helps)

    def _pass(self, name: str, decl: PassDecl) -> Pass:
        self._name, self._decl = name, decl
        self._numbers: dict[int, int] = {}
        self._empty_lets: set[str] = set()
        self._lets: dict[str, int] = {}
        self._pending: list[Let] = []
        self._substeps: list[Substep] = []
        self._scratch: list[Field] = []
        for block in decl.walk():
            for rule in block.rules:
                self._numbers[id(rule)] = len(self._numbers)
        scope = Scope(decl.pack, {})
        for item in decl.scratch:
            scope = scope.bind(**{item.name.text: self._scratch_field(item, scope)})
        self._block(decl, scope, "", None, None)
        if self._pending:
            self._substeps.append(Substep(tuple(self._pending), (), "prove", ""))
        return Pass(name, decl.pack, tuple(self._scratch), tuple(self._substeps), decl.span)

    def _scratch_field(self, decl: ScratchDecl, scope: Scope) -> Operand:
        name, span = f"{self._name}.{decl.name.text}", decl.name.span
        if not self.typer.is_new(decl.name, scope) or decl.type is None:
            return Broken()
        try:
            kind = read_kind(decl.type, self.typer)
        except Poisoned:
            return Broken()
        default = default_of(kind, self.typer.symbols.first_id)
        self._scratch.append(Field(name, kind, default, "place", True, None, self._decl.pack, span))
        return Expr("field", kind, value=name, span=span)

    def _block(
        self, block: Block, scope: Scope, label: str, symmetry: str | None, policy: str | None
    ) -> None:
        if block.header is not None:
            self._spend(1, block.header.span)
        symmetry, policy = block.symmetry or symmetry, block.conflicts or policy
        for scalar, syntax in block.lets:
            is_new = self.typer.is_new(scalar, scope)
            scope = scope.bind(**{scalar.text: self._let(scalar.text, syntax, scope) if is_new else Broken()})
        rounds = self._rounds(block, scope, label)
        if rounds == [] and block.header is not None:
            self.typer.reporter.report(
                "PD506", "this loop has no iterations", block.header.span, "nothing to loop over",
                helps=["it becomes active with a pack that has such elements"],
            )  # fmt: skip
        for inner, inner_label in rounds:
            if block.rules:
                self._substep(block.rules, inner, inner_label, symmetry, policy)
            for child in block.blocks:
                self._block(child, inner, inner_label, symmetry, policy)
        for child in block.then:
            self._block(child, scope, label, symmetry, policy)

    def _rounds(self, block: Block, scope: Scope, label: str) -> list[tuple[Scope, str]]:
        header = block.header
        if header is None:
            return [(scope, label)]
        if header.kind == "repeat":
            rounds = int(header.text) if len(header.text) < 4 else 1000
            if not 1 <= rounds <= 64:
                fix = "write a number from 1 to 64; a `repeat` inside another multiplies"
                message, label = f"a loop of {header.text} rounds", "1 to 64 are possible"
                self.typer.fail("PD508", message, header.span, label, fix)
                return []
            return [(scope, f"{label}round {i + 1}") for i in range(rounds)]
        variables = [binding.children[0].text for binding in header.children]
        others = self.typer.used.intersection(variables)
        try:
            scopes = self.typer.bindings(header.children, scope)
        except (Poisoned, Unresolved):
            return []
        self.typer.used -= {*variables} - others
        labeled = []
        for inner in scopes:
            words = [f"{name} = {_name_of(inner.locals[name])}" for name in variables]
            labeled.append((inner, ", ".join([label, *words] if label else words)))
        return labeled

    def _let(self, name: str, syntax: Syntax, scope: Scope) -> Operand:
        self.typer.start_rule(syntax.span)
        try:
            operand = self.typer.evaluate(syntax, scope)
            if isinstance(operand, Place) or kind_name(operand) == "number":
                return operand
            value = self.typer.value(operand, syntax.span)
        except Poisoned:
            return Broken()
        except Unresolved as missing:
            return Absent(missing.name)
        finally:
            self._empty_lets |= self.typer.empty
        if value.op == "draw":
            return value  # a stream's draws are fixed for the whole step
        if value.kind.name in ("draw", "chance"):
            value = self.typer.of_kind(value, REAL, syntax.span)
        # Copies of a block define the same name again: each copy gets its own, which earlier rules do not read.
        count = self._lets.get(name, 0)
        self._lets[name] = count + 1
        unique = name if count == 0 else f"{name}#{count + 1}"
        self._pending.append(Let(unique, value, syntax.span))
        return Expr("let", value.kind, value=unique, span=syntax.span)

    def _substep(
        self, rules: tuple[Syntax, ...], scope: Scope, label: str, symmetry: str | None, policy: str | None
    ) -> None:
        self._label = label
        self._spend(len(rules) * len(ORIENTATIONS[symmetry]), rules[0].span)
        typed: list[Rule] = []
        for syntax in rules:
            copies: list[Rule] = []
            for matrix in ORIENTATIONS[symmetry]:
                rules_here = self._rule(syntax, replace(scope, orientation=matrix))
                copies += [rule for rule in rules_here if rule not in copies]
            typed += copies
        self._rules += len(typed)
        self._spend(0, rules[0].span)
        self._substeps.append(Substep(tuple(self._pending), tuple(typed), policy or "prove", label))
        self._pending = []

    def _spend(self, tries: int, span: Span) -> None:
        """Count rules and blocks. Raises Poisoned after reporting that loops unroll to too many."""
        self._tried += tries
        if self._tried > MAX_TRIED or self._rules > MAX_RULES or len(self._substeps) >= MAX_SUBSTEPS:
            message = f"loops unroll to more than {MAX_SUBSTEPS} substeps or {MAX_RULES} rules"
            raise self.typer.fail("PD508", message, span, "here", "loop over fewer things")

    # Rules

    def _rule(self, syntax: Syntax, scope: Scope) -> list[Rule]:
        self.typer.absent.clear()
        self.typer.start_rule(syntax.span)
        try:
            match syntax.kind:
                case "swap" | "move":
                    rules = [self._movement(syntax, scope)]
                case "transform":
                    who, target = syntax.children[:2]
                    mask = self._mask([who], syntax, scope)
                    value = self.typer.of_kind(self.typer.evaluate(target, scope), ELEMENT, target.span)
                    rules = [Transform(mask, value, self._effects(syntax, scope), syntax.span)]
                case "push":
                    rules = self._push(syntax, scope)
                case _:
                    rules = [self._update(syntax.children[0], scope, self._mask((), syntax, scope))]
        except Poisoned:
            self.active.add(syntax.span)
            return []
        except Unresolved as missing:
            self.inactive[syntax.span] = missing.name
            return []
        empty = self.typer.empty | self._empty_lets
        if empty:
            self.empty[syntax.span] = min(empty)
        rules = [rule for rule in rules if not (rule.mask == FALSE and self.typer.absent)]
        if rules:
            self.active.add(syntax.span)
        else:
            self.inactive[syntax.span] = ", ".join(sorted(self.typer.absent))
        return rules

    def _mask(self, subjects: Sequence[Syntax], syntax: Syntax, scope: Scope) -> Expr:
        """The condition of a rule: its subjects and its clauses."""
        parts = [self.typer.condition(subject, scope) for subject in subjects]
        for kind in ("condition", "where"):
            if clause := syntax.child(kind):
                parts.append(self.typer.condition(clause.children[0], scope))
        if clause := syntax.child("chance"):
            # Named by the rule's location, not by the number of rules before it, so that other packs shift nothing.
            label = f"[{self._label}]" if self._label else ""
            name = f"{self._decl.qualified}#{self._numbers[id(syntax)]}{label}"
            self.streams[name] = Stream(name, name_number(name), 32)
            parts.append(self.typer.chance_draw(name, clause.children[0], scope))
        return conjunction(parts, syntax.span)

    def _movement(self, syntax: Syntax, scope: Scope) -> Rule:
        who, where = syntax.children[:2]
        subjects = who.children if syntax.kind == "swap" else (who,)
        place = self.typer.place(self.typer.evaluate(where, scope), where.span)
        if place.offset == (0, 0):
            raise self.typer.fail("PD401", "a cell cannot move to itself", where.span, "expected a neighbor")
        offset = self.typer.offset(place.offset, where.span)
        mask = self._mask(subjects, syntax, scope)
        if syntax.kind == "swap":
            return Swap(mask, offset, self._effects(syntax, scope), syntax.span)
        leaving = syntax.children[2]
        behind, left = self.typer.evaluate(leaving, scope), None
        if isinstance(behind, Place):
            if behind.offset != offset:
                fix = f"write `leaving {where.span.text}`, or name an element"
                message, label = "the element left behind was there", "another place than the target"
                raise self.typer.fail("PD405", message, leaving.span, label, fix)
        else:
            left = self.typer.of_kind(behind, ELEMENT, leaving.span)
            if left.op != "const":
                message = "what is left behind must be one element"
                raise self.typer.fail("PD405", message, leaving.span, "name it")
        return Move(mask, offset, left, self._effects(syntax, scope), syntax.span)

    def _effects(self, syntax: Syntax, scope: Scope) -> tuple[Assign, ...]:
        clause = syntax.child("then")
        return tuple([self._update(update, scope, TRUE) for update in clause.children]) if clause else ()

    def _update(self, syntax: Syntax, scope: Scope, mask: Expr) -> Assign:
        target, value = syntax.children
        name, kind, offset = self._target(target, scope)
        operand = self.typer.evaluate(value, scope)
        if syntax.text == ":=":
            expr = self.typer.of_kind(operand, kind, value.span)
            if kind.name == "int" and (expr.kind.lo < kind.lo or expr.kind.hi > kind.hi):
                message = f"a value of {expr.kind} is assigned to `{name}`, whose range is {kind}"
                helps = [f"widen the field, or write `clamp(…, {kind.lo:g}, {kind.hi:g})`"]
                label = "it is clamped to the range"
                self.typer.reporter.report("PD408", message, value.span, label, helps=helps)
        elif kind.name in ("int", "real", "vec2"):
            expr = self.typer.of_kind(operand, Kind(kind.name, -1e6, 1e6), value.span)
        else:
            message, label = f"`{syntax.text}` needs a number", f"`{name}` is a {kind}"
            raise self.typer.fail("PD407", message, syntax.span, label, "assign with `:=`")
        return Assign(name, offset, syntax.text, expr, mask, syntax.span)

    def _target(self, syntax: Syntax, scope: Scope) -> tuple[str, Kind, Offset]:
        """The field that is assigned, its kind, and where."""
        operand, offset = self.typer.evaluate(syntax, scope), (0, 0)
        if isinstance(operand, Absent):
            raise Unresolved(operand.name)
        if isinstance(operand, Expr) and operand.op == "look":
            operand, offset = operand.args[0], operand.value
        if not isinstance(operand, Expr) or operand.op not in ("field", "property"):
            symbols, scratch = self.typer.symbols, (field.name.rpartition(".")[2] for field in self._scratch)
            helps = suggest(syntax.text, (*symbols.fields, *symbols.properties, *scratch), "fields")
            if isinstance(operand, (SetOf, Place)):
                helps = ("one element becomes another with `->`: `SET -> ELEMENT if …`",)
            if isinstance(operand, Expr) and operand.op.endswith("_part"):
                whole = syntax.children[0].span.text
                helps = (f"assign the whole vector: `{whole} := vector(…, …)`",)
            message = f"`{syntax.span.text.removesuffix('?')}` cannot be assigned"
            raise self.typer.fail("PD407", message, syntax.span, "not a field or property", *helps)
        name = str(operand.value)
        if operand.op == "property":
            if operand.kind.name == "chance":
                message, label = f"the chance `{name}` cannot be assigned", "chances belong to elements"
                raise self.typer.fail("PD407", message, syntax.span, label, "declare it as an integer")
            self.overridden.add(name)
        return name, operand.kind, offset

    def _push(self, syntax: Syntax, scope: Scope) -> list[Rule]:
        target, amount, source = syntax.children[:3]
        name, kind, _ = self._target(target, scope)
        if kind.name != "vec2":
            message, fix = f"`{name}` is not a vector", "`push` works on vec2 fields"
            raise self.typer.fail("PD401", message, target.span, f"this is a {kind}", fix)
        mask = self._mask([source], syntax, scope)
        strength = self.typer.of_kind(self.typer.evaluate(amount, scope), REAL, amount.span)
        part = {0: Expr("const", REAL, value=0.0), 1: strength, -1: Expr("neg", REAL, (strength,))}
        rules: list[Rule] = []
        for side in DIRECTION_SETS["sides"]:
            dy, dx = rotate(side, scope.orientation)
            vector = Expr("vector", VEC2, (part[dy], part[dx]), span=amount.span)
            rules.append(Assign(name, (dy, dx), "+=", vector, mask, syntax.span))
        return rules


def _name_of(operand: Operand) -> str:
    match operand:
        case Place():
            names = [n for n, o in DIRECTIONS.items() if o == operand.offset]
            return names[0] if names else f"at{operand.offset}".replace(" ", "")
        case Expr():
            return str(operand.value)
    return str(getattr(operand, "name", operand))
