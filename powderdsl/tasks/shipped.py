"""Tasks by name or path. Needs no torch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from powderdsl.compiler import shipped
from powderdsl.diagnostics import CompileError, Diagnostic, Reporter, Severity, suggest
from powderdsl.model.composition.palette import Palette
from powderdsl.syntax.sources import read_source
from powderdsl.tasks.file import read_task
from powderdsl.tasks.names import shipped_tasks
from powderdsl.tasks.task import Task


def load_task(
    name_or_path: str | Path,
    *,
    knobs: Mapping[str, int] | None = None,
    params: Mapping[str, Any] | None = None,
    packs: Sequence[str] = (),
    palette: Palette | None = None,
) -> Task:
    """A shipped task by name, or a file.

    Args:
        knobs: values for knobs of the task.
        params: values for parameters of its rules, by qualified name.
        packs: names or files of packs that are added to its rules.
        palette: ids that were recorded, as `compiler.load` takes them.

    Raises:
        CompileError: with everything that is wrong.
    """
    return load_task_with_diagnostics(name_or_path, knobs=knobs, params=params, packs=packs, palette=palette)[
        0
    ]


def load_task_with_diagnostics(
    name_or_path: str | Path,
    *,
    knobs: Mapping[str, int] | None = None,
    params: Mapping[str, Any] | None = None,
    packs: Sequence[str] = (),
    palette: Palette | None = None,
) -> tuple[Task, tuple[Diagnostic, ...]]:
    """Like `load_task`; the second value has the warnings and notes."""
    reporter = Reporter()
    for name, value in (knobs or {}).items():
        if isinstance(value, bool) or not isinstance(value, int):
            raise TypeError(f"the knob `{name}` takes an integer, found {value!r}")
    text = str(name_or_path)
    path = shipped("tasks") / f"{text}.yaml" if text in shipped_tasks() else Path(text)
    if text not in shipped_tasks() and not text.lower().endswith((".yaml", ".yml")):
        helps = suggest(text, shipped_tasks()) or ("shipped: " + ", ".join(shipped_tasks()),)
        reporter.error("PD801", f"no task `{text[:80]}`", None, helps=helps)
    source = None if reporter.has_errors else read_source(path, reporter)
    reporter.raise_if_errors()
    assert source is not None
    task = read_task(source, reporter, knobs=knobs, params=params, packs=packs, palette=palette)
    return task, tuple(one for one in reporter.diagnostics if one.severity is not Severity.ERROR)


def check_split(task: Task, split: str) -> None:
    """Raises CompileError (PD801) for a split that the task does not have."""
    names = [one.name for one in task.splits]
    if split not in names:
        reporter = Reporter()
        helps = suggest(split, names, "splits") or ("splits: " + ", ".join(names),)
        reporter.error("PD801", f"the task {task.name} has no split `{str(split)[:80]}`", None, helps=helps)
        raise CompileError(reporter.diagnostics)
