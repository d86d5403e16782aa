"""Statements as written -> a checked `Generator`: names known, elements resolved, numbers within bounds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from powderdsl.diagnostics import Reporter, suggest
from powderdsl.model.types import Ruleset
from powderdsl.tasks.statement_lists import BROKEN, Item, Repeat
from powderdsl.tasks.task import MAX_NUMBER, MAX_REPEATS, Drawing, Generator, Group, Region, Stamp, Target
from powderdsl.worlds.raster import Shape, Size, mask
from powderdsl.worlds.scene.amounts import Amount, Interval, filled_in, integers, interval, number
from powderdsl.worlds.scene.read import covers_nothing
from powderdsl.worlds.scene.statements import NUMBERS, RANGES, ElementChoice, Statement, Word

MAX_DRAWINGS = 4_096
"""Drawings of one world, repetitions counted."""


@dataclass(frozen=True)
class DrawingPlan:
    """The parts of a generator, as written: sections of a file, with the changes of a split on top."""

    name: str
    fill: int
    knobs: Mapping[str, int]
    lets: Sequence[tuple[Word, Amount]]
    regions: Mapping[str, Sequence[Statement]]
    stamps: Mapping[str, Stamp]
    parts: Mapping[str, Sequence[Item]]
    targets: Mapping[str, Sequence[Item]]
    items: Sequence[Item]
    broken: frozenset[str] = frozenset()
    """Knobs whose definition has been reported."""


@dataclass
class Drawer:
    """Checks one plan. Mistakes go to the reporter; the generator is valid only if there were none."""

    plan: DrawingPlan
    ruleset: Ruleset
    size: Size
    reporter: Reporter
    names: dict[str, Interval] = field(default_factory=dict)
    used_parts: set[str] = field(default_factory=set)
    broken: set[str] = field(default_factory=set)
    """Names whose definition has been reported: using them is not a second mistake."""
    count: int = 0
    cells: int = 0

    def generator(self) -> Generator:
        plan = self.plan
        return Generator(
            plan.name,
            plan.fill,
            lets=self.lets(plan.lets, self.names),
            regions=tuple(self.region(name, shapes) for name, shapes in plan.regions.items()),
            groups=self.groups(plan.items),
            targets=tuple(Target(name, self.groups(items)) for name, items in plan.targets.items()),
            stamps=tuple(plan.stamps.values()),
        )

    def lets(
        self, written: Sequence[tuple[Word, Amount]], names: dict[str, Interval]
    ) -> tuple[tuple[str, Amount], ...]:
        """Named numbers in order; `names` gets their bounds."""
        found = []
        for word, amount in written:
            filled = self.filled(amount, names) if amount is not BROKEN else None
            if filled is None:
                self.broken.add(word.text)
            else:
                found.append((word.text, filled))
            names[word.text] = (0, 0) if filled is None else interval(filled, names)
        return tuple(found)

    def region(self, name: str, shapes: Sequence[Statement]) -> Region:
        drawings = tuple(filter(None, (self.drawing(one, self.names) for one in shapes)))
        return Region(name, drawings, any(integers(one.amounts) is None for one in drawings))

    def groups(self, items: Sequence[Item], inside: tuple[str, ...] = ()) -> tuple[Group, ...]:
        """The groups of a list of statements: each repetition is one, and each statement between them."""
        found: list[Group] = []
        for item in items:
            if isinstance(item, Repeat):
                found += self.repeated(item)
            elif item.kind == "part":
                found += self.part(item.name or Word("", item.span), inside)
            else:
                self.count += 1
                self.cells += 1
                drawing = self.drawing(item, self.names)
                found += [Group(self.count, number(1), 1, (), (drawing,))] if drawing else []
            if self.cells > MAX_DRAWINGS:
                message = f"a world of more than {MAX_DRAWINGS:,} drawings"
                self.reporter.error("PD508", message, item.span, "over the limit", helps=["draw less"])
                break
        return tuple(found)

    def part(self, name: Word, inside: tuple[str, ...]) -> tuple[Group, ...]:
        if name.text not in self.plan.parts:
            report_unknown("part", name, self.plan.parts, self.reporter)
            return ()
        self.used_parts.add(name.text)
        if name.text in inside:
            self.reporter.error("PD307", f"the part `{name.text}` is made of itself", name.span, "here")
            return ()
        return self.groups(self.plan.parts[name.text], (*inside, name.text))

    def repeated(self, repeat: Repeat) -> tuple[Group, ...]:
        self.count += 1
        place = self.count
        names = dict(self.names)
        for word, _ in repeat.lets:
            if word.text in self.names or word.text in self.plan.knobs:
                message = f"`{word.text}` already means something"
                self.reporter.error("PD308", message, word.span, "second meaning")
        count = self.filled(repeat.count, self.names)
        lets = self.lets(repeat.lets, names)
        drawings = []
        for statement in repeat.statements:
            self.count += 1
            if statement.kind == "part":
                label = "a part cannot stand in a repetition"
                self.reporter.error("PD605", "a part in a repetition", statement.span, label)
                continue
            drawings.append(self.drawing(statement, names))
        known = tuple(filter(None, drawings))
        if count is None or len(known) < len(drawings):
            return ()
        low, most = interval(count, self.names)
        if low < 0 or most > MAX_REPEATS:
            label = f"they must lie in 0..{MAX_REPEATS}"
            self.reporter.error("PD606", f"{low}..{most} repetitions", repeat.count.span, label)
            return ()
        self.cells += most * len(known)
        return (Group(place, count, most, lets, known),) if most and known else ()

    def drawing(self, statement: Statement, names: Mapping[str, Interval]) -> Drawing | None:
        ids, over = (
            choice_ids(one, self.ruleset, self.reporter, self.plan.knobs) if one else ()
            for one in (statement.choice, statement.over)
        )
        where, stamp = statement.where, statement.name
        for what, word, known in (("region", where, self.plan.regions), ("stamp", stamp, self.plan.stamps)):
            if word is not None and word.text not in known:
                report_unknown(what, word, known, self.reporter)
        amounts = [None if one is None else self.filled(one, names) for one in statement.numbers]
        if any(new is None and old is not None for new, old in zip(amounts, statement.numbers, strict=True)):
            return None
        found = Drawing(
            self.count,
            statement.kind,
            tuple(amounts),
            ids,
            where.text if where else None,
            frozenset(over) if statement.over else None,
            stamp.text if stamp else None,
            statement.span,
        )
        return found if self.numbers_fit(found, names) and (ids or statement.choice is None) else None

    def filled(self, amount: Amount, names: Mapping[str, Interval]) -> Amount | None:
        """The amount with knobs filled in, or None after reporting names that nothing defines."""
        if any(part.value in self.broken or part.value in self.plan.broken for part in amount.walk()):
            return None
        known = {**dict.fromkeys(names), **dict.fromkeys(self.plan.knobs)}
        unknown = [part for part in amount.walk() if part.op == "name" and part.value not in known]
        for part in unknown:
            assert part.span is not None
            report_unknown("number", Word(str(part.value), part.span), known, self.reporter)
        if unknown:
            return None
        try:
            found = filled_in(amount, self.plan.knobs)
            interval(found, names)
        except ZeroDivisionError:
            self.reporter.error("PD606", "a division by zero", amount.span, "the divisor can be 0")
            return None
        for part in found.walk():
            if part.op == "draw":
                (low, _), (_, high) = (interval(arg, names) for arg in part.args)
                if low > high:
                    label = "the first must not be above the second"
                    self.reporter.error("PD606", f"a range {low}..{high} without numbers", part.span, label)
                    return None
        return found

    def numbers_fit(self, drawing: Drawing, names: Mapping[str, Interval]) -> bool:
        """Whether all numbers can be what their statement needs; reports the others."""
        fits = True
        for amount, (what, lowest) in zip(drawing.amounts, NUMBERS[drawing.kind], strict=True):
            if amount is None:
                continue
            low, high = interval(amount, names)
            most = 100 if drawing.kind == "scatter" else MAX_NUMBER
            # A range that begins before the world is cut off, as everything is that lies outside.
            outside = drawing.kind in RANGES and lowest == 0
            least = -MAX_NUMBER if outside else max(lowest, -MAX_NUMBER)
            if low < least or high > most:
                can_be = f"it can be {low}..{high}" if low < high else f"it is {low}"
                self.reporter.error("PD606", f"{what} must lie in {least}..{most}", amount.span, can_be)
                fits = False
        return fits and self.covers_something(drawing, names)

    def covers_something(self, drawing: Drawing, names: Mapping[str, Interval]) -> bool:
        """Whether the shape can cover a cell; reports one that never does."""
        amounts = drawing.amounts
        never = ""
        for i in range(RANGES.get(drawing.kind, 0)):
            start, stop = amounts[2 * i], amounts[2 * i + 1]
            assert start is not None
            low = interval(start, names)[0]
            high = self.size[i] if stop is None else interval(stop, names)[1]
            if low >= high or start == stop or low >= self.size[i] or high <= 0:
                never = "rows" if i == 0 else "columns"
        values = integers(amounts) if drawing.kind not in ("scatter", "stamp") else None
        if values is not None and not mask(Shape(drawing.kind, values), self.size).any():
            never = never or "cells"
        if never:
            covers_nothing(drawing.span, f"none of its {never} lie", self.size, self.reporter)
        return not never


def report_unknown(what: str, word: Word, known: Mapping[str, object], reporter: Reporter) -> None:
    """Report a name that the task does not define, PD802."""
    helps = suggest(word.text, known, f"{what}s") or (f"the task defines no {what}s",)
    reporter.error("PD802", f"unknown {what} `{word.text}`", word.span, "not defined", helps=helps)


def choice_ids(
    choice: ElementChoice, ruleset: Ruleset, reporter: Reporter, knobs: Mapping[str, int]
) -> tuple[int, ...]:
    """The elements of a choice by id, in the order written, tags in the order of ids. Empty after a report."""
    ids = tuple(dict.fromkeys(i for word in choice.names for i in element_ids(word, ruleset, reporter)))
    if choice.how == "any":
        ids = tuple(element.id for element in ruleset.elements if element.id not in ids)
    if choice.how == "first":
        assert choice.count is not None
        count = filled_in(choice.count, knobs)
        if not count.is_number or not 1 <= count.integer <= len(ids):
            label = f"a number from 1 to {len(ids)}, or knobs"
            reporter.error("PD606", "how many of them must be fixed", choice.count.span, label)
            return ()
        ids = ids[: count.integer]
    if not ids and (choice.how == "any" or not choice.names):
        reporter.error("PD604", "a choice among no elements", choice.span, "nothing is left")
    return ids


def element_ids(word: Word, ruleset: Ruleset, reporter: Reporter) -> tuple[int, ...]:
    """The element, or all elements with the tag, of a name; empty after reporting PD604."""
    element = ruleset.element(word.text)
    if element is not None:
        return (element.id,)
    tagged = tuple(one.id for one in ruleset.elements if word.text in one.tags)
    if not tagged:
        known = {one.name for one in ruleset.elements} | {tag for one in ruleset.elements for tag in one.tags}
        helps = suggest(word.text, known, "its elements")
        label = "neither an element nor a tag of these rules"
        reporter.error("PD604", f"unknown element `{word.text}`", word.span, label, helps=helps)
    return tagged
