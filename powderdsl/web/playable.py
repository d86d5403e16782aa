"""The tasks for people in the page, as data: start worlds, the agent's limits, and the goal as arithmetic on counts."""

from __future__ import annotations

import base64
import re
from collections.abc import Sequence
from typing import Any

from powderdsl.arrays import np
from powderdsl.model.state import qualified_slots
from powderdsl.model.types import Expr
from powderdsl.syntax.sources import shipped
from powderdsl.targets.array_kind import ArrayKind
from powderdsl.tasks.file import task_under
from powderdsl.tasks.goals import REGION_LET, measures_in, scalars_of
from powderdsl.tasks.shipped import load_task
from powderdsl.tasks.task import BLOW, NO_CHANGE, Measure, Split, Task
from powderdsl.tasks.tensors.generator import StartWorlds
from powderdsl.worlds.store import world_data

WORLDS = 8
"""Number of start worlds of a task in the page: the first ones of `played_split`."""


def played_split(task: Task) -> Split:
    """The split of the worlds in the page: of tasks whose rules differ by world, rules that training does not show."""
    return task.split("test") if task.splits[0].rulesets else task.splits[0]


def task_data(name: str) -> dict[str, Any]:
    """A task for the page: expressions are lists of an operation and its arguments.

    Each of `starts` has its rules and what depends on them, such as the ids of elements.
    """
    task = load_task(name)
    agent, split, measures = task.agent, played_split(task), measures_in(scalars_of(task.goal))
    goal = {key: getattr(task.goal, key) for key in ("each", "final", "success", "failure")}
    text = (shipped("tasks") / f"{name}.yaml").read_text(encoding="utf-8")
    lines = re.findall(r"^  ((?:each|final|success|failure): (?:.|\n    )*)$", text, re.MULTILINE)
    tasks = [task_under(task, rules) for rules in split.rulesets[:WORLDS]] or [task] * WORLDS
    return {
        "name": task.name,
        "about": task.about,
        "lines": [" ".join(line.split()).replace(">- ", "") for line in lines],
        **{key: getattr(agent, key) for key in ("brush", "bins", "actions", "speed")},
        "steps": agent.steps_per_action,
        "free": agent.free_steps,
        "goal": {key: _written(scalar, measures) for key, scalar in goal.items() if scalar is not None},
        "starts": [_start(task, split.name, number) for number, task in enumerate(tasks)],
    }


def start_world(task: Task, split: str, number: int) -> tuple[Any, dict[str, Any]]:
    """A start world of a split: as it is made, with its regions, and as JSON."""
    made = StartWorlds(task, split, ArrayKind()).make(np.array([number], np.int64))
    fields = {key: np.asarray(values)[0] for key, (values, _) in made.fields.items()}
    return made, world_data(task.ruleset, np.asarray(made.ids)[0], fields, (number, 0, 0))


def _start(task: Task, split: str, number: int) -> dict[str, Any]:
    """A start world, and what depends on its rules."""
    rules, measures = task.ruleset, measures_in(scalars_of(task.goal))
    made, world = start_world(task, split, number)
    counted = [_counted(measure, [element.id for element in rules.elements]) for measure in measures]
    names = {BLOW: "blow", NO_CHANGE: "nothing"}
    names |= {element.id: element.qualified for element in rules.elements}
    regions = {count[key] for count in counted for key in ("region", "let")} - {None}
    cells = {key: np.asarray(made.regions[key])[0].astype("uint8") for key in sorted(regions)}
    return {
        "rules": task.rules[0].replace(":", "_"),
        "choices": [names[choice] for choice in task.agent.choices],
        "field": qualified_slots(rules).get(task.agent.speed_field or ""),
        "measures": counted,
        "world": world,
        "regions": {key: base64.b64encode(values.tobytes()).decode() for key, values in cells.items()},
    }


def _counted(measure: Measure, elements: list[int]) -> dict[str, Any]:
    """The cells that a measure counts in `region`: elements `inside` the region `let` named by its cells, and outside."""
    value = measure.value
    assert value is not None
    lets = [str(part.value).removeprefix(REGION_LET) for part in value.walk() if part.op == "let"]
    inside, outside = ([id for id in elements if _holds(value, id, within)] for within in (True, False))
    where = {"how": measure.how, "region": measure.region, "let": lets[0] if lets else None}
    return {**where, "inside": inside, "outside": outside}


def _holds(cell: Expr, element: int, inside: bool) -> Any:
    """The value of an expression in a cell of an element, inside or outside the region that it names."""
    args = [_holds(arg, element, inside) for arg in cell.args]
    leaves = {"element": element, "let": inside, "const": cell.value}
    if cell.op in leaves:
        return leaves[cell.op]
    if cell.op == "member":
        return args[0] in cell.value
    return not args[0] if cell.op == "not" else all(args) if cell.op == "and" else any(args)


def _written(scalar: Expr, measures: Sequence[Measure]) -> Any:
    """An expression as JSON: numbers, and lists of an operation and its arguments."""
    if scalar.op == "const":
        return float(scalar.value)
    if scalar.op in ("measure", "action"):
        return [scalar.op, measures.index(scalar.value) if scalar.op == "measure" else scalar.value]
    return [scalar.op, *(_written(arg, measures) for arg in scalar.args)]
