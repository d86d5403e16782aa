"""Rules given as text."""

from __future__ import annotations

import contextlib

import powderdsl
from powderdsl.diagnostics import CompileError, Diagnostic, Reporter, Source
from powderdsl.model.check import check
from powderdsl.model.declarations import PackDecl, read_file
from powderdsl.model.types import Ruleset
from tests.compilers import skip_without_compiler


def load_text(text: str, name: str = "random.yaml") -> Ruleset:
    """The checked model of one pack given as text. Raises CompileError."""
    reporter = Reporter()
    pack = read_file(Source(name, text), reporter)
    reporter.raise_if_errors()
    if not isinstance(pack, PackDecl):
        raise ValueError("the text is not a pack")
    return check([pack], None, reporter)


def simulator(text: str, backend: str = "reference") -> powderdsl.Simulator:
    """A simulator of a pack. The test is skipped if the backend needs a compiler that is missing."""
    skip_without_compiler(backend)
    return powderdsl.compile(load_text(text), backend=backend)


def diagnosed(text: str) -> list[Diagnostic]:
    """All errors, warnings and notes about a pack."""
    reporter = Reporter()
    pack = read_file(Source("pack.yaml", text), reporter)
    if isinstance(pack, PackDecl):
        with contextlib.suppress(CompileError):
            check([pack], None, reporter)
    return list(reporter.diagnostics)


def codes(text: str) -> list[str]:
    """The codes of all diagnostics about a pack."""
    return [diagnostic.code for diagnostic in diagnosed(text)]


def mistakes(text: str) -> list[tuple[str, str]]:
    """The code of each error in a pack, and the text that it points at."""
    errors = [diagnostic for diagnostic in diagnosed(text) if diagnostic.severity.value == "error"]
    return [(error.code, error.primary.span.text if error.primary.span else "") for error in errors]
