"""The JSON Schema of files takes what `check` takes, and rejects what is structurally wrong."""

from __future__ import annotations

import copy
import random
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from powderdsl.cli.commands.study import commands
from powderdsl.diagnostics import CompileError, Reporter, Source
from powderdsl.editing.json_schema import schema
from powderdsl.experiments.studies.study import read_study
from powderdsl.model.declarations import read_file
from powderdsl.tasks.file import read_task

ROOT = Path(__file__).resolve().parents[2]
FILES = sorted(
    [*ROOT.glob("rules/*.yaml"), *ROOT.glob("tasks/**/*.yaml"), *ROOT.glob("docs/examples/*.yaml")]
)
LEAVES = (str, int, float, bool)


@pytest.fixture(scope="module")
def validator() -> Any:
    jsonschema = pytest.importorskip("jsonschema")
    jsonschema.Draft7Validator.check_schema(schema())
    return jsonschema.Draft7Validator(schema())


def test_all_shipped_files_are_valid(validator: Any) -> None:
    for path in FILES:
        mistakes = [
            error.message for error in validator.iter_errors(yaml.load(path.read_text(), yaml.CSafeLoader))
        ]
        assert mistakes == [], path


def places(node: Any, depth: int = 0) -> Iterator[tuple[Any, Any, int]]:
    """Each key or index below a node, with the mapping or list that has it, and how deep it lies."""
    pairs = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for key, value in [*pairs]:
        yield node, key, depth
        yield from places(value, depth + 1)


def renamed(part: Any, key: Any) -> None:
    if isinstance(part, dict) and isinstance(key, str):
        part[key[:-1] + "xq"] = part.pop(key)


def removed(part: Any, key: Any) -> None:
    del part[key]


def listed(part: Any, key: Any) -> None:
    part[key] = [[part[key]]]


def mapped(part: Any, key: Any) -> None:
    part[key] = {"nested": {"deeper": 1}}


def flattened(part: Any, key: Any) -> None:
    part[key] = "word" if not isinstance(part[key], LEAVES) else part[key]


def huge(part: Any, key: Any) -> None:
    part[key] = 10**9 if isinstance(part[key], int) else part[key]


CHANGES: tuple[Callable[[Any, Any], None], ...] = (renamed, removed, listed, mapped, flattened, huge)


def is_rejected(data: Any) -> bool:
    """True if the reader of such files finds a mistake of structure."""
    source, reporter = Source("file.yaml", yaml.safe_dump(data, sort_keys=False)), Reporter()
    try:
        if "task" in data:
            read_task(source, reporter)
        elif "study" in data:
            read_study(source, reporter, commands())
        else:
            read_file(source, reporter)
            reporter.raise_if_errors()
    except CompileError as error:
        return error.diagnostics[0].code in ("PD107", "PD108", "PD109", "PD110", "PD111", "PD402")
    return False


@pytest.mark.parametrize("count", [60, pytest.param(500, marks=pytest.mark.slow)])
def test_files_with_a_broken_structure_are_not(validator: Any, count: int) -> None:
    draw = random.Random(0)
    caught, missed = 0, []
    while caught + len(missed) < count:
        path = draw.choice(FILES)
        data = copy.deepcopy(yaml.load(path.read_text(), yaml.CSafeLoader))
        shallow = [place for place in places(data) if place[2] <= 3]
        part, key, _ = draw.choice(shallow)
        change = draw.choice(CHANGES)
        change(part, key)
        if not {"pack", "ruleset", "task", "study"} & data.keys() or not is_rejected(data):
            continue
        if validator.is_valid(data):
            missed.append(f"{path.name}: {change.__name__} {key}")
        else:
            caught += 1
    assert caught >= 0.95 * count, "\n".join(missed)
