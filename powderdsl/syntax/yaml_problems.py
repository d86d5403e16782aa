"""PyYAML's errors in plain words, with the location and a fix.

PyYAML reports where its scanner gave up, in its own terms, or in libyaml's.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import yaml

from powderdsl.diagnostics import Diagnostic, Label, Reporter, Source, Span

QUOTE = "put quotes around the whole value"
_STARTS, _MEANING = "a value cannot start with `{}`", "has a meaning of its own in YAML"
_ENTRY = re.compile(r"\s*(?:- +)?(?P<key>[\w?]+): +(?P<value>[^\"'\s].*?)\s*\Z")


@dataclass(frozen=True)
class Place:
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
    reporter.add(_explain(Place(source, at, since), f"{error.context}: {error.problem}"))


def _explain(place: Place, words: str) -> Diagnostic:
    """The usual mistake behind an error that PyYAML or libyaml reports in some words."""

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
        quoted, fix = place.quoted(place.at), "put `- …` on a line of its own"
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
    """A diagnostic; `label` finishes the sentence under the caret."""
    others, helps = (other,) if other else (), (fix,) if fix else ()
    return Diagnostic("PD103", f"invalid YAML: {message}", Label(span, label), others, helps=helps)


def _second_colon(place: Place) -> Diagnostic:
    before = place.before(place.at)
    if ": " in before or before.rstrip().endswith(":"):
        return _problem("a second `: ` in one line", place.span(place.at), "only a key ends with `:`", QUOTE)
    start = place.at - len(before.lstrip())
    label = "indented deeper than the line before, or part of it"
    fix = "check the indentation, and that the line before ends as it should: a key with `:`"
    return _problem("a key that cannot stand here", place.span(start, place.at - start), label, fix)


def _broken_key(place: Place) -> Diagnostic:
    if place.before(place.at).rstrip().endswith(('"', "'")):
        label = "does not belong to the value"
        return _problem("text after a closing quote", place.rest(place.at), label, QUOTE)
    if place.char == ":":
        return _problem("a `:` without a key", place.span(place.at), "a key is missing before it")
    return _indentation(place, "not indented like the keys of this mapping")


def _indentation(place: Place, label: str) -> Diagnostic:
    other = None if place.same_line else Label(place.span(place.since), "which begins here")
    fix = "indent it like its neighbors, or deeper than its own key"
    return _problem("a line that does not line up", place.rest(place.at), label, fix, other)


def _unclosed_bracket(place: Place) -> Diagnostic:
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


def _comment(place: Place) -> int | None:
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


def _missing_value(place: Place) -> Diagnostic:
    at = min(place.at, len(place.text.rstrip()))
    before = place.before(at)
    if "{" in before and _comment(Place(place.source, at, at - len(before))) is not None:
        return _unclosed_bracket(Place(place.source, at, at - len(before) + before.rindex("{")))
    span = place.span(place.at)
    if place.char in ("}", "]"):
        label = "nothing is open, or a value is missing"
        return _problem(f"a `{place.char}` that closes nothing", span, label)
    return _problem("a value is missing", span, "before this", "remove one comma, or write the value")
