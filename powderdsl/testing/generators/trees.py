"""Start worlds as YAML that people can read: plain Python values, the last axis of an array a line of numbers."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml

from powderdsl.arrays import NDArray, np
from powderdsl.diagnostics import CompileError, Reporter
from powderdsl.model.state import slots
from powderdsl.model.text import show_single
from powderdsl.model.types import Ruleset
from powderdsl.syntax.sources import read_source
from powderdsl.syntax.yaml_tree import Mapping, Node, Scalar, parse_yaml
from powderdsl.system.writing import failure
from powderdsl.testing.generators.cases import Start

Array = NDArray[Any]

Tree = str | list["Tree"] | dict[str, "Tree"]
"""YAML as Python values; every scalar is text."""


class _Dumper(yaml.SafeDumper):
    """Writes every scalar as text, without quotes where that is possible."""

    yaml_implicit_resolvers: dict[str, Any] = {}  # noqa: RUF012  # PyYAML's own name


def write_yaml(tree: Tree) -> str:
    """Block-style YAML of nested mappings, lists and texts."""
    return yaml.dump(tree, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=float("inf"))


def to_tree(node: Node) -> Tree:
    """Located YAML as plain Python values."""
    if isinstance(node, Scalar):
        return node.text
    if isinstance(node, Mapping):
        return {key.text: to_tree(value) for key, value in node.entries}
    return [to_tree(item) for item in node.items]


def write_array(values: Array) -> Tree:
    """An array as a tree; floats as the shortest text that means the same float32."""
    if values.ndim == 1:
        show = show_single if values.dtype == np.float32 else str
        return " ".join(map(show, values.tolist()))
    return [write_array(part) for part in values]


def read_array(tree: Tree, dtype: str) -> Array:
    """The array of a tree. Raises ValueError, OverflowError or AssertionError for anything else."""

    def nested(part: Tree) -> list:
        if isinstance(part, str):
            return [*map(float if dtype.startswith("float") else int, part.split())]
        assert isinstance(part, list)
        return [nested(item) for item in part]

    return np.asarray(nested(tree), dtype)


def line_of(tree: Tree) -> str:
    """A scalar. Raises AssertionError for anything else."""
    assert isinstance(tree, str)
    return tree


def start_tree(start: Start) -> dict[str, Tree]:
    """Start worlds as a tree."""
    tree: dict[str, Tree] = {
        "seed": str(start.seed[0]),
        "step": str(start.step[0]),
        "worlds": write_array(start.ids),
    }
    if (start.index != np.arange(len(start))).any():
        tree["index"] = write_array(start.index)
    for name, arrays in (("fields", start.fields), ("params", start.params)):
        if arrays:
            tree[name] = {key: write_array(values) for key, values in arrays.items()}
    return tree


def read_start(tree: Tree, ruleset: Ruleset) -> Start:
    """The start worlds of a tree, without parameters that the rules do not have. Raises as `read_array` for others."""
    assert isinstance(tree, dict)
    ids = read_array(tree["worlds"], "uint8")
    if ids.ndim != 3 or not ids.size:
        raise ValueError("no world")
    types = {slot.name: slot.dtype for slot in slots(ruleset)}
    fields, params = tree.get("fields", {}), tree.get("params", {})
    assert isinstance(fields, dict)
    assert isinstance(params, dict)
    planes = {name: read_array(rows, types[name]) for name, rows in fields.items()}
    if any((len(values), *values.shape[-2:]) != ids.shape for values in planes.values()):
        raise ValueError("a field of another size than the world")
    known = {param.name for param in ruleset.params}
    numbers = {name: read_array(row, "float64") for name, row in params.items() if name in known}
    seed, step = int(line_of(tree["seed"])), int(line_of(tree["step"]))
    if min(seed, step) < 0:
        raise ValueError("a seed or a step below 0")
    start = Start.fresh(ids, seed, step, planes, numbers)
    return replace(start, index=read_array(tree["index"], "int64")) if "index" in tree else start


@contextmanager
def reading(problem: str, fix: str) -> Iterator[None]:
    """Turn what the functions above raise into a diagnostic: PD602 with `problem`, the reason and `fix` as its help."""
    try:
        yield
    except CompileError:
        raise
    except (AssertionError, KeyError, ValueError, TypeError, OverflowError) as error:
        text = " ".join(str(error).split())
        note = f"{type(error).__name__}: {text}" if text else "a part is missing"
        raise failure("PD602", problem, notes=(note,), helps=(fix,)) from None


def read_yaml(path: Path) -> Tree | None:
    """The tree in a file, None if it is empty. Raises CompileError (PD1xx) if it cannot be read."""
    reporter = Reporter()
    source = read_source(path, reporter)
    root = parse_yaml(source, reporter) if source is not None else None
    reporter.raise_if_errors()
    return None if root is None else to_tree(root)
