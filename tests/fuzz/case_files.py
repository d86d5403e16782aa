"""Cases as files that people can read: rules, worlds as ids, fields, steps, and what was wrong when it was found."""

from __future__ import annotations

from pathlib import Path

from powderdsl.system.writing import replacing
from powderdsl.testing.generators.cases import load_text
from powderdsl.testing.generators.trees import line_of, read_start, read_yaml, reading, start_tree, write_yaml
from tests.fuzz.cases import Case


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
