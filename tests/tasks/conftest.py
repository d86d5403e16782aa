"""Tests of tasks read many files on the same rules: those are read and checked once."""

from __future__ import annotations

from functools import cache

import pytest

from powderdsl.compiler import load_with_diagnostics, read
from powderdsl.diagnostics import Reporter
from powderdsl.tasks import file

RULES = "powderworld"


@cache
def loaded():  # type: ignore[no-untyped-def]
    return load_with_diagnostics(RULES), read([RULES], Reporter())


@pytest.fixture(autouse=True)
def _rules_once(monkeypatch: pytest.MonkeyPatch) -> None:
    def load(*names, params=None, palette=None):  # type: ignore[no-untyped-def]
        return (
            loaded()[0] if names == (RULES,) and not params else load_with_diagnostics(*names, params=params)
        )

    def read_names(names, reporter):  # type: ignore[no-untyped-def]
        return loaded()[1] if list(names) == [RULES] else read(names, reporter)

    monkeypatch.setattr(file, "load_with_diagnostics", load)
    monkeypatch.setattr(file, "read", read_names)
