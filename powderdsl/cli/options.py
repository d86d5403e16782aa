"""Arguments and options of commands, and their types. Commands import this module as `opt`."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import Field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from powderdsl.cli.exits import BadInput
from powderdsl.cli.output import counted
from powderdsl.compiler import BACKENDS, load_with_diagnostics, shipped_rules
from powderdsl.diagnostics import Severity
from powderdsl.system.reading import is_path

if TYPE_CHECKING:
    from powderdsl.experiments.runs import RunFolder
    from powderdsl.model.types import Ruleset
    from powderdsl.tasks.task import Task

Option = Callable[[Any], Any]
"""A decorator that gives a command an option."""
Presets = Mapping[str, Mapping[str, Any]] | None

MAX_SIDE = 1 << 24
"""Maximum of rows or columns of a world; `worlds` limits the number of cells."""


class Parsed(click.ParamType):
    """A value that a function parses from text. The function raises ValueError with a reason if the text is invalid."""

    def __init__(self, name: str, make: Callable[[str], Any]):
        self.name, self.make = name, make

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        try:
            return self.make(value) if isinstance(value, str) else value
        except ValueError as error:
            self.fail(f"`{value}` {error}", param, ctx)


class Integer(click.IntRange):
    """An integer in a range, in ASCII digits: Python would also accept those of other scripts."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if isinstance(value, str) and not value.isascii():
            self.fail(f"`{value}` is not a valid integer", param, ctx)
        return super().convert(value, param, ctx)


def _count(text: str) -> int:
    text = text.replace("_", "")
    if not re.fullmatch(r"[0-9]{1,18}|[0-9]{1,6}(\.[0-9]{1,6})?[eE]\+?[0-9]{1,2}", text):
        raise ValueError("is not an integer: write 200000 or 2e5")
    number = float(text) if "e" in text.lower() else int(text)
    if number != int(number):
        raise ValueError("is not an integer")
    return int(number)


COUNT = Parsed("N", _count)
"""An integer, which may be written ``1e6`` or ``200_000``. The settings check its range."""


def _size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"([0-9]{1,8})(?:[xX×]([0-9]{1,8}))?", text)
    if match is None:
        raise ValueError("is not a size: write ROWSxCOLUMNS, such as 48x64")
    size = int(match[1]), int(match[2] or match[1])
    if not 1 <= min(size) <= max(size) <= MAX_SIDE:
        raise ValueError("is not a size: a world has at least one row and one column")
    return size


SIZE = Parsed("HxW", _size)
"""`48x64`: rows and columns; `64`: a square."""


def _names(text: str) -> tuple[str, ...]:
    names = tuple(name.strip() for name in text.split(","))
    if not all(names):
        raise ValueError("is not a list of names: write NAME,NAME")
    return names


NAMES = Parsed("NAME,NAME", _names)
"""`one,another`."""


def option(name: str, kind: Any, about: str, default: Any = None, *, to: str = "", **more: Any) -> Option:
    """An option of a command.

    Args:
        kind: two integers (a range), a list of words (a choice), `bool` (a flag), a metavar (any text), or a click
            type, such as SIZE.
        to: the command's parameter, if its name differs.
    """
    match kind:
        case str():
            more["metavar"] = kind
        case (int() as low, int() as high):
            more |= {"type": Integer(low, high), "metavar": "N"}
        case [*words]:
            more["type"] = click.Choice(words)
        case _ if kind is bool:
            more["is_flag"] = True
        case _:
            more["type"] = kind
    if default is not None:  # click would take None for the value of a required option
        more["default"] = default
    return click.option(name, *([to] if to else []), help=about, **more)


def path(name: str, metavar: str, about: str, **more: Any) -> Option:
    return option(name, click.Path(path_type=Path), about, metavar=metavar, **more)


def output(name: str, metavar: str, about: str, *suffixes: str, **more: Any) -> Option:
    """An option for an output file with one of `suffixes`. Raises CompileError (PD613) before the command begins."""

    def checked_path(text: str) -> Path:
        path = Path(text)
        if suffixes and path.suffix.lower() not in suffixes:
            raise ValueError(f"must end in {' or '.join(suffixes)}")
        check_writable(path)
        return path

    return option(name, Parsed(metavar, checked_path), about, metavar=metavar, **more)


def pairs(name: str, metavar: str, about: str, to: str, value: str = ".+", read: type = str) -> Option:
    """A repeatable option that maps names to values. Values match the pattern `value` and are parsed by `read`."""

    def mapping(ctx: click.Context, param: click.Parameter, words: tuple[str, ...]) -> dict[str, Any]:
        values: dict[str, Any] = {}
        for word in words:
            match = re.fullmatch(rf"\s*([^\s=]+)\s*=\s*({value})", word.rstrip())
            if match is None or match[1] in values:
                raise click.BadParameter(f"`{word}`: write {metavar}, a name once", ctx, param)
            values[match[1]] = read(match[2])
        return values

    return option(name, metavar, about, to=to, multiple=True, callback=mapping)


def knobs(about: str) -> Option:
    return pairs("--knob", "NAME=N", about, "knobs", "-?[0-9]{1,6}", int)


def several(*options: Option) -> Option:
    """A decorator that applies several options in order."""

    def decorate(function: Any) -> Any:
        for option in reversed(options):
            function = option(function)
        return function

    return decorate


def settings_of(config: type, presets: Presets = None, *, only: Sequence[str] = (), **names: str) -> Option:
    """An option for each field of a dataclass that has a help text (`system.settings`). Its default is None.

    The settings report all values out of range at once. `presets`: the settings that each preset changes, for the help;
    None if defaults are the run's. `only`: names of fields (default: all). `names`: other names for options.
    """
    chosen = [field for field in fields(config) if not only or field.name in only]
    return several(*(_setting(field, names.get(field.name, ""), presets) for field in chosen))


def _setting(field: Field[Any], name: str, presets: Presets) -> Option:
    about = field.metadata.get("about")
    if not about:
        return several()
    defaults: dict[str, Any] = {"default": "the run's"}
    if presets is not None:
        own = {name: values.get(field.name, field.default) for name, values in presets.items()}
        defaults = own if len({*own.values()}) > 1 else {"default": field.default}
    words = ", ".join(f"{name}: {value}" for name, value in defaults.items() if value not in ("", ()))
    about = about.partition("  [default")[0] + (words and f"  [{words}]")
    name = name or field.metadata["option"] or field.name.replace("_", "-")
    limits = field.metadata["limits"]
    kind: Any = name.rpartition("-")[2].upper()
    if limits.choices:
        kind = limits.choices
    elif isinstance(field.default, int):
        kind = COUNT
    elif isinstance(field.default, float):
        kind = Parsed("FLOAT", lambda text: float(ascii(text)[1:-1]))
    return option(f"--{name}", kind, about, to=field.name, multiple=isinstance(field.default, tuple))


def given_options(values: Mapping[str, Any], names: Iterable[str]) -> dict[str, Any]:
    """The values of the options in `names` that were given."""
    return {name: values[name] for name in names if values.get(name) not in (None, (), {})}


def given_settings(values: Mapping[str, Any], config: type, without: Sequence[str] = ()) -> dict[str, Any]:
    """The settings of a dataclass that were given as options."""
    return given_options(values, [setting.name for setting in fields(config) if setting.name not in without])


rules = click.argument("rules", metavar="RULES")
"""RULES: an argument of `powderdsl.load`."""

parameters = pairs(
    "--set", "PACK.PARAM=VALUE", "Set a parameter, such as to 5%. May be repeated.", "settings"
)
"""Names and values are checked later, against the model."""
proof = option("--prove", (0, 24 * 3600), "Effort for proofs, in nominal seconds (counted, not timed).", 60)
world = option("--world", "FILE|NAME", "A .npz, .png, .txt or .yaml file, or the name of a scene.")
size = option("--size", SIZE, "Rows and columns, such as 48x64.")
device = click.option("--device", default="cpu", help="A torch device: cpu, cuda, cuda:1.")


SECTIONS = {
    "Run": "run resume preset seed steps iterations episodes envs examples seconds rounds save-every validate-every",
    "World": "world task split worlds rulesets size number rules packs held-out only knob set slots workload reward after "
    "data ignore-actions",
    "Cell": "at step of",
    "Policy": "policy policies deterministic",
    "Network": "network observation features frames width",
    "Cloning": "init-from init-expert init-epochs",
    "Training": "rollout batch epochs learning-rate schedule gamma gae-lambda clip entropy vf-coef max-grad-norm target-kl "
    "normalize curriculum precision buffer refresh",
    "Evaluation": "eval-every eval-split eval-episodes",
    "Counterexamples": "replay picture keep",
    "Mutants": "mutate mutants write jobs",
    "Data": "out shard compress verify to-minari from-minari",
    "Output": "out watch scale every fps beside profile all json verbose",
    "Machine": "backend device threads store",
}
"""Names of options, by section of the help."""


class Command(click.Command):
    """A command whose help groups many options into sections; options without a group come last."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        ctx.allow_extra_args = True
        rest, fix = super().parse_args(ctx, args), f"see `{ctx.command_path} --help`"
        for word in rest if not ctx.resilient_parsing else ():
            if "rules" in ctx.params and (word in shipped_rules() or is_path(word)):
                fix = f"join rules by `+`: {ctx.params['rules']}+{word}"
            elif "world" in ctx.params:
                fix = f"name a start world by `--world {word}`"
            raise BadInput(f"unexpected argument `{word}`: {fix}")
        return rest

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        options = [option for option in self.get_params(ctx) if isinstance(option, click.Option)]
        rows = {option.opts[-1][2:]: option.get_help_record(ctx) or ("", "") for option in options}
        for title, words in SECTIONS.items() if len(rows) > 10 else ():
            names = [name for name in words.split() if name in rows]
            if len(names) > 1:
                with formatter.section(title):
                    formatter.write_dl([rows.pop(name) for name in names])
        with formatter.section("Options"):
            formatter.write_dl([*rows.values()])


def pack_list(name: str, about: str, read: Callable[[str], str] = str, **more: Any) -> Option:
    """A repeatable option for packs, separated by commas."""

    def joined(ctx: Any, param: Any, lists: Sequence[Sequence[str]]) -> tuple[str, ...]:
        return tuple(read(pack) for packs in lists for pack in packs)

    return option(name, NAMES, about, metavar="PACK,PACK", multiple=True, callback=joined, **more)


def _place(pack: str) -> str:
    """A pack as runs record it: files by absolute path."""
    return str(Path(pack).absolute()) if pack.endswith((".yaml", ".yml")) else pack


packs = pack_list("--packs", "Packs to add to the task's rules, by name or file.", _place)
task_options = several(knobs("Set a knob of a task. May be repeated."), parameters, packs)


BACKEND = click.Choice(list(BACKENDS))


def backend(default: str | None, about: str = "Backend that runs the rules.") -> Option:
    return click.option("--backend", type=BACKEND, default=default, help=about)


machine = several(backend("auto"), device, option("--threads", (1, 1024), "CPU threads.", 1))


def load_rules(rules: str, settings: dict[str, str]) -> Ruleset:
    """Load RULES with `--set` values; print the number of warnings on stderr."""
    ruleset, remarks = load_with_diagnostics(rules, params=settings)
    warnings = sum(remark.severity is Severity.WARNING for remark in remarks)
    if warnings:
        click.echo(f"{counted(warnings, 'warning')}: powderdsl check {rules}", err=True)
    return ruleset


def find_played(
    name: str, knobs: dict[str, int], settings: dict[str, str], packs: Sequence[str]
) -> Task | RunFolder:
    """The task, or the run of an agent, that a command was given. Raises CompileError and BadInput."""
    from powderdsl.tasks.shipped import is_task, load_task

    if is_task(name):
        return load_task(name, knobs=knobs, params=settings, packs=packs)
    if knobs or settings:
        raise BadInput("--knob and --set require a task: a run has its own values")
    from powderdsl.experiments.runs import find_run

    return find_run(name, "ppo")


def check_writable(path: Path) -> None:
    """Fail before long work if a file cannot be written. Raises CompileError (PD613)."""
    from powderdsl.system.writing import destination, failure

    folder = destination(path, follow=True).parent
    if not folder.is_dir():
        raise failure("PD613", f"cannot write {path}", notes=(f"there is no folder {folder}",))
    if not os.access(folder, os.W_OK):
        raise failure("PD613", f"cannot write {path}", notes=(f"the folder {folder} is not writable",))
