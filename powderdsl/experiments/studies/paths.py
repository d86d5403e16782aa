"""Paths in studies. A study comes from a file, so what it names lies beside that file, and what it writes in its results."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from powderdsl.compiler import shipped, shipped_rules
from powderdsl.system.reading import inside, is_path

TEXT, FLAG, FILE, TASK, RUN, RUN_OR_TASK, RULES = "text", "flag", "file", "task", "run", "run|task", "rules"
"""What an argument or option of a command is: text, a flag, a file to write, a task, a run, either, or rules."""


def confined(means: str, text: str, folder: Path, results: Path) -> str:
    """A word for a command, from what a study says.

    Args:
        means: one of the above. folder: where the study's file lies. results: where files that it names are written.

    Raises:
        ValueError: it names a path that leads out of `folder`, or of `results` for a file to write.
    """
    if "\0" in text:
        raise ValueError("it has control characters")
    return _WORDS[means](text, folder, results)


def _file(text: str, folder: Path, results: Path) -> str:
    return str(inside(results, text))


def _task(text: str, folder: Path, results: Path) -> str:
    return str(inside(folder, text)) if is_path(text) else text


def _run_or_task(text: str, folder: Path, results: Path) -> str:
    if not is_path(text) and (shipped("tasks") / f"{text}.yaml").is_file():
        return text
    return str(inside(folder, text))


def _rules(text: str, folder: Path, results: Path) -> str:
    return "+".join(_pack(part, folder) for part in text.split("+"))


def _pack(text: str, folder: Path) -> str:
    if is_path(text):
        return str(inside(folder, text))
    if text.split("-")[0] not in shipped_rules() and os.path.isfile(text):
        raise ValueError("a name without `/` or `.yaml` means shipped rules, and there are none of this name")
    return text


_WORDS: dict[str, Callable[[str, Path, Path], str]] = {
    TEXT: lambda text, folder, results: text,
    FLAG: lambda text, folder, results: text,
    FILE: _file,
    TASK: _task,
    RUN: lambda text, folder, results: str(inside(folder, text)),
    RUN_OR_TASK: _run_or_task,
    RULES: _rules,
}
