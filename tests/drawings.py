"""Worlds drawn in tests."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from powderdsl.diagnostics import Reporter, Source, Span
from powderdsl.model.types import Element
from powderdsl.worlds.ascii import parse_ascii


def read_ascii(text: str, elements: Sequence[Element], *, name: str = "<drawing>") -> NDArray[np.uint8]:
    """The ids uint8 [H, W] of a drawing. Raises CompileError as `parse_ascii` reports."""
    reporter = Reporter()
    ids = parse_ascii(Span(Source(name, text), 0, len(text)), elements, reporter)
    reporter.raise_if_errors()
    assert ids is not None
    return ids
