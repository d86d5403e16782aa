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
from powderdsl.diagnostics import CompileError
from powderdsl.testing.generators.cases import load_text
from powderdsl.worlds.raster import Paint
from powderdsl.worlds.scene import shipped_scenes
from powderdsl.worlds.strewn import strew
from tests.cli.commands import PACK, powderdsl
from tests.semantics.test_mixed import HEAVY

FAST = ("--backend", "reference", "--size", "12x20", "--steps", "3")
"""Small and without a compiler: how rules run is tested elsewhere."""


@pytest.fixture(autouse=True)
def _folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "grit.yaml").write_text(PACK)
    (tmp_path / "drawing.txt").write_text("# . G #\n# G . #\n# # # #\n")


def picture_size(path: str) -> tuple[int, int]:
    with Image.open(path) as image:
        return image.size


# Pictures and files


def test_the_last_step_is_drawn_where_nothing_else_is_asked_for():
    result = powderdsl("run", "core+grit.yaml", *FAST)
    assert result.exit_code == 0
    rows = result.stdout.split()
    assert len(rows) == 12
    assert {len(row) for row in rows} == {20}
    assert "core+grit: 1 world of 12×20, 3 steps in" in result.stderr


def test_a_picture_has_the_last_step():
    assert powderdsl("run", "core+grit.yaml", *FAST, "--scale", "2", "--out", "x.png").exit_code == 0
    assert picture_size("x.png") == (40, 24)


def test_a_batch_stands_side_by_side():
    assert powderdsl("run", "core+grit.yaml", *FAST, "--batch", "3", "--out", "x.png").exit_code == 0
    wide, high = picture_size("x.png")
    assert wide > high


@pytest.mark.parametrize(("every", "frames"), [(1, 8), (3, 4), (100, 2)])
def test_an_animation_has_every_nth_step_and_the_ends(every, frames):
    arguments = ("core+grit.yaml", "--world", "drawing.txt", "--backend", "reference", "--steps", "7")
    result = powderdsl("run", *arguments, "--every", every, "--out", "x.gif")
    assert result.exit_code == 0
    with Image.open("x.gif") as image:
        # Pillow merges frames that are alike into one that lasts longer.
        assert 1 <= image.n_frames <= frames
    assert result.stderr.rstrip().endswith("-> x.gif")


def test_a_saved_world_goes_on_where_it_stopped():
    start = ("powderworld", "--backend", "reference", "--size", "16x16", "--batch", "2", "--seed", "5")
    powderdsl("run", *start, "--steps", "3", "--out", "three.npz")
    powderdsl("run", *start, "--steps", "5", "--out", "five.npz")
    result = powderdsl(
        "run",
        "powderworld",
        *("--backend", "reference", "--world", "three.npz"),
        *("--steps", "2", "--out", "three-and-two.npz"),
    )
    assert result.exit_code == 0, result.stderr
    with np.load("five.npz") as one, np.load("three-and-two.npz") as other:
        assert one.files == other.files
        assert all(np.array_equal(one[name], other[name]) for name in one.files)


@pytest.mark.parametrize("option", [("--size", "4x4"), ("--batch", "2"), ("--seed", "0")])
def test_a_saved_world_has_its_own_size_and_seed(option):
    powderdsl("run", "core", *FAST, "--out", "x.npz")
    result = powderdsl("run", "core", "--world", "x.npz", *option)
    assert result.exit_code == 2
    assert f"{option[0]} does not go with this world" in result.stderr


def test_a_saved_world_of_other_rules_is_refused():
    powderdsl("run", "core+grit.yaml", *FAST, "--out", "x.npz")
    result = powderdsl("run", "core", "--world", "x.npz", "--backend", "reference")
    assert result.exit_code == 2
    assert "PD603" in result.stderr


def test_settings_change_what_happens():
    arguments = ("core+grit.yaml", "--world", "drawing.txt", "--backend", "reference", "--steps", "9")
    never = powderdsl("run", *arguments, "--set", "grit.vanish=0%")
    always = powderdsl("run", *arguments, "--set", "grit.vanish=1")
    assert never.stdout.count("G") == 2
    assert always.stdout.count("G") <= 2
    assert never.stdout != powderdsl("run", *arguments, "--steps", "0").stdout


def test_verbose_tells_the_speed():
    result = powderdsl("run", "core+grit.yaml", *FAST, "-v")
    assert "cells/s; reference on cpu" in result.stderr


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
    result = powderdsl("run", "core+odd.yaml", *FAST)
    assert result.exit_code == 0
    assert "powderdsl check core+odd.yaml" in result.stderr


def test_without_a_terminal_frames_follow_one_another():
    result = powderdsl("run", "core+grit.yaml", *FAST, "--watch", "--world", "drawing.txt")
    assert result.exit_code == 2  # a drawing has its own size
    result = powderdsl("run", "life", *FAST, "--watch")
    assert result.exit_code == 0
    assert "\x1b" not in result.stdout
    assert [f"life  step {step} of 3" in result.stdout for step in range(4)] == [True] * 4


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
    assert powderdsl("run", "core+grit.yaml", "--world", "scene.yaml", *quiet).stdout.split() == [
        "#G#",
        "###",
    ]


def test_shipped_rules_and_scenes_belong_together():
    """Each shipped scene is a start world of some shipped rules, and all of them have one."""
    scenes = {scene.name: scene for scene in shipped_scenes()}
    drawn = set()
    for name in shipped_tests():
        rules = package.load(name)
        names = {element.name for element in rules.elements}
        own = [one for one in scenes.values() if one.fill in names and _painted(one) <= names]
        assert own, f"{name} has no scene"
        for scene in own:
            assert start_drawn(rules, scene.name, None, 2, None).ids.shape == (2, *scene.size)
        drawn |= {scene.name for scene in own}
    assert drawn == set(scenes)


def _painted(scene):
    return {one.element for one in scene.paints if isinstance(one, Paint)}


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


@pytest.mark.parametrize(
    ("world", "code"),
    [
        ("gardn", "PD601"),
        ("none.png", "PD101"),
        ("none.npz", "PD602"),
        ("grit.yaml", "PD10"),
        ("broken.npz", "PD602"),
        ("broken.txt", "PD610"),
        ("ragged.txt", "PD611"),
        ("broken.dat", "PD602"),
        ("garden", "PD604"),
        ("", "PD601"),
    ],
)
def test_worlds_that_cannot_be_used(tmp_path, world, code):
    for name in ("broken.png", "broken.npz", "broken.txt", "broken.dat"):
        (tmp_path / name).write_text("??")
    (tmp_path / "ragged.txt").write_text("..\n.\n")
    before = sorted(tmp_path.iterdir())
    result = powderdsl("run", "core+grit.yaml", "--backend", "reference", "--world", world, "--out", "x.png")
    assert result.exit_code == 2
    assert f"error[{code}" in result.stderr
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize(
    "arguments",
    [
        ("run", "core", "--size", "100000x100000"),
        ("run", "core", "--batch", "1000000"),
        ("run", "core+grit.yaml", "--set", "grit.vanish=200%"),
        ("run", "core+grit.yaml", "--set", "grit.vanish=often"),
        ("run", "core", "--out", "none/x.png"),
        ("run", "core", "--device", "cuda:99"),
        (
            "run",
            "grit.yaml",
        ),
        ("render", "drawing.txt", "--rules", "core", "--out", "x.png"),
        ("render", "none.npz", "--rules", "core", "--out", "x.png"),
        ("render", "drawing.txt", "--rules", "core+grit.yaml", "--out", "none/x.png"),
    ],
)
def test_bad_values_are_diagnostics(tmp_path, arguments):
    before = sorted(tmp_path.iterdir())
    result = powderdsl(*arguments, exits=2)
    assert "error[PD" in result.stderr
    assert "PD901" not in result.stderr
    assert sorted(tmp_path.iterdir()) == before


def test_a_picture_may_be_too_large():
    result = powderdsl("run", "life", "--size", "600", "--steps", "0", "--scale", "64", "--out", "x.png")
    assert result.exit_code == 2
    assert "choose a smaller --scale" in result.stderr


# Scattered worlds


def test_strewn_worlds_depend_on_seed_and_place_alone():
    rules = package.load("powderworld")
    four, two = strew(rules, (20, 30), 4, 7), strew(rules, (20, 30), 2, 7)
    assert np.array_equal(four[:2], two)
    assert not np.array_equal(four[0], four[1])
    assert not np.array_equal(four, strew(rules, (20, 30), 4, 8))


def test_strewn_worlds_have_a_frame_that_stays():
    rules = package.load("powderworld")
    (wall,) = unchanging_ids(rules)
    worlds = strew(rules, (9, 12), 3, 0)
    for edge in (worlds[:, 0], worlds[:, -1], worlds[:, :, 0], worlds[:, :, -1]):
        assert (edge == wall).all()
    assert len(np.unique(strew(rules, (64, 64), 16, 0))) == len(rules.elements)


def test_rules_without_movement_get_no_frame():
    worlds = strew(package.load("life"), (16, 16), 8, 0)
    assert set(np.unique(worlds[:, 0])) == {0, 1}


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (9, 1), (2, 2)])
def test_strewn_worlds_may_be_thin(size):
    assert strew(package.load("powderworld"), size, 2, 0).shape == (2, *size)


def test_strewn_worlds_have_an_end():
    with pytest.raises(CompileError) as caught:
        strew(package.load("life"), (1 << 14, 1 << 14), 2, 0)
    assert caught.value.diagnostics[0].code == "PD607"


# render


def test_render_draws_a_world_as_it_stands():
    result = powderdsl("render", "drawing.txt", "--rules", "core+grit.yaml", "--out", "x.png", "--scale", "3")
    assert result.exit_code == 0
    assert picture_size("x.png") == (12, 9)
    powderdsl("run", "core+grit.yaml", *FAST, "--batch", "2", "--out", "x.npz")
    assert powderdsl("render", "x.npz", "--rules", "core+grit.yaml", "--out", "y.png").exit_code == 0
