"""The ledger of a ruleset: the elements that its rules create, destroy and move, and the consequences for all worlds.

A verdict `Proven` holds for worlds of every size and content, for all parameter values and random numbers, at every
step. `NotProven` names the lines of rules that prevent a proof. The statement may still be true, since several rules
may compensate for each other.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain, product
from math import inf
from operator import gt, lt, ne
from typing import Any

from powderdsl.analysis.changes import (
    MAX_QUESTION,
    OUTCOMES,
    LineEffects,
    Overlap,
    Requirements,
    RuleLine,
    facts_of,
    find_changes,
    find_overlaps,
    find_requirements,
    may_rise_and_fall,
    named_by_fields,
)
from powderdsl.model.logic.satisfy import Budget
from powderdsl.model.text import element_name, show_value
from powderdsl.model.types import Assign, Field, Property, Ruleset

Bounds = tuple[float, float]

BUDGET = 2_000_000
"""Maximum number of nodes evaluated for each part of a ledger: some seconds. The largest shipped ruleset needs most."""

QUICK = 20_000
"""Maximum number of nodes evaluated for the trend of one element: at most about 50 ms."""

TREND_BREAKS: dict[str, Callable[..., Any]] = {"constant": ne, "never rises": gt, "never falls": lt}
"""The trends of a number, each with the comparison of a later value and an earlier one that breaks it."""


@dataclass(frozen=True)
class Proven:
    """A statement that holds in every world, at every step. `given` is a condition on the start world, if any.

    `by` is the method of the proof: the ``ledger``, or a ``search`` through all possible contents of a cell.
    """

    reason: str
    given: str = ""
    by: str = "ledger"

    def __bool__(self) -> bool:
        return True


@dataclass(frozen=True)
class NotProven:
    """An undecided statement: some lines of rules may break it."""

    reason: str
    rules: tuple[RuleLine, ...] = ()

    def __bool__(self) -> bool:
        return False


Verdict = Proven | NotProven


@dataclass(frozen=True)
class RuleEntry:
    """Upper bounds of the effects of one line.

    `changes` are pairs (before, after) of elements: the second replaces the first in a cell. `moves` are the elements
    that it carries away or pushes aside. `fires` is False if the line is proven to have no effect.

    At least one element of each of `needs` must exist, or the line cannot fire. `copies` are elements that it creates
    only where they already exist. An element exists if a cell contains it or a field names it, now or earlier in
    the step.
    """

    rule: RuleLine
    fires: bool
    changes: tuple[tuple[str, str], ...]
    moves: tuple[str, ...]
    needs: tuple[tuple[str, ...], ...]
    copies: tuple[str, ...]


@dataclass(frozen=True)
class FieldEntry:
    """A field, a scratch field of a pass, or a property that cells may override.

    `bounds` are the declared ones, for numbers: every write is clamped to them. `fresh_bounds` hold permanently in a
    world in which they hold once, such as one whose field was never set by hand. `travels`: it moves with the
    element; otherwise it stays in its place.
    """

    name: str
    kind: str
    default: str
    travels: bool
    bounds: Bounds | None
    fresh_bounds: Bounds | None
    writers: tuple[RuleLine, ...]
    reaches: tuple[tuple[RuleLine, Bounds], ...]
    """For each line that writes an integer: the lowest result, or ∞ if it never lowers it, and the highest, or -∞."""


@dataclass(frozen=True)
class Ledger:
    """The effects of a ruleset's rules, line by line, and conclusions from them. Elements are given by name.

    `complete` is False if the search ran out of budget: more effects are then considered possible.
    `named` are the elements that fields may name although no cell ever contained them.
    """

    name: str
    elements: tuple[str, ...]
    rules: tuple[RuleEntry, ...]
    fields: tuple[FieldEntry, ...]
    overlaps: tuple[Overlap, ...]
    named: tuple[str, ...]
    complete: bool

    @cached_property
    def changes(self) -> dict[tuple[str, str], tuple[RuleLine, ...]]:
        """Every pair (before, after) that some rule may bring about, and the lines that may."""
        changes: dict[tuple[str, str], tuple[RuleLine, ...]] = {}
        for entry in self.rules:
            for pair in entry.changes:
                changes[pair] = (*changes.get(pair, ()), entry.rule)
        return changes

    @cached_property
    def constant_sums(self) -> tuple[tuple[str, ...], ...]:
        """The smallest sums of elements that no single change alters; all other such sums consist of them.

        A change turns one cell of `a` into one of `b`: weights w keep the total if w(a) = w(b). So they are equal
        within each connected part of the graph of changes, and the parts are the sums.
        """
        group = {name: [name] for name in self.elements}
        for before, after in self.changes:
            if group[before] is not group[after]:
                group[before] += group[after]
                group |= dict.fromkeys(group[after], group[before])
        parts = {id(part): part for part in group.values()}.values()
        return tuple(self._in_order(part) for part in parts)

    @cached_property
    def rising_sums(self) -> tuple[tuple[str, ...], ...]:
        """The smallest sum with each element that never falls, unless that sum is constant.

        Such a sum contains everything that its element may become. Every other sum of different elements that cannot
        fall consists of these and of constant ones.
        """
        return self._closed_sums(self.changes)

    @cached_property
    def falling_sums(self) -> tuple[tuple[str, ...], ...]:
        """The smallest sum with each element that never rises, unless constant: everything that may become the element."""
        return self._closed_sums([(after, before) for before, after in self.changes])

    @property
    def sums(self) -> dict[str, tuple[tuple[str, ...], ...]]:
        return {
            "constant": self.constant_sums,
            "never falls": self.rising_sums,
            "never rises": self.falling_sums,
        }

    def _closed_sums(self, pairs: Iterable[tuple[str, str]]) -> tuple[tuple[str, ...], ...]:
        """Each element with everything reachable from it along some pairs, without the constant sums."""
        reached = {name: {name} for name in self.elements}
        for before, after in pairs:
            reached[before].add(after)
        # The transitive closure by Warshall's algorithm: the intermediate element is the outer loop.
        for middle, start in product(self.elements, repeat=2):
            if middle in reached[start]:
                reached[start] |= reached[middle]
        sums = dict.fromkeys(map(self._in_order, reached.values()))
        return tuple(names for names in sums if names not in self.constant_sums)

    def _in_order(self, chosen: Iterable[str]) -> tuple[str, ...]:
        """Some elements in the order of their ids."""
        names = set(chosen)
        return tuple(name for name in self.elements if name in names)

    def conserved(self, weights: Mapping[str, int]) -> Verdict:
        """Decide if the weighted number of cells is constant: ``{"a": 1, "b": 1}`` is the sum of two elements.

        Elements without a weight count 0. Raises KeyError for a name that is not an element.
        """
        return self.keeps(weights, "constant")

    def never_rises(self, what: Mapping[str, int] | Iterable[str]) -> Verdict:
        """Decide if the (weighted) number of cells with these elements never rises. Raises KeyError as `conserved`."""
        return self.keeps(what, "never rises")

    def never_falls(self, what: Mapping[str, int] | Iterable[str]) -> Verdict:
        """Decide if the (weighted) number of cells with these elements never falls. Raises KeyError as `conserved`."""
        return self.keeps(what, "never falls")

    def unchanged(self, element: str) -> Verdict:
        """Decide if a cell with this element keeps it permanently. Others may still become it: see `never_rises`.

        Raises KeyError for a name that is not an element.
        """
        self._check_names([element])
        lines = [
            entry.rule
            for entry in self.rules
            if element in entry.moves or any(before == element for before, _ in entry.changes)
        ]
        if not lines:
            return Proven(f"no rule moves `{element}` or turns it into anything")
        return NotProven(f"`{element}` may be moved or become something else", tuple(lines))

    def never_appears(self, element: str) -> Verdict:
        """Decide if a world that starts without this element, in cells and in fields, stays without it.

        Raises KeyError for a name that is not an element.
        """
        self._check_names([element])
        makers = [
            entry.rule
            for entry in self.rules
            if any(after == element for _, after in entry.changes)
            and element not in entry.copies
            and (element,) not in entry.needs
        ]
        if makers:
            return NotProven(f"`{element}` may come from other elements", tuple(makers))
        is_made = any(after == element for _, after in self.changes)
        return Proven(f"rules only copy existing `{element}`" if is_made else f"no rule makes `{element}`")

    def reach(self, start: Iterable[str]) -> tuple[str, ...]:
        """All elements that a world can ever hold, if it starts with these and its fields were not set by hand.

        Raises KeyError for a name that is not an element.
        """
        start = dict.fromkeys(start)
        self._check_names(start)
        cells = set(start)
        while True:
            more = {after for _, _, after in self.possible(cells)}
            if more <= cells:
                return self._in_order(cells)
            cells |= more

    def possible(self, cells: Set[str]) -> Iterator[tuple[RuleLine, str, str]]:
        """The changes (before, after) that lines may bring about in worlds whose cells hold only these elements."""
        known = {*cells, *self.named}
        for entry in self.rules:
            if all(known.intersection(names) for names in entry.needs):
                for before, after in entry.changes:
                    if before in cells and (after in known or after not in entry.copies):
                        yield entry.rule, before, after

    def within(self, field: str, low: float, high: float) -> Verdict:
        """Decide if a field's numbers stay within two bounds, in every cell. Both parts of a vector are numbers.

        Raises KeyError for a name that is not a field.
        """
        entry = next((f for f in self.fields if f.name == field), None)
        if entry is None:
            raise KeyError(f"no field `{field}` in {self.name}")
        if entry.bounds is None:
            return NotProven(f"`{field}` is not a number: it holds {entry.kind}")
        if low <= entry.bounds[0] and entry.bounds[1] <= high:
            return Proven(f"`{field}` is declared as {entry.kind}, and every write is clamped to it")
        if entry.fresh_bounds is None:
            return NotProven(f"`{field}` holds {entry.kind}", entry.writers)
        if low <= entry.fresh_bounds[0] and entry.fresh_bounds[1] <= high:
            return Proven(f"no rule writes `{field}` beyond", f"`{field}` within {low:g}..{high:g}")
        lines = [line for line, (least, most) in entry.reaches if least < low or most > high]
        if not lines:
            return NotProven(f"`{field}` starts outside {low:g}..{high:g}")
        return NotProven(f"`{field}` may be written beyond {low:g}..{high:g}", tuple(lines))

    def keeps(self, what: Mapping[str, int] | Iterable[str], trend: str) -> Verdict:
        """Decide if a (weighted) number of cells keeps to a trend of TREND_BREAKS. Raises KeyError as `conserved`."""
        weights = what if isinstance(what, Mapping) else dict.fromkeys(what, 1)
        self._check_names(weights)
        broken = {
            (a, b): lines
            for (a, b), lines in self.changes.items()
            if TREND_BREAKS[trend](weights.get(b, 0), weights.get(a, 0))
        }
        if not broken:
            parts = [
                name if weight == 1 else f"{weight} {name}" for name, weight in weights.items() if weight
            ]
            verb = {"constant": "alone changes", "never rises": "adds to", "never falls": "takes from"}[trend]
            return Proven(f"no rule {verb} " + (f"`{' + '.join(parts)}`" if parts else "nothing"))
        (before, after), _ = next(iter(broken.items()))
        lines = tuple(dict.fromkeys(chain.from_iterable(broken.values())))
        more = f", and {len(broken) - 1} changes more" if len(broken) > 1 else ""
        return NotProven(f"`{before}` may become `{after}`{more}", lines)

    def _check_names(self, names: Iterable[str]) -> None:
        for name in names:
            if name not in self.elements:
                raise KeyError(f"no element `{name}` in {self.name}")


def ledger(ruleset: Ruleset, *, needs: bool = True) -> Ledger:
    """The ledger of a checked ruleset, decided from its rules without running a world. Raises TypeError for other values.

    `needs`: also find what rules need in the world, which takes longer than the rest.
    """
    if not isinstance(ruleset, Ruleset):
        raise TypeError(f"ledger takes a Ruleset, from powderdsl.load; found {type(ruleset).__name__}")
    parts = [replace(facts_of(ruleset), budget=Budget(BUDGET, MAX_QUESTION)) for _ in range(3)]
    names = {element.id: element.name for element in ruleset.elements}
    effects = find_changes(ruleset, parts[0])
    requirements = find_requirements(ruleset, parts[1]) if needs else {}
    return Ledger(
        ruleset.name,
        tuple(names.values()),
        tuple(_entry(line, requirements.get(line.line), names) for line in effects),
        find_fields(ruleset, effects),
        find_overlaps(ruleset, parts[2]),
        tuple(_names_of(named_by_fields(ruleset), names)),
        all(facts.budget.left > 0 for facts in parts),
    )


def _entry(effects: LineEffects, requirements: Requirements | None, names: Mapping[int, str]) -> RuleEntry:
    requirements = requirements or Requirements((), frozenset())
    return RuleEntry(
        effects.line,
        effects.fires,
        tuple((names[a], names[b]) for a, b in sorted(effects.pairs)),
        tuple(_names_of(effects.moves, names)),
        tuple(tuple(_names_of(ids, names)) for ids in requirements.needs),
        tuple(_names_of(requirements.copies & {after for _, after in effects.pairs}, names)),
    )


def _names_of(ids: Iterable[int], names: Mapping[int, str]) -> Iterator[str]:
    return (names[number] for number in sorted(ids))


# Fields


def find_fields(ruleset: Ruleset, effects: Iterable[LineEffects]) -> tuple[FieldEntry, ...]:
    """The analysis of all fields: in load order, then scratch fields by pass, then properties."""
    writes = [(line.line, assign) for line in effects for assign in line.writes]
    entries = []
    for item in (*ruleset.fields, *(item for pass_ in ruleset.passes for item in pass_.scratch)):
        default = show_value(ruleset, item.kind, item.default)
        for identity, value in item.own:
            default += f", {element_name(ruleset, identity)} as {show_value(ruleset, item.kind, value)}"
        values = [(value, value) for value in item.defaults]
        entries.append(_field_entry(item, default, item.at == "element", values, writes))
    params = {param.name: (param.kind.lo, param.kind.hi) for param in ruleset.params}
    for prop in ruleset.properties:
        if prop.stored:
            values = [params[value] if isinstance(value, str) else (value, value) for value in prop.values]
            entries.append(_field_entry(prop, "its element has it", True, values, writes))
    return tuple(entries)


def _field_entry(
    item: Field | Property,
    default: str,
    travels: bool,
    fresh: Sequence[tuple[Any, Any]],
    writes: Iterable[tuple[RuleLine, Assign]],
) -> FieldEntry:
    """The entry of a field or property; `fresh` are the bounds of the values that fresh cells have."""
    kind = item.kind
    declared = (kind.lo, kind.hi) if kind.name in ("int", "real", "vec2") else None
    lines: dict[RuleLine, list[Bounds]] = {}
    for line, assign in writes:
        if assign.field == item.name:
            lines.setdefault(line, []).append(reach(assign, (kind.lo, kind.hi)))
    reaches = tuple((line, _hull(bounds)) for line, bounds in lines.items() if kind.name == "int")
    bounds = _hull([*fresh, *(bounds for _, bounds in reaches)]) if kind.name == "int" else None
    return FieldEntry(item.name, str(kind), default, travels, declared, bounds, tuple(lines), reaches)


def reach(assign: Assign, declared: Bounds) -> Bounds:
    """The lowest and highest integer that an assignment may lead to; ∞ if it never lowers it, -∞ if it never raises it."""
    low, high = assign.change
    if assign.op == ":=":
        return min(max(low, declared[0]), declared[1]), min(max(high, declared[0]), declared[1])
    return (declared[0] if low < 0 else inf), (declared[1] if high > 0 else -inf)


def _hull(parts: Sequence[Bounds]) -> Bounds:
    return min(low for low, _ in parts), max(high for _, high in parts)


# As text for people, and as plain data for JSON

SCHEMA = 1
"""The version of the JSON form. It changes when a key changes its meaning or is removed, not when keys are added."""


def ledger_text(ledger: Ledger) -> str:
    """The whole ledger, ending with a line break; equal rules give equal texts."""
    head = [
        f"ledger of {ledger.name}: {len(ledger.elements)} elements, {len(ledger.rules)} lines of rules",
        "Effects that are not listed cannot happen, in worlds of any size and content, with any parameters.",
    ]
    if not ledger.complete:
        head.append(
            "Incomplete: there are too many rules. Effects that could not be excluded in time are listed."
        )
    blocks: list[Iterable[str]] = [head, _sums(ledger), _sources(ledger)]
    blocks += [_element(ledger, name) for name in ledger.elements]
    blocks += [_rules(ledger), _fields(ledger), _overlaps(ledger)]
    return "\n\n".join("\n".join(block) for block in blocks) + "\n"


def _sums(ledger: Ledger) -> Iterator[str]:
    yield "sums of cells"
    for title, sums in ledger.sums.items():
        for names in sums:
            others = [name for name in ledger.elements if name not in names]
            text = "all but " + " and ".join(others) if len(others) < 3 < len(names) else " + ".join(names)
            yield f"  {title:<12} {text if others else 'all cells'}"


def _sources(ledger: Ledger) -> Iterator[str]:
    products = {after for _, after in ledger.changes}
    never = [name for name in ledger.elements if name not in products]
    copied = [name for name in ledger.elements if name in products and ledger.never_appears(name)]
    standing = [name for name in ledger.elements if ledger.unchanged(name)]
    yield "elements"
    yield f"  no rule makes: {_listed(never)}"
    yield f"  made only in worlds that already contain them: {_listed(copied)}"
    yield f"  stay in place permanently: {_listed(standing)}"


def _listed(names: Iterable[str]) -> str:
    return ", ".join(names) or "none"


TREND_WORDS = {"constant": "is constant", "not decided": "may rise and fall"}


def trend_text(ruleset: Ruleset, number: int) -> str:
    """The trend of the number of cells of one element, as text; empty if finding it would take too long."""
    facts = replace(facts_of(ruleset), budget=Budget(QUICK, MAX_QUESTION))
    trends = {(True, True): "not decided", (True, False): "never falls", (False, True): "never rises"}
    trend = trends.get(may_rise_and_fall(ruleset, facts, number), "constant")
    return f"its number {TREND_WORDS.get(trend, trend)}" if facts.budget.left > 0 else ""


def _element(ledger: Ledger, name: str) -> Iterator[str]:
    trend = _number(ledger, name)
    yield f"{name}: its number {TREND_WORDS.get(trend, trend)}"
    for verb, there, here in (("made from", 0, 1), ("becomes", 1, 0)):
        for entry in ledger.rules:
            names = [pair[there] for pair in entry.changes if pair[here] == name]
            if names:
                yield f"  {verb} {_listed(names)}: {_place(entry.rule)}"
    moved = [_place(entry.rule) for entry in ledger.rules if name in entry.moves]
    if moved:
        yield f"  moved: {_listed(moved)}"


def _number(ledger: Ledger, name: str) -> str:
    """The trend of an element's number of cells."""
    return next((trend for trend in TREND_BREAKS if ledger.keeps([name], trend)), "not decided")


def _place(rule: RuleLine) -> str:
    return f"{rule} ({rule.pass_name})"


def _rules(ledger: Ledger) -> Iterator[str]:
    yield "lines of rules"
    for entry in ledger.rules:
        yield f"  {_place(entry.rule)}: {entry.rule.text}"
        if not entry.fires:
            yield "    never fires: no cell of any world can fulfill it"
        elif entry.needs:
            needs = [ids[0] if len(ids) == 1 else f"one of ({', '.join(ids)})" for ids in entry.needs]
            yield f"    never fires without {', and without '.join(needs)}"


def _fields(ledger: Ledger) -> Iterator[str]:
    yield "fields" if ledger.fields else "fields: none"
    for entry in ledger.fields:
        place = "travels with its element" if entry.travels else "stays in its place"
        bounds = ""
        if entry.fresh_bounds is not None and entry.fresh_bounds != entry.bounds:
            bounds = f", within {entry.fresh_bounds[0]:g}..{entry.fresh_bounds[1]:g} unless set by hand"
        yield f"  {entry.name}: {entry.kind}{bounds}, starts as {entry.default}, {place}"
        yield f"    written: {_listed(_place(line) for line in entry.writers)}"


def _overlaps(ledger: Ledger) -> Iterator[str]:
    yield "lines that may meet" if ledger.overlaps else "lines that may meet: none"
    for outcome, words in OUTCOMES.items():
        overlaps = [overlap for overlap in ledger.overlaps if overlap.outcome == outcome]
        if overlaps:
            yield f"  {words}"
        for overlap in overlaps:
            what = f"{overlap.field}: " if overlap.field else ""
            other = _place(overlap.second) if overlap.second != overlap.first else "another copy of it"
            yield f"    {what}{_place(overlap.first)} and {other}"


# JSON


def ledger_data(ledger: Ledger) -> dict[str, Any]:
    """The ledger as plain data. Lines of rules are numbers of `rules`, from 0."""
    numbers = {entry.rule: number for number, entry in enumerate(ledger.rules)}
    return {
        "schema": SCHEMA,
        "name": ledger.name,
        "complete": ledger.complete,
        "constant_sums": ledger.constant_sums,
        "never_falls": ledger.rising_sums,
        "never_rises": ledger.falling_sums,
        "elements": [_element_data(ledger, name, numbers) for name in ledger.elements],
        "rules": [
            {"rule": line.text, "where": str(line), "pass": line.pass_name, "pack": line.pack}
            | _without(entry, "rule")
            for entry in ledger.rules
            for line in [entry.rule]
        ],
        "fields": [
            _without(entry, "writers", "reaches") | {"written_by": [numbers[line] for line in entry.writers]}
            for entry in ledger.fields
        ],
        "overlaps": [
            {"outcome": o.outcome, "field": o.field or None, "rules": (numbers[o.first], numbers[o.second])}
            for o in ledger.overlaps
        ],
    }


def _element_data(ledger: Ledger, name: str, numbers: dict[RuleLine, int]) -> dict[str, Any]:
    changes = {pair: [numbers[line] for line in lines] for pair, lines in ledger.changes.items()}
    return {
        "name": name,
        "number": _number(ledger, name),
        "unchanged": bool(ledger.unchanged(name)),
        "never_appears": bool(ledger.never_appears(name)),
        "made_from": {before: lines for (before, after), lines in changes.items() if after == name},
        "becomes": {after: lines for (before, after), lines in changes.items() if before == name},
        "moved_by": [numbers[entry.rule] for entry in ledger.rules if name in entry.moves],
    }


def _without(entry: RuleEntry | FieldEntry, *names: str) -> dict[str, Any]:
    return {name: value for name, value in vars(entry).items() if name not in names}
