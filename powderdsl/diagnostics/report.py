"""Diagnostics are collected by a Reporter, and raised once per stage as one CompileError."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from difflib import get_close_matches

from powderdsl.diagnostics.codes import Severity
from powderdsl.diagnostics.diagnostic import Diagnostic, Label, Span
from powderdsl.diagnostics.render import render_text

MAX_ERRORS = 200
"""A file with more mistakes than this is reported up to here: more would not be read."""


MAX_CANDIDATES = 500
"""Names among which a misspelled one is looked for; if there are more, those with its first letter."""


class CompileError(Exception):
    """Bad input: rule files, worlds, tasks. `diagnostics` has all errors, in source order."""

    def __init__(self, diagnostics: Iterable[Diagnostic]):
        self.diagnostics = tuple(diagnostics)
        super().__init__(self.diagnostics)

    def __str__(self) -> str:
        return "\n".join(render_text(diagnostic) for diagnostic in self.diagnostics)


class Reporter:
    """Collects diagnostics. Every stage reports all it can; `raise_if_errors` ends the stage."""

    def __init__(self) -> None:
        self._diagnostics: dict[Diagnostic, None] = {}
        self._errors = 0

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
        """Add a diagnostic. The code's row in the table decides whether it is an error, a warning or a note.

        Raises:
            CompileError: with everything so far, when there are MAX_ERRORS errors.
        """
        if span is not None and span.end <= span.start:
            span = Span(span.source, span.start, span.start + 1)  # something to underline
        self.add(Diagnostic(code, message, Label(span, label), tuple(secondary), tuple(notes), tuple(helps)))

    error = report

    def add(self, diagnostic: Diagnostic) -> None:
        """Add a diagnostic. Raises CompileError as `report` does."""
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
        """Everything found so far, in source order, without repetitions."""
        return tuple(sorted(self._diagnostics, key=lambda diagnostic: diagnostic.sort_key))

    @property
    def has_errors(self) -> bool:
        return self._errors > 0

    def raise_if_errors(self) -> None:
        """Raise CompileError with the errors found (warnings and notes stay with the reporter)."""
        if self.has_errors:
            errors = [d for d in self.diagnostics if d.severity is Severity.ERROR]
            raise CompileError(errors)


def suggest(word: str, candidates: Iterable[str], kind: str = "") -> tuple[str, ...]:
    """Help lines for an unknown word: the close match, or the whole list when it is short."""
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
