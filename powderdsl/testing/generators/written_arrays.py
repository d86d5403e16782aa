"""Arrays in YAML that people read: nested lists, the last axis a line of numbers."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from powderdsl.syntax.yaml_tree import Mapping, Node, Scalar
from powderdsl.testing.generators.vocabulary import Tree

Array = NDArray[Any]


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
        return " ".join(str(value) for value in values)
    return [write_array(part) for part in values]


def read_array(tree: Tree, dtype: str) -> Array:
    """The array of a tree. Raises ValueError, OverflowError or AssertionError for what is none."""

    def nested(part: Tree) -> list:
        if isinstance(part, str):
            return [np.dtype(dtype).type(word) for word in part.split()]
        assert isinstance(part, list)
        return [nested(item) for item in part]

    return np.asarray(nested(tree), dtype)


def line_of(tree: Tree) -> str:
    """A scalar. Raises AssertionError for anything else."""
    assert isinstance(tree, str)
    return tree


def entries_of(tree: Tree | None) -> list[tuple[str, Tree]]:
    """The entries of a mapping, none where there is none. Raises AssertionError for anything else."""
    assert tree is None or isinstance(tree, dict)
    return list((tree or {}).items())
