"""Parts of a study: the combinations that `--only`, `--seeds` and `--shard` select."""

from __future__ import annotations

import re
from collections.abc import Sequence

from powderdsl.cli import options as opt
from powderdsl.cli.exits import BadInput
from powderdsl.diagnostics import suggest
from powderdsl.experiments.studies.study import SEED, Point, Study

MAX_SHARDS = 1_000_000

only = opt.text(
    "--only",
    "NAME=VALUE,…",
    "Run only combinations with these values of a setting, or `seed=0,1`. May be repeated.",
    multiple=True,
)
seeds = opt.integer("--seeds", 1, 1000, "Runs of each combination.  [default: the study's]")


def _shard(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"([0-9]{1,7})/([0-9]{1,7})", text)
    number, of = (int(match[1]), int(match[2])) if match else (0, 0)
    if not 1 <= number <= of <= MAX_SHARDS:
        raise ValueError("is not a part: write 1/4 to 4/4 for four parts")
    return number, of


SHARD = opt.Parsed("I/N", _shard)


def selected(study: Study, size: str, seeds: int | None, only: Sequence[str]) -> list[Point]:
    """The combinations that were asked for.

    Raises:
        BadInput: names or values that the study does not have, or no combination has all of them.
    """
    points = list(study.points(size, seeds))
    known: dict[str, dict[str, None]] = {}
    for point in points:
        for name, value in _values(point).items():
            known.setdefault(name, {})[value] = None
    asked: dict[str, set[str]] = {}
    for text in only:
        name, equals, listed = text.partition("=")
        values = listed.split(",")
        if not equals or name not in known:
            raise BadInput(f"`--only {text}`: write NAME=VALUE,… with one of {', '.join(known)} as NAME")
        for value in values:
            if value not in known[name]:
                helps = suggest(value, known[name]) or (f"it has {', '.join(list(known[name])[:20])}",)
                raise BadInput(f"`--only {text}`: `{name}` has no value `{value}` here; {helps[0]}")
        asked.setdefault(name, set()).update(values)
    found = [point for point in points if all(_values(point)[name] in asked[name] for name in asked)]
    if not found:
        raise BadInput(f"no combination has {' and '.join(only)}")
    return found


def part(points: Sequence[Point], shard: tuple[int, int] | None) -> list[Point]:
    """A shard of some points: consecutive ones, so that a shard has large and small settings."""
    number, of = shard or (1, 1)
    return list(points[len(points) * (number - 1) // of : len(points) * number // of])


def _values(point: Point) -> dict[str, str]:
    return {**dict(point.values), **dict(point.sets), SEED: str(point.seed)}
