"""Paths in studies. A study comes from a file, so what it names lies beside that file, and what it writes in its results."""

from __future__ import annotations

import os
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
    if means == FILE:
        return str(inside(results, text))
    if means == RULES:
        return "+".join(_pack(part, folder) for part in text.split("+"))
    if means == RUN_OR_TASK:
        named = not is_path(text) and (shipped("tasks") / f"{text}.yaml").is_file()
        means = TASK if named else RUN
    if means == RUN or (means == TASK and is_path(text)):
        return str(inside(folder, text))
    return text


def _pack(text: str, folder: Path) -> str:
    if is_path(text):
        return str(inside(folder, text))
    if text.split("-")[0] not in shipped_rules() and os.path.isfile(text):
        raise ValueError("a name without `/` or `.yaml` means shipped rules, and there are none of this name")
    return text
