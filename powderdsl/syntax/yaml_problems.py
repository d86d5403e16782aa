"""What PyYAML complains about, in plain words: where the mistake is, and how to fix it.

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
COMMENT = "YAML takes a `#` after a space for a comment"


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
        return self.text[self.text.rfind("\n", 0, self.at) + 1 : self.at]

    def before_of(self, at: int) -> str:
        """The text of the line before another place."""
        return self.text[self.text.rfind("\n", 0, at) + 1 : at]

    @property
    def same_line(self) -> bool:
        return "\n" not in self.text[self.since : self.at]

    def span(self, start: int, length: int = 1) -> Span:
        # At the end of the file there is nothing to underline but what stands last.
        start = min(start, max(len(self.text.rstrip()) - 1, 0))
        return Span(self.source, start, start + max(length, 1))

    def quoted(self, at: int) -> str:
        """The fix for the value on the line of a place: the same line with quotes."""
        begin, end = self.text.rfind("\n", 0, at) + 1, self.text.find("\n", at)
        found = _ENTRY.match(self.text[begin : end if end >= 0 else len(self.text)])
        if found is None or found.start("value") > at - begin:
            return QUOTE
        quote = "'" if '"' in found["value"] else '"'
        return f"put quotes around it: {found['key']}: {quote}{found['value']}{quote}"

    def rest(self, start: int) -> Span:
        """From `start` to the end of its line."""
        end = self.text.find("\n", start)
        return self.span(start, len(self.text[start : end if end >= 0 else len(self.text)].rstrip()))


def report_yaml(error: yaml.YAMLError, source: Source, reporter: Reporter) -> None:
    """Report what PyYAML raised as PD103."""
    problem = (
        _character(error, source) if not isinstance(error, yaml.MarkedYAMLError) else _marked(error, source)
    )
    reporter.error(
        "PD103",
        f"invalid YAML: {problem.message}",
        problem.span,
        problem.label,
        secondary=[problem.other] if problem.other else [],
        helps=[problem.help] if problem.help else [],
    )


def _character(error: yaml.YAMLError, source: Source) -> Problem:
    # The position that comes with it counts bytes; the character itself is surer.
    code = getattr(error, "character", 0)
    char = chr(code) if isinstance(code, int) else str(code)
    start = max(source.text.find(char), 0)
    span = Span(source, start, start + 1)
    return Problem(
        f"the character U+{ord(char[0]):04X} is not allowed", span, "cannot stand in a text file", "remove it"
    )


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
    return Problem(
        "a key that cannot stand here",
        place.span(start, place.at - start),
        "indented deeper than the line before, or part of it",
        "check the indentation, and that the line before ends as it should: a key with `:`",
    )


def _key(place: Place) -> Problem:
    if place.before.rstrip().endswith(('"', "'")):
        return Problem(
            "text after a closing quote", place.rest(place.at), "does not belong to the value", QUOTE
        )
    if place.char == ":":
        return Problem("a `:` without a key", place.span(place.at), "a key is missing before it")
    return _indentation(place, "a line that does not line up", "not indented like the keys of this mapping")


def _item(place: Place) -> Problem:
    return _indentation(place, "a line that does not line up", "expected `- `, as far in as the items above")


def _indentation(place: Place, message: str, label: str) -> Problem:
    other = None if place.same_line else Label(place.span(place.since), "which begins here")
    return Problem(
        message,
        place.rest(place.at),
        label,
        "indent it like its neighbors, or deeper than its own key",
        other,
    )


def _unclosed(place: Place) -> Problem:
    opener = place.text[place.since : place.since + 1]
    closer = {"{": "}", "[": "]"}.get(opener, "}")
    comment = _comment(place)
    if comment is not None:
        return Problem(
            f"a comment inside `{opener}…{closer}`", place.rest(comment), COMMENT,
            f'put quotes around a value that starts with `#`: "{_word(place.text, comment)}"',
            Label(place.span(place.since), "opened here"),
        )  # fmt: skip
    opened = place.span(place.since)
    if place.at >= len(place.text.rstrip()) or not place.same_line:
        line = place.rest(place.since).text
        fix = place.quoted(place.since)
        if (
            closer not in line
            and re.search(r"\b(given|expect): \Z", place.before_of(place.since))
            and fix != QUOTE
        ):
            return Problem(
                f"a `{opener}` that is never closed", opened, "not closed", f"write the `{closer}`, or {fix}"
            )
    if place.same_line and place.at < len(place.text):
        return Problem(
            f"expected `,` or `{closer}`", place.span(place.at), "", QUOTE, Label(opened, "opened here")
        )
    return Problem(f"a `{opener}` that is never closed", opened, "not closed", f"write the `{closer}`")


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
    end = start
    while end < len(text) and text[end] not in " \t\r\n,}]":
        end += 1
    return text[start:end]


def _bad_start(place: Place) -> Problem:
    if place.char == "\t":
        return _tab(place)
    return Problem(
        f"a value cannot start with `{place.char}`",
        place.span(place.at),
        "has a meaning of its own in YAML",
        place.quoted(place.at),
    )


def _tab(place: Place) -> Problem:
    return Problem("a tab in the indentation", place.span(place.at), "a tab", "indent with spaces")


def _open_quote(place: Place) -> Problem:
    if place.text[place.since : place.since + 1] not in "\"'":
        return Problem("the file ends too early", place.span(place.at), "something is not finished")
    return Problem(
        "a quote that is never closed", place.span(place.since), "no closing quote", "write the closing quote"
    )


def _escape(place: Place) -> Problem:
    return Problem(
        "an unknown escape",
        place.span(place.at, 2),
        'in "…" a backslash starts an escape',
        "use '…' quotes, or no quotes",
    )


def _no_colon(place: Place) -> Problem:
    return Problem(
        "a line that is neither a key nor a value", place.rest(place.since), "no `:` after it",
        "a key ends with `:`; text that continues is indented deeper than its key",
    )  # fmt: skip


def _list_beside_key(place: Place) -> Problem:
    fix = place.quoted(place.at)
    return Problem(
        "a list on the line of its key",
        place.span(place.at),
        "a list starts on the next line",
        "put `- …` on a line of its own" + ("" if fix == QUOTE else f"; if it is not a list, {fix}"),
    )


def _nothing(place: Place) -> Problem:
    last = Place(place.source, min(place.at, len(place.text.rstrip())), 0)
    line = Place(place.source, last.at, last.at - len(last.before))
    if "{" in last.before and _comment(line) is not None:
        return _unclosed(Place(place.source, last.at, line.since + last.before.rindex("{")))
    if place.char in ("}", "]"):
        return Problem(
            f"a `{place.char}` that closes nothing",
            place.span(place.at),
            "nothing is open, or a value is missing",
        )
    return Problem(
        "a value is missing", place.span(place.at), "before this", "remove one comma, or write the value"
    )


def _block_header(place: Place) -> Problem:
    char = place.text[place.since : place.since + 1]
    fix = f"put the text on the next lines, indented; or {place.quoted(place.since)}"
    return Problem(
        f"text after `{char}`", place.rest(place.at), f"`{char}` starts a block on the next lines", fix
    )


def _after_end(place: Place) -> Problem:
    return Problem(
        "text after the end of the document",
        place.rest(place.at),
        "not part of it",
        "remove it, or the line before it",
    )


def _directive(place: Place) -> Problem:
    return Problem(
        "a YAML directive", place.rest(place.since), "a line that starts with `%`", "remove the line"
    )


def _start_of_value(place: Place) -> Problem:
    since = place.span(place.since)
    return Problem(
        f"a value cannot start with `{since.text}`",
        since,
        "has a meaning of its own in YAML",
        place.quoted(place.since),
    )


def _complex_key(place: Place) -> Problem:
    return Problem(
        "a value cannot start with `?`", place.span(place.at), "begins a key, to YAML", place.quoted(place.at)
    )


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
