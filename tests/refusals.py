"""What is refused, and why."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from powderdsl.diagnostics import CompileError, Diagnostic


def refusal(call: Callable[..., Any], *given: Any, **options: Any) -> tuple[Diagnostic, ...]:
    """The errors that a call ends with."""
    with pytest.raises(CompileError) as caught:
        call(*given, **options)
    return caught.value.diagnostics


def refused_codes(call: Callable[..., Any], *given: Any, **options: Any) -> list[str]:
    """The codes of the errors that a call ends with."""
    return [error.code for error in refusal(call, *given, **options)]
