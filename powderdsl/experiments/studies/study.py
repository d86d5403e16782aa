"""Checked studies, and the paths that they may name."""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from string import Template

from powderdsl.compiler import shipped, shipped_rules
from powderdsl.diagnostics import Span
from powderdsl.system.reading import inside, is_path

SIZES = ("small", "paper")
EXPECTED = ("rises", "falls")
SCALES = ("linear", "log")
SEED, SIZE = "seed", "size"


@dataclass(frozen=True)
class StudyStep:
    """A call of a command: what it works on, and its options as text, in which ``$NAME`` stands for a value.

    `on` is the argument of the command: a step before it, whose run is meant, or text. `means` says what the argument
    (``on``) and each option are: see `confined`.
    """

    name: str
    command: tuple[str, ...]
    on: str | None
    on_step: bool
    options: tuple[tuple[str, tuple[str, ...]], ...]
    makes_run: bool
    means: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Axis:
    """A setting that is varied, and its values for each of `SIZES`.

    `sets`: for each value, other names and what they stand for with it; empty if the values stand for themselves.
    """

    name: str
    about: str
    values: Mapping[str, tuple[str, ...]]
    sets: Mapping[str, Mapping[str, str]] = field(default_factory=dict)


@dataclass(frozen=True)
class Measure:
    """A number out of the ``evaluation.json`` of a step's run: the keys that lead to it, with ``$NAME`` as above.

    `scale` is one of `SCALES`. On ``log`` numbers are compared by their ratios: means are geometric ones.
    """

    name: str
    step: str
    keys: tuple[str, ...]
    about: str
    expect: str | None
    scale: str = "linear"


@dataclass(frozen=True)
class Point:
    """One combination of values, and a seed. `sets`: other names, and what they stand for with these values."""

    values: tuple[tuple[str, str], ...]
    seed: int
    sets: tuple[tuple[str, str], ...] = ()

    @property
    def name(self) -> str:
        """Names its folder."""
        return ",".join([*(f"{name}={value}" for name, value in self.values), f"seed={self.seed}"])


@dataclass(frozen=True)
class Study:
    """A checked study. `text` is what its file says, `folder` is where the file lies, `places` where its parts stand."""

    name: str
    about: str
    seeds: int
    axes: tuple[Axis, ...]
    steps: tuple[StudyStep, ...]
    measures: tuple[Measure, ...]
    text: str
    folder: Path = Path()
    places: Mapping[tuple[str, ...], Span] = field(default_factory=dict, repr=False, compare=False)

    def points(self, size: str, seeds: int | None = None) -> Iterator[Point]:
        """All combinations, each with every seed; the seeds outside, so that early ends leave whole sets."""
        names = [axis.name for axis in self.axes]
        for seed in range(self.seeds if seeds is None else seeds):
            for values in itertools.product(*(axis.values[size] for axis in self.axes)):
                chosen = tuple(zip(names, values, strict=True))
                sets = [
                    axis.sets.get(value, {}).items() for axis, value in zip(self.axes, values, strict=True)
                ]
                yield Point(chosen, seed, tuple(itertools.chain.from_iterable(sets)))


def filled(text: str, point: Point, size: str) -> str:
    """A text with the values of a point in it."""
    return Template(text).safe_substitute(
        {**dict(point.values), **dict(point.sets), SEED: str(point.seed), SIZE: size}
    )


def maker(steps: Mapping[str, StudyStep], name: str) -> StudyStep:
    """The step whose run is meant by a step's name: the step itself, or what it works on if it makes no run."""
    step = steps[name]
    while not step.makes_run and step.on_step:
        step = steps[str(step.on)]
    return step


# Paths. A study comes from a file: what it names lies beside that file, and what it writes in its results

TEXT, FLAG, FILE, TASK, RUN, RUN_OR_TASK, RULES = "text", "flag", "file", "task", "run", "run|task", "rules"
"""The meaning of an argument or option of a command: text, a flag, a file to write, a task, a run, either, or rules."""


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
