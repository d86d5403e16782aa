"""What is found out about universes, and which of it counts as a fault."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from powderdsl.testing.lawful import MOST, findings
from tests.tiers import tiered


@pytest.mark.parametrize("seed", tiered(range(100, 108), [100]))
def test_universes_pass_all_filters(seed: int) -> None:
    found = findings(seed)
    assert found.faults == []
    assert found.proven > 6
    assert found.moved > 100
    assert len(found.lines) == 4


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"moved": 0}, "nothing moves"),
        ({"reacted": 0}, "nothing reacts"),
        ({"largest": ("ooze", MOST + 0.01)}, "ooze takes over 51% of the world"),
        ({"remarks": ("warning[PD507]",)}, "warning[PD507]"),
        ({"unproven": ("wall never changes",)}, "not proven: wall never changes"),
    ],
)
def test_each_filter_can_fail(change: dict[str, Any], fault: str) -> None:
    found = replace(findings(100), **change)
    assert found.faults == [fault]
    assert found.lines[-1] == f"fault: {fault}"
