"""A diagnostic as data."""

from __future__ import annotations

from dataclasses import dataclass

from powderdsl.diagnostics.codes import CODES, Severity
from powderdsl.diagnostics.span import Span


@dataclass(frozen=True)
class Label:
    """A place and the words that finish the sentence under its caret. `span` is None where there is no text."""

    span: Span | None
    text: str = ""


@dataclass(frozen=True)
class Diagnostic:
    """One mistake (or remark): a code of the table, the place, what is wrong, and how to fix it."""

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
    def sort_key(self) -> tuple[str, int, int, str]:
        span = self.primary.span
        return (span.source.name, span.start, span.end, self.code) if span else ("", 0, 0, self.code)
