"""`powderdsl show`: what a ruleset or a task consists of, as tables or as JSON, and a picture of a task's worlds."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from powderdsl.analysis.changes import reactions
from powderdsl.cli import options as opt
from powderdsl.cli.exits import BadInput
from powderdsl.cli.output import color_wanted, print_json
from powderdsl.diagnostics import Span
from powderdsl.diagnostics.printable import printable, write_styled
from powderdsl.model.text import element_name, one_line, place_of, show_set, show_value
from powderdsl.model.types import ColorRamp, Element, Pass, Property, Ruleset, Value
from powderdsl.system.reports import Painted, table
from powderdsl.tasks.shipped import is_task

if TYPE_CHECKING:
    from powderdsl.tasks.task import Task


@click.command("show")
@click.argument("rules", metavar="RULES|TASK")
@opt.option("--json", bool, "One JSON object instead of tables.", to="as_json")
@opt.parameters
@opt.knobs("For a task: another value for a knob.")
@opt.option("--split", "SPLIT", "For a task: the set of worlds.", "train")
@opt.option("--seeds", (1, 256), "For a task: the number of worlds.", 16)
@opt.output("--out", "FILE.png", "For a task: draw these worlds, with regions outlined.", ".png")
def command(
    rules: str,
    as_json: bool,
    settings: dict[str, str],
    knobs: dict[str, int],
    split: str,
    seeds: int,
    out: Path | None,
) -> None:
    """List elements, reactions, passes and parameters; or what a task is, with pictures.

    TASK is a shipped task's name, or a file that begins with `task:`.
    """
    if is_task(rules):
        from powderdsl.tasks.shipped import check_split, load_task

        task = load_task(rules, knobs=knobs, params=settings)
        check_split(task, split)
        if as_json:
            print_json(_task_data(task))
        else:
            click.echo("\n".join(_task_text(task)))
        if out is not None:
            _write_sheet(task, split, seeds, out)
            click.echo(f"wrote {out}: seeds 0 to {seeds - 1} of {split}", err=as_json)
        return
    if out is not None or knobs:
        raise BadInput("--out and --knob go with a task")
    ruleset = opt.load_rules(rules, settings)
    if as_json:
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
    for line, before, after in reactions(ruleset):
        ids = show_set(ruleset, before), show_set(ruleset, after)
        rows.append([*ids, line.pass_name, line.text, str(line)])
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
        "packs": ruleset.packs,
        "slots": ruleset.slots,
        "elements": [
            _described(
                element,
                *("id", "name", "pack", "glyph", "color", "about", "tags"),
                color_by=_ramp_data(element.ramp),
                properties={prop.name: _plain(prop.values[element.id]) for prop in ruleset.properties},
            )
            for element in ruleset.elements
        ],
        "properties": [_described(prop, "name", "pack", kind=str(prop.kind)) for prop in ruleset.properties],
        "fields": [_described(field, "name", "at", "pack", kind=str(field.kind)) for field in ruleset.fields],
        "reactions": [
            {
                "from": [element_name(ruleset, number) for number in before],
                "to": [element_name(ruleset, number) for number in after],
                "pass": line.pass_name,
                "pack": line.pack,
                "rule": line.text,
                "where": str(line),
            }
            for line, before, after in reactions(ruleset)
        ],
        "passes": [
            _described(
                pass_,
                *("name", "pack"),
                moments=len(pass_.moments),
                rules=[{"rule": one_line(span), "where": place_of(span)} for span in rule_spans(pass_)],
            )
            for pass_ in ruleset.passes
        ],
        "params": [
            _described(param, "name", "about", kind=str(param.kind), value=_plain(param.default))
            for param in ruleset.params
        ],
    }


def _described(part: Any, *names: str, **more: Any) -> dict[str, Any]:
    """Some attributes of a part of the model, and its place."""
    return {**{name: getattr(part, name) for name in names}, **more, "where": place_of(part.span)}


def _ramp_data(ramp: ColorRamp | None) -> dict[str, Any] | None:
    if ramp is None:
        return None
    return {"field": ramp.field, "from": ramp.start, "to": ramp.end, "over": (ramp.lo, ramp.hi)}


# Tasks


def _task_text(task: Task) -> Iterator[str]:
    yield f"{task.name}{': ' if task.about else ''}{task.about}"
    yield f"rules: {task.ruleset.name}"
    yield f"worlds: {task.size[0]}×{task.size[1]} cells"
    yield f"agent: {'; '.join(_agent_text(task))}"
    rows = [["split", "worlds", "about"]]
    for split in task.splits:
        worlds = "one a seed" if len(split.variants) == 1 else f"{len(split.variants)} stands"
        rows.append([split.name, worlds, split.about])
    yield from ("", "Splits", *table(rows))
    rows = [["name", "value", "range", "about"]]
    rows += [[knob.name, str(knob.value), f"{knob.lo}..{knob.hi}", knob.about] for knob in task.knobs]
    yield from ("", "Knobs (--knob NAME=N)", *table(rows))


def _agent_text(task: Task) -> Iterator[str]:
    from powderdsl.tasks.task import BLOW

    agent, brush, bins = task.agent, task.agent.brush, task.agent.bins
    names = {element.id: element.name for element in task.ruleset.elements}
    placed = [names[choice] for choice in agent.choices if choice >= 0]
    acts = []
    if placed:
        acts.append("places " + ("any element" if len(placed) == len(names) else ", ".join(placed)))
    if BLOW in agent.choices:
        acts.append(f"blows with {agent.speed:g} ({agent.speed_field})")
    yield " or ".join(acts) or "does nothing"
    yield f"{agent.actions} actions of {agent.steps_per_action} steps"
    if agent.free_steps:
        yield f"then {agent.free_steps} steps"
    yield f"a brush of {brush[0]}×{brush[1]} cells at {bins[0]}×{bins[1]} places"


def _task_data(task: Task) -> dict[str, Any]:
    return {
        "name": task.name,
        "about": task.about,
        "rules": task.ruleset.name,
        "size": task.size,
        "agent": task.agent,
        "splits": [
            {"name": split.name, "about": split.about, "stands": [stand.name for stand in split.variants]}
            for split in task.splits
        ],
        "knobs": [
            {"name": knob.name, "value": knob.value, "range": [knob.lo, knob.hi], "about": knob.about}
            for knob in task.knobs
        ],
    }


def _write_sheet(task: Task, split: str, seeds: int, out: Path) -> None:
    """Start worlds side by side, each region outlined in a color of its own."""
    import torch

    from powderdsl.cli.pictures import MAX_SIDE, USUAL_SIDE
    from powderdsl.simulation.draw import OUTLINES, contact_sheet, outline, scale
    from powderdsl.simulation.media import write_png
    from powderdsl.tasks.episodes import compile_task

    program = compile_task(task, split=split, backend="torch")
    episodes = program.start(torch.arange(seeds))
    drawn = episodes.world.rgb().numpy()
    columns = math.ceil(math.sqrt(seeds))
    longest = max(task.size) * columns
    factor = max(2, min(8, 2 * USUAL_SIDE // longest))
    if longest * factor > MAX_SIDE:
        raise BadInput(f"a picture of {longest * factor:,} pixels a side: show fewer --seeds")
    images = scale(drawn, factor)
    for color, masks in zip(cycle(OUTLINES), episodes.regions.values(), strict=False):
        for world, image in enumerate(images):
            outline(image, masks[world % len(masks)].numpy(), factor, color)
    write_png(out, contact_sheet(images, columns=columns))
