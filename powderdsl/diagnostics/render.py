"""Three renderings of one diagnostic: full text with carets, one line, JSON."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any
from unicodedata import combining, east_asian_width

from powderdsl.diagnostics.codes import Severity
from powderdsl.diagnostics.diagnostic import Diagnostic, Label, Source
from powderdsl.diagnostics.printable import printable

TAB_WIDTH = 4
MAX_SHOWN = 160
COLORS = {Severity.ERROR: "31;1", Severity.WARNING: "33;1", Severity.NOTE: "36;1"}


def _cells(text: str) -> int:
    """Terminal cells that `text` takes, tabs already expanded."""
    return sum(0 if combining(char) else 2 if east_asian_width(char) in "WF" else 1 for char in text)


def _snippet(label: Label, caret: str) -> tuple[str, str]:
    """The source line and the line of carets below it, long lines cut to a window around the place."""
    span = label.span
    assert span is not None
    line_number, column = span.source.position(span.start)
    raw = span.source.line(line_number)
    start = min(column - 1, len(raw))
    end = max(min(start + span.end - span.start, len(raw)), start)
    left = max(0, start - MAX_SHOWN // 2) if len(raw) > MAX_SHOWN else 0
    right = min(len(raw), left + MAX_SHOWN)

    def shown(piece: str) -> str:
        # What cannot be printed takes one column, so that carets stay below their text.
        chars = piece.expandtabs(TAB_WIDTH)
        return "".join("\N{REPLACEMENT CHARACTER}" if printable(char) != char else char for char in chars)

    text = ("…" if left else "") + shown(raw[left:right]) + ("…" if right < len(raw) else "")
    before = _cells(shown(raw[left:start])) + (1 if left else 0)
    width = max(1, _cells(shown(raw[left : min(end, right)])) + (1 if left else 0) - before)
    return text, (" " * before + caret * width + (f" {printable(label.text)}" if label.text else "")).rstrip()


def source_lines(labels: Sequence[Label]) -> tuple[list[str], int]:
    """The source lines of labels with carets, the first label's as `^`; and the width of the line numbers."""
    placed = [label for label in labels if label.span]
    gutter = max((len(str(label.span.line)) for label in placed if label.span), default=1)
    lines: list[str] = []
    name = None
    for label in placed:
        assert label.span is not None
        if label.span.source.name != name:
            arrow = "-->" if name is None else ":::"
            name = label.span.source.name
            lines.append(f"{' ' * gutter}{arrow} {printable(label.span.place)}")
            lines.append(f"{' ' * gutter} |")
        text, carets = _snippet(label, "^" if label is labels[0] else "-")
        lines += [f"{label.span.line:>{gutter}} | {text}".rstrip(), f"{' ' * gutter} | {carets}"]
    return lines, gutter


def render_text(diagnostic: Diagnostic, *, color: bool = False) -> str:
    """The full text with source lines and carets. Ends without a line break."""

    def paint(text: str, style: str) -> str:
        return f"\x1b[{style}m{text}\x1b[0m" if color else text

    severity = diagnostic.severity
    head = (
        paint(f"{severity.value}[{diagnostic.code}]", COLORS[severity]) + f": {printable(diagnostic.message)}"
    )
    places, gutter = source_lines([diagnostic.primary, *diagnostic.secondary])
    lines = [head, *places]
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

    return {
        "code": diagnostic.code,
        "severity": diagnostic.severity.value,
        "message": diagnostic.message,
        "primary": label_data(diagnostic.primary),
        "secondary": [label_data(label) for label in diagnostic.secondary],
        "notes": list(diagnostic.notes),
        "helps": list(diagnostic.helps),
    }
