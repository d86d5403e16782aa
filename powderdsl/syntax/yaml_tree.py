"""YAML text -> located tree. YAML carries structure only: no tags, anchors, merges, or resolved scalars.

Every node has its span in the file. Scalars are text, interpreted by the schema, which avoids YAML 1.1's surprises
(`no` as false, `012` as ten, `1:30` as ninety).
"""

from __future__ import annotations

import re
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache

import yaml

from powderdsl.diagnostics import CompileError, Diagnostic, Label, Reporter, Source, Span
from powderdsl.syntax import pure_yaml

MAX_CHARACTERS = 1 << 20
MAX_DEPTH = 32
MAX_NODES = 50_000

_LIBYAML: type | None = getattr(yaml, "CSafeLoader", None)
"""libyaml's parser, if PyYAML was built with it."""
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
        """The text as a name, without the `?` of an optional one."""
        return self.text.removesuffix("?")

    @property
    def is_optional(self) -> bool:
        """True for an optional name."""
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
    """Parse a whole file; None after reporting mistakes."""
    tree, diagnostics = _parsed(source)
    for diagnostic in diagnostics:
        reporter.add(diagnostic)
    return tree


@lru_cache(maxsize=4)
def _parsed(source: Source) -> tuple[Node | None, tuple[Diagnostic, ...]]:
    """The tree of a file, and its diagnostics: editors ask for the outline after each check."""
    reporter, tree = Reporter(), None
    with suppress(CompileError, _Abort):  # also at more errors than the limit
        tree = _parse(source, reporter)
    # A broken tree gets no further messages.
    return None if reporter.has_errors else tree, reporter.diagnostics


def _parse(source: Source, reporter: Reporter) -> Node | None:
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
        reporter.error("PD103", message, Span(source, at, at + 1), "not allowed in a text file", helps=helps)
        return None
    try:
        # PyYAML cannot decode what escapes in a tag may spell for libyaml.
        if _LIBYAML is None or _ESCAPED_TAG.search(text):
            events = pure_yaml.events(text)
        else:
            events = yaml.parse(text, Loader=_LIBYAML)
        # Events are counted before anything recursive runs: the C loader's composer can be crashed by depth.
        return _Builder(source, reporter).build(events)
    except yaml.YAMLError as error:
        report_yaml(error, source, reporter)
        return None


class _Abort(Exception):
    """Raised at a mistake that makes the rest of the document meaningless or dangerous."""


class _Builder:
    """Builds the tree from parser events with an explicit bound on depth and size."""

    def __init__(self, source: Source, reporter: Reporter):
        self.source = source
        self.reporter = reporter
        self.nodes = 0

    def build(self, events) -> Node | None:  # type: ignore[no-untyped-def]
        root: Node | None = None
        for event in events:
            if isinstance(event, yaml.DocumentStartEvent) and root is not None:
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
        """Report keys without a value in `{…}`, usually because a comma split a value."""
        if self.source.text[key.span.end :].lstrip().startswith(":"):
            label = "nothing follows its `:`"
            fix = 'write its value; one with `#` in it needs quotes: "#RRGGBB"'
        elif first:
            label, fix = "a key without a `:`", "`{…}` takes `key: value` pairs; write rules outside it"
        else:
            label = "the comma before it ended the value before it"
            fix = "put quotes around a value with a comma, or put it on its own line, outside `{…}`"
        self._fail("PD107", f"`{key.text}` has no value", key.span, label, fix)

    def _in_braces(self, start) -> bool:  # type: ignore[no-untyped-def]
        """True if a collection is written with `{…}` or `[…]`."""
        return self.source.text[start.start_mark.index : start.start_mark.index + 1] in ("{", "[")

    def _collection_span(self, start, end, last: Span | None) -> Span:  # type: ignore[no-untyped-def]
        begin = start.start_mark.index
        if self._in_braces(start):
            return Span(self.source, begin, max(end.end_mark.index, begin + 1))
        # A block collection's end mark is at the next token; the visible end is that of its last child.
        return Span(self.source, begin, max(start.end_mark.index, last.end if last else 0, begin + 1))


# PyYAML's errors in plain words, with the location and a fix: it reports where its scanner gave up

QUOTE = "put quotes around the whole value"
_STARTS, _MEANING = "a value cannot start with `{}`", "has a special meaning in YAML"
_ENTRY = re.compile(r"\s*(?:- +)?(?P<key>[\w?]+): +(?P<value>[^\"'\s].*?)\s*\Z")


@dataclass(frozen=True)
class StopPosition:
    """The offset at which the parser gave up (`at`), and the start of the value that it was reading (`since`)."""

    source: Source
    at: int
    since: int

    @property
    def text(self) -> str:
        return self.source.text

    @property
    def char(self) -> str:
        return self.text[self.at : self.at + 1]

    @property
    def same_line(self) -> bool:
        return "\n" not in self.text[self.since : self.at]

    def before(self, at: int) -> str:
        """The text of a line up to `at`."""
        return self.text[self.text.rfind("\n", 0, at) + 1 : at]

    def after(self, at: int) -> str:
        """The text of a line from `at` on."""
        return self.text[at:].partition("\n")[0]

    def span(self, start: int, length: int = 1) -> Span:
        # At the end of the file the last character is underlined.
        start = min(start, max(len(self.text.rstrip()) - 1, 0))
        return Span(self.source, start, start + max(length, 1))

    def rest(self, start: int) -> Span:
        """The text from `start` to the end of its line."""
        return self.span(start, len(self.after(start).rstrip()))

    def quoted(self, at: int) -> str:
        """The fix for the value on the line of a place: the same line with quotes."""
        before = self.before(at)
        entry = _ENTRY.match(before + self.after(at))
        if entry is None or entry.start("value") > len(before):
            return QUOTE
        quote = "'" if '"' in entry["value"] else '"'
        return f"put quotes around it: {entry['key']}: {quote}{entry['value']}{quote}"


def report_yaml(error: yaml.YAMLError, source: Source, reporter: Reporter) -> None:
    """Report what PyYAML raised as PD103."""
    assert isinstance(error, yaml.MarkedYAMLError), error
    mark = error.problem_mark or error.context_mark
    at = mark.index if mark else 0
    since = error.context_mark.index if error.context_mark else at
    reporter.add(_explain(StopPosition(source, at, since), f"{error.context}: {error.problem}"))


def _explain(place: StopPosition, words: str) -> Diagnostic:
    """The usual mistake behind an error message of PyYAML or libyaml."""

    def matches(pattern: str) -> bool:
        return re.search(pattern, words) is not None

    here, start = place.span(place.at), place.span(place.since)
    if matches("directive|YAML document|duplicate tag"):
        label, fix = "a line that starts with `%`", "remove the line"
        return _problem("a YAML directive", place.rest(place.since), label, fix)
    if matches("an? (tag|anchor|alias):|tag handle"):
        return _problem(_STARTS.format(start.text), start, _MEANING, place.quoted(place.since))
    if matches("mapping keys are not allowed"):
        return _problem(_STARTS.format(here.text), here, "begins a key, to YAML", place.quoted(place.at))
    if matches("mapping values are not allowed"):
        return _second_colon(place)
    if matches("found a tab character") or (place.char == "\t" and matches("cannot start any token")):
        return _problem("a tab in the indentation", here, "a tab", "indent with spaces")
    if matches("cannot start any token"):
        return _problem(_STARTS.format(here.text), here, _MEANING, place.quoted(place.at))
    if matches("unexpected ':'"):
        return _problem("a `:` inside a value", here, "only a key ends with `:`", QUOTE)
    if matches("expected ',' or '[]}]'"):
        return _unclosed_bracket(place)
    if matches("unexpected (end of stream|document indicator|document separator)"):
        if place.text[place.since : place.since + 1] not in "\"'":
            return _problem("the file ends too early", here, "something is not finished")
        return _problem("a quote that is never closed", start, "no closing quote", "write the closing quote")
    if matches("unknown escape character|hexa?decimal number|invalid Unicode"):
        label, fix = 'in "…" a backslash starts an escape', "use '…' quotes, or no quotes"
        backslash = place.text.rfind("\\", 0, place.at + 1)
        return _problem("an unknown escape", place.span(backslash, 2), label, fix)
    if matches("could not find expected ':'"):
        span = place.rest(place.since)
        fix = "a key ends with `:`; text that continues is indented deeper than its key"
        return _problem("a line that is neither a key nor a value", span, "no `:` after it", fix)
    if matches("sequence entries are not allowed"):
        quoted, fix = place.quoted(place.at), "put `- …` on its own line"
        fix += "" if quoted == QUOTE else f"; if it is not a list, {quoted}"
        return _problem("a list on the line of its key", here, "a list starts on the next line", fix)
    if matches("expected (a )?comment or (a )?line break|chomping or indentation"):
        char = place.text[place.since : place.since + 1]
        fix = f"put the text on the next lines, indented; or {place.quoted(place.since)}"
        label = f"`{char}` starts a block on the next lines"
        return _problem(f"text after `{char}`", place.rest(place.at), label, fix)
    if matches("while parsing a block collection"):
        return _indentation(place, "expected `- `, as far in as the items above")
    if matches("while parsing a block mapping"):
        return _broken_key(place)
    if matches("expected (the )?node content"):
        return _missing_value(place)
    if matches("expected '?<document start>"):
        label, fix = "not part of it", "remove it, or the line before it"
        return _problem("text after the end of the document", place.rest(place.at), label, fix)
    return _problem("not readable", here, words)


def _problem(
    message: str, span: Span, label: str = "", fix: str = "", other: Label | None = None
) -> Diagnostic:
    """A diagnostic; `label` is the text under the caret."""
    others, helps = (other,) if other else (), (fix,) if fix else ()
    return Diagnostic("PD103", f"invalid YAML: {message}", Label(span, label), others, helps=helps)


def _second_colon(place: StopPosition) -> Diagnostic:
    before = place.before(place.at)
    if ": " in before or before.rstrip().endswith(":"):
        return _problem("a second `: ` in one line", place.span(place.at), "only a key ends with `:`", QUOTE)
    start = place.at - len(before.lstrip())
    label = "indented deeper than the line before, or part of it"
    fix = "check the indentation, and that the line before ends as it should: a key with `:`"
    return _problem("a key that is not allowed here", place.span(start, place.at - start), label, fix)


def _broken_key(place: StopPosition) -> Diagnostic:
    if place.before(place.at).rstrip().endswith(('"', "'")):
        label = "does not belong to the value"
        return _problem("text after a closing quote", place.rest(place.at), label, QUOTE)
    if place.char == ":":
        return _problem("a `:` without a key", place.span(place.at), "a key is missing before it")
    return _indentation(place, "not indented like the keys of this mapping")


def _indentation(place: StopPosition, label: str) -> Diagnostic:
    other = None if place.same_line else Label(place.span(place.since), "which begins here")
    fix = "indent it like its neighbors, or deeper than its own key"
    return _problem("a line that does not line up", place.rest(place.at), label, fix, other)


def _unclosed_bracket(place: StopPosition) -> Diagnostic:
    opener, opened = place.text[place.since : place.since + 1], place.span(place.since)
    closer = {"{": "}", "[": "]"}.get(opener, "}")
    comment = _comment(place)
    if comment is not None:
        value = re.split(r"[ \t\r\n,}\]]", place.text[comment:], maxsplit=1)[0]
        message = f"a comment inside `{opener}…{closer}`"
        label = "YAML reads a `#` after a space as a comment"
        fix = f'put quotes around a value that starts with `#`: "{value}"'
        return _problem(message, place.rest(comment), label, fix, Label(opened, "opened here"))
    message, fix = f"a `{opener}` that is never closed", f"write the `{closer}`"
    if place.at >= len(place.text.rstrip()) or not place.same_line:
        quoted = place.quoted(place.since)
        drawn = re.search(r"\b(given|expect): \Z", place.before(place.since))
        if drawn and closer not in place.rest(place.since).text and quoted != QUOTE:
            return _problem(message, opened, "not closed", f"{fix}, or {quoted}")
    if place.same_line and place.at < len(place.text):
        other = Label(opened, "opened here")
        return _problem(f"expected `,` or `{closer}`", place.span(place.at), "", QUOTE, other)
    return _problem(message, opened, "not closed", fix)


def _comment(place: StopPosition) -> int | None:
    """The start of a comment between the two offsets; None without one. Quoted text is skipped."""
    quote = ""
    for i in range(place.since, min(place.at, len(place.text))):
        char = place.text[i]
        if quote:
            quote = "" if char == quote else quote
        elif char in "\"'" and place.text[i - 1] in " {[,:":
            quote = char
        elif char == "#" and place.text[i - 1] in " \t":
            return i
    return None


def _missing_value(place: StopPosition) -> Diagnostic:
    at = min(place.at, len(place.text.rstrip()))
    before = place.before(at)
    if "{" in before and _comment(StopPosition(place.source, at, at - len(before))) is not None:
        return _unclosed_bracket(StopPosition(place.source, at, at - len(before) + before.rindex("{")))
    span = place.span(place.at)
    if place.char in ("}", "]"):
        label = "nothing is open, or a value is missing"
        return _problem(f"a `{place.char}` that closes nothing", span, label)
    return _problem("a value is missing", span, "before this", "remove one comma, or write the value")
