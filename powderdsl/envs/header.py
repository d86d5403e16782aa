"""A task's environment for C programs: a header, and a C++ file with the rules, the task and start worlds."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from importlib.resources import files
from typing import Any, NamedTuple

import numpy as np
import torch

from powderdsl.compiler import segments_of
from powderdsl.envs.compiled import Plan
from powderdsl.envs.tensor_env import TensorEnv
from powderdsl.system.writing import failure
from powderdsl.targets.cpp.program import Places
from powderdsl.targets.cpp.source import known_width, native_source
from powderdsl.targets.layout import braced, pieces
from powderdsl.tasks.episodes import Episodes

SETTINGS = (
    *("threads", "steps", "free_steps", "actions", "limit", "mode", "last_terminates", "counts_always"),
    *("numbers", "fresh_count", "counts_painted", "element", "element_bits", "measures", "views", "size"),
)
"""Integers of `Play` that worlds do not change."""

C_TYPES = {"uint8": "uint8_t", "int32": "int", "int64": "int64_t", "float32": "float", "float64": "double"}


class CEnvironment(NamedTuple):
    """The texts of a header and of its C++ file."""

    header: str
    source: str


def c_environment(env: TensorEnv, worlds: int, name: str) -> CEnvironment:
    """Write an environment whose episodes begin in worlds 0 to `worlds` − 1 of its split and restart automatically.

    `name`: the file name of the header. Raises CompileError (PD702) if bit planes do not show everything that a step
    needs.
    """
    ruleset, size, split = env.task.ruleset, env.task.size, env.task.split(env.split)
    if split.params or split.rulesets:
        raise failure(
            "PD702",
            f"the worlds of the split {split.name} have laws of their own",
            helps=("choose another --split",),
        )
    segments = segments_of(ruleset)
    if len(segments) > 1 or segments[0].planes is None:
        raise failure(
            "PD702", f"{ruleset.name} does not fit on bit planes", helps=("use smaller numbers or kernels",)
        )
    code = native_source(segments[0].planes, known_width(size[1]))
    places = Places(code.layout, pieces(segments[0].program))
    plan = Plan(env, places)
    if plan.measures_cells:
        helps = ("`powderdsl show TASK --cost` names them",)
        raise failure("PD702", "bit planes do not show all measures of this task", helps=helps)
    episodes = env.program.start(torch.arange(worlds))
    lines = [code.whole, *_tables(env, plan, places, episodes), _text("environment.hpp")]
    values = ", ".join(map(str, env.action_form.nvec))
    constants = {
        "ROWS": size[0],
        "COLUMNS": size[1],
        "START_WORLDS": worlds,
        "ACTION_NUMBERS": len(env.action_form.nvec),
        "OBSERVATION_BYTES": plan.play.size,
        "EPISODE_ACTIONS": env.max_episode_steps,
    }
    header = _text("environment.h").replace("@TASK", env.task.name).replace("/* VALUES */", values)
    named = "\n".join(f"#define POWDER_{key} {value}" for key, value in constants.items())
    return CEnvironment(header.replace("/* CONSTANTS */", named), f'#include "{name}"\n' + "\n".join(lines))


def _text(name: str) -> str:
    return (files("powderdsl.targets.cpp") / name).read_text(encoding="utf-8")


def _tables(env: TensorEnv, plan: Plan, places: Places, episodes: Episodes) -> Iterator[str]:
    """Yield the tables of a task, and `describe`, which fills in what worlds do not change."""
    assignments = [f"p.{name} = {int(getattr(plan.play, name))};" for name in SETTINGS]
    names: dict[str, str] = {}
    for number, (name, values) in enumerate(plan.arrays.items()):
        names[name] = f"ARRAY_{number}"
        if name == "fresh":
            continue
        if name in ("each", "final", "success", "failure"):
            rows = [braced((op, at, float(value).hex())) for op, at, value in values.tolist()]
            yield _array("Op", names[name], rows)
            assignments.append(f"p.{name} = Formula{{{len(rows)}, {names[name]}}};")
        else:
            yield _numbers(names[name], values)
    slots = {piece.name: places.homes[piece.name] for parts in places.pieces.values() for piece in parts}
    fresh = [name for name in names if name.startswith("fresh ")]
    rows = [braced((*slots[name.removeprefix("fresh ")][:2], names[name])) for name in fresh]
    yield _array("Fresh", "FRESH", rows)
    for name, member in {"row_edges": "edges[0]", "column_edges": "edges[1]"}.items():
        assignments.append(f"p.{member} = {names[name]};")
    for name in ("most", "column", "table", "choices"):
        if name in names:
            assignments.append(f"p.{name} = {names[name]};")
    play, counts = plan.play, plan.counts
    for axis, slot in enumerate((play.speed_row, play.speed_column)):
        assignments.append(f"p.speed_slots[{axis}] = {slot};")
    assignments += [f"p.speed = {float(play.speed).hex()};", "p.fresh = FRESH;"]
    if counts is not None:
        yield _array("Gate", "GATES", map(braced, counts.gates.tolist()))
        ends = [braced((*end[:3], float(end[3]).hex())) for end in counts.ends.tolist()]
        yield _array("Count", "ENDS", ends)
        head = [int(getattr(counts.plan, name)) for name in ("gates", "counts", "numbers", "top", "bottom")]
        yield f"static const Counts COUNTS = {braced((*head, 'GATES', 'ENDS'))};"
        assignments.append("p.counts = &COUNTS;")
    views = []
    for number, (view, tables) in enumerate(zip(plan.views.parts, plan.views.tables, strict=True)):
        for at, table in enumerate(tables):
            yield _numbers(f"VIEW_{number}_{at}", table)
        given = [f"VIEW_{number}_{at}" for at in range(len(tables))] + ["nullptr"] * (2 - len(tables))
        views.append(braced((view.kind, braced(view.numbers), float(view.number).hex(), *given, view.offset)))
    yield _array("View", "VIEWS", views)
    assignments += ["p.view = VIEWS;", f"p.own_masks = {int(env.program.meter.own)};"]
    assignments.append(f"p.mask_words = {episodes.masks.words[0].numel()};")
    for name, tensor in {
        "start": episodes.start,
        "sizes": episodes.masks.sizes,
        "masks": episodes.masks.words,
    }.items():
        yield _numbers(f"POOL_{name.upper()}", tensor)
        cast = "(const u64*)" if name == "masks" else ""
        assignments.append(f"p.pool_{name} = {cast}POOL_{name.upper()};")
    params = env.simulator.parameters(env.params, 1)
    bits, reals = places.layout.parameters(torch, params, 1)
    yield _numbers("PARAMETER_BITS", bits)
    yield _numbers("PARAMETER_VALUES", reals)
    yield from _worlds(env, places, episodes)
    yield "static void describe(Play& p) {\n  " + "\n  ".join(assignments) + "\n}"


def _worlds(env: TensorEnv, places: Places, episodes: Episodes) -> Iterator[str]:
    """Yield the start worlds: each piece of the state in runs, or by a table of the elements' initial values."""
    worlds, (rows, columns) = len(episodes), env.task.size
    yield f"constexpr int ROWS = {rows}, COLUMNS = {columns}, WORLDS = {worlds};"
    ids = episodes.world.state["element"].numpy()
    entries: list[str] = []
    for name, parts in places.pieces.items():
        values = episodes.world.state[name].numpy()
        usual = env.program.hands.blocks.tables[name].numpy()
        for piece in parts:
            cells, table = piece.of(values), piece.of(usual)
            slot, bits, _ = places.homes[piece.name]
            home, label = (slot, bits, cells.dtype.itemsize), f"CELLS_{len(entries)}"
            if name != "element" and (cells == table[ids]).all():
                yield _array("u32", label, _words(table))
                entries.append(braced((*home, "nullptr", label)))
                continue
            flat = _words(cells.reshape(-1))
            ends = np.flatnonzero(np.diff(flat, append=flat[-1] + 1))
            runs = np.stack([np.diff(ends, prepend=-1), flat[ends]], 1)
            yield _array("u32", label, runs.reshape(-1))
            entries.append(braced((*home, label, "nullptr")))
    yield "struct PieceData {\n  int slot, bits, item;\n  const u32 *runs, *table;\n};"
    yield _array("PieceData", "PIECES", entries)


def _words(values: Any) -> Any:
    """Return the bits of values as 32-bit integers, int64."""
    whole = {1: np.uint8, 2: np.uint16, 4: np.uint32}[values.dtype.itemsize]
    return np.ascontiguousarray(values).view(whole).astype(np.int64)


def _array(kind: str, name: str, items: Iterable[object]) -> str:
    """Return a definition of an array, of at least one item."""
    texts = [*map(str, items)] or ["{}"]
    return f"static const {kind} {name}[] = {braced(texts)};"


def _numbers(name: str, values: Any) -> str:
    """Return the definition of a C array with exactly the numbers of a tensor or array."""
    array = np.ascontiguousarray(values).reshape(-1)
    texts = [float(value).hex() for value in array] if array.dtype.kind == "f" else map(str, array.tolist())
    return _array(C_TYPES[array.dtype.name], name, texts)
