"""Arguments and options that several commands share, and what their values mean."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from dataclasses import fields
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from powderdsl.cli.exits import counted
from powderdsl.compiler import BACKENDS, RENAMED_BACKENDS, load_with_diagnostics
from powderdsl.diagnostics import Severity

if TYPE_CHECKING:
    from powderdsl.model.types import Ruleset

Decorated = TypeVar("Decorated", bound=Callable[..., Any])

MAX_SIDE = 1 << 24
"""Rows or columns of a world; how many cells it may have is the worlds' business."""


def layout_options(about: str, *more: tuple[str, str]) -> Callable[[Decorated], Decorated]:
    """`--json` as every command has it, passed on as `layout`: ``text``, ``json``, or one of `more` (flag, help).

    `--format LAYOUT` means the same; it was the spelling of some commands, and is hidden now.
    """
    flags = (("json", about), *more)

    def decorate(function: Decorated) -> Decorated:
        @wraps(function)
        def command(*args: Any, layout: str | None, **values: Any) -> Any:
            asked = [name for name, _ in flags if values.pop(f"as_{name}")] + ([layout] if layout else [])
            return function(*args, layout=asked[0] if asked else "text", **values)

        names = ("text", *(name for name, _ in flags))
        option = click.option("--format", "layout", type=click.Choice(names), hidden=True)
        decorated = option(command)
        for name, help_text in reversed(flags):
            decorated = click.option(f"--{name}", f"as_{name}", is_flag=True, help=help_text)(decorated)
        return decorated  # type: ignore[return-value]

    return decorate


PATH = click.Path(path_type=Path)


class Integer(click.ParamType):
    """An integer from `low` to `high`."""

    name = "N"

    def __init__(self, low: int, high: int):
        self.low, self.high = low, high

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        if isinstance(value, int):
            return value
        if not re.fullmatch(r"[0-9]{1,20}", str(value)) or not self.low <= int(value) <= self.high:
            self.fail(f"`{value}` is not an integer from {self.low} to {self.high}", param, ctx)
        return int(value)


class CountType(click.ParamType):
    """An integer, also written as ``1e6`` or ``200_000``. The settings check whether it is in range."""

    name = "N"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        if isinstance(value, int):
            return value
        text = str(value).replace("_", "")
        if not re.fullmatch(r"[0-9]{1,18}|[0-9]{1,6}(\.[0-9]{1,6})?[eE]\+?[0-9]{1,2}", text):
            self.fail(f"`{value}` is not an integer: write 200000 or 2e5", param, ctx)
        number = float(text) if "e" in text.lower() else int(text)
        if number != int(number):
            self.fail(f"`{value}` is not an integer", param, ctx)
        return int(number)


class SizeType(click.ParamType):
    """`48x64`: rows and columns; `64`: as many of both."""

    name = "HxW"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[int, int]:
        if isinstance(value, tuple):
            return value
        match = re.fullmatch(r"([0-9]{1,8})(?:[xX×]([0-9]{1,8}))?", str(value))
        if match is None:
            self.fail(f"`{value}` is not a size: write ROWSxCOLUMNS, such as 48x64", param, ctx)
        rows, columns = int(match[1]), int(match[2] or match[1])
        if not (1 <= rows <= MAX_SIDE and 1 <= columns <= MAX_SIDE):
            self.fail(f"`{value}`: a world has at least one row and one column", param, ctx)
        return rows, columns


def _settings(ctx: click.Context, param: click.Parameter, values: tuple[str, ...]) -> dict[str, str]:
    """`pack.param=VALUE` options as a mapping; the checked model knows which names and values are right."""
    found = {}
    for value in values:
        name, equals, text = value.partition("=")
        if not equals or not name.strip() or not text.strip():
            raise click.BadParameter(f"`{value}`: write pack.param=VALUE", ctx, param)
        found[name.strip()] = text.strip()
    return found


def setting_options(config: type) -> Callable[[Decorated], Decorated]:
    """An option for each field of a dataclass that says what it is for (`system.settings`); None where none is given."""

    def decorate(function: Decorated) -> Decorated:
        for one in reversed(fields(config)):
            if about := one.metadata.get("about"):
                usual = CountType() if isinstance(one.default, int) else type(one.default)
                kind = click.Choice(one.metadata["choices"]) if one.metadata["choices"] else usual
                name = f"--{one.name.replace('_', '-')}"
                function = click.option(name, one.name, type=kind, help=about)(function)
        return function

    return decorate


def rules_argument(function: Decorated) -> Decorated:
    """RULES: what `powderdsl.load` takes."""
    return click.argument("rules", metavar="RULES")(function)


def set_option(function: Decorated) -> Decorated:
    return click.option(
        "--set",
        "settings",
        multiple=True,
        metavar="PACK.PARAM=VALUE",
        callback=_settings,
        help="Another value for a parameter of the rules, such as 5%. May be repeated.",
    )(function)


class ManyWords(click.Command):
    """Its options for packs take all words up to the next option: ``--packs ONE ANOTHER``."""

    MANY = ("--packs", "--held-out", "--only")

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        found: list[str] = []
        option, first = "", False
        for word in args:
            if word.startswith("-"):
                option, first = word if word in self.MANY else "", True
                found.append(word)
            else:
                found += [word] if first or not option else [option, word]
                first = False
        return super().parse_args(ctx, found)


def packs_option(function: Decorated) -> Decorated:
    """Of a command whose class is `ManyWords`: packs that are added to the rules of its task."""
    return click.option(
        "--packs",
        multiple=True,
        metavar="PACK…",
        callback=lambda ctx, param, words: tuple(_place_of(word) for word in words),
        help="Packs, by name or file, that are added to the task's rules.",
    )(function)


def _place_of(word: str) -> str:
    """A pack as runs keep it: files by their whole path."""
    return str(Path(word).absolute()) if word.endswith((".yaml", ".yml")) else word


class BackendType(click.Choice):
    """A backend. An old name gives the new one, with a note on stderr."""

    def __init__(self) -> None:
        super().__init__(list(BACKENDS))

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        return super().convert(renamed_backend(value), param, ctx)


def renamed_backend(name: str) -> str:
    """The name of a backend as it is now; an old one is noted on stderr."""
    new = RENAMED_BACKENDS.get(name, name)
    if new != name:
        click.echo(f"note: the backend `{name}` is called `{new}` now", err=True)
    return new


def backend_option(
    default: str, about: str = "Backend that runs the rules."
) -> Callable[[Decorated], Decorated]:
    return click.option("--backend", type=BackendType(), default=default, help=about)


def device_option(function: Decorated) -> Decorated:
    return click.option("--device", default="cpu", help="A torch device: cpu, cuda, cuda:1.")(function)


def load_rules(rules: str, settings: dict[str, str]) -> Ruleset:
    """The checked model of RULES with `--set` values; how many warnings there are goes to stderr."""
    ruleset, remarks = load_with_diagnostics(rules, params=settings)
    warnings = sum(one.severity is Severity.WARNING for one in remarks)
    if warnings:
        click.echo(f"{counted(warnings, 'warning')}: powderdsl check {rules}", err=True)
    return ruleset


def check_writable(path: Path) -> None:
    """Fail before long work if a file cannot be written. Raises CompileError (PD613)."""
    from powderdsl.system.writing import destination, failure

    folder = destination(path, follow=True).parent
    if not folder.is_dir():
        raise failure("PD613", f"cannot write {path}", notes=(f"there is no folder {folder}",))
    if not os.access(folder, os.W_OK):
        raise failure("PD613", f"cannot write {path}", notes=(f"the folder {folder} is not writable",))
