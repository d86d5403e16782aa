"""Counterexamples as files: people read them, `powderdsl test --replay` runs them, later tests try them first."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path

from powderdsl.arrays import np
from powderdsl.diagnostics import CompileError
from powderdsl.model.state import slots
from powderdsl.model.types import Ruleset
from powderdsl.system.writing import failure, replacing
from powderdsl.testing.generators.cases import Start
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
from powderdsl.testing.properties.outcomes import Counterexample, Property

FOLDER = ".powderdsl"
"""Where counterexamples are kept, under the working directory."""


def is_kept() -> bool:
    """Whether counterexamples are kept: not on machines that run tests and are thrown away."""
    return not os.environ.get("CI")


def file_of(rules: str, prop: Property, folder: Path = Path(FOLDER)) -> Path:
    """The file of a property's counterexample: one for each property of some rules."""
    words = re.sub(r"[^A-Za-z0-9]+", "-", f"{prop.owner}-{prop.text}").strip("-")[:60]
    digest = hashlib.sha256(f"{rules}\n{prop.text}".encode()).hexdigest()[:8]
    return folder / f"{words}-{digest}.yaml"


def write_example(path: Path, rules: str, prop: Property, found: Counterexample) -> None:
    """Write a counterexample.

    Raises:
        CompileError: PD613, the file cannot be written.
    """
    sample = found.sample
    tree: dict[str, Tree] = {
        "rules": rules,
        "property": prop.text,
        "steps": str(found.steps),
        "seed": str(int(sample.seed[0])),
        "clock": str(int(sample.step[0])),
        "world": write_array(sample.ids[0]),
    }
    if sample.fields:
        tree["fields"] = {name: write_array(values[0]) for name, values in sample.fields.items()}
    if sample.params:
        tree["params"] = {name: repr(float(values[0])) for name, values in sample.params.items()}
    head = f"# Breaks `{prop.text}` ({prop.place or prop.owner})\n"
    head += f"# Again: powderdsl test {rules} --replay {path}\n"
    if not path.resolve().is_relative_to(Path.cwd()) and not path.is_absolute():
        raise failure("PD112", f"{path} leaves the working directory through a link")
    path.parent.mkdir(exist_ok=True)
    with replacing(path) as temporary:
        temporary.write_text(head + write_yaml(tree), encoding="utf-8")


def read_example(path: Path, ruleset: Ruleset) -> tuple[str, Start, int]:
    """A property's text, a world and a number of steps.

    Raises:
        CompileError: it cannot be read (PD1xx), or holds no counterexample for these rules (PD602).
    """
    tree = read_yaml(path)
    problem = f"{path} is not a counterexample for {ruleset.name}"
    with reading(problem, "a counterexample is written by `powderdsl test`"):
        assert isinstance(tree, dict)
        dtypes = {slot.name: slot.dtype for slot in slots(ruleset)}
        ids = read_array(tree["world"], "uint8")
        known = [element.id for element in ruleset.elements]
        if ids.ndim != 2 or not ids.size or not np.isin(ids, known).all():
            raise ValueError("cells of elements that the rules do not have")
        fields = {name: read_array(rows, dtypes[name])[None] for name, rows in entries_of(tree.get("fields"))}
        if any(values.shape[-2:] != ids.shape for values in fields.values()):
            raise ValueError("a field of another size than the world")
        names = {param.name for param in ruleset.params}
        given = [(name, text) for name, text in entries_of(tree.get("params")) if name in names]
        params = {name: np.array([float(line_of(text))]) for name, text in given}
        steps, seed, clock = (int(line_of(tree[key])) for key in ("steps", "seed", "clock"))
        if not 1 <= steps <= 100_000 or min(seed, clock) < 0:
            raise ValueError("a number of steps that no test has")
        return line_of(tree["property"]), Start.fresh(ids, seed, clock, fields, params), steps


def kept_examples(
    ruleset: Ruleset, properties: Mapping[str, Property], rules: str, folder: Path = Path(FOLDER)
) -> Iterator[tuple[Property, Start, int]]:
    """The counterexamples that were kept for these rules. Files that no longer fit are passed over."""
    for prop in properties.values():
        path = file_of(rules, prop, folder)
        if path.is_file():
            try:
                text, sample, steps = read_example(path, ruleset)
            except CompileError:
                continue
            if text == prop.text:
                yield prop, sample, steps
