"""Tasks by name or path. `is_task` reads only the start of a file; nothing here needs torch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from powderdsl.diagnostics import Diagnostic, Reporter, Severity, suggest
from powderdsl.syntax.sources import find_source, shipped_names
from powderdsl.system.reading import open_regular
from powderdsl.system.writing import failure

if TYPE_CHECKING:
    from powderdsl.model.composition.compose import Palette
    from powderdsl.tasks.task import Task

MAX_HEAD = 1 << 16
"""Maximum number of bytes of comments at the start of a task's file."""


def shipped_tasks() -> list[str]:
    """Names of the shipped tasks."""
    return shipped_names("tasks")


def is_task(name: str) -> bool:
    """True if a name or path is that of a task: a shipped one, or a file that begins with ``task:``."""
    if name in shipped_tasks():
        return True
    if not name.lower().endswith((".yaml", ".yml")):
        return False
    try:
        with open_regular(name) as file:
            head = file.read(MAX_HEAD).decode("utf-8-sig", errors="replace")
    except OSError:
        return False
    lines = (line.strip() for line in head.splitlines())
    return next((line for line in lines if line and not line.startswith("#")), "").startswith("task:")


def load_task(
    name_or_path: str | Path,
    *,
    knobs: Mapping[str, int] | None = None,
    params: Mapping[str, Any] | None = None,
    packs: Sequence[str] = (),
    palette: Palette | None = None,
    reporter: Reporter | None = None,
) -> Task:
    """Load a shipped task by name, or a task file by path.

    Args:
        knobs: values for knobs of the task.
        params: values for parameters of its rules, by qualified name.
        packs: names or files of packs that are added to its rules.
        palette: recorded ids, as for `compiler.load`.
        reporter: where warnings and notes go.

    Raises:
        CompileError: all mistakes in the files.
    """
    from powderdsl.tasks.file import read_task

    reporter = reporter or Reporter()
    for name, value in (knobs or {}).items():
        if isinstance(value, bool) or not isinstance(value, int):
            raise TypeError(f"the knob `{name}` takes an integer, found {value!r}")
    source = find_source(str(name_or_path), "tasks", "task", reporter)
    return read_task(source, reporter, knobs=knobs, params=params, packs=packs, palette=palette)


def load_task_with_diagnostics(name_or_path: str | Path, **how: Any) -> tuple[Task, tuple[Diagnostic, ...]]:
    """Like `load_task`, and also return the warnings and notes."""
    reporter = Reporter()
    task = load_task(name_or_path, reporter=reporter, **how)
    return task, tuple(
        diagnostic for diagnostic in reporter.diagnostics if diagnostic.severity is not Severity.ERROR
    )


def check_split(task: Task, split: str) -> None:
    """Raise CompileError (PD801) for a split that the task does not have."""
    names = [split.name for split in task.splits]
    if split not in names:
        helps = suggest(split, names, "splits") or ("splits: " + ", ".join(names),)
        raise failure("PD801", f"the task {task.name} has no split `{str(split)[:80]}`", helps=helps)
