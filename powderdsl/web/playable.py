"""The tasks for people in the page, as data: start worlds, the agent's limits, and the goal as arithmetic on counts."""

from __future__ import annotations

import base64
import re
from functools import cache
from typing import Any

from powderdsl.arrays import np
from powderdsl.model.state import qualified_slots
from powderdsl.model.types import Expr
from powderdsl.syntax.sources import shipped
from powderdsl.targets.array_kind import ArrayKind
from powderdsl.tasks.goals import REGION_LET, parts_of
from powderdsl.tasks.shipped import load_task, shipped_tasks
from powderdsl.tasks.task import BLOW, NO_CHANGE, Measure, Task
from powderdsl.tasks.tensors.generator import StartWorlds
from powderdsl.worlds.store import world_data

WORLDS = 8
"""Number of start worlds of a task in the page: the first ones of its first split."""

_KNOWN = {"element", "member", "let", "and", "or", "not", "const"}
"""Operations on cells that depend only on their element."""


@cache
def playable() -> tuple[str, ...]:
    """The shipped tasks with a goal that depends on counts of elements, under rules that all worlds share."""
    return tuple(name for name in shipped_tasks() if _is_playable(load_task(name)))


def _is_playable(task: Task) -> bool:
    split, values = task.splits[0], [measure.value for measure in _measures(task)]
    alike = not split.rulesets and not split.params and len(task.rules) == 1
    known = all(value is not None and {part.op for part in value.walk()} <= _KNOWN for value in values)
    return alike and known and (task.goal.each is not None or task.goal.final is not None)


def _goal(task: Task) -> dict[str, Expr]:
    goal = {key: getattr(task.goal, key) for key in ("each", "final", "success", "failure")}
    return {key: scalar for key, scalar in goal.items() if scalar is not None}


def _measures(task: Task) -> list[Measure]:
    parts = (part for scalar in _goal(task).values() for part in parts_of(scalar))
    return list(dict.fromkeys(part.value for part in parts if part.op == "measure"))


def task_data(name: str) -> dict[str, Any]:
    """A task for the page: expressions are lists of an operation and its arguments."""
    task, rules = load_task(name), load_task(name).ruleset
    made = StartWorlds(task, task.splits[0].name, ArrayKind()).make(np.arange(WORLDS, dtype=np.int64))
    agent, measures = task.agent, _measures(task)
    counted = [_counted(measure, [element.id for element in rules.elements]) for measure in measures]
    names = {element.id: element.qualified for element in rules.elements}
    names |= {BLOW: "blow", NO_CHANGE: "nothing"}
    text = (shipped("tasks") / f"{name}.yaml").read_text(encoding="utf-8")
    lines = re.findall(r"^  ((?:each|final|success|failure): (?:.|\n    )*)$", text, re.MULTILINE)
    starts = []
    for number in range(WORLDS):
        fields = {key: np.asarray(values)[number] for key, (values, _) in made.fields.items()}
        world = world_data(rules, np.asarray(made.ids)[number], fields, (number, 0, 0))
        regions = {}
        for region in sorted({one[key] for one in counted for key in ("region", "let") if one[key]}):
            cells = np.asarray(made.regions[region])
            octets = cells[number % len(cells)].astype("uint8").tobytes()
            regions[region] = base64.b64encode(octets).decode()
        starts.append({"world": world, "regions": regions})
    return {
        "name": task.name,
        "about": task.about,
        "rules": task.rules[0],
        "lines": [" ".join(line.split()).replace(">- ", "") for line in lines],
        "choices": [names[choice] for choice in agent.choices],
        "brush": agent.brush,
        "bins": agent.bins,
        "actions": agent.actions,
        "steps": agent.steps_per_action,
        "free": agent.free_steps,
        "speed": agent.speed,
        "field": qualified_slots(rules).get(agent.speed_field or ""),
        "goal": {key: _written(scalar, measures) for key, scalar in _goal(task).items()},
        "measures": counted,
        "starts": starts,
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


def _written(scalar: Expr, measures: list[Measure]) -> Any:
    """An expression as JSON: numbers, and lists of an operation and its arguments."""
    if scalar.op == "const":
        return float(scalar.value)
    if scalar.op in ("measure", "action"):
        return [scalar.op, measures.index(scalar.value) if scalar.op == "measure" else scalar.value]
    return [scalar.op, *(_written(arg, measures) for arg in scalar.args)]
