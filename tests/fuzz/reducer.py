"""Makes a failing case small: parts of the rule file and of the worlds go as long as the case still fails."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import islice

from powderdsl.diagnostics import Reporter, Source, Span
from powderdsl.syntax.parse import Syntax, parse_text
from powderdsl.syntax.yaml_tree import parse_yaml
from powderdsl.testing.generators.cases import Start
from powderdsl.testing.properties.outcomes import Tree, to_tree, write_yaml
from powderdsl.testing.properties.search import smallest
from tests.fuzz.cases import Case

PLAIN = ("yes", "no", "0", "1", "here", "0.5")
"""What an expression may shrink to, besides its own parts."""


def reduce_text(text: str, fails: Callable[[str], bool], tries: int = 5000) -> str:
    """The smallest rule file found for which `fails` is still true.

    Args:
        fails: whether a text fails as the first one did. It must say False for texts that do not compile.
        tries: how many texts to try at most.
    """
    root = parse_yaml(Source("case.yaml", text), Reporter())
    assert root is not None
    tree = to_tree(root)
    position, last_success = 0, -1
    while tries > 0:
        # What follows a success is tried next, not what failed before it: one success rarely helps another.
        smaller = next(islice(_smaller_trees(tree), position, None), None)
        if smaller is None:
            if last_success < 0:
                break
            position, last_success = 0, -1
            continue
        tries -= 1
        if fails(write_yaml(smaller)):
            tree, last_success = smaller, position
        else:
            position += 1
    return write_yaml(tree)


def reduce_case(case: Case, fails: Callable[[Case], bool]) -> Case:
    """The smallest case found that still fails: fewer steps, smaller worlds, fewer rules, until nothing goes.

    Args:
        fails: whether a case fails as the first one did. It must say False for rules that do not compile, and may
            say so for everything when time is up.
    """
    while True:
        before = case
        for steps in range(1, case.steps):
            if fails(replace(case, steps=steps)):
                case = replace(case, steps=steps)
                break
        case = _with_start(case, fails)
        case = _with_text(case, fails)
        if (case.steps, case.text) == (before.steps, before.text):
            return case


def _with_start(case: Case, fails: Callable[[Case], bool]) -> Case:
    return replace(case, start=reduce_start(case.start, lambda start: fails(replace(case, start=start))))


def _with_text(case: Case, fails: Callable[[Case], bool]) -> Case:
    text = reduce_text(case.text, lambda text: fails(replace(case, text=text)))
    return replace(case, text=text) if len(text) < len(case.text) else case


def reduce_start(start: Start, fails: Callable[[Start], bool]) -> Start:
    """The smallest start worlds found that still fail: one world, fewer rows and columns, fewer fields."""
    small = smallest(start, lambda starts: next(filter(fails, starts), None))
    plain = Start.fresh(small.ids, 0, int(small.step[0]), small.fields, small.params)
    return plain if small.seed.any() and fails(plain) else small


def _smaller_trees(tree: Tree) -> Iterator[Tree]:
    """The tree with one thing gone or smaller; big parts first."""
    if isinstance(tree, str):
        yield from _smaller_lines(tree)
        return
    keys = list(tree) if isinstance(tree, dict) else list(range(len(tree)))
    for key in reversed(keys):
        yield (
            {k: v for k, v in tree.items() if k != key}
            if isinstance(tree, dict)
            else [v for i, v in enumerate(tree) if i != key]
        )
    if isinstance(tree, dict):
        for key in keys:  # a loop's body once, a nested block's parts for the block
            if str(key).startswith(("for ", "repeat ")):
                yield {("do" if k == key else k): v for k, v in tree.items()}
    for key in keys:
        value = tree[key]  # type: ignore[index]
        if key in ("type", "pack"):  # another kind would be another case
            continue
        inner: list[Tree] = (
            [value[0]] if isinstance(value, list) and len(value) == 1 and isinstance(value[0], str) else []
        )
        for smaller in (*inner, *_smaller_trees(value)):
            if isinstance(tree, dict):
                yield {k: (smaller if k == key else v) for k, v in tree.items()}
            else:
                yield [smaller if i == key else v for i, v in enumerate(tree)]


def _smaller_lines(text: str) -> Iterator[str]:
    """A rule or expression with a clause less, or an expression in it replaced by one of its parts or a plain one."""
    source = Source("line", text)
    syntax = next(
        (
            s
            for start in ("rule", "expression")
            if (s := parse_text(Span(source, 0, len(text)), start, Reporter()))
        ),
        None,
    )
    if syntax is None:
        return
    for clause in ("then", "chance", "condition", "where"):
        if (found := syntax.child(clause)) is not None:
            yield _without(text, found)
    for node in _nodes(syntax):
        inside = text[node.span.start : node.span.end]
        parts = [text[part.span.start : part.span.end] for part in _nodes(node)][1:]
        for shorter in dict.fromkeys([*parts, *(f"({part})" for part in parts), *PLAIN]):
            if (len(shorter), shorter) < (len(inside), inside):
                yield text[: node.span.start] + shorter + text[node.span.end :]


def _without(text: str, node: Syntax) -> str:
    return (text[: node.span.start].rstrip(" ,") + text[node.span.end :]).strip()


def _nodes(syntax: Syntax) -> Iterator[Syntax]:
    yield syntax
    for child in syntax.children:
        yield from _nodes(child)
