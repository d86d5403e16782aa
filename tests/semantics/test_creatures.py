"""The creatures behave as docs/creatures.md says, in the second world and in the first one.

Tests inside the packs check single steps. These check longer runs, which element does what to which creature, and how the
two worlds differ.
"""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import powderdsl
from powderdsl.simulation.draw import to_numpy
from powderdsl.simulation.simulator import Simulator, World
from powderdsl.worlds.scene import draw_start, find_scene
from tests.drawings import read_ascii

PAGE = Path(__file__).parents[2] / "docs" / "creatures.md"
CREATURES = ("fish", "bird", "kangaroo", "mole", "lemming", "snake", "robot")
LIGHT = {"empty", "water", "gas", "fire", "acid", "dust"}
"""What moves out of the way and is at most as heavy as a fish."""

both_worlds = pytest.mark.parametrize("first", [False, True], ids=["second", "first"])
"""`powderworld2`, or `powderworld` with all seven creatures."""


@cache
def simulator(first: bool = False) -> Simulator:
    rules = "+".join(("powderworld", *CREATURES)) if first else "powderworld2"
    return powderdsl.compile(powderdsl.load(rules), backend="wasm")


def drawn(sim: Simulator, art: str, count: int = 1, **fields: float) -> World:
    """`count` worlds that begin alike. Fields are set in the cells that have creatures."""
    world = sim.world(np.repeat(read_ascii(art, sim.ruleset.elements)[None], count, 0), seed=5)
    creatures = np.isin(to_numpy(world.ids), [sim.ruleset.element(name).id for name in CREATURES])
    return sim.paint(world, where=creatures, **fields) if fields else world


def beside(sim: Simulator, glyph: str, copies: int) -> World:
    """Worlds of a creature and to the right of it each element, in the order of their ids, `copies` of each."""
    elements = sim.ruleset.elements
    drawings = [read_ascii(f"####\n#{glyph}{other.glyph}#\n####", elements) for other in elements]
    return sim.world(np.repeat(np.array(drawings), copies, 0), seed=5)


def cells(world: World, name: str) -> NDArray[np.bool_]:
    return np.asarray(to_numpy(world.ids) == world.sim.ruleset.element(name).id)


def path(world: World, name: str, steps: int) -> NDArray[np.int64]:
    """Row and column of the only creature of each world, in each step: [steps + 1, B, 2]."""
    positions = []
    for step in range(steps + 1):
        places = np.argwhere(cells(world, name))
        assert places[:, 0].tolist() == list(range(len(world))), f"lost or doubled in step {step}"
        positions.append(places[:, 1:])
        world = world.sim.step(world)
    return np.array(positions)


def assert_chance(hits: int, tries: int, chance: float) -> None:
    """A count of independent events lies within four standard deviations of its mean."""
    assert abs(hits - tries * chance) <= 4 * np.sqrt(tries * chance * (1 - chance)), (hits, tries)


def entered(before: World, name: str, steps: int) -> set[str]:
    """The elements whose cell the creature of `beside` has been in."""
    names = [element.name for element in before.sim.ruleset.elements]
    been = np.zeros(len(before), bool)
    world = before
    for _ in range(steps):
        world = world.sim.step(world, passes=[name])
        been |= cells(world, name)[:, 1, 2]
    some = been.reshape(len(names), -1).any(1)
    return {name for name, yes in zip(names, some, strict=True) if yes}


# --- how they move


def test_fish_swim_in_what_moves_and_is_no_heavier_and_snakes_destroy_all_but_walls() -> None:
    sim = simulator()
    assert entered(beside(sim, "F", 8), "fish", 25) == LIGHT | {"fish"}
    assert entered(beside(sim, "S", 2), "snake", 1) == {one.name for one in sim.ruleset.elements} - {"wall"}


@pytest.mark.slow
@both_worlds
def test_birds_fly_one_cell_a_step_or_two_and_keep_away_from_walls(first: bool) -> None:
    sim = simulator(first)
    room = np.zeros((20, 20), np.uint8)
    room[[0, -1]] = room[:, [0, -1]] = sim.ruleset.element("wall").id
    room[9, 10] = sim.ruleset.element("bird").id
    places = path(sim.world(np.repeat(room[None], 8, 0), seed=1), "bird", 14)
    assert (np.abs(np.diff(places[1:4], axis=0)).max(2) == (2 if first else 1)).all()
    distance = np.minimum(places, 19 - places).min(2)
    assert first or distance.min() == 3


@pytest.mark.slow
@both_worlds
def test_kangaroos_leap_ten_cells_high_or_25(first: bool) -> None:
    world = drawn(
        simulator(first), "\n".join(["#######", *["#.....#"] * 29, "#..k..#", "#######"]), 4, leap=1
    )
    height = 30 - path(world, "kangaroo", 26 if first else 19)[..., 0]
    assert (24 if first else 9) <= height.max(0).min() <= height.max() <= (26 if first else 10)
    if not first:
        assert (height[16:] == 0).any(0).mean() > 0.5  # back on the ground


@pytest.mark.slow
def test_kangaroos_leap_over_walls_and_climb_no_steps() -> None:
    sim = simulator()
    room = ["#" * 16, *["#" + "." * 14 + "#"] * 10, *["#........#.....#"] * 3, "#..k.....#.....#", "#" * 16]
    leaping = drawn(sim, "\n".join(room), 4, leap=1, momentum=-2)
    assert (path(leaping, "kangaroo", 12)[-1, :, 1] > 9).all()
    walking = drawn(sim, "########\n#......#\n#.k..w.#\n########", 8)
    for _ in range(12):
        walking = sim.step(walking, params={"kangaroo.leaps": 0})
        assert cells(walking, "kangaroo")[:, 2, 1:5].any(1).all()


@pytest.mark.slow
def test_fish_swim_everywhere_in_the_water() -> None:
    sim = simulator()
    world = sim.step(drawn(sim, "######\n#F~~w#\n######", 100), 100)
    assert set(np.argwhere(cells(world, "fish"))[:, 2]) == {1, 2, 3}


def test_birds_form_flocks() -> None:
    sim = simulator()
    ids = np.zeros((1, 30, 30), np.uint8)  # no walls: birds that leave on one side enter on the other
    ids[0, 3::7, 3::7] = sim.ruleset.element("bird").id
    world = sim.step(sim.world(ids, seed=1))

    def agreement(world: World) -> float:
        """0 if headings cancel out, 1 if all birds fly the same way."""
        birds, heading = cells(world, "bird"), to_numpy(world["flying"])
        return float(np.hypot(*(heading * birds[:, None]).sum((2, 3))[0]) / birds.sum())

    assert agreement(world) < 0.5
    assert agreement(sim.step(world, 60)) > 0.9


def test_moles_push_water_aside_and_eat_wood() -> None:
    sim = simulator()
    world = drawn(sim, "########\n#~~~www#\n#~m~www#\n#~~~www#\n########", 100)
    later = sim.step(world, 200)
    assert cells(later, "water").sum() == cells(world, "water").sum()
    assert cells(later, "wood").sum() < cells(world, "wood").sum()


def test_lemmings_climb_steps_of_one_cell() -> None:
    sim = simulator()
    stairs = "##########\n#........#\n#.....w..#\n#....www.#\n#L..wwww.#\n##########"
    wall = "##########\n#........#\n#....w...#\n#L...w...#\n##########"
    over, stopped = (
        np.argwhere(cells(sim.step(drawn(sim, art, 50), 60), "lemming"))[:, 2] for art in (stairs, wall)
    )
    assert (over > 6).any()
    assert (stopped < 5).all()


def test_snakes_with_energy_grow_to_eleven_cells() -> None:
    sim = simulator()
    world = drawn(sim, "#" * 60 + "\n##S" + "." * 56 + "#\n" + "#" * 60, energy=1)
    lengths = []
    for _ in range(30):
        world = sim.step(world)
        lengths.append(int(cells(world, "snake").sum()))
    assert lengths == [*range(2, 12)] + [11] * 20


def test_robots_stay_where_they_land() -> None:
    sim = simulator()
    world = drawn(sim, "#####\n#r.r#\n#..~#\n#####")
    assert (cells(sim.step(world, 2), "robot") == cells(sim.step(world, 100), "robot")).all()


def test_cloners_pour_out_creatures_and_moles_and_snakes_eat_theirs() -> None:
    sim = simulator()
    start = draw_start(find_scene("hatchery"), sim.ruleset)
    world = sim.world(np.repeat(start.ids[None], 2, 0), seed=0)
    for name, field in start.fields.items():
        world = sim.paint(world, where=field.where, **{name: field.values})
    world = sim.step(world, 100)
    for cage, name in enumerate(CREATURES):
        inside = to_numpy(world.ids)[:, 1:-1, 7 * cage + 1 : 7 * cage + 7]
        number, cloner = (sim.ruleset.element(element).id for element in (name, "cloner"))
        eaten = name in ("mole", "snake")
        assert (inside == cloner).sum() == (0 if eaten else 2), name
        assert eaten or (inside == number).sum() > 20, name


# --- who harms whom


def table(heading: str) -> dict[str, list[str]]:
    """The rows of the first table under a heading of the page, by their first cell."""
    text = PAGE.read_text(encoding="utf-8").partition(f"\n## {heading}\n")[2].partition("\n## ")[0]
    rows = [
        [cell.strip() for cell in line.strip("|").split("|")] for line in re.findall(r"^\|.*\|$", text, re.M)
    ]
    return {name: cells for name, *cells in rows[2:]}


def test_creatures_are_harmed_as_the_table_says() -> None:
    harms = table("Who harms whom")
    assert tuple(harms) == CREATURES
    sim = simulator()
    glyphs = [sim.ruleset.element(creature).glyph for creature in CREATURES]

    def left(art: str, name: str, steps: int, copies: int) -> NDArray[np.bool_]:
        """Where the creature `X` of a drawing still is, [7, copies, H, W], after steps of one pass."""
        ids = [read_ascii(art.replace("X", glyph), sim.ruleset.elements) for glyph in glyphs]
        world = sim.step(sim.world(np.repeat(np.array(ids), copies, 0), seed=2), steps, passes=[name])
        return np.array(
            [cells(world, creature)[i * copies : (i + 1) * copies] for i, creature in enumerate(CREATURES)]
        )

    burns, acid, mole, snake = zip(*harms.values(), strict=True)
    for safe, words in zip(left("####\n#Xf#\n####", "fire", 1, 1000).sum((1, 2, 3)), burns, strict=True):
        assert_chance(1000 - int(safe), 1000, 0 if words == "no" else int(words.removesuffix(" %")) / 100)
    stays = left("###\n#a#\n#X#\n###", "acid", 40, 4).any((1, 2, 3))
    assert ["no" if here else "dissolves" for here in stays] == list(acid)
    dug = left("####\n#mX#\n####", "mole", 25, 16)
    seen = np.where(
        dug.any((2, 3)).all(1), np.where(dug[:, :, 1, 2].all(1), "stops it", "pushed aside"), "eaten"
    )
    assert seen.tolist() == list(mole)
    bitten = left("####\n#SX#\n####", "snake", 1, 2)[:, :, 1, 2].any(1)
    assert [creature for creature, some in zip(CREATURES, bitten, strict=True) if some] == ["snake"]
    assert set(snake) == {"eaten"}


def test_wind_carries_all_of_them() -> None:
    sim = simulator()
    for creature in CREATURES:
        world = drawn(sim, f"####\n#{sim.ruleset.element(creature).glyph}.#\n####", 2)
        world = sim.paint(world, where=np.ones(world.shape, bool), velocity=(0, 8))
        assert cells(sim.step(world, passes=["wind"]), creature)[:, 1, 2].all(), creature
