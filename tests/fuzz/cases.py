"""Cases: rules, start worlds and a target to compare with the reference; and their files, which people can read."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from powderdsl.model.state import slots
from powderdsl.model.types import Ruleset
from powderdsl.system.writing import replacing
from powderdsl.testing.generators.cases import Start
from powderdsl.testing.properties.outcomes import (
    line_of,
    read_start,
    read_yaml,
    reading,
    start_tree,
    write_yaml,
)
from tests.semantics.texts import load_text


@dataclass(frozen=True)
class Case:
    """Rules, worlds and a number of steps to run on a backend and compare with the reference."""

    text: str
    start: Start
    steps: int
    backend: str


def fitted(start: Start, ruleset: Ruleset) -> Start:
    """The same worlds for a ruleset from which something went: without what it does not have."""
    known = sorted(element.id for element in ruleset.elements)
    ids = np.where(np.isin(start.ids, known), start.ids, known[0]).astype(np.uint8)
    names = {slot.name for slot in slots(ruleset)[1:]}
    params = {param.name for param in ruleset.params}
    return replace(
        start,
        ids=ids,
        fields={name: values for name, values in start.fields.items() if name in names},
        params={name: values for name, values in start.params.items() if name in params},
    )


def write_case(path: Path, case: Case, problem: str = "") -> None:
    """Write a case. `problem` stands above it as a comment.

    Raises:
        CompileError: PD613, the file cannot be written.
    """
    head = [*problem.splitlines(), f"Again: python -m tests.fuzz --replay {path.name}"]
    tree = {"backend": case.backend, "steps": str(case.steps), **start_tree(case.start)}
    rules = "".join(f"  {line}\n" for line in case.text.splitlines())
    text = "".join(f"# {line}\n" for line in head) + write_yaml(tree) + f"rules: |\n{rules}"
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def read_case(path: Path) -> Case:
    """The case in a file.

    Raises:
        CompileError: it cannot be read (PD1xx), it is not a case (PD602), or its rules are refused.
    """
    tree = read_yaml(path)
    problem = f"{path} is not a case of `python -m tests.fuzz`"
    with reading(problem, "a case is written by `python -m tests.fuzz`"):
        assert isinstance(tree, dict)
        text = line_of(tree["rules"])
        start = read_start(tree, load_text(text, path.name))
        return Case(text, start, int(line_of(tree["steps"])), line_of(tree["backend"]))
