"""`powderdsl run` and `powderdsl render`: worlds in, pictures and saved worlds out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import powderdsl as package
from powderdsl.analysis.changes import unchanging_ids
from powderdsl.cli.start_worlds import start, start_drawn
from powderdsl.compiler import shipped_tests
from powderdsl.worlds.raster import Paint
from powderdsl.worlds.scene import shipped_scenes
from powderdsl.worlds.strewn import strew
from tests.cli.commands import PACK, powderdsl
from tests.refusals import refused_codes
from tests.semantics.test_mixed import HEAVY
from tests.semantics.texts import load_text

FAST = ("--backend", "reference", "--size", "12x20", "--steps", "3")
"""Small and without a compiler: how rules run is tested elsewhere."""


@pytest.fixture(autouse=True)
def _folder(folder):
    (folder / "grit.yaml").write_text(PACK)
    (folder / "drawing.txt").write_text("# . G #\n# G . #\n# # # #\n")


def picture_size(path: str) -> tuple[int, int]:
    with Image.open(path) as image:
        return image.size


# Pictures and files


def test_the_last_step_is_drawn_where_nothing_else_is_asked_for():
    result = powderdsl("run", "core+grit.yaml", *FAST, "-v", exits=0)
    rows = result.stdout.split()
    assert len(rows) == 12
    assert {len(row) for row in rows} == {20}
    assert "core+grit: 1 world of 12×20, 3 steps in" in result.stderr
    assert "cells/s; reference on cpu" in result.stderr


def test_pictures_have_the_last_step_and_worlds_stand_side_by_side():
    result = powderdsl("run", "core+grit.yaml", *FAST, "--scale", "2", "--out", "x.png", exits=0)
    assert picture_size("x.png") == (40, 24)
    assert result.stdout == ""
    assert result.stderr.count("\n") == 1, "progress is for terminals"
    assert "\x1b" not in result.stderr
    powderdsl("run", "core+grit.yaml", *FAST, "--batch", "3", "--out", "x.npz", exits=0)
    powderdsl("render", "core+grit.yaml", "--world", "x.npz", "--out", "y.png", exits=0)
    powderdsl("run", "core+grit.yaml", *FAST, "--batch", "3", "--out", "x.png", exits=0)
    assert picture_size("x.png") == picture_size("y.png")
    wide, high = picture_size("x.png")
    assert wide > high
    powderdsl("render", "core+grit.yaml", "--world", "drawing.txt", "--out", "x.png", "--scale", "3", exits=0)
    assert picture_size("x.png") == (12, 9)


@pytest.mark.parametrize(("every", "frames"), [(1, 8), (3, 4), (100, 2)])
def test_an_animation_has_every_nth_step_and_the_ends(every, frames):
    arguments = ("core+grit.yaml", "--world", "drawing.txt", "--backend", "reference", "--steps", "7")
    result = powderdsl("run", *arguments, "--every", every, "--out", "x.gif", exits=0)
    with Image.open("x.gif") as image:
        # Pillow merges frames that are alike into one that lasts longer.
        assert 1 <= image.n_frames <= frames
    assert result.stderr.rstrip().endswith("-> x.gif")


def test_a_saved_world_goes_on_where_it_stopped():
    start = ("powderworld", "--backend", "reference", "--size", "16x16", "--batch", "2", "--seed", "5")
    powderdsl("run", *start, "--steps", "3", "--out", "three.npz")
    powderdsl("run", *start, "--steps", "5", "--out", "five.npz")
    more = ("--backend", "reference", "--world", "three.npz", "--steps", "2", "--out", "three-and-two.npz")
    powderdsl("run", "powderworld", *more, exits=0)
    with np.load("five.npz") as one, np.load("three-and-two.npz") as other:
        assert one.files == other.files
        assert all(np.array_equal(one[name], other[name]) for name in one.files)


def test_settings_change_what_happens():
    arguments = ("core+grit.yaml", "--world", "drawing.txt", "--backend", "reference", "--steps", "9")
    never = powderdsl("run", *arguments, "--set", "grit.vanish=0%")
    always = powderdsl("run", *arguments, "--set", "grit.vanish=1")
    assert never.stdout.count("G") == 2
    assert always.stdout.count("G") <= 2
    assert never.stdout != powderdsl("run", *arguments, "--steps", "0").stdout


def test_auto_takes_torch_for_many_steps_large_worlds_and_passes_on_cells():
    core, heavy = package.load("core"), load_text(HEAVY, "heavy.yaml")

    def library(rules, side=8, steps=10):
        return start(rules, None, (side, side), 1, 0, steps=steps).sim.kind.xp.__name__

    assert library(core) == "numpy"
    assert library(core, steps=10**8) == library(core, side=1200) == library(heavy) == "torch"


def test_threads_are_set():
    import torch

    before = torch.get_num_threads()
    try:
        powderdsl("run", "core", *FAST, "--backend", "torch", "--threads", "2")
        assert torch.get_num_threads() == 2
        powderdsl("run", "core", *FAST, "--backend", "torch")
        assert torch.get_num_threads() == 1
    finally:
        torch.set_num_threads(before)


def test_warnings_are_mentioned():
    odd = PACK.replace("do: ", "do: grit -> empty if grit and not grit\n    then: ")
    Path("odd.yaml").write_text(odd)
    result = powderdsl("run", "core+odd.yaml", *FAST, exits=0)
    assert "powderdsl check core+odd.yaml" in result.stderr


def test_without_a_terminal_frames_follow_one_another():
    result = powderdsl("run", "life", *FAST, "--watch", exits=0)
    assert "\x1b" not in result.stdout
    assert all(f"life  step {step} of 3" in result.stdout for step in range(4))


# Start worlds


def test_worlds_come_from_drawings_pictures_and_scenes():
    quiet = ("--backend", "reference", "--steps", "0")
    drawn = powderdsl("run", "core+grit.yaml", "--world", "drawing.txt", *quiet)
    assert drawn.stdout.split() == ["#.G#", "#G.#", "####"]
    powderdsl("run", "core+grit.yaml", "--world", "drawing.txt", *quiet, "--scale", "1", "--out", "x.png")
    assert powderdsl("run", "core+grit.yaml", "--world", "x.png", *quiet).stdout == drawn.stdout
    Path("scene.yaml").write_text(
        "scene: s\nsize: [2, 3]\nfill: wall\ndraw:\n  - box grit rows 0 columns 1\n"
    )
    scene = powderdsl("run", "core+grit.yaml", "--world", "scene.yaml", *quiet)
    assert scene.stdout.split() == ["#G#", "###"]


def test_shipped_rules_and_scenes_belong_together():
    """Each shipped scene is a start world of some shipped rules, and all of them have one."""
    scenes = {scene.name: scene for scene in shipped_scenes()}
    drawn = set()
    for name in shipped_tests():
        rules = package.load(name)
        names = {element.name for element in rules.elements}
        own = [
            scene
            for scene in scenes.values()
            if {scene.fill, *(one.element for one in scene.paints if isinstance(one, Paint))} <= names
        ]
        assert own, f"{name} has no scene"
        for scene in own:
            assert start_drawn(rules, scene.name, None, 2, None).ids.shape == (2, *scene.size)
        drawn |= {scene.name for scene in own}
    assert drawn == set(scenes)


@pytest.mark.parametrize(
    ("rules", "scene", "steps", "period"),
    [
        ("life", "glider-gun", 300, 30),
        ("wireworld", "clocks-and-gates", 400, 120),
        ("cyclic", "spirals", 200, 6),
        ("brians_brain", "spaceships", 0, 64),
    ],
)
def test_designed_automata_repeat(rules, scene, steps, period):
    """The eater survives, gates do not disturb clocks, spirals turn, ships come back."""
    sim = package.compile(rules)
    world = sim.step(sim.world(start_drawn(sim.ruleset, scene, None, 1, None).ids), steps)
    later = sim.step(world, period)
    assert np.array_equal(world.ids, later.ids)
    assert not np.array_equal(world.ids, sim.step(world, period // 2).ids)


# Scattered worlds


def test_strewn_worlds_depend_on_seed_and_place_alone_and_have_a_frame_that_stays() -> None:
    rules = package.load("powderworld")
    four = strew(rules, (20, 30), 4, 7)
    assert np.array_equal(four[:2], strew(rules, (20, 30), 2, 7))
    assert not np.array_equal(four[0], four[1])
    assert not np.array_equal(four, strew(rules, (20, 30), 4, 8))
    (wall,) = unchanging_ids(rules)
    for edge in (four[:, 0], four[:, -1], four[:, :, 0], four[:, :, -1]):
        assert (edge == wall).all()
    assert len(np.unique(strew(rules, (64, 64), 16, 0))) == len(rules.elements)
    still = strew(package.load("life"), (16, 16), 8, 0)
    assert set(np.unique(still[:, 0])) == {0, 1}, "rules without movement get no frame"


def test_strewn_worlds_may_be_thin_but_have_an_end() -> None:
    for size in ((1, 1), (1, 9), (9, 1), (2, 2)):
        assert strew(package.load("powderworld"), size, 2, 0).shape == (2, *size)
    assert refused_codes(strew, package.load("life"), (1 << 14, 1 << 14), 2, 0) == ["PD607"]
