"""Results of testing properties, as text for people and as plain data for JSON."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import yaml

from powderdsl.arrays import np
from powderdsl.diagnostics import CompileError, Reporter, Span
from powderdsl.model.composition.added_packs import ScopeDifference
from powderdsl.model.state import slots
from powderdsl.model.text import one_line, place_of, show_single
from powderdsl.model.types import Invariant, Ruleset
from powderdsl.simulation.draw import contact_sheet, looks, rgb, scale
from powderdsl.syntax.sources import read_source
from powderdsl.syntax.yaml_tree import Node, Scalar, parse_yaml
from powderdsl.syntax.yaml_tree import Sequence as YamlSequence
from powderdsl.system.writing import failure, write_text
from powderdsl.testing.generators.cases import Array, Start, fresh
from powderdsl.testing.pack_tests.runner import field_words
from powderdsl.testing.properties.breaks import Tested

MAX_DRAWN = 40
"""Rows and columns that are drawn in full."""

MAX_TEXT = 200
"""Characters of a field that are shown."""

UNTESTED = "no random world starts as it demands"


@dataclass(frozen=True)
class Property:
    """A claim with the words it is known by. `owner` is the pack that says it, or ``automatic``; then it has no place."""

    claim: Tested
    text: str
    owner: str
    span: Span | None
    without: frozenset[int] = frozenset()
    """Elements that a world starts without."""
    scope: tuple[str, ...] = ()
    """The packs that it speaks of."""

    @classmethod
    def of(cls, invariant: Invariant) -> Property:
        text = one_line(invariant.span)
        return cls(invariant.claim, text, invariant.pack, invariant.span, invariant.without, invariant.scope)

    @property
    def place(self) -> str:
        """`file:line`, or nothing."""
        return place_of(self.span) if self.span else ""


@dataclass(frozen=True)
class Counterexample:
    """A small world that breaks a property after some steps.

    `before` and `after` are states at the start and after the last step: ids [H, W] and the fields that colors follow.
    `cell` is where it is broken, `culprits` are the lines of rules without which the last step would not have broken it.
    """

    sample: Start
    steps: int
    before: Mapping[str, Array]
    after: Mapping[str, Array]
    cell: tuple[int, int]
    culprits: tuple[Span, ...]


@dataclass
class Result:
    """A property, and what became of it on how many worlds. `reason` is a proof, or what the test is about.

    `sample` is a world that breaks it after some `steps`; `counterexample` is a small one. `difference` says how added
    packs break it: then it holds in its scope.
    """

    prop: Property
    reason: str = ""
    proof: str = ""
    """How it was proven: ``ledger``, ``search`` or ``induction``; empty if it is not."""
    worlds: int = 0
    batches: int = 0
    sample: Start | None = None
    steps: int = 0
    counterexample: Counterexample | None = None
    difference: ScopeDifference | None = None

    @property
    def status(self) -> str:
        """``proven``, ``tested``, ``untested``, ``broken`` or ``differs``."""
        if self.sample is not None:
            return "differs" if self.difference else "broken"
        return "proven" if self.proof else "tested" if self.worlds else "untested"

    @property
    def holds(self) -> bool:
        """True unless a world breaks the property."""
        return self.status != "broken"


def result_line(result: Result) -> str:
    """`proven    core: … (…)`."""
    how = {
        "proven": f"{result.proof}: {result.reason}",
        "tested": f"{result.worlds:,} worlds{', ' + result.reason if result.reason else ''}",
        "untested": UNTESTED,
        "differs": difference_words(result.difference) if result.difference else "",
        "broken": result.prop.place or "of every ruleset",
    }[result.status]
    status = result.status.upper() if result.status == "broken" else result.status
    return f"{status:<9} {result.prop.owner}: {result.prop.text} ({how})"


def difference_words(difference: ScopeDifference) -> str:
    """``with `steam`: steam.yaml:17``: the packs, and where in their files the reason stands."""
    places = dict.fromkeys(place_of(cause.span) for cause in difference.causes)
    return f"{difference.with_packs}{': ' if places else ''}{', '.join(places)}"


def difference_lines(difference: ScopeDifference) -> Iterator[str]:
    """The places in the added packs that make the difference."""
    for cause in difference.causes:
        yield f"{place_of(cause.span)}: {cause.does}"


def counterexample_lines(counterexample: Counterexample, ruleset: Ruleset) -> Iterator[str]:
    """The rule that broke it, the world before and after, and what else the world holds."""
    steps = "1 step" if counterexample.steps == 1 else f"{counterexample.steps} steps"
    yield f"broken at row {counterexample.cell[0]}, column {counterexample.cell[1]}, after {steps} with seed {int(counterexample.sample.seed[0])}"
    for span in counterexample.culprits:
        yield f"by {place_of(span)}: {one_line(span)}"
    states = {"before": counterexample.before["element"], "after": counterexample.after["element"]}
    yield from world_lines(counterexample.sample, states, ruleset)


def world_lines(sample: Start, states: Mapping[str, Array], ruleset: Ruleset) -> Iterator[str]:
    """Ids [H, W] by title, side by side, and what else the start world holds."""
    glyphs = {element.id: element.glyph for element in ruleset.elements}
    columns = [
        [title, *(" ".join(glyphs.get(number, "?") for number in row) for row in ids[:MAX_DRAWN, :MAX_DRAWN].tolist())]
        for title, ids in states.items()
    ]  # fmt: skip
    yield from side_by_side(columns)
    names = {element.id: element.name for element in ruleset.elements}
    there = sorted({number for ids in states.values() for number in np.unique(ids).tolist()})
    yield ", ".join(f"{glyphs[number]} {names[number]}" for number in there if number in names)
    for slot in slots(ruleset):
        values = sample.fields.get(slot.name)
        if values is None or np.array_equal(values, fresh(ruleset, slot, sample.ids)):
            continue  # as in fresh cells
        text = " / ".join(" ".join(row) for row in field_words(ruleset, slot.kind, values[0]))
        yield f"{slot.name}: {text if len(text) <= MAX_TEXT else f'{text[:MAX_TEXT]} …'}"
    for name, values in sample.params.items():
        yield f"{name} = {float(values[0]):g}"
    if sample.step.any():
        yield f"the clock says {int(sample.step[0])}"


def side_by_side(columns: Sequence[Sequence[str]]) -> Iterator[str]:
    """Columns of lines, as many in each."""
    width = max(len(line) for lines in columns for line in lines) + 3
    for lines in zip(*columns, strict=True):
        yield "".join(line.ljust(width) for line in lines).rstrip()


def picture(counterexample: Counterexample, ruleset: Ruleset) -> Array:
    """Before and after side by side, uint8 [H', W', 3]."""
    shown = looks(ruleset.elements, ruleset.fields)
    factor = max(1, min(32, 512 // max(counterexample.sample.shape)))
    images = [
        scale(rgb(state["element"], fields=state, **shown), factor)
        for state in (counterexample.before, counterexample.after)
    ]
    return contact_sheet(images, columns=2, gap=8)


def result_data(result: Result) -> dict[str, Any]:
    """Plain data for JSON."""
    data: dict[str, Any] = {
        "property": result.prop.text,
        "pack": result.prop.owner,
        "place": result.prop.place,
        "status": result.status,
        "proof": result.proof or None,
        "worlds": result.worlds,
        "reason": UNTESTED if result.status == "untested" else result.reason,
    }
    if result.difference is not None:
        data["difference"] = {
            "packs": list(result.difference.packs),
            "causes": [
                {"pack": cause.pack, "place": place_of(cause.span), "text": cause.does}
                for cause in result.difference.causes
            ],
        }
    counterexample = result.counterexample
    if counterexample is not None:
        data["counterexample"] = {
            "before": counterexample.before["element"].tolist(),
            "after": counterexample.after["element"].tolist(),
            "steps": counterexample.steps,
            "row": counterexample.cell[0],
            "column": counterexample.cell[1],
            "seed": int(counterexample.sample.seed[0]),
            "clock": int(counterexample.sample.step[0]),
            "fields": {name: values[0].tolist() for name, values in counterexample.sample.fields.items()},
            "params": {name: values[0].tolist() for name, values in counterexample.sample.params.items()},
            "rules": [{"place": place_of(span), "text": one_line(span)} for span in counterexample.culprits],
        }
    return data


FOLDER = ".powderdsl"
"""The folder of counterexamples in the working directory."""


def file_of(rules: str, prop: Property) -> Path:
    """The file of a property's counterexample: one for each property of some rules."""
    words = re.sub(r"[^A-Za-z0-9]+", "-", f"{prop.owner}-{prop.text}").strip("-")[:60]
    digest = hashlib.sha256(f"{rules}\n{prop.text}".encode()).hexdigest()[:8]
    return Path(FOLDER) / f"{words}-{digest}.yaml"


def write_example(path: Path, rules: str, prop: Property, counterexample: Counterexample) -> None:
    """Write a counterexample. Raises CompileError (PD613) if the file cannot be written."""
    tree: dict[str, Tree] = {"rules": rules, "property": prop.text, "steps": str(counterexample.steps)}
    tree |= start_tree(counterexample.sample)
    head = f"# Breaks `{prop.text}` ({prop.place or prop.owner})\n"
    head += f"# Again: powderdsl test {rules} --replay {path}\n"
    if not path.resolve().is_relative_to(Path.cwd()) and not path.is_absolute():
        raise failure("PD112", f"{path} leaves the working directory through a link")
    path.parent.mkdir(exist_ok=True)
    write_text(path, head + write_yaml(tree))


def read_example(path: Path, ruleset: Ruleset) -> tuple[str, Start, int]:
    """A property's text, a world and a number of steps.

    Raises CompileError if it cannot be read (PD1xx), or holds no counterexample for these rules (PD602).
    """
    tree = read_yaml(path)
    problem = f"{path} is not a counterexample for {ruleset.name}"
    with reading(problem, "a counterexample is written by `powderdsl test`"):
        assert isinstance(tree, dict)
        start, steps = read_start(tree, ruleset), int(line_of(tree["steps"]))
        if not np.isin(start.ids, [element.id for element in ruleset.elements]).all():
            raise ValueError("cells of elements that the rules do not have")
        if len(start) != 1 or not 1 <= steps <= 100_000:
            raise ValueError("more than one world, or a number of steps that no test has")
        return line_of(tree["property"]), start, steps


def kept_examples(
    ruleset: Ruleset, properties: Mapping[str, Property], rules: str
) -> Iterator[tuple[Property, Start, int]]:
    """The stored counterexamples for these rules. Files that no longer fit are skipped."""
    for prop in properties.values():
        path = file_of(rules, prop)
        if path.is_file():
            try:
                text, sample, steps = read_example(path, ruleset)
            except CompileError:
                continue
            if text == prop.text:
                yield prop, sample, steps


# Start worlds as YAML that people can read: plain Python values, the last axis of an array a line of numbers

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
    if isinstance(node, YamlSequence):
        return [to_tree(item) for item in node.items]
    return {key.text: to_tree(value) for key, value in node.entries}


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
        raise ValueError("a field whose size differs from the world's")
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
