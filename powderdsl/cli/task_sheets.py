"""What `powderdsl show` prints of a task, and a picture of its worlds."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from powderdsl.cli.exits import BadInput
from powderdsl.cli.options import check_writable
from powderdsl.cli.output import print_json
from powderdsl.cli.pictures import MAX_SIDE, USUAL_SIDE
from powderdsl.simulation.draw import OUTLINES, contact_sheet, outline, scale
from powderdsl.system.reports import table
from powderdsl.tasks.shipped import check_split, is_task, load_task
from powderdsl.tasks.task import BLOW, Agent, Task

if TYPE_CHECKING:
    from powderdsl.experiments.runs import RunFolder


def show_task(
    name: str,
    layout: str,
    settings: dict[str, str],
    knobs: Sequence[str],
    split: str,
    seeds: int,
    out: Path | None,
) -> None:
    """Print a task, and draw some of its worlds if `out` is given. Raises CompileError and BadInput."""
    task = load_task(name, knobs=knob_values(knobs), params=settings)
    check_split(task, split)
    if out is not None:
        if out.suffix.lower() != ".png":
            raise BadInput(f"`{out}`: a sheet is a .png file")
        check_writable(out)
    if layout == "json":
        print_json(_data(task))
    else:
        click.echo("\n".join(_text(task)))
    if out is not None:
        _write_sheet(task, split, seeds, out)
        click.echo(f"wrote {out}: seeds 0 to {seeds - 1} of {split}", err=layout == "json")


def knob_values(knobs: Sequence[str]) -> dict[str, int]:
    """`NAME=N` options as a mapping. Raises BadInput."""
    found = {}
    for one in knobs:
        match = re.fullmatch(r"([A-Za-z_]\w*)=(-?[0-9]{1,6})", one.strip())
        if match is None:
            raise BadInput(f"`{one}`: write --knob NAME=N")
        found[match[1]] = int(match[2])
    return found


def find_played(
    name: str, knobs: Sequence[str], settings: dict[str, str], packs: Sequence[str]
) -> Task | RunFolder:
    """The task or the run of an agent that a command was given. Raises CompileError and BadInput."""
    if is_task(name):
        return load_task(name, knobs=knob_values(knobs), params=settings, packs=packs)
    if knobs or settings:
        raise BadInput("--knob and --set go with a task: a run has its own")
    from powderdsl.experiments.runs import find_run

    return find_run(name, "ppo")


def _text(task: Task) -> Iterator[str]:
    yield f"{task.name}{': ' if task.about else ''}{task.about}"
    yield f"rules: {task.ruleset.name}"
    yield f"worlds: {task.size[0]}×{task.size[1]} cells"
    yield f"agent: {_agent_text(task.agent, task)}"
    rows = [["split", "worlds", "about"]]
    for split in task.splits:
        many = "one a seed" if len(split.variants) == 1 else f"{len(split.variants)} stands"
        rows.append([split.name, many, split.about])
    yield from ("", "Splits", *table(rows))
    rows = [["name", "value", "range", "about"]]
    rows += [[one.name, str(one.value), f"{one.lo}..{one.hi}", one.about] for one in task.knobs]
    yield from ("", "Knobs (--knob NAME=N)", *table(rows))


def _agent_text(agent: Agent, task: Task) -> str:
    named = {element.id: element.name for element in task.ruleset.elements}
    placed = [choice for choice in agent.choices if choice >= 0]
    acts = []
    if placed:
        every = len(placed) == len(named)
        acts.append("places " + ("any element" if every else ", ".join(named[one] for one in placed)))
    if BLOW in agent.choices:
        acts.append(f"blows with {agent.speed:g} ({agent.speed_field})")
    parts = [" or ".join(acts) or "does nothing"]
    parts.append(f"{agent.actions} actions of {agent.steps_per_action} steps")
    if agent.free_steps:
        parts.append(f"then {agent.free_steps} steps")
    brush, bins = agent.brush, agent.bins
    parts.append(f"a brush of {brush[0]}×{brush[1]} cells at {bins[0]}×{bins[1]} places")
    return "; ".join(parts)


def _data(task: Task) -> dict[str, Any]:
    return {
        "name": task.name,
        "about": task.about,
        "rules": task.ruleset.name,
        "size": list(task.size),
        "agent": asdict(task.agent),
        "splits": [
            {"name": one.name, "about": one.about, "stands": [v.name for v in one.variants]}
            for one in task.splits
        ],
        "knobs": [
            {"name": one.name, "value": one.value, "range": [one.lo, one.hi], "about": one.about}
            for one in task.knobs
        ],
    }


def _write_sheet(task: Task, split: str, seeds: int, out: Path) -> None:
    """Start worlds side by side, each region outlined in a color of its own."""
    import torch

    from powderdsl.simulation.media import write_png
    from powderdsl.tasks.episodes import compile_task

    program = compile_task(task, split=split, backend="torch")
    episodes = program.start(torch.arange(seeds))
    drawn = episodes.world.rgb().numpy()
    columns = int(np.ceil(np.sqrt(seeds)))
    longest = max(task.size) * columns
    factor = max(2, min(8, 2 * USUAL_SIDE // longest))
    if longest * factor > MAX_SIDE:
        raise BadInput(f"a picture of {longest * factor:,} pixels a side: show fewer --seeds")
    images = scale(drawn, factor)
    for color, masks in zip(cycle(OUTLINES), episodes.regions.values(), strict=False):
        for world, image in enumerate(images):
            outline(image, masks[world % len(masks)].numpy(), factor, color)
    write_png(out, contact_sheet(images, columns=columns))
