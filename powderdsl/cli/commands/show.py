"""`powderdsl show`: what a ruleset consists of, as tables or as JSON."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click

from powderdsl.analysis.reactions import reactions
from powderdsl.cli import options as opt
from powderdsl.cli.exits import BadInput
from powderdsl.cli.options import load_rules
from powderdsl.cli.output import color_wanted, print_json
from powderdsl.diagnostics import Span
from powderdsl.diagnostics.printable import printable, write_styled
from powderdsl.model.text import element_name, one_line, place_of, show_set, show_value
from powderdsl.model.types import Element, Pass, Property, Ruleset, Value
from powderdsl.system.reports import Painted, table
from powderdsl.tasks.shipped import is_task


@click.command("show")
@click.argument("rules", metavar="RULES|TASK")
@opt.layouts("One JSON object instead of tables.")
@opt.parameters
@opt.knobs("For a task: another value for a knob.")
@opt.text("--split", "SPLIT", "For a task: the set of worlds.", "train")
@opt.integer("--seeds", 1, 256, "For a task: the number of worlds.", 16)
@opt.path("--out", "FILE.png", "For a task: draw these worlds, with regions outlined.")
def command(
    rules: str,
    layout: str,
    settings: dict[str, str],
    knobs: tuple[str, ...],
    split: str,
    seeds: int,
    out: Path | None,
) -> None:
    """List elements, reactions, passes and parameters; or what a task is, with pictures.

    TASK is a shipped task's name, or a file that begins with `task:`.
    """
    if is_task(rules):
        from powderdsl.cli.task_sheets import show_task

        show_task(rules, layout, settings, knobs, split, seeds, out)
        return
    if out is not None or knobs:
        raise BadInput("--out and --knob go with a task")
    ruleset = load_rules(rules, settings)
    if layout == "json":
        print_json(_data(ruleset))
    else:
        write_styled(sys.stdout, "\n".join(_text(ruleset, color_wanted(sys.stdout))) + "\n")


def rule_spans(pass_: Pass) -> tuple[Span, ...]:
    """The spans of the rules of a pass, each line once: loops and symmetries make many rules of one."""
    return tuple(dict.fromkeys(rule.span for moment in pass_.moments for rule in moment.rules))


# Tables


def _text(ruleset: Ruleset, styled: bool) -> Iterator[str]:
    yield printable(f"{ruleset.name}{': ' if ruleset.about else ''}{ruleset.about}")
    yield f"packs: {' '.join(ruleset.packs)}"
    for title, rows in _tables(ruleset, styled):
        yield ""
        yield title
        yield from table(rows)


def _tables(ruleset: Ruleset, styled: bool) -> Iterator[tuple[str, list[list[str]]]]:
    """The title and the rows of each table."""
    rows = [["id", "element", "pack", "glyph", "color", *(p.name for p in ruleset.properties), "tags"]]
    for element in ruleset.elements:
        head = [str(element.id), element.name, element.pack, element.glyph, _color(element, styled)]
        values = [_property_text(ruleset, prop, element) for prop in ruleset.properties]
        rows.append([*head, *values, " ".join(sorted(element.tags))])
    yield f"Elements ({len(ruleset.elements)} of {ruleset.slots} ids)", rows
    rows = [["from", "to", "pass", "rule", "where"]]
    for one in reactions(ruleset):
        before, after = show_set(ruleset, one.before), show_set(ruleset, one.after)
        rows.append([before, after, one.pass_name, one_line(one.span), place_of(one.span)])
    yield "Reactions", rows
    rows = [["", "pass", "pack", "moments", "rules", "where"]]
    for number, pass_ in enumerate(ruleset.passes, 1):
        counts = [str(len(pass_.moments)), str(len(rule_spans(pass_)))]
        rows.append([str(number), pass_.name, pass_.pack, *counts, place_of(pass_.span)])
    yield "Passes, in order", rows
    rows = [["name", "value", "kind", "about", "where"]]
    for param in ruleset.params:
        value = show_value(ruleset, param.kind, param.default)
        rows.append([param.name, value, str(param.kind), param.about, place_of(param.span)])
    yield "Parameters (--set NAME=VALUE)", rows


def _swatch(color: str, styled: bool) -> str:
    if not styled:
        return color
    red, green, blue = bytes.fromhex(color[1:])
    return Painted(f"\x1b[48;2;{red};{green};{blue}m    \x1b[0m {color}")


def _color(element: Element, styled: bool) -> str:
    """Its color, and both ends of its ramp with what this follows."""
    text, ramp = _swatch(element.color, styled), element.ramp
    if ramp is None:
        return text
    start, end = _swatch(ramp.start, styled), _swatch(ramp.end, styled)
    text = f"{text}; {start} -> {end} by {ramp.field} {ramp.lo}..{ramp.hi}"
    return Painted(text) if styled else text


def _property_text(ruleset: Ruleset, prop: Property, element: Element) -> str:
    """Its value; `*` where cells may hold one of their own."""
    text = show_value(ruleset, prop.kind, prop.values[element.id])
    return f"{text}*" if element.id in prop.stored else text


# JSON


def _plain(value: Value | str) -> Any:
    """A constant for JSON: chances as numbers in 0..1."""
    if isinstance(value, (str, int)):
        return value
    return [float(part) for part in value] if isinstance(value, tuple) else float(value)


def _data(ruleset: Ruleset) -> dict[str, Any]:
    return {
        "name": ruleset.name,
        "about": ruleset.about,
        "packs": list(ruleset.packs),
        "slots": ruleset.slots,
        "elements": [_element_data(ruleset, element) for element in ruleset.elements],
        "properties": [_described(one, "name", "kind", "pack") for one in ruleset.properties],
        "fields": [_described(one, "name", "kind", "at", "pack") for one in ruleset.fields],
        "reactions": [
            {
                "from": [element_name(ruleset, number) for number in one.before],
                "to": [element_name(ruleset, number) for number in one.after],
                "pass": one.pass_name,
                "rule": one_line(one.span),
                **_described(one, "pack"),
            }
            for one in reactions(ruleset)
        ],
        "passes": [
            {
                "moments": len(one.moments),
                "rules": [{"rule": one_line(span), "where": place_of(span)} for span in rule_spans(one)],
                **_described(one, "name", "pack"),
            }
            for one in ruleset.passes
        ],
        "params": [
            {"value": _plain(one.default), **_described(one, "name", "kind", "about")}
            for one in ruleset.params
        ],
    }


def _described(one: Any, *names: str) -> dict[str, str]:
    """Some attributes of a part of the model as text, and its place."""
    return {**{name: str(getattr(one, name)) for name in names}, "where": place_of(one.span)}


def _element_data(ruleset: Ruleset, element: Element) -> dict[str, Any]:
    ramp = element.ramp
    return {
        "id": element.id,
        "name": element.name,
        "pack": element.pack,
        "glyph": element.glyph,
        "color": element.color,
        "color_by": ramp
        and {"field": ramp.field, "from": ramp.start, "to": ramp.end, "over": [ramp.lo, ramp.hi]},
        "about": element.about,
        "tags": sorted(element.tags),
        "properties": {prop.name: _plain(prop.values[element.id]) for prop in ruleset.properties},
        "where": place_of(element.span),
    }
