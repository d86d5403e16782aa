"""What is proven holds: no random world breaks a proven claim, or tells rulesets apart that are proven equal."""

from __future__ import annotations

from collections import Counter

import pytest

from powderdsl.compiler import shipped_tests
from powderdsl.testing.generators.cases import Choices
from powderdsl.testing.mutation.judging import Original, sampled
from powderdsl.testing.mutation.operators import Mutant
from tests.fuzz.rulemaker import random_ruleset
from tests.prover.soundness import (
    breaking_world,
    differing_world,
    equal_mutants,
    proven,
    random_claims,
    random_original,
)
from tests.tiers import tiered

FEW, MANY = range(3000, 3008), [range(first, first + 100) for first in range(3000, 5000, 100)]


@pytest.mark.parametrize("seeds", tiered([FEW, *MANY], [FEW]), ids=str)
def test_no_world_breaks_a_proven_claim(seeds: range) -> None:
    kinds = Counter[str]()
    unproven_and_broken = 0
    for seed in seeds:
        ruleset = random_ruleset(seed)
        if ruleset is None:
            continue
        claims = random_claims(ruleset, Choices.seeded(seed), 14)
        known = proven(ruleset, claims, seconds=2)
        for claim in known:
            kinds[type(claim[0]).__name__] += 1
            world = breaking_world(ruleset, claim, 192, seed)
            assert world is None, f"seed {seed}: {claim} is broken after {world[1]} steps by\n{world[0]}"
        for claim in claims:
            if claim not in known and len(seeds) == len(FEW):
                unproven_and_broken += breaking_world(ruleset, claim, 64, seed) is not None
    assert {"Total", "Never", "Unchanging", "Local"} <= kinds.keys()
    assert sum(kinds.values()) > 3 * len(seeds)
    assert unproven_and_broken > 20 or len(seeds) > len(FEW)  # the worlds can break what is false


FEW_ORIGINALS, ORIGINALS = range(5000, 5010), [range(first, first + 50) for first in range(5000, 6000, 50)]


@pytest.mark.parametrize("seeds", tiered([FEW_ORIGINALS, *ORIGINALS], [FEW_ORIGINALS]), ids=str)
def test_no_world_tells_equal_mutants_of_random_packs_apart(seeds: range) -> None:
    found = 0
    for seed in seeds:
        original = random_original(seed)
        if original is not None:
            mutants = Choices.seeded(seed).some(original.mutants(), 6, 12)
            found += check_equal_mutants(original, mutants, 200 if len(seeds) == len(FEW_ORIGINALS) else 1000)
    assert found > len(seeds) // 2


def check_equal_mutants(original: Original, mutants: list[Mutant], worlds: int) -> int:
    """How many of some mutants are proven equal. Raises AssertionError if a world tells one from the original."""
    found = 0
    for mutant, mutated in equal_mutants(original, mutants, seconds=2):
        world = differing_world(original.ruleset, mutated, worlds)
        assert world is None, f"{mutant.diff}\ndiffers after {world[1]} steps with\n{world[0]}"
        found += 1
    return found


@pytest.mark.slow
@pytest.mark.parametrize("rules", shipped_tests())
def test_no_world_tells_equal_mutants_of_shipped_packs_apart(rules: str) -> None:
    original = Original.of(rules)
    mutants = original.mutants()
    check_equal_mutants(original, [mutants[number] for number in sampled(mutants, 120, seed=0)], 1000)
