"""Test tiers: `make test` runs a few parameters of a slow test, `make test-all` all of them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def tiered(values: Iterable[Any], smoke: Iterable[Any]) -> list[Any]:
    """Parameters for `pytest.mark.parametrize`: those not in `smoke` are marked `slow`.

    Raises:
        ValueError: a value of `smoke` is not one of `values`, so that a renamed one cannot vanish from `make test`.
    """
    all_values, quick = list(values), list(smoke)
    if not quick or any(value not in all_values for value in quick):
        raise ValueError(f"{quick} must be some of {all_values}")
    return [value if value in quick else pytest.param(value, marks=pytest.mark.slow) for value in all_values]
