"""Diagnostics as data, as text with carets or JSON, and the Reporter that collects them.

Spans in source text are two character offsets; lines and columns are only for printing.
"""

from __future__ import annotations

import re
from bisect import bisect_right
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from functools import cached_property
from typing import Any
from unicodedata import combining, east_asian_width

from powderdsl.diagnostics.codes import CODES, Severity
from powderdsl.diagnostics.printable import printable

TAB_WIDTH = 4
MAX_SHOWN = 160
"""Maximum number of characters of a source line to show."""
COLORS = {Severity.ERROR: "31;1", Severity.WARNING: "33;1", Severity.NOTE: "36;1"}

MEANT = re.compile(r"did you mean `([^`]+)`\?")

MAX_ERRORS = 200
"""Maximum number of errors to report."""

MAX_CANDIDATES = 500
"""Maximum number of names to compare a misspelled name with; of more, only those with the same first letter."""


@dataclass(frozen=True)
class Source:
    """A text with a name for messages. Sources are equal if both name and text are."""

    name: str
    text: str = field(repr=False)

    @cached_property
    def _line_starts(self) -> list[int]:
        starts = [0]
        starts.extend(i + 1 for i, char in enumerate(self.text) if char == "\n")
        return starts

    def position(self, offset: int) -> tuple[int, int]:
        """Line and column of a character offset, both counted from 1."""
        line = bisect_right(self._line_starts, offset)
        return line, offset - self._line_starts[line - 1] + 1

    def line(self, number: int) -> str:
        """The text of line `number` (from 1), without its line break."""
        start = self._line_starts[number - 1]
        end = self._line_starts[number] if number < len(self._line_starts) else len(self.text)
        return self.text[start:end].rstrip("\r\n")


@dataclass(frozen=True)
class Span:
    """Characters `start` to `end` (exclusive) of a source."""

    source: Source
    start: int
    end: int

    @property
    def text(self) -> str:
        return self.source.text[self.start : self.end]

    @property
    def line(self) -> int:
        return self.source.position(self.start)[0]

    @property
    def column(self) -> int:
        return self.source.position(self.start)[1]

    @property
    def place(self) -> str:
        """`file:line:column`."""
        line, column = self.source.position(self.start)
        return f"{self.source.name}:{line}:{column}"

    def to(self, other: Span) -> Span:
        """From the start of this span to the end of `other`, which is in the same source."""
        return Span(self.source, self.start, max(self.end, other.end))


@dataclass(frozen=True)
class Label:
    """A location and the text under its caret. `span` is None without source text."""

    span: Span | None
    text: str = ""


@dataclass(frozen=True)
class Diagnostic:
    """A diagnostic: its code, location and message, and fixes."""

    code: str
    message: str
    primary: Label
    secondary: tuple[Label, ...] = ()
    notes: tuple[str, ...] = ()
    helps: tuple[str, ...] = ()

    @property
    def severity(self) -> Severity:
        return CODES[self.code].severity

    @property
    def fix(self) -> tuple[Span, str] | None:
        """The span of a misspelled word and the suggested word, if there is one."""
        words = [match[1] for text in self.helps if (match := MEANT.fullmatch(text))]
        span = self.primary.span
        return (span, words[0]) if span is not None and len(words) == 1 and span.text.strip() else None

    @property
    def sort_key(self) -> tuple[str, int, int, str]:
        """The file, the position in it, and the code. Diagnostics without a location come first."""
        span = self.primary.span
        return (span.source.name, span.start, span.end, self.code) if span else ("", 0, 0, self.code)


# Renderings


def _cells(text: str) -> int:
    """The width of `text` in terminal cells, with tabs already expanded."""
    return sum(0 if combining(char) else 2 if east_asian_width(char) in "WF" else 1 for char in text)


def _snippet(span: Span, words: str, caret: str) -> tuple[str, str]:
    """The source line and the line of carets below it; a long line is cut to a window around the span."""
    line_number, column = span.source.position(span.start)
    raw = span.source.line(line_number)
    start = min(column - 1, len(raw))
    end = max(min(start + span.end - span.start, len(raw)), start)
    left = max(0, start - MAX_SHOWN // 2) if len(raw) > MAX_SHOWN else 0
    right = min(len(raw), left + MAX_SHOWN)

    def visible(piece: str) -> str:
        # Unprintable characters take one column, so that carets stay below their text.
        chars = piece.expandtabs(TAB_WIDTH)
        return "".join("\N{REPLACEMENT CHARACTER}" if printable(char) != char else char for char in chars)

    text = ("…" if left else "") + visible(raw[left:right]) + ("…" if right < len(raw) else "")
    before = _cells(visible(raw[left:start])) + (1 if left else 0)
    width = max(1, _cells(visible(raw[left : min(end, right)])) + (1 if left else 0) - before)
    return text, (" " * before + caret * width + (f" {printable(words)}" if words else "")).rstrip()


def source_lines(labels: Sequence[Label]) -> tuple[list[str], int]:
    """The source lines of labels with carets (`^` for the first label), and the width of the line numbers."""
    placed = [(label.span, label) for label in labels if label.span]
    gutter = max((len(str(span.line)) for span, _ in placed), default=1)
    lines: list[str] = []
    name = None
    for span, label in placed:
        if span.source.name != name:
            arrow = "-->" if name is None else ":::"
            name = span.source.name
            lines.append(f"{' ' * gutter}{arrow} {printable(span.place)}")
            lines.append(f"{' ' * gutter} |")
        text, carets = _snippet(span, label.text, "^" if label is labels[0] else "-")
        lines += [f"{span.line:>{gutter}} | {text}".rstrip(), f"{' ' * gutter} | {carets}"]
    return lines, gutter


def render_text(diagnostic: Diagnostic, *, color: bool = False) -> str:
    """The full text with source lines and carets. Ends without a line break."""

    def paint(text: str, style: str) -> str:
        return f"\x1b[{style}m{text}\x1b[0m" if color else text

    severity = diagnostic.severity
    code = paint(f"{severity.value}[{diagnostic.code}]", COLORS[severity])
    places, gutter = source_lines([diagnostic.primary, *diagnostic.secondary])
    lines = [f"{code}: {printable(diagnostic.message)}", *places]
    lines.extend(f"{' ' * gutter} = note: {printable(note)}" for note in diagnostic.notes)
    lines.extend(f"{' ' * gutter} = help: {printable(text)}" for text in diagnostic.helps)
    lines.append(f"{' ' * gutter} = more: powderdsl explain {diagnostic.code}")
    return "\n".join(lines)


def diagnostic_data(diagnostic: Diagnostic, *, utf16: bool = False) -> dict[str, Any]:
    """A diagnostic as plain data. `utf16` counts columns in UTF-16 units, as browser editors do."""

    def point(source: Source, offset: int) -> dict[str, int]:
        line, column = source.position(offset)
        before = source.line(line)[: column - 1]
        units = len(before.encode("utf-16-le")) // 2 if utf16 else len(before)
        return {"line": line, "column": units + 1}

    def label_data(label: Label) -> dict[str, Any]:
        span = label.span
        if span is None:
            return {"span": None, "text": label.text}
        ends = {"start": point(span.source, span.start), "end": point(span.source, span.end)}
        return {"span": {"file": span.source.name, **ends}, "text": label.text}

    fix = diagnostic.fix
    return {
        "code": diagnostic.code,
        "severity": diagnostic.severity.value,
        "message": diagnostic.message,
        "primary": label_data(diagnostic.primary),
        "secondary": [label_data(label) for label in diagnostic.secondary],
        "notes": list(diagnostic.notes),
        "helps": list(diagnostic.helps),
        "fix": None if fix is None else label_data(Label(*fix)),
    }


# Collecting


class CompileError(Exception):
    """Invalid input, such as rule files, worlds or tasks. `diagnostics` has all errors, in source order."""

    def __init__(self, diagnostics: Iterable[Diagnostic]):
        self.diagnostics = tuple(diagnostics)
        super().__init__(self.diagnostics)

    def __str__(self) -> str:
        return "\n".join(render_text(diagnostic) for diagnostic in self.diagnostics)


class Reporter:
    """Collects diagnostics. Every stage reports as many as it can; `raise_if_errors` ends the stage."""

    def __init__(self) -> None:
        self._diagnostics: dict[Diagnostic, None] = {}
        self._errors = self.reports = 0
        """`reports` also counts repetitions."""

    def report(
        self,
        code: str,
        message: str,
        span: Span | None,
        label: str = "",
        *,
        secondary: Sequence[Label] = (),
        notes: Sequence[str] = (),
        helps: Sequence[str] = (),
    ) -> None:
        """Add a diagnostic, with the severity of its code.

        Raises CompileError with all errors so far once there are MAX_ERRORS.
        """
        if span is not None and span.end <= span.start:
            span = Span(span.source, span.start, span.start + 1)  # something to underline
        self.add(Diagnostic(code, message, Label(span, label), tuple(secondary), tuple(notes), tuple(helps)))

    error = report

    def add(self, diagnostic: Diagnostic) -> None:
        """Add a diagnostic. Raises CompileError as `report` does."""
        self.reports += 1
        if diagnostic in self._diagnostics:
            return
        if diagnostic.severity is Severity.ERROR:
            self._errors += 1
        elif len(self._diagnostics) > 10 * MAX_ERRORS:
            return
        self._diagnostics[diagnostic] = None
        if self._errors >= MAX_ERRORS:
            self.raise_if_errors()

    @property
    def diagnostics(self) -> tuple[Diagnostic, ...]:
        """The diagnostics so far, in source order, without repetitions."""
        return tuple(sorted(self._diagnostics, key=lambda diagnostic: diagnostic.sort_key))

    @property
    def has_errors(self) -> bool:
        return self._errors > 0

    def raise_if_errors(self) -> None:
        """Raise CompileError with the errors so far, if any (warnings and notes stay with the reporter)."""
        if self.has_errors:
            errors = [d for d in self.diagnostics if d.severity is Severity.ERROR]
            raise CompileError(errors)


def suggest(word: str, candidates: Iterable[str], kind: str = "") -> tuple[str, ...]:
    """Help lines for an unknown word: a close match, or the whole list if it is short."""
    word = str(word)  # callers of the Python API may pass anything
    known = sorted(set(candidates) - {word})
    if len(known) > MAX_CANDIDATES:
        known = [name for name in known if name[:1] == word[:1]][:MAX_CANDIDATES]
    close = get_close_matches(word.lower(), known, n=1, cutoff=0.6)
    if close:
        return (f"did you mean `{close[0]}`?",)
    if 0 < len(known) <= 8:
        names = ", ".join(f"`{name}`" for name in known)
        return (f"{kind or 'known here'}: {names}",)
    return ()


def with_suggestion(message: str, word: str, candidates: Iterable[str], kind: str = "") -> str:
    """A message about an unknown word in one line, followed by the help of `suggest` if there is any."""
    return "; ".join([message, *suggest(word, candidates, kind)])
