"""Cutting entries out of located YAML, and putting some in: text edits that leave the rest of the file as it is."""

from __future__ import annotations

from powderdsl.diagnostics import Source, Span
from powderdsl.syntax.yaml_tree import Mapping, Node, Scalar, Sequence
from powderdsl.testing.mutation.mutants import Edit

Container = Mapping | Sequence
Path = tuple[tuple[Container, int], ...]
"""From the file's root to an entry: each container, and which of its entries leads on."""


def removed(source: Source, path: Path) -> Edit:
    """The entry at the end of a path cut out; the whole container where it was the only one."""
    container, number = path[-1]
    spans = entry_spans(container)
    if len(spans) == 1 and len(path) > 1:
        return removed(source, path[:-1])
    text = source.text
    start, end = spans[number].start, spans[number].end
    if text[container.span.start] in "[{":
        if number + 1 < len(spans):
            return Edit(start, spans[number + 1].start, "")
        return Edit(spans[number - 1].end, end, "")
    line = text.rfind("\n", 0, start) + 1
    stop = text.find("\n", end)
    stop = len(text) if stop < 0 else stop + 1
    before = text[line:start]
    if isinstance(container, Mapping) and before.strip():
        # The first key of a list's item stands beside the dash, which stays.
        return Edit(start, spans[number + 1].start, "") if number + 1 < len(spans) else Edit(start, end, "")
    return Edit(line, stop, "")


def without_action(source: Source, path: Path) -> tuple[Edit, ...]:
    """A block without its action: what stood under `then` comes at once, or the block goes."""
    block = path[-1][0]
    assert isinstance(block, Mapping)
    then = next((key for key, _ in block.entries if key.text == "then"), None)
    if then is None:
        return (removed(source, path[:-1]),)
    return (removed(source, path), Edit(then.span.start, then.span.end, "do"))


def inserted(node: Mapping, number: int, entry: str) -> Edit:
    """A new entry behind one of a mapping's, written as the mapping is: with a comma, or on a line of its own."""
    end = entry_spans(node)[number].end
    source = node.span.source
    if source.text[node.span.start] == "{":
        return Edit(end, end, f", {entry}")
    column = source.position(node.entries[0][0].span.start)[1]
    return Edit(end, end, "\n" + " " * (column - 1) + entry)


def entry_spans(container: Container) -> list[Span]:
    """Where each entry stands, key and value."""
    if isinstance(container, Sequence):
        return [_whole(item) for item in container.items]
    return [key.span.to(_whole(value)) for key, value in container.entries]


def _whole(node: Node) -> Span:
    """A node with all of its text: a block scalar's own span is its sign alone."""
    span = node.span
    if isinstance(node, Scalar) and node.style == "block":
        text = node.content.source.text
        end = node.content.end
        while end > span.start and text[end - 1].isspace():
            end -= 1
        return Span(span.source, span.start, end)
    return span


def lines_of(node: Node) -> list[Scalar]:
    """The rules of a body: itself or the items of a list; none where there are blocks."""
    items = node.items if isinstance(node, Sequence) else (node,)
    scalars = [item for item in items if isinstance(item, Scalar)]
    return scalars if len(scalars) == len(items) else []
