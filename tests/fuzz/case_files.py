"""Cases as files that people can read: rules, worlds as ids, fields, steps, and what was wrong when it was found."""

from __future__ import annotations

from pathlib import Path

from powderdsl.compiler import RENAMED_BACKENDS
from powderdsl.diagnostics import CompileError, Reporter
from powderdsl.model.state import slots
from powderdsl.syntax.sources import read_source
from powderdsl.syntax.yaml_tree import parse_yaml
from powderdsl.system.writing import failure, replacing
from powderdsl.testing.generators.cases import Start, load_text
from powderdsl.testing.generators.rulemaker import write_yaml
from powderdsl.testing.generators.vocabulary import Tree
from powderdsl.testing.generators.written_arrays import entries_of, line_of, read_array, to_tree, write_array
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
        "seed": str(start.seed),
        "step": str(start.step),
        "worlds": write_array(start.ids),
    }
    if start.fields:
        tree["fields"] = {name: write_array(values) for name, values in start.fields.items()}
    if start.params:
        tree["params"] = {
            name: " ".join(repr(value) for value in values) for name, values in start.params.items()
        }
    rules = "".join(f"  {line}\n" for line in case.text.splitlines())
    text = "".join(f"# {line}\n" for line in head) + write_yaml(tree) + f"rules: |\n{rules}"
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def read_case(path: Path) -> Case:
    """The case in a file.

    Raises:
        CompileError: it cannot be read (PD1xx), it is not a case (PD602), or its rules are refused.
    """
    reporter = Reporter()
    source = read_source(path, reporter)
    root = parse_yaml(source, reporter) if source is not None else None
    reporter.raise_if_errors()
    tree = to_tree(root) if root is not None else None
    try:
        assert isinstance(tree, dict)
        text = line_of(tree["rules"])
        types = {slot.name: slot.dtype for slot in slots(load_text(text, path.name))}
        fields = {name: read_array(rows, types[name]) for name, rows in entries_of(tree.get("fields"))}
        params = {
            name: [float(word) for word in line_of(row).split()]
            for name, row in entries_of(tree.get("params"))
        }
        start = Start(
            read_array(tree["worlds"], "uint8"),
            fields,
            int(line_of(tree["seed"])),
            params,
            int(line_of(tree["step"])),
        )
        backend = line_of(tree["backend"])
        return Case(text, start, int(line_of(tree["steps"])), RENAMED_BACKENDS.get(backend, backend))
    except CompileError:
        raise
    except (AssertionError, KeyError, ValueError, TypeError, OverflowError) as error:
        note = (
            f"{type(error).__name__}: {' '.join(str(error).split())}" if str(error) else "a part is missing"
        )
        helps = ("a case is written by `python -m tests.fuzz`",)
        raise failure(
            "PD602", f"{path} is not a case of `python -m tests.fuzz`", notes=(note,), helps=helps
        ) from None
