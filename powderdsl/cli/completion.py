"""Shell completion of shipped names, for parameters whose metavar or name tells what they take."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path

import click
from click.shell_completion import CompletionItem

from powderdsl.compiler import shipped_rules
from powderdsl.diagnostics import CODES, CompileError
from powderdsl.experiments.runs import find_run
from powderdsl.tasks.shipped import is_task, load_task, shipped_tasks
from powderdsl.worlds.scene.read import shipped_scenes


def _splits(args: Sequence[str]) -> Iterable[str]:
    """The splits of the task, or of the run's task, named before the option."""
    with suppress(CompileError, LookupError):
        task = args[0] if is_task(args[0]) else find_run(args[0]).config["task"]
        return [split.name for split in load_task(task).splits]
    return ("train", "test")


NAMES = {
    "RULES": ("+-", lambda args: shipped_rules()),
    "PACK": (",", lambda args: shipped_rules()),
    "TASK": ("\0", lambda args: shipped_tasks()),
    "RUN": ("\0", lambda args: [path.name for path in Path("runs").glob("*")]),
    "WORLD": ("\0", lambda args: [scene.name for scene in shipped_scenes()]),
    "CODE": ("\0", lambda args: CODES),
    "SPLIT": (",", _splits),
}
"""Completions of a parameter, by a word of its metavar or name, and the characters that separate names."""


def add_completion(command: click.Command) -> None:
    """Complete the parameters of a command and its subcommands by names."""
    for param in command.params:
        words = re.findall("[A-Z]+", f"{param.metavar} {param.name}".upper())
        if known := [word for word in NAMES if word in words]:
            param.shell_complete = partial(_complete, known)  # type: ignore[method-assign]
    for subcommand in command.commands.values() if isinstance(command, click.Group) else ():
        add_completion(subcommand)


def _complete(words: Sequence[str], ctx: click.Context, incomplete: str) -> list[CompletionItem]:
    items = [] if words == ["SPLIT"] else [CompletionItem(incomplete, type="file")]
    for word in words:
        marks, names = NAMES[word]
        head = incomplete[: 1 + max(incomplete.rfind(mark) for mark in marks)]
        values = (head + name for name in names(ctx.args))
        items += [CompletionItem(value) for value in values if value.startswith(incomplete)]
    return items
