"""YAML text -> located tree. YAML carries structure only: no tags, anchors, merges, or resolved scalars.

Every node knows its span in the file. Scalars stay text; the schema decides what they mean, so YAML 1.1's
surprises (`no` as false, `012` as ten, `1:30` as ninety) never happen.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import yaml

from powderdsl.diagnostics import Label, Reporter, Source, Span
from powderdsl.syntax import pure_yaml
from powderdsl.syntax.yaml_problems import report_yaml

MAX_CHARACTERS = 1 << 20
MAX_DEPTH = 32
MAX_NODES = 50_000

_LIBYAML: type | None = getattr(yaml, "CSafeLoader", None)
"""libyaml's parser, where PyYAML was built with it."""
_UNPRINTABLE = re.compile("[^\t\n\r -~\x85\xa0-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
_ESCAPED_TAG = re.compile(r"![^\s!]*%")


@dataclass(frozen=True)
class Scalar:
    """A scalar's text. `content` spans the text without quotes; `style` is one of ``plain quoted block``."""

    text: str
    span: Span
    content: Span
    style: str

    @property
    def items(self) -> tuple[Node, ...]:
        """Itself, as a list of one."""
        return (self,)

    @property
    def word(self) -> str:
        """The text as a name, without the `?` of one that may be absent."""
        return self.text.removesuffix("?")

    @property
    def is_optional(self) -> bool:
        """True for a name of a definition that may be absent."""
        return self.text.endswith("?")


@dataclass(frozen=True)
class Sequence:
    """A list."""

    items: tuple[Node, ...]
    span: Span


@dataclass(frozen=True)
class Mapping:
    """A mapping, in the order of the file. Keys are unique scalars."""

    entries: tuple[tuple[Scalar, Node], ...]
    span: Span

    @property
    def items(self) -> tuple[Node, ...]:
        """Itself, as a list of one."""
        return (self,)

    def get(self, key: str) -> Node | None:
        return next((value for name, value in self.entries if name.text == key), None)


Node = Scalar | Sequence | Mapping


def parse_yaml(source: Source, reporter: Reporter) -> Node | None:
    """Parse a whole file; None after reporting what is wrong with it."""
    text = source.text
    if len(text) > MAX_CHARACTERS:
        notes = [f"{source.name}: a rule file may have {MAX_CHARACTERS:,} characters"]
        helps = ["split the pack, or check that this is the file you meant"]
        reporter.error("PD102", f"file of {len(text):,} characters", None, notes=notes, helps=helps)
        return None
    unprintable = _UNPRINTABLE.search(text)
    if unprintable:
        at, helps = unprintable.start(), ["remove it"]
        message = f"invalid YAML: the character U+{ord(text[at]):04X} is not allowed"
        reporter.error("PD103", message, Span(source, at, at + 1), "cannot stand in a text file", helps=helps)
        return None
    builder = _Builder(source, reporter)
    try:
        # PyYAML cannot decode what escapes in a tag may spell for libyaml.
        if _LIBYAML is None or _ESCAPED_TAG.search(text):
            events = pure_yaml.events(text)
        else:
            events = yaml.parse(text, Loader=_LIBYAML)
        # Events are counted before anything recursive runs: the C loader's composer can be crashed by depth.
        root = builder.build(events)
    except yaml.YAMLError as error:
        report_yaml(error, source, reporter)
        return None
    except _Abort:
        return None
    # A broken tree gets no further messages.
    return None if builder.failed else root


class _Abort(Exception):
    """Raised to stop at the first mistake that makes the rest of the document meaningless or dangerous."""


class _Builder:
    """Builds the tree from parser events with an explicit bound on depth and size."""

    def __init__(self, source: Source, reporter: Reporter):
        self.source = source
        self.reporter = reporter
        self.nodes = 0
        self.failed = False

    def build(self, events) -> Node | None:  # type: ignore[no-untyped-def]
        root: Node | None = None
        documents = 0
        for event in events:
            if isinstance(event, yaml.DocumentStartEvent):
                documents += 1
                if documents > 1:
                    self._forbid(event, "a second document", "keep one pack to a file")
            elif isinstance(event, yaml.NodeEvent):
                root = self._node(event, events, 0)
        return root

    def _span(self, event) -> Span:  # type: ignore[no-untyped-def]
        start, end = event.start_mark.index, event.end_mark.index
        return Span(self.source, start, max(start, end))

    def _forbid(self, event, what: str, fix: str) -> None:  # type: ignore[no-untyped-def]
        span = self._span(event)
        word = self.source.text[span.start : span.end].split(maxsplit=1)[:1]
        place = Span(self.source, span.start, span.start + max(len(word[0]) if word else 0, 1))
        self.reporter.error("PD105", f"{what} is not allowed", place, "not allowed", helps=[fix])
        raise _Abort

    def _fail(self, code: str, message: str, span: Span, label: str, fix: str, *others: Label) -> None:
        self.failed = True
        self.reporter.error(code, message, span, label, secondary=others, helps=[fix])

    def _node(self, event, events, depth: int) -> Node:  # type: ignore[no-untyped-def]
        self.nodes += 1
        if depth > MAX_DEPTH or self.nodes > MAX_NODES:
            deep = f"document nested more than {MAX_DEPTH} deep"
            large = f"document of more than {MAX_NODES:,} values"
            place = Span(self.source, event.start_mark.index, event.start_mark.index + 1)
            self.reporter.error("PD106", deep if depth > MAX_DEPTH else large, place, "over the limit")
            raise _Abort
        if event.anchor:  # an alias has the name of its anchor
            what = "alias `*" if isinstance(event, yaml.AliasEvent) else "anchor `&"
            fix = "write the value out: rule files have no anchors"
            self._forbid(event, f"the {what}{event.anchor}`", fix)
        if event.tag is not None:
            fix = "remove it: rule files are plain data; a value that starts with `!` needs quotes"
            self._forbid(event, f"the tag `{event.tag}`", fix)
        if isinstance(event, yaml.ScalarEvent):
            return self._scalar(event)
        if isinstance(event, yaml.SequenceStartEvent):
            return self._sequence(event, events, depth)
        return self._mapping(event, events, depth)

    def _scalar(self, event) -> Scalar:  # type: ignore[no-untyped-def]
        span = self._span(event)
        if event.style in ("'", '"'):
            content = Span(self.source, span.start + 1, max(span.start + 1, span.end - 1))
            return Scalar(event.value, span, content, "quoted")
        if event.style in ("|", ">"):
            newline = self.source.text.find("\n", span.start)
            body = newline + 1 if newline >= 0 else span.end
            content = Span(self.source, body, max(body, span.end))
            return Scalar(event.value, Span(self.source, span.start, span.start + 1), content, "block")
        return Scalar(event.value, span, span, "plain")

    def _sequence(self, start, events, depth: int) -> Sequence:  # type: ignore[no-untyped-def]
        items = []
        event = start
        for event in events:
            if isinstance(event, yaml.SequenceEndEvent):
                break
            items.append(self._node(event, events, depth + 1))
        return Sequence(tuple(items), self._collection_span(start, event, items[-1].span if items else None))

    def _mapping(self, start, events, depth: int) -> Mapping:  # type: ignore[no-untyped-def]
        entries: list[tuple[Scalar, Node]] = []
        seen: dict[str, Span] = {}
        event = start
        for event in events:
            if isinstance(event, yaml.MappingEndEvent):
                break
            key = self._node(event, events, depth + 1)
            value = self._node(next(events), events, depth + 1)
            plain_empty = isinstance(value, Scalar) and value.style == "plain" and not value.text
            if not isinstance(key, Scalar):
                label, fix = "a list or a mapping", "write a name before the `:`"
                self._fail("PD107", "a key must be a word", key.span, label, fix)
            elif key.text == "<<" and key.style == "plain":
                message = "the merge key `<<` is not allowed"
                self._fail("PD105", message, key.span, "not allowed", "write the entries out")
            elif plain_empty and self._in_braces(start):
                self._no_value(key, first=not seen)
            elif key.text in seen:
                message = f"key `{key.text}` occurs twice in one mapping"
                fix = "remove one of them, or merge them"
                other = Label(seen[key.text], "first time here")
                self._fail("PD104", message, key.span, "second time here", fix, other)
            else:
                seen[key.text] = key.span
                entries.append((key, value))
        last = entries[-1][1].span if entries else None
        return Mapping(tuple(entries), self._collection_span(start, event, last))

    def _no_value(self, key: Scalar, *, first: bool) -> None:
        """Nothing in `{…}` has a key without a value: most often a comma has cut a value in two."""
        if self.source.text[key.span.end :].lstrip().startswith(":"):
            label = "nothing follows its `:`"
            fix = 'write its value; one with `#` in it needs quotes: "#RRGGBB"'
        elif first:
            label, fix = "a key without a `:`", "`{…}` holds `key: value` pairs; rules stand outside braces"
        else:
            label = "the comma before it ended the value before it"
            fix = "put quotes around a value with a comma, or give it a line of its own, outside `{…}`"
        self._fail("PD107", f"`{key.text}` has no value", key.span, label, fix)

    def _in_braces(self, start) -> bool:  # type: ignore[no-untyped-def]
        """True if a collection is written with `{…}` or `[…]`."""
        return self.source.text[start.start_mark.index : start.start_mark.index + 1] in ("{", "[")

    def _collection_span(self, start, end, last: Span | None) -> Span:  # type: ignore[no-untyped-def]
        begin = start.start_mark.index
        if self._in_braces(start):
            return Span(self.source, begin, max(end.end_mark.index, begin + 1))
        # A block collection's end mark runs to the next token; the last child's end is where a reader sees it end.
        return Span(self.source, begin, max(start.end_mark.index, last.end if last else 0, begin + 1))
