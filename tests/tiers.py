"""Test tiers: `make test` runs a smoke test of each campaign, `make test-all` the whole campaign."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def tiered(values: Iterable[Any], smoke: Iterable[Any]) -> list[Any]:
    """Parameters for `pytest.mark.parametrize`: those not in `smoke` are marked `campaign`.

    Raises:
        ValueError: a value of `smoke` is not one of `values`, so that a renamed one cannot vanish from `make test`.
    """
    every, first = list(values), list(smoke)
    if not first or any(one not in every for one in first):
        raise ValueError(f"{first} must be some of {every}")
    return [one if one in first else pytest.param(one, marks=pytest.mark.campaign) for one in every]
