"""PyYAML's complaints in plain words: where the mistake is, and how to fix it.

PyYAML reports where its scanner gave up, in its own terms. Each row of the table below knows what people
usually did there.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass

import yaml

from powderdsl.diagnostics import Label, Reporter, Source, Span

QUOTE = "put quotes around the whole value"
_ENTRY = re.compile(r"\s*(?:- +)?(?P<key>[\w?]+): +(?P<value>[^\"'\s].*?)\s*\Z")
COMMENT = "YAML reads a `#` after a space as a comment"


@dataclass(frozen=True)
class Problem:
    """A complaint in plain words. `label` finishes the sentence under the caret."""

    message: str
    span: Span
    label: str = ""
    help: str = ""
    other: Label | None = None


@dataclass(frozen=True)
class Place:
    """Where the parser gave up (`at`) and where the thing began that it was reading (`since`)."""

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
    def before(self) -> str:
        """The text of the line before the place."""
        return self.before_of(self.at)

    def before_of(self, at: int) -> str:
        """The text of the line before another place."""
        return self.text[self.text.rfind("\n", 0, at) + 1 : at]

    def line_end(self, at: int) -> int:
        end = self.text.find("\n", at)
        return end if end >= 0 else len(self.text)

    @property
    def same_line(self) -> bool:
        return "\n" not in self.text[self.since : self.at]

    def span(self, start: int, length: int = 1) -> Span:
        # At the end of the file the last character is underlined.
        start = min(start, max(len(self.text.rstrip()) - 1, 0))
        return Span(self.source, start, start + max(length, 1))

    def quoted(self, at: int) -> str:
        """The fix for the value on the line of a place: the same line with quotes."""
        before = self.before_of(at)
        found = _ENTRY.match(before + self.text[at : self.line_end(at)])
        if found is None or found.start("value") > len(before):
            return QUOTE
        quote = "'" if '"' in found["value"] else '"'
        return f"put quotes around it: {found['key']}: {quote}{found['value']}{quote}"

    def rest(self, start: int) -> Span:
        """From `start` to the end of its line."""
        return self.span(start, len(self.text[start : self.line_end(start)].rstrip()))


def report_character(source: Source, at: int, reporter: Reporter) -> None:
    """Report a character that YAML does not allow as PD103."""
    message = f"invalid YAML: the character U+{ord(source.text[at]):04X} is not allowed"
    label = "cannot stand in a text file"
    reporter.error("PD103", message, Span(source, at, at + 1), label, helps=["remove it"])


def report_yaml(error: yaml.YAMLError, source: Source, reporter: Reporter) -> None:
    """Report what PyYAML raised as PD103."""
    assert isinstance(error, yaml.MarkedYAMLError), error
    found = _marked(error, source)
    others, helps = [found.other] if found.other else [], [found.help] if found.help else []
    message = f"invalid YAML: {found.message}"
    reporter.error("PD103", message, found.span, found.label, secondary=others, helps=helps)


def _marked(error: yaml.MarkedYAMLError, source: Source) -> Problem:
    mark = error.problem_mark or error.context_mark
    at = mark.index if mark else 0
    since = error.context_mark.index if error.context_mark else at
    words = " ".join(str(error.problem or error.context or "").split())
    place = Place(source, at, since)
    for needles, explain in _ROWS:
        if any(needle in words for needle in needles):
            return explain(place)
    return Problem("not readable", place.span(at), words)


def _second_colon(place: Place) -> Problem:
    if ": " in place.before or place.before.rstrip().endswith(":"):
        return Problem("a second `: ` in one line", place.span(place.at), "only a key ends with `:`", QUOTE)
    start = place.at - len(place.before.lstrip())
    label = "indented deeper than the line before, or part of it"
    fix = "check the indentation, and that the line before ends as it should: a key with `:`"
    return Problem("a key that cannot stand here", place.span(start, place.at - start), label, fix)


def _key(place: Place) -> Problem:
    if place.before.rstrip().endswith(('"', "'")):
        label = "does not belong to the value"
        return Problem("text after a closing quote", place.rest(place.at), label, QUOTE)
    if place.char == ":":
        return Problem("a `:` without a key", place.span(place.at), "a key is missing before it")
    return _indentation(place, "not indented like the keys of this mapping")


def _item(place: Place) -> Problem:
    return _indentation(place, "expected `- `, as far in as the items above")


def _indentation(place: Place, label: str) -> Problem:
    other = None if place.same_line else Label(place.span(place.since), "which begins here")
    fix = "indent it like its neighbors, or deeper than its own key"
    return Problem("a line that does not line up", place.rest(place.at), label, fix, other)


def _unclosed(place: Place) -> Problem:
    opener, opened = place.text[place.since : place.since + 1], place.span(place.since)
    closer = {"{": "}", "[": "]"}.get(opener, "}")
    comment = _comment(place)
    if comment is not None:
        message = f"a comment inside `{opener}…{closer}`"
        fix = f'put quotes around a value that starts with `#`: "{_word(place.text, comment)}"'
        return Problem(message, place.rest(comment), COMMENT, fix, Label(opened, "opened here"))
    message, fix = f"a `{opener}` that is never closed", f"write the `{closer}`"
    if place.at >= len(place.text.rstrip()) or not place.same_line:
        quoted = place.quoted(place.since)
        drawn = re.search(r"\b(given|expect): \Z", place.before_of(place.since))
        if drawn and closer not in place.rest(place.since).text and quoted != QUOTE:
            return Problem(message, opened, "not closed", f"{fix}, or {quoted}")
    if place.same_line and place.at < len(place.text):
        label = Label(opened, "opened here")
        return Problem(f"expected `,` or `{closer}`", place.span(place.at), "", QUOTE, label)
    return Problem(message, opened, "not closed", fix)


def _comment(place: Place) -> int | None:
    """Where a comment begins between the two places. Quoted text is skipped."""
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


def _word(text: str, start: int) -> str:
    return re.split(r"[ \t\r\n,}\]]", text[start:], maxsplit=1)[0]


def _bad_start(place: Place) -> Problem:
    return (
        _tab(place) if place.char == "\t" else _meaning(place, place.at, "has a meaning of its own in YAML")
    )


def _start_of_value(place: Place) -> Problem:
    return _meaning(place, place.since, "has a meaning of its own in YAML")


def _complex_key(place: Place) -> Problem:
    return _meaning(place, place.at, "begins a key, to YAML")


def _meaning(place: Place, at: int, label: str) -> Problem:
    span = place.span(at)
    return Problem(f"a value cannot start with `{span.text}`", span, label, place.quoted(at))


def _tab(place: Place) -> Problem:
    return Problem("a tab in the indentation", place.span(place.at), "a tab", "indent with spaces")


def _open_quote(place: Place) -> Problem:
    if place.text[place.since : place.since + 1] not in "\"'":
        return Problem("the file ends too early", place.span(place.at), "something is not finished")
    span, fix = place.span(place.since), "write the closing quote"
    return Problem("a quote that is never closed", span, "no closing quote", fix)


def _escape(place: Place) -> Problem:
    label, fix = 'in "…" a backslash starts an escape', "use '…' quotes, or no quotes"
    return Problem("an unknown escape", place.span(place.at, 2), label, fix)


def _no_colon(place: Place) -> Problem:
    fix = "a key ends with `:`; text that continues is indented deeper than its key"
    return Problem(
        "a line that is neither a key nor a value", place.rest(place.since), "no `:` after it", fix
    )


def _list_beside_key(place: Place) -> Problem:
    quoted = place.quoted(place.at)
    fix = "put `- …` on a line of its own" + ("" if quoted == QUOTE else f"; if it is not a list, {quoted}")
    span, label = place.span(place.at), "a list starts on the next line"
    return Problem("a list on the line of its key", span, label, fix)


def _nothing(place: Place) -> Problem:
    last = Place(place.source, min(place.at, len(place.text.rstrip())), 0)
    line = Place(place.source, last.at, last.at - len(last.before))
    if "{" in last.before and _comment(line) is not None:
        return _unclosed(Place(place.source, last.at, line.since + last.before.rindex("{")))
    span = place.span(place.at)
    if place.char in ("}", "]"):
        label = "nothing is open, or a value is missing"
        return Problem(f"a `{place.char}` that closes nothing", span, label)
    return Problem("a value is missing", span, "before this", "remove one comma, or write the value")


def _block_header(place: Place) -> Problem:
    char = place.text[place.since : place.since + 1]
    fix = f"put the text on the next lines, indented; or {place.quoted(place.since)}"
    label = f"`{char}` starts a block on the next lines"
    return Problem(f"text after `{char}`", place.rest(place.at), label, fix)


def _after_end(place: Place) -> Problem:
    message, fix = "text after the end of the document", "remove it, or the line before it"
    return Problem(message, place.rest(place.at), "not part of it", fix)


def _directive(place: Place) -> Problem:
    span, label = place.rest(place.since), "a line that starts with `%`"
    return Problem("a YAML directive", span, label, "remove the line")


_ROWS: tuple[tuple[tuple[str, ...], Callable[[Place], Problem]], ...] = (
    (("mapping values are not allowed",), _second_colon),
    (("mapping keys are not allowed",), _complex_key),
    (("found a tab character",), _tab),
    (("cannot start any token",), _bad_start),
    (("expected ',' or '}'", "expected ',' or ']'"), _unclosed),
    (("unexpected end of stream", "unexpected document indicator"), _open_quote),
    (("unknown escape character", "did not find expected hexdecimal number", "invalid Unicode"), _escape),
    (("could not find expected ':'",), _no_colon),
    (("sequence entries are not allowed",), _list_beside_key),
    (("expected comment or line break",), _block_header),
    (("expected '-' indicator",), _item),
    (("did not find expected key",), _key),
    (("expected node content",), _nothing),
    (("expected <document start>",), _after_end),
    (("directive", "incompatible YAML document", "tag handle"), _directive),
    (("alphabetic or numeric character", "expected tag URI", "expected whitespace"), _start_of_value),
)
"""PyYAML's words, and what they mean to the one who wrote the file. The first row that fits counts."""
