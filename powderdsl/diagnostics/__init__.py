"""Diagnostics: a mistake, its location, and a fix. Used by every stage, without dependencies."""

from powderdsl.diagnostics.codes import CODES, Code, Severity
from powderdsl.diagnostics.diagnostic import (
    CompileError,
    Diagnostic,
    Label,
    Reporter,
    Source,
    Span,
    suggest,
    with_suggestion,
)

__all__ = [
    "CODES",
    "Code",
    "CompileError",
    "Diagnostic",
    "Label",
    "Reporter",
    "Severity",
    "Source",
    "Span",
    "suggest",
    "with_suggestion",
]
