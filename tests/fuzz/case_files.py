"""Cases as files that people can read: rules, worlds as ids, fields, steps, and what was wrong when it was found."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from powderdsl.model.state import slots
from powderdsl.system.writing import replacing
from powderdsl.testing.generators.cases import Start, load_text
from powderdsl.testing.generators.trees import (
    Tree,
    entries_of,
    line_of,
    read_array,
    read_yaml,
    reading,
    write_array,
    write_yaml,
)
from tests.fuzz.cases import Case


def write_case(path: Path, case: Case, problem: str = "") -> None:
    """Write a case. `problem` stands above it as a comment.

    Raises:
        CompileError: PD613, the file cannot be written.
    """
    start = case.start
    head = [*problem.splitlines(), f"Again: python -m tests.fuzz --replay {path.name}"]
    tree: dict[str, Tree] = {
        "backend": case.backend,
        "steps": str(case.steps),
        "seed": str(start.seed[0]),
        "step": str(start.step[0]),
        "worlds": write_array(start.ids),
    }
    if (start.index != np.arange(len(start))).any():
        tree["index"] = write_array(start.index)
    if start.fields:
        tree["fields"] = {name: write_array(values) for name, values in start.fields.items()}
    if start.params:
        tree["params"] = {name: write_array(values) for name, values in start.params.items()}
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
        types = {slot.name: slot.dtype for slot in slots(load_text(text, path.name))}
        fields = {name: read_array(rows, types[name]) for name, rows in entries_of(tree.get("fields"))}
        params = {name: read_array(row, "float64") for name, row in entries_of(tree.get("params"))}
        steps, seed, step = (int(line_of(tree[key])) for key in ("steps", "seed", "step"))
        start = Start.fresh(read_array(tree["worlds"], "uint8"), seed, step, fields, params)
        if "index" in tree:
            start = replace(start, index=read_array(tree["index"], "int64"))
        return Case(text, start, steps, line_of(tree["backend"]))
