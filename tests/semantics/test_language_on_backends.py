"""Division, kernels with a radius, defaults by element, and all of them under chances: every backend gives the oracle's worlds."""

from __future__ import annotations

from pathlib import Path

import pytest

from powderdsl.model.types import Ruleset
from powderdsl.simulation.simulator import Simulator
from powderdsl.simulation.simulator import compile as compile_ruleset
from powderdsl.testing.generators.cases import load_text, random_start
from powderdsl.testing.generators.choices import Choices
from tests.compilers import skip_without_compiler
from tests.fuzz.compare import assert_same
from tests.fuzz.cuda_emulation import EmulatedSimulator
from tests.tiers import tiered

DIVISION = """\
pack: quotients
elements:
  air: {id: 0, color: "#101010", glyph: "."}
  rock: {id: 1, color: "#909090"}
properties:
  weight: {type: -5..5, air: -3, rock: 4}
params:
  divisor: {type: -4..4, default: -3}
fields:
  x: {type: -33..40, at: place}
  y: {type: -7..6, at: element}
  many: {type: 0..60000, at: place}
  share: {type: -40..41, at: place}
  rest: {type: -100..100, at: place}
  real: {type: real(-1000..1000), at: place}
passes:
  divide:
    do:
      - share := x div y
      - rest := (many div (y + 10) - below.x div divisor) div weight
      - x += sum(x in ring) div count(rock) where (row div 3 + column div 5 + step) mod 3 == 0
      - real := real / 2 + x div 7
  spread:
    for side in sides:
      - side.x += x div -8 where x > 8 or x < -8
    then:
      - air -> rock if (share - x) div 4 > 3 and left.y div 2 != y
      - rock -> air if rest mod 7 == 3 and many div 60001 == 0
  grow:
    do: [many += abs(x) * 100, y -= x div 9]
"""

KERNELS = """\
pack: neighborhoods
elements:
  off: {id: 0, color: "#101010", glyph: "."}
  lit: {id: 1, color: "#909090"}
  hot: {id: 2, color: "#FF0000"}
fields:
  level: {type: -9..9, at: element}
  total: {type: -5000..5000, at: place}
  warm: {type: real(-100..100), at: place}
  flow: {type: vec2(-9..9), at: place}
kernels:
  near: {shape: box(5), edges: wrap}
  round: {shape: disc(4), edges: wrap}
passes:
  sums:
    do:
      - total := sum(level in disc(3)) - 2 * sum(level in ring(5)) + sum(level in round)
      - warm := warm * 0.5 + sum(warm in diamond(3)) / 50 + count(hot in cross(7))
      - flow := flow * 0.5 + sum(flow in plus(3)) / 12
  bosco:
    do:
      - off -> lit if count(lit in near) in 34..45
      - lit -> off if count(lit, hot in near) not in 33..57 and count(lit in ring(2)) > 3
      - hot -> lit if count((level > 2) in diamond(2)) == count(hot in box(1)) and total > 0
  edges:
    do:
      - off -> hot if count(lit in box(15)) * 2 > count(any in box(15)) and count(any in cross(5)) < 16
      - level += 1 where count(off in plus(2)) > 5 or warm > 3 or flow.row > 0.5
"""

DEFAULTS = """\
pack: hunt
elements:
  grass: {id: 0, color: "#EDF6F9", glyph: "."}
  rabbit: {id: 1, color: "#83C5BE", mood: 3}
  fox: {id: 2, color: "#006D77"}
  den: {id: 3, color: "#582F0E", energy: 2, looks: above}
fields:
  energy: {type: 0..9, at: element, default: 1, rabbit: 5}
  speed: {type: vec2(-9..9), at: element, fox: "vector(1, -2)"}
  warmth: {type: real(0..1), at: element, default: 0.25, fox: 0.5}
  mood: {type: -3..9, at: element, den: -2}
  loves: {type: element, at: element, of: "(rabbit, fox)", default: grass}
  looks: {type: direction, at: element, fox: left}
  awake: {type: flag, at: element, default: yes, grass: no}
also:
  fox: {loves: rabbit, energy: 7}
passes:
  live:
    conflicts: first_wins
    do:
      - rabbit -> fox if energy > 4 and left.mood < 2
      - grass -> above if left is rabbit and above is not grass
      - fox -> (den if awake else loves) if energy > 6 and warmth > 0.3
      - den -> rabbit if below.mood > 1 or speed.row > 0.5
    then:
      conflicts: drop_both
      for side in sides:
        - (rabbit, fox) moves side leaving den if side is grass and looks is side, then side.energy -= 1
      then:
        do: [energy += 1 where awake, mood -= 1 where fox, "looks := below where energy > 4 and not (rabbit)"]
        then: fox swaps right if right is den and loves is rabbit
"""

TOGETHER = """\
pack: together
elements:
  air: {id: 0, color: "#101010", glyph: "."}
  ant: {id: 1, color: "#909090", food: 5, head: left}
  leaf: {id: 2, color: "#00FF00", food: 3}
streams:
  luck: {bits: 16}
params:
  pace: 40%
fields:
  food: {type: 0..20, at: element, leaf: 7}
  head: {type: direction, at: element, of: ant, default: above}
  smell: {type: 0..200, at: place}
passes:
  smell:
    do:
      - smell += count(leaf in disc(3)) div 2 where luck < 60%
      - smell -= smell div 5 + 1
    then:
      for side in sides:
        - side.smell += smell div 8 where smell > 8 with chance pace
  walk:
    conflicts: first_wins
    for dir in sides:
      - ant moves dir leaving air if head is dir and dir is air with chance 80%, then dir.food -= 1
      - ant -> leaf if food div 4 == 0 and head is dir with chance 0.1 * (1 + food)
    then:
      do:
        - food += below.food div 2 where ant and below is leaf and luck > 30%
        - air -> leaf if sum(smell in diamond(2)) div 13 > 2 + count(ant in box(2)) with chance 25%
        - leaf -> air if count(leaf in ring(2)) > 9 with chance pace
      then:
        for dir in sides:
          - head := opposite(dir) where ant and head is dir with chance 30%
"""

HEADINGS = """\
pack: headings
elements:
  air: {id: 0, color: "#101010", glyph: "."}
  bug: {id: 1, color: "#909090"}
  wall: {id: 2, color: "#FF0000"}
fields:
  head: {type: direction, at: element, of: bug, default: above.left}
  trail: {type: direction, at: place, default: below}
  wind: {type: vec2(-9..9), at: place}
  turned: {type: 0..9, at: place}
passes:
  look:
    let: {back: opposite(head), lee: opposite(octant(wind))}
    do:
      - trail := opposite(left.head) where left is bug and left.back is not lee
      - turned += 1 where opposite(trail) in (left, below.right, lee) or left.back == head
      - wind := wind / 2 where opposite(lee if bug else below.trail) is back
  walk:
    conflicts: first_wins
    for side in octants:
      - bug moves side leaving air if side is opposite(opposite(head)) and side is air, then side.turned := 0
      - bug -> air if head is opposite(side) and side is bug and side.head is opposite(head)
    then:
      do: head := opposite(head) where bug and turned mod 2 == 0
      then: head := opposite(above.left if turned == 3 else trail) where bug and above in (wall, bug)
"""

PACKS = {
    "division": DIVISION,
    "kernels": KERNELS,
    "defaults": DEFAULTS,
    "together": TOGETHER,
    "headings": HEADINGS,
}
TORCH = ("torch", "wasm")
SIZES = ((3, 4, 5), (2, 9, 33), (1, 3, 64), (1, 17, 70))
"""Worlds smaller than the kernels, rows that end within a word, of one word and of three."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Compiled kernels, for all tests of this file."""
    return tmp_path_factory.mktemp("kernels")


def compare(ruleset: Ruleset, simulators: list[Simulator], sizes: tuple[tuple[int, int, int], ...]) -> None:
    oracle = compile_ruleset(ruleset, backend="reference")
    for seed, shape in enumerate(sizes):
        start = random_start(ruleset, Choices.seeded(seed), shape)
        assert_same(ruleset, start, steps=4, simulators=[oracle, *simulators])


@pytest.mark.parametrize("backend", tiered([*TORCH, "native"], ["wasm"]))
@pytest.mark.parametrize("name", PACKS)
def test_worlds_of_a_backend(name: str, backend: str) -> None:
    skip_without_compiler(backend)
    ruleset = load_text(PACKS[name])
    compare(ruleset, [compile_ruleset(ruleset, backend=backend)], SIZES)


@pytest.mark.parametrize("name", tiered(PACKS, ["together"]))
def test_emulated_kernels(name: str, folder: Path) -> None:
    """On the chip with either order of threads, and with everything outside."""
    skip_without_compiler()
    ruleset = load_text(PACKS[name])
    simulators = [
        EmulatedSimulator(ruleset, folder, n % 2, limit) for n, limit in enumerate((232_448, 232_448, 300))
    ]
    compare(ruleset, simulators, SIZES)
