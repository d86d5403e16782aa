"""The start worlds that the page offers with rules: scenes, those of tasks, shapes and noise."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from random import Random
from typing import Any

from powderdsl.analysis.changes import unchanging_ids
from powderdsl.arrays import np
from powderdsl.diagnostics import CompileError
from powderdsl.model.types import Ruleset
from powderdsl.targets.array_kind import PlainArrays
from powderdsl.tasks.shipped import load_task, shipped_tasks
from powderdsl.tasks.tensors.generator import StartWorlds
from powderdsl.web.worlds import world_data
from powderdsl.worlds.raster import mask
from powderdsl.worlds.scene import draw_start, shipped_scenes
from powderdsl.worlds.strewn import random_shape, strew

SIDE = 64
"""Rows and columns of worlds that have no size of their own."""

OWN_SHAPES = 12
"""Shapes of an added pack's own elements."""


def offered_worlds(ruleset: Ruleset, names: Sequence[str]) -> tuple[list[dict[str, Any]], str]:
    """Worlds with `name`, `about` and what `world_data` has; and the name of the world that shows the rules best.

    `names` is what `load` takes: an added pack gets a world with its elements.
    """
    found = [*_scenes(ruleset)]
    shown = found[-1]["name"] if found else "shapes"
    found.append(
        _named("shapes", "Random shapes of all elements.", ruleset, strew(ruleset, (SIDE, SIDE), 1, 0)[0])
    )
    if not unchanging_ids(ruleset):
        noise = Random(0).choices([element.id for element in ruleset.elements], k=SIDE * SIDE)
        ids = np.array(noise, np.uint8).reshape(SIDE, SIDE)
        found.append(_named("noise", "Every cell at random.", ruleset, ids))
    if len(names) > 1:
        found.append(_own(ruleset))
        shown = found[-1]["name"]
    return found, shown


def _named(name: str, about: str, ruleset: Ruleset, ids: Any, fields: Any = None) -> dict[str, Any]:
    return {"name": name, "about": about} | world_data(ruleset, ids, fields or {}, (0, 0, 0))


def _scenes(ruleset: Ruleset) -> Iterator[dict[str, Any]]:
    """The shipped scenes whose elements the rules have."""
    for scene in shipped_scenes():
        try:
            start = draw_start(scene, ruleset)
        except CompileError:
            continue
        fields = {name: given.values for name, given in start.fields.items()}
        yield _named(scene.name, scene.about or "", ruleset, start.ids, fields)


def task_worlds() -> dict[str, list[dict[str, Any]]]:
    """The first world of each shipped task's first split, by the rules of the tasks."""
    kind = PlainArrays()
    found: dict[str, list[dict[str, Any]]] = {}
    for name in shipped_tasks():
        task = load_task(name)
        made = StartWorlds(task, task.splits[0].name, kind).make(np.array([0], np.int64))
        world = _named(f"task {name}", task.about, task.ruleset, np.asarray(made.ids)[0])
        found.setdefault("+".join(task.rules), []).append(world)
    return found


def _own(ruleset: Ruleset) -> dict[str, Any]:
    """Shapes of all elements, and more of those of the pack that was added last."""
    pack = ruleset.packs[-1]
    own = [element.id for element in ruleset.elements if element.pack == pack]
    ids = strew(ruleset, (SIDE, SIDE), 1, 1)[0]
    edge = ids.copy()
    random = Random(2)
    for number in range(OWN_SHAPES if own else 0):
        ids[mask(random_shape(random, (SIDE, SIDE), SIDE // 10), (SIDE, SIDE))] = own[number % len(own)]
    ids[[0, -1]], ids[:, [0, -1]] = edge[[0, -1]], edge[:, [0, -1]]
    return _named(pack, f"Random shapes, and more of {pack}.", ruleset, ids)
