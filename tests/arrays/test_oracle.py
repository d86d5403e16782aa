"""The oracle gives the same worlds on plain arrays as on NumPy's, for random rules."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from powderdsl.testing.generators.cases import Choices, random_start
from powderdsl.testing.properties.running import Oracle
from tests.fuzz.rulemaker import random_ruleset
from tests.tiers import tiered

BLOCKED = f"""
import sys

sys.modules.update(numpy=None, torch=None)
sys.path[:0] = [{str(Path(__file__).parents[2])!r}]
from tests.arrays.test_oracle import digests

print(*digests(int(sys.argv[1]), int(sys.argv[2])), sep="\\n")
"""


def digests(first: int, stop: int) -> Iterator[str]:
    """For each seed a digest of all states of some random worlds under random rules."""
    for seed in range(first, stop):
        choices, rules = Choices.seeded(seed), random_ruleset(seed)
        if rules is None:
            continue
        whole = hashlib.sha256()
        for shape in (
            (9, choices.integer(1, 5), choices.integer(1, 5)),
            (2, choices.integer(1, 4), choices.pick((31, 33, 64, 65))),
        ):
            for state in Oracle(rules).states(random_start(rules, choices, shape), 3):
                for name, values in sorted(state.items()):
                    whole.update(f"{name} {values.dtype} {values.shape}".encode() + values.tobytes())
        yield f"{seed} {whole.hexdigest()}"


RANGES = [range(2), *(range(seed, seed + 50) for seed in range(2, 302, 50))]


@pytest.mark.parametrize("seeds", tiered(RANGES, RANGES[:1]))
def test_random_rules(seeds: range) -> None:
    command = [sys.executable, "-c", BLOCKED, str(seeds.start), str(seeds.stop)]
    ended = subprocess.run(command, capture_output=True, text=True)
    assert ended.stderr == ""
    assert ended.stdout.splitlines() == [*digests(seeds.start, seeds.stop)]
