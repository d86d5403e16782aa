"""Our random numbers as numbers: fair bits, unrelated to whatever else the hash was given."""

from __future__ import annotations

import numpy as np
import pytest

from powderdsl.model.reference import Clock, draw
from powderdsl.simulation.simulator import compile as compile_ruleset
from powderdsl.system.random import name_number
from tests.semantics.texts import load_text

DEVIATIONS = 6.0
"""Standard deviations that a statistic may be off: by chance, 2 in 10^9 are."""

IDENTS = (name_number("movement"), name_number("interact"), name_number("pack.pass#1"), 0, 1)


def draws(
    seed: int = 1,
    index: int = 0,
    step: int = 0,
    ident: int = IDENTS[0],
    bits: int = 32,
    shape: tuple[int, int] = (128, 160),
) -> np.ndarray:
    """Draws of one world by the oracle, as integers below 2^bits: uint64 [H, W]."""
    clock = Clock(np.array([seed]), np.array([index]), np.array([step]))
    return (draw(clock, ident, bits, *shape)[0] * 2.0**bits).astype(np.uint64)  # type: ignore[no-any-return]


def planes(numbers: np.ndarray, bits: int = 32) -> np.ndarray:
    """Bit planes as ±1: float64 [bits, cells…]."""
    return np.stack([(numbers >> np.uint64(j)) & np.uint64(1) for j in range(bits)]).astype(float) * 2 - 1


def assert_fair(signs: np.ndarray) -> None:
    """Each row of ±1 sums up to about nothing."""
    flat = signs.reshape(len(signs), -1)
    deviations = flat.sum(1) / np.sqrt(flat.shape[1])
    assert np.abs(deviations).max() < DEVIATIONS, deviations


@pytest.mark.parametrize("bits", [16, 32])
@pytest.mark.parametrize("ident", IDENTS[:3])
def test_every_bit_is_fair_and_alone(bits: int, ident: int) -> None:
    signs = planes(draws(ident=ident, bits=bits), bits)
    assert_fair(signs)
    for i in range(1, bits):  # bits of one draw
        assert_fair(signs[i:] * signs[:-i])
    for dy, dx in ((0, 1), (0, 2), (1, 0), (1, 1), (1, -1), (0, 31), (0, 32), (0, 33), (2, 0), (64, 0)):
        assert_fair(signs * np.roll(signs, (dy, dx), (1, 2)))


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ({"step": 0}, {"step": 1}),
        ({"seed": 5}, {"seed": 5 + (1 << 32)}),
        ({"seed": 3}, {"seed": (1 << 63) - 1}),
        ({"index": 0}, {"index": 1}),
        ({"seed": 1, "index": 0}, {"seed": 0, "index": 1}),
        ({"ident": IDENTS[0]}, {"ident": IDENTS[1]}),
        ({"ident": 0, "step": 1}, {"ident": 1, "step": 0}),
    ],
)  # fmt: skip
def test_draws_of_other_clocks_have_nothing_in_common(one: dict[str, int], other: dict[str, int]) -> None:
    first, second = draws(**one), draws(**other)
    assert not np.array_equal(first, second)
    assert_fair(planes(first) * planes(second))
    # Not displaced either: the same numbers at other cells would make patterns that wander.
    for dy, dx in ((0, 1), (1, 0), (0, 32), (1, 1)):
        assert_fair(planes(first) * np.roll(planes(second), (dy, dx), (1, 2)))
    assert len(np.intersect1d(first, second)) < 5  # 20,480 of 2^32 twice: 0.1 are expected in common


def test_draws_lie_strictly_inside_and_half_way_between_multiples() -> None:
    clock = Clock(np.array([0, 7]), np.array([0, 3]), np.array([0, 0]))
    values = draw(clock, 5, 16, 40, 70)
    assert values.shape == (2, 40, 70)
    assert 0 < values.min() < values.max() < 1
    assert np.array_equal(values * 2.0**17 % 2, np.ones_like(values))
    # 16 bits are the first 16 of 32: a finer stream of the same name agrees as far as it goes.
    assert np.array_equal(np.floor(draw(clock, 5, 32, 40, 70) * 2**16), np.floor(values * 2**16))


def test_rules_fire_as_often_as_their_chance_says() -> None:
    """Two rules with chances of their own: each fires as often as it says, and they know nothing of each other."""
    text = """
pack: p
streams: {coarse: {bits: 16}}
fields: {one: {type: flag, at: place}, two: {type: flag, at: place}, three: {type: flag, at: place}}
elements: {a: {id: 0, color: "#000000"}}
passes:
  first:
    do:
      - one := yes where a with chance 20%
      - two := yes where a with chance 0.5%
      - three := coarse < 37.5%
"""
    simulator = compile_ruleset(load_text(text), backend="wasm")
    world = simulator.step(simulator.world(np.zeros((4, 200, 250), int), seed=11))
    one, two, three = (world[name].numpy().astype(bool) for name in ("one", "two", "three"))
    for fired, chance in (
        (one, 0.2), (two, 0.005), (three, 0.375), (one & two, 0.001), (one & three, 0.075), (two & three, 0.001875),
        (one & np.roll(one, 1, 2), 0.04), (one[:-1] & one[1:], 0.04),
    ):  # fmt: skip
        spread = np.sqrt(fired.size * chance * (1 - chance)) * np.sqrt(
            2
        )  # overlapping pairs are not independent
        assert abs(fired.sum() - fired.size * chance) < DEVIATIONS * spread
    # The four worlds of one seed differ, and so do two steps.
    assert len({one[i].tobytes() for i in range(4)}) == 4
    again = simulator.step(simulator.replace(world, one=0, two=0))
    assert not np.array_equal(again["one"].numpy().astype(bool), one)


VINES = """pack: vines
elements:
  soil: {{id: 0, color: "#6F4E37"}}
  vine: {{id: 1, color: "#2A9D8F"}}
passes: {{grow: {{{block}}}}}
"""
ABOVE, SIDE = "soil -> vine if above is vine with chance 30%", "soil -> vine if side is vine with chance 30%"


@pytest.mark.parametrize(
    ("block", "independent"),
    [
        (f"symmetry: rotations, do: {ABOVE}", 1),
        (f"for side in sides: [{SIDE}]", 4),
        (f"repeat 4: [{ABOVE}]", 4),
        (f'symmetry: mirror, "for side in (above, left)": [{SIDE}]', 2),
        (f"do: [{ABOVE}, {ABOVE.replace('above', 'left')}]", 2),
    ],
)
def test_rounds_draw_for_themselves_and_copies_of_a_symmetry_share(block: str, independent: int) -> None:
    count = 20_000
    sim = compile_ruleset(load_text(VINES.format(block=block)), backend="wasm")
    world = sim.world([[[0, 1, 0], [1, 0, 1], [0, 1, 0]]] * count, seed=3)
    grown = float((sim.step(world, steps=1).ids[:, 1, 1] == 1).double().mean())
    expected = 1 - 0.7**independent
    assert abs(grown - expected) < DEVIATIONS * (expected * (1 - expected) / count) ** 0.5


@pytest.mark.parametrize(
    ("old", "new", "stays"),
    [
        ("vine with", "vine and not soil with", True),
        ("grow:", "other: {do: vine -> soil if above is soil}, grow:", True),
        ("side", "near", False),
        ("grow:", "sprout:", False),
        ("pack: vines", "pack: grapes", False),
        ("[soil", "[vine -> soil if above is soil, soil", False),
    ],
)
def test_draws_of_a_chance_follow_from_its_place_and_names(old: str, new: str, stays: bool) -> None:
    text = VINES.format(block=f'"for side in (above, left)": [{SIDE}]')
    before, after = (
        {stream.name for stream in load_text(one).streams if "#" in stream.name}
        for one in (text, text.replace(old, new))
    )
    assert before == {"vines.grow#0[side = above]", "vines.grow#0[side = left]"}
    assert (before == after) is stays
