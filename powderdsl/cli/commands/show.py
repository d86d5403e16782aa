"""`powderdsl show`: the contents of a ruleset or task as tables or JSON, and pictures of a task's worlds."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Iterable, Iterator
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from powderdsl.analysis.changes import reactions
from powderdsl.cli import options as opt
from powderdsl.cli.exits import BadInput
from powderdsl.cli.output import color_wanted, print_json
from powderdsl.diagnostics.printable import printable, write_styled
from powderdsl.model.text import element_name, one_line, place_of, show_set, show_value
from powderdsl.model.types import ColorRamp, Element, Pass, Property, Ruleset
from powderdsl.system.reports import Painted, table
from powderdsl.tasks.shipped import is_task

if TYPE_CHECKING:
    from powderdsl.tasks.task import Split, Task


@click.command("show")
@click.argument("rules", metavar="RULES|TASK")
@opt.option("--json", bool, "Print one JSON object instead of tables.", to="as_json")
@opt.option("--cost", bool, "For a task: also list parts of a step outside the single call of native code.")
@opt.parameters
@opt.knobs("For a task: set a knob.")
@opt.option("--split", "SPLIT", "For a task: the set of worlds.", "train")
@opt.option("--worlds", (1, 256), "For a task: number of worlds of the split.", 16)
@opt.output("--out", "FILE.png", "For a task: draw these worlds, with regions outlined.", ".png")
def command(
    rules: str,
    as_json: bool,
    cost: bool,
    settings: dict[str, str],
    knobs: dict[str, int],
    split: str,
    worlds: int,
    out: Path | None,
) -> None:
    """List elements, reactions, passes and parameters, or describe a task, with pictures.

    TASK is the name of a shipped task, or a file that begins with `task:`.
    """
    if is_task(rules):
        from powderdsl.tasks.shipped import check_split, load_task

        task = load_task(rules, knobs=knobs, params=settings)
        check_split(task, split)
        head, tables = _of_task(task)
        _show(head | ({"step": _step_text(task, split)} if cost else {}), tables, as_json)
        if out is not None:
            _write_sheet(task, split, worlds, out)
            click.echo(f"wrote {out}: worlds 0 to {worlds - 1} of {split}", err=as_json)
        return
    if out is not None or knobs or cost:
        raise BadInput("--out, --knob and --cost require a task")
    _show(*_of_rules(opt.load_rules(rules, settings)), as_json)


Tables = dict[str, list[dict[str, Any]]]
"""The rows of each table, as values by column. A mapping in a row has a column for each key."""


class Shown(NamedTuple):
    """A cell shown as text in tables, and as data in JSON."""

    text: str
    data: Any


TITLES = {
    "passes": "Passes, in order",
    "params": "Parameters (--set NAME=VALUE)",
    "knobs": "Knobs (--knob NAME=N)",
}
"""Titles of tables, where they differ from the name."""


def _show(head: dict[str, Any], tables: Tables, as_json: bool) -> None:
    """Print tables, with color swatches on a terminal."""
    if as_json:
        print_json(_data({**head, **tables}))
        return
    styled = color_wanted(sys.stdout)
    about = f": {head['about']}" if head["about"] else ""
    lines = [printable(f"{head['name']}{about}")]
    lines += [f"{name}: {_text(value)}" for name, value in head.items() if name not in ("name", "about")]
    for name, parts in tables.items():
        rows = [
            {
                key: cell
                for name, value in part.items()
                for key, cell in (value.items() if isinstance(value, dict) else ((name, value),))
            }
            for part in parts
        ]
        cells = [[_text(cell, styled) for cell in row.values()] for row in rows]
        columns = [column for column in zip(rows[0], *cells, strict=True) if any(column[1:])] if rows else []
        lines += ["", TITLES.get(name, name.capitalize()), *table([*zip(*columns, strict=True)])]
    write_styled(sys.stdout, "\n".join(lines) + "\n")


def _data(value: Any) -> Any:
    """Cells as data, in lists and mappings."""
    if isinstance(value, Shown):
        return value.data
    if isinstance(value, dict):
        return {name: _data(part) for name, part in value.items()}
    return [_data(part) for part in value] if isinstance(value, list) else value


def _text(value: Any, styled: bool = False) -> str:
    """A cell as text; names are separated by spaces."""
    if isinstance(value, Shown):
        value = value.text
    text = " ".join(value) if isinstance(value, list) else str(value)
    if not (styled and COLOR.search(text)):
        return text
    return Painted(COLOR.sub(_swatch, printable(text)))


COLOR = re.compile("#([0-9A-Fa-f]{6})")


def _swatch(color: re.Match[str]) -> str:
    red, green, blue = bytes.fromhex(color[1])
    return f"\x1b[48;2;{red};{green};{blue}m    \x1b[0m {color[0]}"


def _of_rules(ruleset: Ruleset) -> tuple[dict[str, Any], Tables]:
    head = {"name": ruleset.name, "about": ruleset.about, "packs": [*ruleset.packs], "slots": ruleset.slots}
    elements = [
        {
            **_described(element, "id", "name", "pack", "glyph", "color"),
            "color_by": _ramp(element.ramp),
            "properties": {prop.name: _property(ruleset, prop, element) for prop in ruleset.properties},
            "tags": sorted(element.tags),
            **_described(element, "about", "where"),
        }
        for element in ruleset.elements
    ]
    fields = [_described(field, "name", "pack", "at", "kind", "where") for field in ruleset.fields]
    changes = [
        {
            **{side: _elements(ruleset, ids) for side, ids in (("from", before), ("to", after))},
            "pass": line.pass_name,
            "rule": line.text,
            "where": str(line),
        }
        for line, before, after in reactions(ruleset)
    ]
    passes = [
        {
            **_described(pass_, "name", "pack"),
            "substeps": len(pass_.substeps),
            "rules": _rules(pass_),
            "where": place_of(pass_.span),
        }
        for pass_ in ruleset.passes
    ]
    params = [
        {
            "name": param.name,
            "value": Shown(show_value(ruleset, param.kind, param.default), _plain(param.default)),
            **_described(param, "kind", "about", "where"),
        }
        for param in ruleset.params
    ]
    return head, {
        "elements": elements,
        "fields": fields,
        "reactions": changes,
        "passes": passes,
        "params": params,
    }


def _described(part: Any, *names: str) -> dict[str, Any]:
    """Some attributes of a part of the model, and its location."""
    special = {"kind": lambda: str(part.kind), "where": lambda: place_of(part.span)}
    return {name: special[name]() if name in special else getattr(part, name) for name in names}


def _plain(value: Any) -> Any:
    """A constant for JSON: chances are numbers in 0..1."""
    if isinstance(value, str | int):
        return value
    return [_plain(part) for part in value] if isinstance(value, tuple) else float(value)


def _elements(ruleset: Ruleset, ids: Iterable[int]) -> Shown:
    return Shown(show_set(ruleset, ids), [element_name(ruleset, number) for number in ids])


def _rules(pass_: Pass) -> Shown:
    """The number of a pass's rules, and their distinct lines: loops and symmetries make many rules of one."""
    spans = dict.fromkeys(rule.span for substep in pass_.substeps for rule in substep.rules)
    return Shown(str(len(spans)), [{"rule": one_line(span), "where": place_of(span)} for span in spans])


def _ramp(ramp: ColorRamp | None) -> Shown:
    """The field that determines an element's color, and both ends of its range."""
    if ramp is None:
        return Shown("", None)
    data = {"field": ramp.field, "from": ramp.start, "to": ramp.end, "over": [ramp.lo, ramp.hi]}
    return Shown(f"{ramp.start} -> {ramp.end} by {ramp.field} {ramp.lo}..{ramp.hi}", data)


def _property(ruleset: Ruleset, prop: Property, element: Element) -> Shown:
    """A property's value; as text, with a `*` if cells may have their own value."""
    value = prop.values[element.id]
    text = show_value(ruleset, prop.kind, value)
    return Shown(f"{text}*" if element.id in prop.stored else text, _plain(value))


# Tasks


def _of_task(task: Task) -> tuple[dict[str, Any], Tables]:
    head = {
        **_described(task, "name", "about"),
        "rules": task.ruleset.name,
        "size": Shown(f"{task.size[0]}×{task.size[1]} cells", task.size),
        "agent": Shown("; ".join(_agent_text(task)), task.agent),
    }
    splits = [
        {
            **_described(split, "name", "about"),
            "stands": [stand.name for stand in split.variants],
            "laws": _laws(split),
        }
        for split in task.splits
    ]
    knobs = [
        {
            "name": knob.name,
            "value": knob.value,
            "range": Shown(f"{knob.lo}..{knob.hi}", [knob.lo, knob.hi]),
            "about": knob.about,
        }
        for knob in task.knobs
    ]
    return head, {"splits": splits, "knobs": knobs}


def _laws(split: Split) -> Shown:
    """The parameters and rulesets that a split's worlds draw."""
    ranges = {part.name: [part.low, part.high] for part in split.params}
    texts = [f"{name} {low:g}..{high:g}" for name, (low, high) in ranges.items()]
    if split.rulesets:
        first, last = ("+".join(rules) for rules in (split.rulesets[0], split.rulesets[-1]))
        texts.append(f"{len(split.rulesets)} rulesets: {first}" + (f" … {last}" if first != last else ""))
    return Shown(", ".join(texts), {"params": ranges, "rulesets": [*map(list, split.rulesets)]})


def _step_text(task: Task, split: str) -> str:
    """The text on how an environment's step runs if there is a C++ compiler."""
    from powderdsl.tasks.episodes import compile_task

    meter = compile_task(task, split=split).meter
    left = [measure for number, measure in enumerate(meter.measures) if number not in meter.on_planes]
    if not left:
        return "one call of native code"
    places = ", ".join(
        f"{measure.how}(…{f' in {measure.region}' if measure.region else ''})" for measure in left
    )
    return f"native code, but {len(left)} of {len(meter.measures)} measures on tensors: {places}"


def _agent_text(task: Task) -> Iterator[str]:
    from powderdsl.tasks.task import BLOW, NO_CHANGE

    agent, brush, bins = task.agent, task.agent.brush, task.agent.bins
    names = {element.id: element.name for element in task.ruleset.elements}
    placed = [names[choice] for choice in agent.choices if choice >= 0]
    acts = []
    if placed:
        acts.append("places " + ("any element" if len(placed) == len(names) else ", ".join(placed)))
    if BLOW in agent.choices:
        acts.append(f"blows with {agent.speed:g} ({agent.speed_field})")
    if NO_CHANGE in agent.choices:
        acts.append("does nothing")
    yield " or ".join(acts)
    yield f"{agent.actions} actions of {agent.steps_per_action} steps"
    if agent.free_steps:
        yield f"then {agent.free_steps} steps"
    yield f"a brush of {brush[0]}×{brush[1]} cells at {bins[0]}×{bins[1]} places"


def _write_sheet(task: Task, split: str, worlds: int, out: Path) -> None:
    """Start worlds side by side, each region outlined in its own color."""
    import torch

    from powderdsl.cli.pictures import MAX_SIDE
    from powderdsl.simulation.draw import OUTLINES, contact_sheet, outline, scale
    from powderdsl.simulation.simulator import USUAL_SIDE
    from powderdsl.tasks.episodes import compile_task
    from powderdsl.worlds.media import write_png

    program = compile_task(task, split=split, backend="torch")
    numbers = torch.arange(worlds)
    if program.is_mixed:
        rulesets = enumerate(program.ruleset_of(numbers).tolist())
        parts = [program.under(ruleset).start(numbers[[world]]) for world, ruleset in rulesets]
    else:
        parts = [program.start(numbers)]
    drawn = torch.cat([part.world.rgb() for part in parts]).numpy()
    regions = {name: [part.regions[name] for part in parts] for name in parts[0].regions}
    columns = math.ceil(math.sqrt(worlds))
    longest = max(task.size) * columns
    factor = max(2, min(8, 2 * USUAL_SIDE // longest))
    if longest * factor > MAX_SIDE:
        raise BadInput(f"a picture of {longest * factor:,} pixels a side: show fewer --worlds")
    images = scale(drawn, factor)
    for color, cells in zip(cycle(OUTLINES), regions.values(), strict=False):
        masks = torch.cat(cells).numpy()
        for world, image in enumerate(images):
            outline(image, masks[world % len(masks)], factor, color)
    write_png(out, contact_sheet(images, columns=columns))
