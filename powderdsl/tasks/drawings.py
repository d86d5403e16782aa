"""Lists of statements and pictures of a task file -> a checked `Generator`, with known names and numbers in range."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from powderdsl.arrays import NDArray, np
from powderdsl.diagnostics import CompileError, Reporter, Span, suggest
from powderdsl.model.schema import Entry, Reader, first_line, keyed
from powderdsl.model.state import holders, slot_name, slots
from powderdsl.model.types import Element, Expr, Ruleset
from powderdsl.syntax import yaml_tree
from powderdsl.syntax.parse import Syntax, line_of
from powderdsl.syntax.sources import path_beside
from powderdsl.tasks.task import (
    MAX_NUMBER,
    MAX_REPEATS,
    MAX_SIDE,
    NOTHING,
    Drawing,
    FieldValue,
    Generator,
    Group,
    Region,
    Stamp,
    Target,
)
from powderdsl.worlds.ascii import ids_by_name, load_ascii, parse_ascii
from powderdsl.worlds.image import read_image
from powderdsl.worlds.raster import Setting, Shape, Size, mask
from powderdsl.worlds.scene import draw_start, find_scene
from powderdsl.worlds.scene.read import covers_nothing, not_a_statement, shipped_scene, value_of
from powderdsl.worlds.scene.statements import (
    RANGES,
    Statement,
    Written,
    amounts_of,
    constants,
    number,
    read_amount,
    read_line,
    read_statement,
    report_unknown,
    shape_of,
)

Lets = Sequence[tuple[Written, Syntax | None]]
"""Names of numbers as written, in order; None for a number whose mistake has been reported."""

MAX_STATEMENTS = 2_000
"""Statements of one list."""


@dataclass(frozen=True)
class Repeat:
    """Statements to repeat `count` times, with local names."""

    count: Syntax
    lets: Lets
    statements: tuple[Statement, ...]
    span: Span = field(compare=False, repr=False)


Item = Statement | Repeat


def line_in(node: yaml_tree.Node | None, start: str, reader: Reader) -> Syntax | None:
    """The syntax of a line of the language of statements; None if it is absent or after a report."""
    span = line_of(node, start, reader.reporter)
    return None if span is None else read_line(span, start, reader.reporter)


def shape_in(node: yaml_tree.Node | None, reader: Reader) -> Statement | None:
    """The shape in a line; None if it is absent or after a report."""
    tree = line_in(node, "shape", reader)
    return None if tree is None else shape_of(tree, reader.reporter)


def limited(node: yaml_tree.Sequence, most: int, what: str, reporter: Reporter) -> bool:
    """Return True if a list has at most `most` items; report one that has more."""
    if len(node.items) > most:
        reporter.error("PD508", what.format(len(node.items)), first_line(node), f"the limit is {most:,}")
    return len(node.items) <= most


def read_items(node: yaml_tree.Node | None, reader: Reader, *, nested: bool = False) -> tuple[Item, ...]:
    """The items of a list of statements. `nested` lists, those of a repetition, hold no repetitions."""
    reporter = reader.reporter
    if node is None or (isinstance(node, yaml_tree.Scalar) and node.text == ""):
        return ()
    if not isinstance(node, yaml_tree.Sequence):
        reader.shape(node, "a list of statements", "write one `- statement` per line")
        return ()
    if not limited(node, MAX_STATEMENTS, "a list of {:,} statements", reporter):
        return ()
    items: list[Item | None] = []
    for item in node.items:
        if isinstance(item, yaml_tree.Sequence):
            reader.shape(item, "a statement")
        elif isinstance(item, yaml_tree.Scalar):
            span = line_of(item, "statement", reporter)
            items.append(None if span is None else read_statement(span, reporter))
        elif not nested and len(item.entries) == 1 and item.entries[0][0].text.startswith("repeat"):
            items.append(_repeat(*item.entries[0], reader))
        elif not (nested and _is_let(item)):
            word = next(iter(item.entries[0][0].text.split()), "") if item.entries else ""
            if nested and word == "repeat":
                fix = "repetitions cannot be nested: multiply the counts"
            elif word == "let":
                fix = "`let:` belongs at the top level of the file or in a repetition"
            else:
                fix = "write `48:end` for `48:`, or quote the statement; `repeat 0..5:` needs a list below it"
            not_a_statement(item, reporter, fix)
    return tuple(item for item in items if item is not None)


def _is_let(item: yaml_tree.Node) -> bool:
    return isinstance(item, yaml_tree.Mapping) and [key.text for key, _ in item.entries] == ["let"]


def _repeat(key: yaml_tree.Scalar, body: yaml_tree.Node, reader: Reader) -> Repeat | None:
    """`repeat COUNT:` with a list below it, among whose items `let:` gives names."""
    count = read_line(key.content, "repeat", reader.reporter)
    if isinstance(body, yaml_tree.Scalar) and body.text == "":
        reader.reporter.error("PD109", "a repetition of nothing", key.span, "no statements below it")
        return None
    lets: list[tuple[Written, Syntax | None]] = []
    for item in body.items if isinstance(body, yaml_tree.Sequence) else ():
        if isinstance(item, yaml_tree.Mapping) and _is_let(item):
            lets += read_lets(item.entries[0][1], reader)
    statements = tuple(item for item in read_items(body, reader, nested=True) if isinstance(item, Statement))
    return Repeat(count.children[0], lets, statements, key.span) if count is not None else None


def read_lets(node: yaml_tree.Node | None, reader: Reader) -> list[tuple[Written, Syntax | None]]:
    """The names of a `let:` and their numbers, in order; None after a report."""
    lets: list[tuple[Written, Syntax | None]] = []
    for key, value in reader.named(node, "a number"):
        if not isinstance(value, yaml_tree.Scalar):
            reader.shape(value, "a number")
        lets.append((key, line_in(value, "operand", reader)))
    return lets


MAX_DRAWINGS = 4_096
"""Drawings of one world, repetitions counted."""
MAX_VISITS = 100_000
"""Statements and names of one task's worlds; those of a part count each time a list includes it."""


@dataclass(frozen=True)
class DrawingPlan:
    """The parts of a generator, as written: sections of a file, with the changes of a split on top."""

    name: str
    fill: int
    knobs: Mapping[str, int]
    lets: Lets
    regions: Mapping[str, Sequence[Statement]]
    stamps: Mapping[str, Stamp]
    parts: Mapping[str, Sequence[Item]]
    targets: Mapping[str, Sequence[Item]]
    items: Sequence[Item]
    broken: frozenset[str] = frozenset()
    """Knobs whose definition has been reported."""


@dataclass
class Drawer:
    """Checks one plan. Mistakes go to the reporter; the generator is valid only if there are none."""

    plan: DrawingPlan
    ruleset: Ruleset
    size: Size
    reporter: Reporter
    visits: Iterator[int]  # all worlds of a task share these numbers
    used_parts: set[str] = field(default_factory=set)
    count: int = 0
    cells: int = 0

    def __post_init__(self) -> None:
        self.names: dict[str, Expr | None] = dict.fromkeys(sorted(self.plan.broken))
        """The amounts of names; None for a name whose definition has been reported."""
        self.names |= {name: number(value) for name, value in self.plan.knobs.items()}

    def generator(self) -> Generator:
        plan = self.plan
        return Generator(
            plan.name,
            plan.fill,
            lets=self.lets(plan.lets, self.names),
            regions=tuple(self.region(name, shapes) for name, shapes in plan.regions.items()),
            groups=self.groups(plan.items),
            targets=tuple(self.target(name, items) for name, items in plan.targets.items()),
            stamps=tuple(plan.stamps.values()),
        )

    def visit(self, span: Span) -> None:
        """Count something that is checked. Raises CompileError for more than MAX_VISITS."""
        if next(self.visits) >= MAX_VISITS:
            message = f"a task of more than {MAX_VISITS:,} statements, parts counted each time"
            self.reporter.error("PD508", message, span, "over the limit")
            self.reporter.raise_if_errors()

    def target(self, name: str, items: Sequence[Item]) -> Target:
        groups = self.groups(items)
        for drawing in (drawing for group in groups for drawing in group.drawings):
            if drawing.value is not None and drawing.span is not None:
                message = f"the target `{name}` sets `{drawing.value.slot.name}`"
                self.reporter.error("PD605", message, drawing.span, "a target is made of elements only")
        return Target(name, groups)

    def lets(self, written: Lets, names: dict[str, Expr | None]) -> tuple[tuple[str, Expr], ...]:
        """The amounts of named numbers, in order. They are added to `names`."""
        lets = []
        for word, syntax in written:
            self.visit(word.span)
            amount = None if syntax is None else read_amount(syntax, names, self.reporter)
            names[word.text] = amount and Expr("let", amount.kind, value=word.text)
            if amount is not None:
                lets.append((word.text, amount))
        return tuple(lets)

    def region(self, name: str, shapes: Sequence[Statement]) -> Region:
        drawings = tuple(filter(None, (self.drawing(shape, self.names) for shape in shapes)))
        return Region(name, drawings, any(constants(drawing.amounts) is None for drawing in drawings))

    def groups(self, items: Sequence[Item], inside: tuple[str, ...] = ()) -> tuple[Group, ...]:
        """The groups of a list of statements: each repetition is one, and each statement between them."""
        groups: list[Group] = []
        for item in items:
            if isinstance(item, Repeat):
                groups += self.repeated(item)
            elif item.kind == "part" and item.name is not None:
                groups += self.part(item.name, inside)
            else:
                self.count += 1
                self.cells += 1
                drawing = self.drawing(item, self.names)
                groups += [Group(self.count, number(1), 1, (), (drawing,))] if drawing else []
            if self.cells > MAX_DRAWINGS:
                message = f"a world of more than {MAX_DRAWINGS:,} drawings"
                self.reporter.error("PD508", message, item.span, "over the limit", helps=["draw less"])
                break
        return tuple(groups)

    def part(self, name: Syntax, inside: tuple[str, ...]) -> tuple[Group, ...]:
        self.visit(name.span)
        if name.text not in self.plan.parts:
            report_unknown("part", name, self.plan.parts, self.reporter)
            return ()
        self.used_parts.add(name.text)
        if name.text in inside:
            self.reporter.error("PD307", f"the part `{name.text}` contains itself", name.span, "here")
            return ()
        return self.groups(self.plan.parts[name.text], (*inside, name.text))

    def repeated(self, repeat: Repeat) -> tuple[Group, ...]:
        self.visit(repeat.span)
        self.count += 1
        place, names = self.count, dict(self.names)
        for word, _ in repeat.lets:
            if word.text in self.names:
                message = f"`{word.text}` is already in use"
                self.reporter.error("PD308", message, word.span, "second meaning")
        count = read_amount(repeat.count, self.names, self.reporter)
        lets = self.lets(repeat.lets, names)
        drawings = []
        for statement in repeat.statements:
            self.count += 1
            if statement.kind == "part":
                label = "a part cannot be in a repetition"
                self.reporter.error("PD605", "a part in a repetition", statement.span, label)
            elif drawing := self.drawing(statement, names):
                drawings.append(drawing)
        if count is None:
            return ()
        low, most = int(count.kind.lo), int(count.kind.hi)
        if low < 0 or most > MAX_REPEATS:
            label = f"they must lie in 0..{MAX_REPEATS}"
            self.reporter.error("PD606", f"{low}..{most} repetitions", repeat.count.span, label)
            return ()
        self.cells += most * len(drawings)
        return (Group(place, count, most, lets, tuple(drawings)),) if most and drawings else ()

    def drawing(self, statement: Statement, names: Mapping[str, Expr | None]) -> Drawing | None:
        self.visit(statement.span)
        ids, over = (
            choice_ids(choice, self.ruleset, self.reporter, self.plan.knobs) if choice else ()
            for choice in (statement.choice, statement.over)
        )
        where, stamp = statement.where, statement.name
        for what, word, known in (("region", where, self.plan.regions), ("stamp", stamp, self.plan.stamps)):
            if word is not None and word.text not in known:
                report_unknown(what, word, known, self.reporter)
        amounts = amounts_of(statement, names, self.reporter, MAX_NUMBER)
        value = self.value(statement.setting) if statement.setting else None
        if amounts is None or not self.covers_something(statement, amounts):
            return None
        return Drawing(
            self.count,
            statement.kind,
            amounts,
            ids,
            where.text if where else None,
            frozenset(over) if statement.over else None,
            stamp.text if stamp else None,
            value,
            statement.span,
        )

    def value(self, setting: Setting) -> FieldValue | None:
        """The value of a field; None after a report."""
        setting = replace(setting, name=slot_name(self.ruleset, setting.name))
        known = {slot.name: slot for slot in slots(self.ruleset)[1:]}
        ids = ids_by_name(self.ruleset.elements)
        parts = value_of(setting, known, ids, self.ruleset, self.reporter)
        slot = known.get(setting.name)
        return FieldValue(slot, parts, holders(self.ruleset, slot)) if slot and parts else None

    def covers_something(self, statement: Statement, amounts: tuple[Expr | None, ...]) -> bool:
        """Return True if the shape can cover a cell; otherwise, report it."""
        never = ""
        for i in range(RANGES.get(statement.kind, 0)):
            start, stop = amounts[2 * i], amounts[2 * i + 1]
            assert start is not None
            high = self.size[i] if stop is None else min(stop.kind.hi, self.size[i])
            if start.kind.lo >= high or high <= 0 or start == stop:
                never = ("rows", "columns")[i]
        values = constants(amounts) if statement.kind not in ("scatter", "stamp") else None
        if not never and values is not None and not mask(Shape(statement.kind, values), self.size).any():
            never = "cells"
        if never:
            covers_nothing(statement.span, f"none of its {never} lie", self.size, self.reporter)
        return not never


def choice_ids(
    choice: Syntax, ruleset: Ruleset, reporter: Reporter, knobs: Mapping[str, int]
) -> tuple[int, ...]:
    """The elements of a choice by id, in the order written, tags in the order of ids. Empty after a report."""
    words = [child for child in choice.children if child.kind == "identifier"]
    ids = tuple(dict.fromkeys(i for word in words for i in element_ids(word, ruleset, reporter)))
    if choice.kind == "any_element":
        ids = tuple(element.id for element in ruleset.elements if element.id not in ids)
    if choice.kind == "first":
        written = choice.children[0]
        count = read_amount(written, {name: number(value) for name, value in knobs.items()}, Reporter())
        if count is None or count.op != "const" or not 1 <= count.value <= len(ids):
            label = f"a number from 1 to {len(ids)}, or knobs"
            reporter.error("PD606", "the count must be fixed", written.span, label)
            return ()
        ids = ids[: count.value]
    if not ids and not words:
        reporter.error("PD604", "a choice among no elements", choice.span, "nothing is left")
    return ids


def element_ids(word: Written, ruleset: Ruleset, reporter: Reporter) -> tuple[int, ...]:
    """The element, or all elements with the tag, of a name; empty after reporting PD604."""
    element = ruleset.element(word.text)
    if element is not None:
        return (element.id,)
    tagged = tuple(element.id for element in ruleset.elements if word.text in element.tags)
    if not tagged:
        known = {name for element in ruleset.elements for name in (element.name, *element.tags)}
        helps = suggest(word.text, known, "its elements")
        label = "neither an element nor a tag of these rules"
        reporter.error("PD604", f"unknown element `{word.text}`", word.span, label, helps=helps)
    return tagged


class StampDecl(Entry, noun="a stamp"):
    art: yaml_tree.Scalar | None = keyed("ASCII art; `?` leaves a cell unchanged", shape="text")
    legend: tuple[tuple[yaml_tree.Scalar, yaml_tree.Scalar], ...] = keyed(
        "characters and their elements, where glyphs do not suffice", (), maps="characters to elements"
    )
    scene: yaml_tree.Scalar | None = keyed("instead of art: a shipped scene, or a file in the task's folder")


def read_stamp(decl: StampDecl, reader: Reader, ruleset: Ruleset) -> Stamp:
    """The picture of a stamp; an empty one after a report."""
    key, art, scene = decl.name, decl.art, decl.scene
    ids: NDArray[np.uint8] | None = None
    try:
        if art is not None and scene is None:
            ids = _drawn(art, decl, reader, ruleset)
        elif scene is not None and art is None:
            ids = _named(scene, reader, ruleset)
        else:
            label = "neither `art` nor `scene`" if art is None else "both `art` and `scene`"
            reader.reporter.error("PD109", f"the stamp `{key.text}` needs one picture", key.span, label)
    except CompileError as error:
        pass_on(error, reader.reporter, (art or scene or key).span)
    if ids is not None and max(ids.shape) > MAX_SIDE:
        message = f"a stamp of {ids.shape[0]}×{ids.shape[1]} cells"
        reader.reporter.error("PD607", message, key.span, "too large")
    return Stamp(key.text, ((NOTHING,),) if ids is None else tuple(map(tuple, ids.tolist())))


def _drawn(
    art: yaml_tree.Scalar, decl: StampDecl, reader: Reader, ruleset: Ruleset
) -> NDArray[np.uint8] | None:
    """ASCII art, in which `?` leaves cells unchanged."""
    for key, _ in decl.legend:
        if len(key.text) != 1:
            reader.reporter.error("PD110", "a legend maps single characters", key.span, "not one character")
    legend = {key.text: value.text for key, value in decl.legend if len(key.text) == 1}
    hole = replace(ruleset.elements[0], name="?", pack="?", id=NOTHING, glyph="?")
    elements: list[Element] = [element for element in ruleset.elements if element.id != NOTHING]
    if art.style == "quoted" and art.content.text.split() != art.text.split():
        helps = ["write `art: |`, and the rows below it"]
        reader.reporter.error("PD107", "art with escapes", art.span, "quoted, on one line", helps=helps)
        return None
    return parse_ascii(art.content, [*elements, hole], reader.reporter, {"?": "?", **legend})


def _named(word: yaml_tree.Scalar, reader: Reader, ruleset: Ruleset) -> NDArray[np.uint8] | None:
    """A shipped scene, or a file in the task's folder: .yaml, .png or .txt."""
    file, sign, name = word.text.partition("#")
    suffix = Path(file).suffix.lower()
    if suffix in (".png", ".txt", ".yaml", ".yml"):
        path = path_beside(file, word.span, reader.reporter)
        if path is None:
            return None
        if suffix in (".png", ".txt"):
            return (read_image if suffix == ".png" else load_ascii)(f"{path}{sign}{name}", ruleset.elements)
        scene = find_scene(f"{path}{sign}{name}")
    else:
        scene = shipped_scene(word.text)
    setting = next((statement for statement in scene.paints if isinstance(statement, Setting)), None)
    if setting is not None:
        message = f"the scene `{scene.name}` sets `{setting.name}`"
        reader.reporter.error("PD605", message, word.span, "a picture is made of elements only")
        return None
    return draw_start(scene, ruleset).ids


def pass_on(error: CompileError, reporter: Reporter, place: Span) -> None:
    """Report the mistakes in a file that a task names; those without a location, at the name."""
    for mistake in error.diagnostics:
        span, label = mistake.primary.span or place, mistake.primary.text
        reporter.error(mistake.code, mistake.message, span, label, notes=mistake.notes, helps=mistake.helps)
