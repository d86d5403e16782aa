"""Every backend gives the oracle's worlds, bit for bit: shipped rulesets, grids that end inside a word, tiny ones."""

from __future__ import annotations

import pytest

import powderdsl
from powderdsl.compiler import shipped_tests, shipped_variants
from powderdsl.model.types import Ruleset
from powderdsl.testing.generators.cases import load_text
from tests.compilers import skip_without_compiler

SIZES = [(1, 1), (1, 7), (5, 1), (2, 2), (3, 33), (7, 64), (4, 65), (9, 130)]
RULESETS = sorted(set(shipped_tests()) - shipped_variants())


def compiled(rules: Ruleset, backend: str) -> powderdsl.Simulator:
    skip_without_compiler(backend)
    return powderdsl.compile(rules, backend=backend)


@pytest.mark.parametrize("backend", ["torch", "native", "wasm"])
@pytest.mark.parametrize("name", RULESETS)
def test_same_worlds(name: str, backend: str, torch) -> None:  # type: ignore[no-untyped-def]
    rules = powderdsl.load(name)
    oracle, other = powderdsl.compile(rules, backend="reference"), compiled(rules, backend)
    generator = torch.Generator().manual_seed(7)
    ids = torch.tensor([element.id for element in rules.elements])
    for height, width in SIZES:
        shape = (2, height, width)
        start = ids[torch.randint(len(ids), shape, generator=generator)]
        fields = {}
        for slot in oracle.slots:
            if slot.is_real:
                full = (2, 2, height, width) if slot.planes == 2 else shape
                values = torch.randn(full, generator=generator) * 3
                if slot.of is not None:  # other cells have no such field
                    has = torch.isin(start, torch.tensor(sorted(slot.of)))
                    values = values * (has[:, None] if slot.planes == 2 else has)
                fields[slot.name] = values
        expected = oracle.replace(oracle.world(start, seed=[5, 6]), **fields)
        found = other.replace(other.world(start, seed=[5, 6]), **fields)
        for _ in range(3):
            expected, found = oracle.step(expected), other.step(found)
            for slot in oracle.slots:
                assert torch.equal(expected.state[slot.name], found.state[slot.name]), (
                    slot.name,
                    height,
                    width,
                )


def test_parameters_may_differ_by_world(torch) -> None:  # type: ignore[no-untyped-def]
    """A batch with a value for each world equals the worlds alone with theirs, on cells, planes and native code."""
    rules = powderdsl.load("powderworld")
    rates = torch.tensor([0.0, 0.3, 1.0], dtype=torch.float64)
    ids = torch.randint(14, (3, 8, 40), generator=torch.Generator().manual_seed(1))
    oracle = powderdsl.compile(rules, backend="reference")
    for backend in ("torch", "native", "wasm"):
        sim = compiled(rules, backend)
        together = sim.step(sim.world(ids, seed=4), 3, params={"water.melt": rates, "fire.spread": rates})
        for i, rate in enumerate(rates.tolist()):
            alone = oracle.world(ids[i : i + 1], seed=4, index=[i])
            alone = oracle.step(alone, 3, params={"water.melt": rate, "fire.spread": rate})
            for slot in oracle.slots:
                assert torch.equal(together.state[slot.name][i : i + 1], alone.state[slot.name]), (
                    backend,
                    slot.name,
                )


@pytest.mark.parametrize("seed", range(4))
def test_what_is_skipped_changes_nothing(seed: int, torch) -> None:  # type: ignore[no-untyped-def]
    """Full worlds and nearly empty ones, with wind and without: the same worlds."""
    rules = powderdsl.load("powderworld")
    oracle, other = powderdsl.compile(rules, backend="torch"), powderdsl.compile(rules, backend="wasm")
    generator = torch.Generator().manual_seed(seed)
    ids = torch.randint(14, (5, 30, 64), generator=generator)
    ids[torch.rand(ids.shape, generator=generator) < (0.2, 0.2, 0.9, 0.9)[seed]] = 0
    velocity = torch.randn((5, 2, 30, 64), generator=generator) * 5
    velocity[:, :, :, 40:] = 0
    for wind in (velocity, 0 * velocity):
        worlds = [sim.replace(sim.world(ids, seed=seed), velocity=wind) for sim in (oracle, other)]
        for _ in range(6):
            worlds = [world.sim.step(world, 2) for world in worlds]
            for slot in oracle.slots:
                assert torch.equal(worlds[0].state[slot.name], worlds[1].state[slot.name]), slot.name


def test_elements_that_appear_are_found_by_later_passes(torch) -> None:  # type: ignore[no-untyped-def]
    rules = load_text(
        """
pack: appearing
elements:
  zero: {id: 0, color: '#000000'}
  one: {id: 1, color: '#808080'}
  two: {id: 2, color: '#F0F0F0'}
passes:
  first:
    do: any -> one
  second:
    do: (zero, one) -> zero
""",
        "appearing.yaml",
    )
    for shape in ((1, 8, 64), (2, 3, 5)):
        for start in range(3):
            ids = torch.full(shape, start)
            for backend in ("reference", "wasm", "native"):
                sim = compiled(rules, backend)
                assert not sim.step(sim.world(ids)).ids.any(), (backend, shape, start)


def test_native_state_is_unpacked_when_read(torch) -> None:  # type: ignore[no-untyped-def]
    """Worlds stay packed between calls; a step leaves its argument as it was; saving and selecting work."""
    sim = compiled(powderdsl.load("life"), "native")
    ids = torch.randint(2, (9, 20, 70), generator=torch.Generator().manual_seed(2))
    start = sim.world(ids)
    one = sim.step(start)
    two = sim.step(one)
    assert torch.equal(start.ids, ids.to(torch.uint8))
    assert torch.equal(sim.step(start, 2).ids, two.ids)
    assert torch.equal(sim.step(one.select([3, 8])).ids, two.ids[[3, 8]])
