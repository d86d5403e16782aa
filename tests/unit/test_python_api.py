"""What a notebook does: load, step, count, paint, film and show worlds."""

from __future__ import annotations

import importlib
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import powderdsl
from powderdsl.cli.pictures import pictures
from powderdsl.diagnostics import CompileError


@pytest.fixture(scope="module")
def sim() -> powderdsl.Simulator:
    return powderdsl.compile("powderworld", backend="wasm")


@pytest.fixture
def garden(sim: powderdsl.Simulator) -> powderdsl.World:
    return powderdsl.load_world("garden", sim, batch=3, seed=5)


@pytest.mark.parametrize("name", ["", ".testing", ".datasets", ".envs", ".ogbench", ".rl", ".worldmodel"])
def test_public_names_are_listed_and_there(name: str) -> None:
    package = importlib.import_module(f"powderdsl{name}")
    assert set(package.__all__) <= set(dir(package))
    assert all(getattr(package, public) is not None for public in dir(package))
    assert (Path(powderdsl.__path__[0]) / "py.typed").is_file()


def test_reprs_are_one_line(sim: powderdsl.Simulator, garden: powderdsl.World) -> None:
    assert repr(sim) == "<Simulator of powderworld: 14 elements, wasm on cpu>"
    assert repr(garden) == "<World of powderworld: 3 of 64×64 cells at step 0>"
    later = garden.select([0, 1]).with_state(garden.state, start=torch.tensor([4, 9]))
    assert repr(later).endswith("at step 4 to 9>")


def test_elements_and_tags_are_counted(sim: powderdsl.Simulator, garden: powderdsl.World) -> None:
    sand, water = (sim.ruleset.element(name).id for name in ("sand", "water"))
    assert garden.count("sand").tolist() == (garden.ids == sand).sum((1, 2)).tolist()
    assert garden.count("core.wall").dtype == torch.int64
    fluids = [element.id for element in sim.ruleset.elements if "fluid" in element.tags]
    assert water in fluids
    assert garden.count("fluid")[0] == np.isin(garden.ids[0], fluids).sum()
    with pytest.raises(KeyError, match="did you mean `sand`"):
        garden.count("snad")
    with pytest.raises(KeyError, match="`sand` is an element"):
        garden["sand"]


def test_an_index_says_where_to_paint(sim: powderdsl.Simulator, garden: powderdsl.World) -> None:
    mask = np.zeros(garden.shape[1:], dtype=bool)
    mask[:8, 3:5] = True
    painted = sim.paint(garden, where=(slice(0, 8), slice(3, 5)), element="lava")
    assert torch.equal(painted.ids, sim.paint(garden, where=mask, element="lava").ids)


def test_rules_are_named_by_texts() -> None:
    with pytest.raises(CompileError, match=r"write load"):
        powderdsl.load(["core", "sand"])
    with pytest.raises(CompileError, match=r"did you mean `water\.melt`"):
        powderdsl.load("core+water", params={"melt": "50%"})


def test_frames_are_the_start_and_each_stride(sim: powderdsl.Simulator, garden: powderdsl.World) -> None:
    frames = list(sim.frames(garden, 7, every=3))
    assert [int(world.step[0]) for world in frames] == [0, 3, 6, 7]
    assert torch.equal(frames[-1].ids, sim.step(garden, 7).ids)


def test_worlds_become_pictures_and_films(
    sim: powderdsl.Simulator, garden: powderdsl.World, tmp_path: Path
) -> None:
    picture = garden.picture(scale=2)
    assert (picture == pictures(garden, most=16, factor=2)).all()
    assert picture.shape == (2 * 128 + 3 * 2, 2 * 128 + 3 * 2, 3)
    assert (np.asarray(Image.open(BytesIO(garden._repr_png_()))) == garden.picture()).all()
    powderdsl.gif(sim.frames(garden, 4), tmp_path / "x.gif", scale=1)
    with Image.open(tmp_path / "x.gif") as film:
        assert film.n_frames == 5
        assert (np.asarray(film.convert("RGB")) == garden.picture(scale=1)).all()
    with pytest.raises(ValueError, match=r"ends in \.gif"):
        powderdsl.gif([garden], tmp_path / "x.png")


def test_worlds_of_every_kind_are_loaded_by_name(
    sim: powderdsl.Simulator, garden: powderdsl.World, tmp_path: Path
) -> None:
    assert garden.seed.tolist() == [5, 5, 5]
    assert powderdsl.load_world("garden", sim, size=(32, 48)).shape == (1, 32, 48)
    (tmp_path / "x.txt").write_text("# . #\n# # #\n")
    assert powderdsl.load_world(tmp_path / "x.txt", sim).shape == (1, 2, 3)
    powderdsl.save(garden, tmp_path / "x.npz")
    assert torch.equal(powderdsl.load_world(tmp_path / "x.npz", sim).ids, garden.ids)
    for more in ({"size": (2, 2)}, {"batch": 2}, {"seed": 1}):
        with pytest.raises(ValueError, match="saved world has its own"):
            powderdsl.load_world(tmp_path / "x.npz", sim, **more)
    with pytest.raises(ValueError, match="drawing has its own"):
        powderdsl.load_world(tmp_path / "x.txt", sim, size=(2, 2))
    with pytest.raises(CompileError, match="did you mean `garden`"):
        powderdsl.load_world("gardn", sim)
    with pytest.raises(ValueError, match=r"ends in \.npz"):
        powderdsl.save(garden, tmp_path / "x.gif")
    assert not (tmp_path / "x.gif").exists()
