"""Rules as text, as parsed and as checked: one line per definition and rule, with its location."""

from __future__ import annotations

from array import array
from collections.abc import Collection, Iterable, Iterator
from dataclasses import fields
from fractions import Fraction

from powderdsl.diagnostics import Span
from powderdsl.model.builtins import DIRECTIONS, OCTANTS
from powderdsl.model.declarations import PackDecl
from powderdsl.model.expressions.operators import TRUE
from powderdsl.model.operations import COMPARISONS, OPERATIONS
from powderdsl.model.schema import Record
from powderdsl.model.types import (
    Assign,
    Expr,
    Field,
    Kernel,
    Kind,
    Move,
    Offset,
    Pass,
    Rule,
    Ruleset,
    Substep,
    Swap,
    Transform,
    Value,
)
from powderdsl.syntax.parse import Syntax
from powderdsl.syntax.yaml_tree import Scalar

_ATOM = 9
"""The binding of a word, or of text that ends in a parenthesis."""
_PLACES = {offset: name for name, offset in DIRECTIONS.items()}


def print_model(ruleset: Ruleset, passes: Collection[str] | None = None) -> str:
    """The model, or only some of its passes, as text that ends with a line break. Equal models give equal texts."""
    printer = _Printer(ruleset)
    shown = (item for item in ruleset.passes if passes is None or item.name in passes)
    blocks = ["\n".join(printer.pass_lines(item)) for item in shown]
    if passes is None:
        blocks = ["\n".join(printer.head()), *blocks, "\n".join(printer.kernel_lines())]
    return "\n\n".join(filter(None, blocks)) + "\n"


def print_tree(packs: Iterable[PackDecl], pass_name: str | None = None) -> str:
    """Packs as parsed, or only one of their passes: each line as written, with its location, above its syntax tree."""
    lines: list[str] = []
    for pack in packs:
        if pass_name is not None:
            passes = tuple(decl for decl in pack.passes if decl.name.text == pass_name)
            pack = PackDecl(name=pack.name, source=pack.source, passes=passes)
        if pass_name is None or pack.passes:
            lines += _tree_lines("pack", pack, "")
    return "\n".join(lines)


def _tree_lines(key: str, value: object, indent: str) -> Iterator[str]:
    """The lines of the tree below a key, without values that are absent or the default."""
    match value:
        case Syntax():
            yield f"{indent}{key}: {one_line(value.span)}  # {place_of(value.span)}"
            yield value.dump(indent + "  ")
        case Record():
            name = getattr(value, "name", None)
            yield f"{indent}{key}" + (f" {name.text}  # {place_of(name.span)}" if name else "")
            for item in fields(value):  # type: ignore[arg-type]  # records are dataclasses
                part, row = getattr(value, item.name), item.metadata.get("key")
                if item.name not in ("name", "pack", "source") and part != item.default:
                    yield from _tree_lines(row.name or item.name if row else item.name, part, indent + "  ")
        case (Scalar() as name, Syntax() as line):
            yield from _tree_lines(f"{key} {name.text}", line, indent)
        case (Record() | Syntax() | tuple(), *_):
            for part in value:
                yield from _tree_lines(key, part, indent)
        case Scalar() | (Scalar(), *_):
            words = value if isinstance(value, tuple) else (value,)
            yield f"{indent}{key} {' '.join(one_line(word.content) for word in words)}"
        case _:
            yield f"{indent}{key} {value}"


def place_of(span: Span) -> str:
    """The location of a span as text: `file:line`."""
    return f"{span.source.name}:{span.line}"


def one_line(span: Span) -> str:
    """The text of a span, with line breaks replaced by spaces."""
    return " ".join(span.text.split())


def show_number(value: float | Fraction) -> str:
    """The shortest exact form of a number: `7`, `0.5`, `1/3`."""
    if isinstance(value, Fraction) and value != Fraction(str(float(value))):
        return str(value)
    number = float(value)
    return repr(int(number)) if number.is_integer() and abs(number) < 1e15 else repr(number)


def show_single(value: float) -> str:
    """The shortest text that represents a float32."""
    texts = (f"{value:.{digits}g}" for digits in range(1, 9))
    text = next((text for text in texts if array("f", [float(text)])[0] == value), f"{value:.9g}")
    return repr(float(text))


def show_value(ruleset: Ruleset, kind: Kind, value: Value | str) -> str:
    """A constant in the syntax of rule files: `20%`, `yes`, an element's name; text names a parameter."""
    match value:
        case str():
            return value
        case tuple():
            return f"({', '.join(show_number(part) for part in value)})"
    match kind.name:
        case "flag":
            return "yes" if value else "no"
        case "element":
            return element_name(ruleset, int(value))
        case "direction":
            return show_offset(OCTANTS[int(value)])
        case "chance":
            percent = value * 100
            # Floats of parameters mean the decimal that they print as: 2% is not 2.0000000000000004%.
            return f"{percent:.10g}%" if isinstance(percent, float) else f"{show_number(percent)}%"
    return show_number(value)


def element_name(ruleset: Ruleset, number: int) -> str:
    return next((element.name for element in ruleset.elements if element.id == number), f"#{number}")


def show_set(ruleset: Ruleset, ids: Iterable[int]) -> str:
    """A set of elements in its shorter form: `(a, b)`, or `any but (c)` for most of them."""
    chosen = frozenset(ids)
    everything = [element.id for element in ruleset.elements]
    if chosen.issuperset(everything) and everything:
        return "any"
    missing = [number for number in everything if number not in chosen]
    if len(missing) < 4 and len(missing) < len(chosen):
        return f"any but {_names(ruleset, missing)}"
    return _names(ruleset, sorted(chosen))


def _names(ruleset: Ruleset, ids: list[int]) -> str:
    names = [element_name(ruleset, number) for number in ids]
    return names[0] if len(names) == 1 else f"({', '.join(names)})"


def show_offset(offset: Offset) -> str:
    """A neighbor's name, or `at(rows, columns)`."""
    return _PLACES.get(offset, f"at({offset[0]}, {offset[1]})")


def show_expr(ruleset: Ruleset, expr: Expr) -> str:
    """An expression of the model in the syntax of rules, with names for numbers."""
    return _Printer(ruleset).expr(expr)


class _Printer:
    """Prints one ruleset, and collects its kernels to name and list them."""

    def __init__(self, ruleset: Ruleset):
        self.ruleset = ruleset
        self.kernels: dict[Kernel, str] = {}

    # Definitions

    def head(self) -> Iterator[str]:
        rules = self.ruleset
        yield f"ruleset {rules.name}"
        yield f"packs {' '.join(rules.packs)}"
        yield f"slots {rules.slots}"
        yield f"matrix {' '.join(channel.name or '-' for channel in rules.matrix)}"
        for element in rules.elements:
            tags = f" tags {' '.join(sorted(element.tags))}" if element.tags else ""
            ramp = element.ramp
            color = f" {ramp.start} -> {ramp.end} by {ramp.field} {ramp.lo}..{ramp.hi}" if ramp else ""
            head = f"element {element.id} {element.qualified} {element.glyph} {element.color}{color}{tags}"
            yield self.with_place(head, element.span)
        for prop in rules.properties:
            values = ", ".join(
                f"{e.name} {show_value(rules, prop.kind, prop.values[e.id])}" for e in rules.elements
            )
            stored = f" stored {show_set(rules, prop.stored)}" if prop.stored else ""
            yield self.with_place(f"property {prop.name} {prop.kind}{stored}: {values}", prop.span)
        for item in rules.fields:
            yield self.with_place(f"field {self.field(item)}", item.span)
        for stream in rules.streams:
            yield f"stream {stream.name} {stream.bits} bits, number {stream.ident:#010x}"
        for param in rules.params:
            value = show_value(rules, param.kind, param.default)
            yield self.with_place(f"param {param.name} {param.kind} = {value}", param.span)
        for example in rules.tests:
            steps = f"{example.steps} step{'' if example.steps == 1 else 's'}"
            yield self.with_place(f"test {example.pack}: {example.name}, {steps}", example.span)

    def field(self, item: Field) -> str:
        default = show_value(self.ruleset, item.kind, item.default)
        of = f" of {show_set(self.ruleset, item.of)}" if item.of is not None else ""
        resets = " resets step" if item.resets else ""
        own = "".join(
            f", {element_name(self.ruleset, identity)} {show_value(self.ruleset, item.kind, value)}"
            for identity, value in item.own
        )
        tint = f" tint {item.tint.color} full {item.tint.full} most {item.tint.most:g}" if item.tint else ""
        return f"{item.name} {item.kind} at {item.at}{of} default {default}{own}{resets}{tint}"

    def kernel_lines(self) -> list[str]:
        """A line for each printed kernel: its name, and the weight of each neighbor."""
        lines = []
        for kernel, name in self.kernels.items():
            weights = " ".join(f"({dy},{dx})={weight}" for dy, dx, weight in kernel.weights)
            lines.append(f"kernel {name}{' wrap' if kernel.wrap else ''}: {weights}")
        return lines

    @staticmethod
    def with_place(text: str, span: Span) -> str:
        return f"{text}  # {place_of(span)}"

    # Passes

    def pass_lines(self, pass_: Pass) -> Iterator[str]:
        yield self.with_place(f"pass {pass_.name} of {pass_.pack}", pass_.span)
        for item in pass_.scratch:
            yield self.with_place(f"  scratch {item.name} {item.kind}", item.span)
        for substep in pass_.substeps:
            yield from self.substep_lines(substep)

    def substep_lines(self, substep: Substep) -> Iterator[str]:
        label = f" [{substep.label}]" if substep.label else ""
        policy = "" if substep.policy == "prove" else f" conflicts {substep.policy}"
        yield f"  substep{label}{policy}"
        for let in substep.lets:
            yield self.with_place(f"    let {let.name}: {let.value.kind} = {self.expr(let.value)}", let.span)
        for rule in substep.rules:
            yield self.with_place(f"    {self.rule(rule)}", rule.span)

    def rule(self, rule: Rule) -> str:
        text = ""
        match rule:
            case Transform():
                text = f"become {self.expr(rule.target)}{self.condition('if', rule.mask)}"
            case Swap():
                text = f"swap {show_offset(rule.offset)}{self.condition('if', rule.mask)}"
            case Move():
                leaving = show_offset(rule.offset) if rule.leaving is None else self.expr(rule.leaving)
                text = f"move {show_offset(rule.offset)} leaving {leaving}{self.condition('if', rule.mask)}"
            case Assign():
                return self.assignment(rule) + self.condition("where", rule.mask)
        return text + "".join(f", then {self.assignment(effect)}" for effect in rule.effects)

    def condition(self, word: str, mask: Expr) -> str:
        return "" if mask == TRUE else f" {word} {self.expr(mask)}"

    def assignment(self, write: Assign) -> str:
        place = "" if write.offset == (0, 0) else f"{show_offset(write.offset)}."
        return f"{place}{write.field} {write.op} {self.expr(write.value)}"

    # Expressions

    def expr(self, expr: Expr, binding: int = 0) -> str:
        """An expression, in parentheses if its precedence requires them."""
        text, level = self._expr(expr)
        return f"({text})" if level < binding else text

    def _expr(self, expr: Expr) -> tuple[str, int]:
        """The text of an expression, and its precedence."""
        rules, args = self.ruleset, expr.args
        row = OPERATIONS[expr.op]
        if row.sign:
            sign, level = row.sign, row.binds
            if len(args) == 1 and expr.value is None:
                return f"{sign}{self.expr(args[0], level)}", level
            # Comparisons do not nest, and a chain of `and` or `or` needs no parentheses on either side.
            left = self.expr(args[0], level + (expr.op in COMPARISONS.values()))
            return f"{left} {sign} {expr.value or self.expr(args[1], level + (level > 2))}", level
        match expr.op:
            case "const":
                return show_value(rules, expr.kind, expr.value), _ATOM
            case "element":
                return "element", _ATOM
            case "draw":  # a stream may share its name with something else
                return f"draw({expr.value})", _ATOM
            case "coordinate":
                return "{} mod {}".format(*expr.value), 6
            case "inside":
                return f"inside({show_offset(expr.value)})", _ATOM
            case "look":
                return f"{show_offset(expr.value)}.{self.expr(args[0], _ATOM)}", _ATOM
            case "member":
                return f"{self.expr(args[0], 5)} in {show_set(rules, expr.value)}", 4
            case "count" | "sum":
                kernel = self.kernel(expr.value)
                return f"{expr.op}({self.expr(args[0], 5)} in {kernel})", _ATOM
            case "choose":
                return f"{self.expr(args[1], 1)} if {self.expr(args[0], 1)} else {self.expr(args[2])}", 0
            case _ if args:
                return f"{expr.op}({', '.join(self.expr(arg) for arg in args)})", _ATOM
        return str(expr.value), _ATOM

    def kernel(self, kernel: Kernel) -> str:
        """The kernel's name, numbered if several kernels share it, such as copies under a symmetry."""
        if kernel not in self.kernels:
            copies = sum(other.name == kernel.name for other in self.kernels)
            self.kernels[kernel] = f"{kernel.name}#{copies + 1}" if copies else kernel.name
        return self.kernels[kernel]
