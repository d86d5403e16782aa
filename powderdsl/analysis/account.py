"""The ledger as text for people, and as plain data for JSON."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

from powderdsl.analysis.changes import OUTCOMES, RuleLine
from powderdsl.analysis.ledger import TREND_BREAKS, FieldEntry, Ledger, RuleEntry

SCHEMA = 1
"""The version of the JSON form. It changes when a key changes its meaning or goes; new keys may come without."""


def ledger_text(ledger: Ledger) -> str:
    """The whole ledger, ends with a line break; equal rules give equal texts."""
    head = [
        f"ledger of {ledger.name}: {len(ledger.elements)} elements, {len(ledger.rules)} lines of rules",
        "What is not listed cannot happen: in worlds of any size and content, with any parameters.",
    ]
    if not ledger.complete:
        head.append(
            "Not decided in full: the rules are too many. What could not be excluded in time is listed."
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
    yield f"  made only in worlds that hold them already: {_listed(copied)}"
    yield f"  stay in place permanently: {_listed(standing)}"


def _listed(names: Iterable[str]) -> str:
    return ", ".join(names) or "none"


def _element(ledger: Ledger, name: str) -> Iterator[str]:
    words = {"constant": "is constant", "not decided": "may rise and fall"}
    number = _number(ledger, name)
    yield f"{name}: its number {words.get(number, number)}"
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
            yield "    never happens: no cell of any world can fulfill it"
        elif entry.needs:
            needs = [ids[0] if len(ids) == 1 else f"one of ({', '.join(ids)})" for ids in entry.needs]
            yield f"    never happens without {', and without '.join(needs)}"


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
    """The ledger as plain data: the form is in docs/testing.md. Lines of rules are numbers of `rules`, from 0."""
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
