"""Generated worlds: functions of their seed alone, drawn uniformly, laid out as the paper's tasks are."""

from __future__ import annotations

import hashlib
from collections import Counter

import numpy as np
import pytest

from powderdsl.targets.tensor_kind import Tensors
from powderdsl.tasks.shipped import load_task, shipped_tasks
from powderdsl.tasks.tensors import generator
from powderdsl.tasks.tensors.generator import WorldMaker
from powderdsl.worlds.raster import Shape, mask
from powderdsl.worlds.scene.read import read_file
from tests.cli.commands import ROOT
from tests.tasks.test_episodes import task_of

HEAD = "task: test\nrules: powderworld\nsize: [64, 64]\nfill: empty\nagent: {may: any, actions: 3}\n"


def maker(torch, task, split: str = "train", variant: int = 0):
    return WorldMaker(task.split(split).variants[variant], task.size, Tensors())


def worlds(torch, text: str, count: int) -> np.ndarray:
    return maker(torch, task_of(HEAD + text)).make(torch.arange(count)).ids.numpy()


EVERYTHING = """
knobs: {most: {default: 4, range: 0..9}}
let: {row: 8..53, edge: row / 2}
regions:
  spot:
    - disk at (row, 30) radius 9
    - box columns edge:edge+4
  left_half: box columns :32
stamps:
  hut:
    art: |
      ?^?
      ^.^
    legend: {"^": wood}
parts:
  ground:
    - wave water at 50 height 6 length 16 phase 0..15
    - ramp sand from (row, 5) to (63, 40)
targets:
  wanted:
    - fill stone in spot
    - disk sand at (row, 9) radius 3
generate:
  - part ground
  - repeat 0..most:
      - let: {thick: 1..5}
      - line (any but sand) from (0..63, 0..63) to (0..63, 0..63) width thick
      - scatter lava chance 5..30% over (empty, water)
  - repeat most:
      - arch stone rows row:row+9 columns edge:edge + (5..20) width 1..3
      - container wood rows 2:9 columns 0..9:end width 1
      - stamp hut at (0..60, -1..60)
  - fill plant in spot over (wall, ice)
  - scatter acid chance 50% in left_half
  - frame wall
"""


def test_a_world_is_the_same_alone_and_in_any_batch(torch, monkeypatch):
    one = maker(torch, task_of(HEAD + EVERYTHING))
    seeds = torch.tensor([0, 7, 2**40, 3, 12_345, 2**62])
    together = one.make(seeds)
    assert len({world.numpy().tobytes() for world in together.ids}) == 6
    for order in ([5, 0, 3], [4], [1, 1, 2]):
        alone = one.make(seeds[order])
        assert torch.equal(alone.ids, together.ids[order])
        assert torch.equal(alone.regions["spot"], together.regions["spot"][order])
        assert torch.equal(alone.targets["wanted"], together.targets["wanted"][order])
    monkeypatch.setattr(generator, "CHUNK_CELLS", 2 * 64 * 64)
    chunked = one.make(seeds)
    assert torch.equal(chunked.ids, together.ids)
    assert torch.equal(chunked.regions["left_half"], together.regions["left_half"])
    assert torch.equal(chunked.targets["wanted"], together.targets["wanted"])


def test_what_regions_targets_and_stamps_hold(torch):
    made = maker(torch, task_of(HEAD + EVERYTHING)).make(torch.arange(4))
    assert made.regions["left_half"].shape == (1, 64, 64)
    assert made.regions["left_half"][0, :, :32].all()
    assert not made.regions["left_half"][0, :, 32:].any()
    target, spot = made.targets["wanted"], made.regions["spot"]
    assert ((target == 9) <= spot).all()
    assert set(target.unique().tolist()) == {2, 9, 255}
    text = "stamps:\n  hut:\n    art: |\n      ?^?\n      ^.^\n    legend: {'^': wood}\n"
    text += "generate: [fill water, 'stamp hut at (-1, 62)']\n"
    corner = worlds(torch, text, 1)[0]
    assert corner[0, 60:].tolist() == [3, 3, 5, 0]
    assert (corner[1:] == 3).all()
    assert not worlds(torch, "regions: {nowhere: []}\ngenerate: [fill sand in nowhere]\n", 2).any()


def test_draws_are_uniform(torch):
    """χ² of numbers read off the worlds, on fixed seeds: 99.9 % points."""
    ids = worlds(torch, "generate:\n  - square sand at (0..63, 0..63) half 1\n", 6400)
    rows = np.array([np.nonzero((one == 2).any(1))[0].max() for one in ids])
    columns = np.array([np.nonzero((one == 2).any(0))[0].max() for one in ids])
    for places in (rows, columns):
        found = np.bincount(places, minlength=64)
        assert ((found - 100) ** 2 / 100).sum() < 106.0  # 63 degrees of freedom
    # Row and column are drawn apart: sixteen fields are equally full.
    fields = np.bincount(rows // 16 * 4 + columns // 16, minlength=16)
    assert ((fields - 400) ** 2 / 400).sum() < 37.7
    kinds = Counter(worlds(torch, "generate: [fill any]\n", 5600)[:, 0, 0].tolist())
    assert sorted(kinds) == list(range(14))
    assert sum((kinds[i] - 400) ** 2 / 400 for i in kinds) < 34.5
    text = "generate:\n  - repeat 0..7:\n      - let: {at_row: 1..62}\n      - box sand rows 5:6 columns at_row:at_row+1\n"
    counts = np.bincount((worlds(torch, text, 4000) == 2).sum((1, 2)), minlength=8)
    assert 380 < counts[0] < 620  # an eighth: nothing is drawn
    density = (worlds(torch, "generate: [scatter sand chance 30%]\n", 50) == 2).mean()
    assert abs(density - 0.3) < 0.004  # 4 standard deviations
    assert (worlds(torch, "generate: [scatter sand chance 100%]\n", 2) == 2).all()
    assert (worlds(torch, "generate: [scatter sand chance 0%]\n", 2) == 0).all()


def test_drawn_numbers_are_those_of_their_statement(torch):
    """Each world is what worlds/raster.py makes of one of the shapes that the statement allows."""
    text = "let: {row: 8..53}\ngenerate:\n  - disk sand at (row, row + 2) radius 3 * (1..3)\n"
    allowed = {
        (mask(Shape("disk", (row, row + 2, 3 * k)), (64, 64))).tobytes()
        for row in range(8, 54)
        for k in (1, 2, 3)
    }
    found = {(one == 2).tobytes() for one in worlds(torch, text, 2000)}
    assert found == allowed


# The shipped tasks


def test_the_designed_worlds_are_the_recorded_ones(torch):
    task = load_task("world-model")
    recorded = np.load(ROOT / "tests" / "data" / "population.npz")["start_ids"]
    for number, expected in enumerate(recorded):
        assert np.array_equal(maker(torch, task, "designed", number).make(torch.tensor([5])).ids[0], expected)
    assert len(task.split("designed").variants) == len(recorded) == 8
    scenes = read_file(ROOT / "tasks" / "scenes" / "designed.yaml")
    assert [one.name for one in task.split("designed").variants] == [scene.name for scene in scenes]


@pytest.mark.parametrize("split", ["train", "test"])
def test_sand_pushing_is_laid_out_as_the_paper_says(torch, split):
    task = load_task("sand-pushing")
    wall, sand = (task.ruleset.element(name).id for name in ("wall", "sand"))
    blocks = []
    for number in range(len(task.split(split).variants)):
        ids = maker(torch, task, split, number).make(torch.arange(60)).ids.numpy()
        columns = np.concatenate([ids[:, :22, 54:63], ids[:, 42:, 54:63]], 1)
        assert (columns == wall).all()
        assert (ids[:, 22:42, 54:63] == 0).all()
        assert (ids[:, [0, -1]] == wall).all()
        assert (ids[:, :, [0, -1]] == wall).all()
        for one in ids:
            rows, places = np.nonzero(one == sand)
            assert len(rows) == 100
            assert (rows.max() - rows.min(), places.max() - places.min()) == (9, 9)
            blocks.append((int(rows.min()) + 5, int(places.min()) + 5))
    assert all(8 <= row <= 53 and 8 <= column <= 43 for row, column in blocks)


def test_the_hand_made_worlds_are_the_recorded_ones(torch):
    """The eight obstacle courses that the paper lists for sand pushing."""
    task = load_task("sand-pushing")
    courses = [maker(torch, task, "handmade", number).make(torch.tensor([number])).ids for number in range(8)]
    digest = hashlib.sha256(torch.cat(courses).numpy().tobytes()).hexdigest()
    assert digest == "c95a7bdce912b54320eeb16cfda8561c2c0345c4a835abd5df89ab70e2efe30f"


def test_path_building_is_laid_out_as_the_paper_says(torch):
    task = load_task("path-building")
    wall, water, cloner = (task.ruleset.element(name).id for name in ("wall", "water", "cloner"))
    for split in ("train", "test"):
        ids = maker(torch, task, split).make(torch.arange(40)).ids.numpy()
        spring = ids[:, 5:15, 5:35]
        assert (spring[:, 1:-1, 1:-1] == cloner).all()
        assert ((spring == cloner).sum((1, 2)) == 8 * 28).all()
        assert ((spring == water).sum((1, 2)) == 10 * 30 - 8 * 28).all()
        assert (ids[:, 40:64, 44:46] == wall).all()
        assert (ids[:, 40:63, 46:63] == 0).all()
        assert (ids[:, [0, -1]] == wall).all()


def test_shipped_tasks_have_names_of_their_own_and_say_what_they_ask():
    for name in shipped_tasks():
        task = load_task(name)
        assert task.name == name
        assert task.about.endswith(".")
        assert all(split.about.endswith(".") for split in task.splits)
        assert all(knob.about for knob in task.knobs)


def test_knobs_reach_the_worlds(torch):
    bare = load_task("sand-pushing", knobs={"lines": 0, "disks": 0})
    ids = maker(torch, bare).make(torch.arange(20)).ids
    assert ((ids == 0).sum((1, 2)) == 64 * 64 - (ids == 1).sum((1, 2)) - 100).all()
    few = load_task("world-model", knobs={"kinds": 2, "lines": 9})
    assert set(maker(torch, few).make(torch.arange(50)).ids.unique().tolist()) == {0, 1, 2, 3}
