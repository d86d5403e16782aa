"""Completion in shells: names that come with powderdsl, for parameters whose metavar or name says what they take."""

from __future__ import annotations

import re
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

import click
from click.shell_completion import CompletionItem

from powderdsl.compiler import shipped_rules
from powderdsl.diagnostics import CompileError
from powderdsl.diagnostics.codes import CODES
from powderdsl.experiments.studies.study import shipped_studies
from powderdsl.tasks.shipped import is_task, load_task, shipped_tasks
from powderdsl.worlds.scene.read import shipped_scenes


def _splits(ctx: click.Context) -> Iterable[str]:
    """The splits of the task, or of the run's task, that stands before the option."""
    with suppress(CompileError, IndexError, KeyError):
        name = ctx.args[0]
        if not is_task(name):
            from powderdsl.experiments.runs import find_run

            name = find_run(name).config["task"]
        return [split.name for split in load_task(name).splits]
    return ("train", "test")


NAMES = {
    "RULES": lambda ctx: shipped_rules(),
    "PACK": lambda ctx: shipped_rules(),
    "TASK": lambda ctx: shipped_tasks(),
    "RUN": lambda ctx: [path.name for path in Path("runs").glob("*")],
    "WORLD": lambda ctx: [scene.name for scene in shipped_scenes()],
    "SPLIT": _splits,
    "STUDY": lambda ctx: shipped_studies(),
    "CODE": lambda ctx: CODES,
}
"""What completes a parameter, by a word of its metavar or name."""
MARKS = {"RULES": "+-", "PACK": ",", "SPLIT": ","}
"""Characters behind which a value goes on with another name."""


def _words(param: click.Parameter) -> list[str]:
    return [word for word in NAMES if word in re.findall("[A-Z]+", f"{param.metavar} {param.name}".upper())]


class Named(click.ParamType):
    """A type of values that names complete, and files."""

    def __init__(self, inner: click.ParamType):
        self.inner, self.name = inner, inner.name

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        return self.inner.convert(value, param, ctx)

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        words = _words(param)
        files = {"RUN": "dir", "SPLIT": "", "CODE": ""}.get(words[0], "file")
        items = [CompletionItem(incomplete, type=files)] if files else []
        for word in words:
            head = incomplete[: 1 + max(incomplete.rfind(mark) for mark in MARKS.get(word, "\0"))]
            found = (head + name for name in NAMES[word](ctx))
            items += [CompletionItem(value) for value in found if value.startswith(incomplete)]
        return items


def add_completion(command: click.Command) -> None:
    """Let names complete the parameters of a command, and of those below it."""
    for param in command.params:
        if _words(param):
            param.type = Named(param.type)
    for one in command.commands.values() if isinstance(command, click.Group) else ():
        add_completion(one)
