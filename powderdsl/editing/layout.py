"""The standard layout of YAML files: indentation, blanks and blank lines. Comments and contents are preserved.

Keys are two columns right of the key above them, items of a list two columns right of theirs. Lines that are parts of
one value, such as a drawing, keep their distance from its first line.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

from powderdsl.diagnostics import Reporter, Source
from powderdsl.syntax.yaml_tree import Mapping, Node, Scalar, parse_yaml

STEP = 2

GAP = re.compile(r"""^(\s*(?:-\s+)*(?:"[^"]*"|[^\s#"'{\[|>-][^#:]*?):)[ \t]+(?=[^\s#])""")
"""The blanks between a key and its value."""


def formatted(source: Source, reporter: Reporter) -> str | None:
    """The text of a file in the standard layout; None after reporting that it is not YAML."""
    tree = parse_yaml(source, reporter)
    if tree is None:
        return None
    lines = source.text.replace("\r\n", "\n").split("\n")
    columns, texts = dict(_columns(tree, 0)), dict(_texts(tree, 0, lines))
    shift, held, out = 0, list[str](), list[str]()
    for number, line in enumerate(lines, 1):
        if number in texts:
            out += [*held, _moved(line, texts[number])]
            held = []
        elif number in columns:
            shift = columns[number] - _indent(line)
            # Comments belong to the line that follows them.
            out += [_moved(other, columns[number] - _indent(other)) for other in held]
            held = []
            out.append(_moved(GAP.sub(r"\1 ", re.sub(r"^(\s*(?:- )*-)\s+", r"\1 ", line.rstrip())), shift))
        elif not line.strip() or line.lstrip().startswith("#"):
            held.append(line.rstrip())
        else:
            out += [*held, _moved(line.rstrip(), shift)]
            held = []
    text = re.sub(r"\n{3,}", "\n\n", "\n".join([*out, *held]).strip("\n")) + "\n"
    return text if _said(parse_yaml(Source(source.name, text), Reporter())) == _said(tree) else source.text


def _columns(node: Node, column: int) -> Iterator[tuple[int, int]]:
    """The lines that begin with a key, a dash or the rest of a value, and the column of each."""
    if isinstance(node, Scalar):
        if node.style != "block":
            last, _ = node.span.source.position(max(node.span.end - 1, node.span.start))
            yield from ((line, column) for line in range(node.span.line, last + 1))
    elif node.span.text[:1] in ("{", "["):
        return
    elif isinstance(node, Mapping):
        for key, value in node.entries:
            yield from _columns(value, column + STEP)
            yield key.span.line, column
    else:
        for item in node.items:
            yield from _columns(item, column + STEP)
            yield item.span.line, column  # with the first key of a mapping


def _texts(node: Node, column: int, lines: list[str], outer: int = -1) -> Iterator[tuple[int, int]]:
    """The lines of text in blocks, and how far each moves. `outer` is the current column of the key or dash above."""
    if isinstance(node, Mapping):
        for key, value in node.entries:
            yield from _texts(value, column + STEP, lines, key.span.column - 1)
    elif not isinstance(node, Scalar):
        for item in node.items:
            yield from _texts(item, column + STEP, lines, _indent(lines[item.span.line - 1]))
    elif node.style == "block":
        first = end = node.span.line
        while end < len(lines) and (not lines[end].strip() or _indent(lines[end]) > outer):
            end += 1
        own = [_indent(line) for line in lines[first:end] if line.strip()]
        yield from ((number + 1, column - min(own, default=column)) for number in range(first, end))


def _indent(line: str) -> int:
    return len(line) - len(line.lstrip(" "))


def _moved(line: str, shift: int) -> str:
    """A line moved right by some columns."""
    if not line.strip():
        return line[: max(0, len(line) + shift)]
    return " " * max(0, _indent(line) + shift) + line.lstrip(" ")


def _said(node: Node | None) -> object:
    """The content of a file, without its layout."""
    if isinstance(node, Mapping):
        return [(key.text, _said(value)) for key, value in node.entries]
    if isinstance(node, Scalar) or node is None:
        return node and (node.text.split() if node.style == "plain" else node.text)
    return [_said(item) for item in node.items]
