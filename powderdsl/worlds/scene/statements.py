"""Drawing statements: the syntax of one line -> a `Statement` with numbers (constants, names, draws `a..b`,
arithmetic).

`worlds.raster` computes the cells that a shape covers.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from powderdsl.diagnostics import Reporter, Span, suggest
from powderdsl.model.operations import OPERATIONS
from powderdsl.model.types import Expr, integer
from powderdsl.syntax.parse import Syntax, parse_text
from powderdsl.syntax.yaml_tree import Scalar
from powderdsl.worlds.raster import MAX_COORDINATE, Setting, Shape

STATEMENTS = {
    "line": "line ELEMENT from (ROW, COLUMN) to (ROW, COLUMN) width NUMBER",
    "disk": "disk ELEMENT at (ROW, COLUMN) radius NUMBER",
    "square": "square ELEMENT at (ROW, COLUMN) half NUMBER",
    "box": "box ELEMENT rows A:B columns C:D",
    "ramp": "ramp ELEMENT from (ROW, COLUMN) to (ROW, COLUMN)",
    "arch": "arch ELEMENT rows A:B columns C:D width NUMBER",
    "container": "container ELEMENT rows A:B columns C:D width NUMBER",
    "wave": "wave ELEMENT at ROW height NUMBER length NUMBER phase NUMBER",
    "frame": "frame ELEMENT",
    "fill": "fill ELEMENT",
}
"""The syntax of every statement. A box may omit rows, columns, and the ends of a range."""

GENERATOR_STATEMENTS = {
    **STATEMENTS,
    "scatter": "scatter ELEMENT chance NUMBER%",
    "stamp": "stamp NAME at (ROW, COLUMN)",
    "part": "part NAME",
}
"""The statements of a generator, including random cells, pictures, and named lists of statements."""

SETTING = "FIELD := VALUE in SHAPE"
"""The statement that sets a field in cells; without `in`, in all cells."""

_POINT = (("a row", -MAX_COORDINATE), ("a column", -MAX_COORDINATE))
_ROWS = (("the start of a range", 0), ("the end of a range", 0))
NUMBERS: dict[str, tuple[tuple[str, int], ...]] = {
    "line": (*_POINT, *_POINT, ("a width", 1)),
    "disk": (*_POINT, ("a radius", 1)),
    "square": (*_POINT, ("half a side", 1)),
    "box": (*_ROWS, *_ROWS),
    "ramp": (*_POINT, *_POINT),
    "arch": (*_ROWS, *_ROWS, ("a width", 1)),
    "container": (*_ROWS, *_ROWS, ("a width", 1)),
    "wave": (("a row", -MAX_COORDINATE), ("a height", 0), ("a length", 2), ("a phase", -MAX_COORDINATE)),
    "frame": (),
    "fill": (),
    "scatter": (("a chance", 0),),
    "stamp": _POINT,
    "part": (),
}
"""The numbers of each statement in order: the name in messages and the minimum."""

RANGES = {"box": 2, "arch": 2, "container": 2}
"""The number of ranges at the start of a statement's numbers: pairs of a start and an end, None for an open end."""


@dataclass(frozen=True)
class Statement:
    """A statement as written. `numbers` are those of NUMBERS; a region's shape has no `choice`.

    `choice` and `over` are choices among elements: a fixed ``element``, one of ``some``, ``any_element`` except the named
    ones, or one of the ``first`` few named ones.
    """

    kind: str
    numbers: tuple[Syntax | None, ...]
    span: Span = field(compare=False, repr=False)
    choice: Syntax | None = None
    name: Syntax | None = None
    where: Syntax | None = None
    over: Syntax | None = None
    setting: Setting | None = None
    """The field that is set in the cells, instead of elements; its shape is this statement's."""


def amounts_of(
    statement: Statement, names: Mapping[str, Expr | None], reporter: Reporter, most: int = MAX_COORDINATE
) -> tuple[Expr | None, ...] | None:
    """The amounts of a statement's numbers, within ±most, None for open ends. None after a report (PD606, PD802)."""
    amounts: list[Expr | None] = []
    fits = True
    for written, (what, lowest) in zip(statement.numbers, NUMBERS[statement.kind], strict=True):
        amount = None if written is None else read_amount(written, names, reporter, what)
        amounts.append(amount)
        if written is None or amount is None:
            fits &= written is None
            continue
        low, high = int(amount.kind.lo), int(amount.kind.hi)
        # A computed range may begin outside the world, since shapes are clipped anyway.
        is_cut = statement.kind in RANGES and lowest == 0 and written.kind not in ("integer", "neg")
        least = -most if is_cut else max(lowest, -most)
        greatest = 100 if statement.kind == "scatter" else most
        if low < least or high > greatest:
            can_be = f"it can be {low}..{high}" if low < high else f"it is {low}"
            message = f"{what} must be in {least}..{greatest}"
            reporter.error("PD606", message, written.span, can_be)
            fits = False
    return tuple(amounts) if fits else None


CHOICES = ("element", "some", "any_element", "first")


def read_statement(line: Span, reporter: Reporter) -> Statement | None:
    """The statement of a line, or None after reporting PD605 or PD606."""
    sets = ":=" in line.text
    tree = read_line(line, "setting" if sets else "statement", reporter)
    if tree is None:
        return None
    if sets:
        field_name, value, *shapes = tree.children
        drawn = shape_of(shapes[0], reporter) if shapes else Statement("fill", (), tree.span)
        word = "".join(value.span.text.split())
        setting = Setting(field_name.text, word, Shape("fill"), tree.span, field_name.span, value.span)
        return drawn and replace(drawn, setting=setting)
    painted, *clauses = tree.children
    first, *parts = painted.children
    numbers = _numbers(painted, parts, reporter)
    if numbers is None:
        return None
    choice, name = (first, None) if first.kind in CHOICES else (None, first)
    wheres = {clause.kind: clause.children[0] for clause in clauses}
    region, over = wheres.get("region"), wheres.get("over")
    return Statement(painted.kind, numbers, tree.span, choice, name, region, over)


def shape_of(tree: Syntax, reporter: Reporter) -> Statement | None:
    """The shape of a region: a statement without an element. None after reporting PD606."""
    numbers = _numbers(tree, tree.children, reporter)
    return None if numbers is None else Statement(tree.kind, numbers, tree.span)


def read_line(line: Span, start: str, reporter: Reporter) -> Syntax | None:
    """The syntax of a line of the language of statements, or None after reporting PD605."""
    word = next(iter(line.text.split(maxsplit=1)), "")
    usage = (SETTING,) if ":=" in line.text else suggest(word, GENERATOR_STATEMENTS, "statements")
    if word in GENERATOR_STATEMENTS and ":=" not in line.text:
        usage = (GENERATOR_STATEMENTS[word],)
    return parse_text(line, start, reporter, usage)


def _numbers(tree: Syntax, parts: Sequence[Syntax], reporter: Reporter) -> tuple[Syntax | None, ...] | None:
    """The numbers of a statement in the order of NUMBERS. A missing range is open at both ends."""
    numbers: list[Syntax | None] = []
    zero, unit = (Syntax("integer", (), digit, tree.span) for digit in "01")
    ranges = {part.kind: part.children[0] for part in parts if part.kind in ("rows", "columns")}
    for axis in ("rows", "columns")[: RANGES.get(tree.kind, 0)]:
        extent = ranges.get(axis, Syntax("whole", (), "", tree.span))
        match extent.kind, extent.children:
            case "single", (start,):
                numbers += [start, Syntax("add", (start, unit), "", start.span)]
            case "between", (start, stop):
                if start.kind == stop.kind == "integer" and int(stop.text) <= int(start.text):
                    label = "the end must be greater than the start: a:b excludes b"
                    reporter.error("PD606", f"a range without {axis}", extent.span, label)
                    return None
                numbers += [start, stop]
            case "onward", (start,):
                numbers += [start, None]
            case "up_to", (stop,):
                numbers += [zero, stop]
            case _:
                numbers += [zero, None]
    for part in parts:
        if part.kind == "percentage":
            if not part.span.text.endswith("%"):
                end = Span(part.span.source, part.span.end, part.span.end + 1)
                usage = (GENERATOR_STATEMENTS[tree.kind],)
                reporter.error("PD605", "a chance without a percent sign", end, "expected `%`", helps=usage)
                return None
            numbers += map(_without_signs, part.children)
        elif part.kind == "point":
            numbers += part.children
        elif part.kind not in ranges:
            numbers.append(part)
    return tuple(numbers)


def _without_signs(tree: Syntax) -> Syntax:
    """The number before a percent sign: `5..30%` is a range from 5 to 30."""
    if tree.kind == "percent":
        span = Span(tree.span.source, tree.span.start, tree.span.end - 1)
        return Syntax("integer" if span.text.isdigit() else "decimal", (), span.text, span)
    return replace(tree, children=tuple(map(_without_signs, tree.children)))


# Amounts

AMOUNTS = {
    **{op: op for op in ("add", "sub", "mul", "quotient", "mod", "neg")},
    "div": "quotient",
    "range": "uniform",
}
"""The operation of each kind of syntax. Operands are integers, so `/` rounds down, like `div`. ``uniform`` draws an integer
from a range that includes both ends."""

MAX_DIGITS = 9


Written = Syntax | Scalar
"""A word of a file and its location."""


def number(value: int, span: Span | None = None) -> Expr:
    return Expr("const", integer(value, value), value=value, span=span)


def constants(amounts: Iterable[Expr | None]) -> tuple[int | None, ...] | None:
    """The values of constants, None for open ends; None if an amount is not a constant."""
    values = list(amounts)
    if not all(amount is None or amount.op == "const" for amount in values):
        return None
    return tuple(None if amount is None else amount.value for amount in values)


def read_amount(
    syntax: Syntax, names: Mapping[str, Expr | None], reporter: Reporter, what: str = "a number"
) -> Expr | None:
    """Turn syntax into an integer expression with its range; constants are folded. Returns None after PD606 or PD802.

    `names` has None for a name whose definition has been reported. `what` is the number in words, for messages.
    """
    span, op = syntax.span, AMOUNTS.get(syntax.kind)
    if syntax.kind == "integer" and len(syntax.text) <= MAX_DIGITS:
        return number(int(syntax.text), span)
    if syntax.kind == "name" and syntax.text in names:
        named = names[syntax.text]
        return None if named is None else replace(named, span=span)
    if syntax.kind == "name":
        report_unknown("number", syntax, names, reporter)
        return None
    if op is None:
        label = "too large" if syntax.kind == "integer" else "not an integer"
        reporter.error("PD606", f"{what} must be an integer", span, label)
        return None
    operands = [read_amount(child, names, reporter, what) for child in syntax.children]
    args = tuple(operand for operand in operands if operand is not None)
    if len(args) < len(operands):
        return None
    ranges = [(int(arg.kind.lo), int(arg.kind.hi)) for arg in args]
    values = [arg.value for arg in args if arg.op == "const"]
    if op == "uniform":
        (low, first_high), (second_low, high) = ranges
        if low > high:
            label = "the first must not be greater than the second"
            reporter.error("PD606", f"an empty range {low}..{high}", span, label)
            return None
        if len(values) == 2 and low == high:
            return number(low, span)
        return Expr(op, integer(min(low, second_low), max(first_high, high)), args, span=span)
    if op in ("quotient", "mod") and ranges[1][0] <= 0 <= ranges[1][1]:
        reporter.error("PD606", "a division by zero", span, "the divisor can be 0")
        return None
    if op == "mod":
        modulus = args[1].value
        if args[1].op != "const" or modulus < 0:
            reporter.error("PD606", "`mod` needs a constant above 0", args[1].span, "not a constant above 0")
            return None
        amount = Expr("mod", integer(0, modulus - 1), args[:1], modulus, span)
    else:
        bounds = OPERATIONS[op].between(*ranges)
        assert bounds is not None
        amount = Expr(op, integer(*bounds), args, span=span)
    evaluate = OPERATIONS[op].evaluate
    if len(values) == len(args) and evaluate is not None:
        return number(evaluate(*values), span)
    return amount


def report_unknown(what: str, word: Written, known: Mapping[str, object], reporter: Reporter) -> None:
    """Report a name that the task does not define, PD802."""
    helps = suggest(word.text, known, f"{what}s") or (f"the task defines no {what}s",)
    reporter.error("PD802", f"unknown {what} `{word.text}`", word.span, "not defined", helps=helps)
