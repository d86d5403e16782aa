"""Scenes that set fields: values in shapes, what painting over them does, and what is wrong with a setting."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import powderdsl
from powderdsl.worlds.scene import draw_start, find_scene
from tests.cli.commands import powderdsl as command
from tests.refusals import refusal
from tests.unit.elements import RULES

HEAD = "scene: small\nsize: [4, 6]\nfill: empty\ndraw:\n"


def written(tmp_path: Path, *statements: str) -> Path:
    path = tmp_path / "small.yaml"
    path.write_text(HEAD + "".join(f"  - {one}\n" for one in statements))
    return path


def fields(tmp_path: Path, *statements: str):
    return draw_start(find_scene(written(tmp_path, *statements)), RULES).fields


def test_fields_are_set_in_shapes(tmp_path):
    found = fields(
        tmp_path,
        "box cloner columns 5",
        "momentum := -3 in box rows 1:3 columns 2",
        "velocity := (0, 2.5) in disk at (1, 1) radius 2",
        "velocity := -1,0 in box rows 3",
        "clone := ice",
        "momentum := 4 in box rows 0 columns 0",
    )
    momentum = np.where(found["momentum"].where, found["momentum"].values, 0)
    assert momentum.tolist() == [[4, 0, 0, 0, 0, 0], [0, 0, -3, 0, 0, 0], [0, 0, -3, 0, 0, 0], [0] * 6]
    assert found["velocity"].values[:, 1, 1].tolist() == [0, 2.5]
    assert found["velocity"].values[:, 3, 4].tolist() == [-1, 0]
    ice = RULES.element("ice")
    assert (found["clone"].where == (np.arange(6) == 5)).all()
    assert (found["clone"].values[:, 5] == ice.id).all()


def test_an_element_painted_later_is_fresh_and_a_place_keeps_its_value(tmp_path):
    assert [field.at for field in RULES.fields if field.name == "velocity"] == ["place"]
    found = fields(
        tmp_path,
        "fill sand",
        "momentum := 5",
        "velocity := (1, 1)",
        "box water rows 2:4",
        "momentum := 1 in box rows 3",
    )
    assert found["momentum"].where.all(axis=1).tolist() == [True, True, False, True]
    assert found["momentum"].values[:, 0].tolist()[3] == 1
    assert found["velocity"].where.all()


def test_a_run_starts_with_the_fields_of_its_scene(tmp_path):
    path = written(tmp_path, "fill sand", "momentum := 7 in box columns 1")
    out = tmp_path / "out.npz"
    command(
        "run", "powderworld", "--world", str(path), "--steps", "0", "--batch", "2", "--out", str(out), exits=0
    )
    world = powderdsl.load_world(out, powderdsl.compile(RULES, backend="reference"))
    assert world["momentum"][:, :, 1].eq(7).all()
    assert int(world["momentum"].sum()) == 2 * 4 * 7


@pytest.mark.parametrize(
    ("statement", "code", "under"),
    [
        ("momentun := 1", "PD301", "momentun"),
        ("density := 1", "PD407", "density"),
        ("momentum := 1.5", "PD110", "1.5"),
        ("momentum := 99", "PD402", "99"),
        ("velocity := 3", "PD110", "3"),
        ("velocity := (1, 2, 3)", "PD605", ","),
        ("clone := icee", "PD110", "icee"),
        ("clone := ice", "PD608", "clone := ice"),
        ("momentum := 1 in box rows 9", "PD608", "momentum := 1 in box rows 9"),
        ("momentum := 1 in disk at (1..2, 3) radius 2", "PD605", "1..2"),
        ("momentum := 1 disk at (1, 3) radius 2", "PD605", "disk"),
        ("momentum :=", "PD605", None),
    ],
)
def test_a_bad_setting(tmp_path, statement, code, under):
    (found,) = refusal(fields, tmp_path, statement)
    assert found.code == code
    assert under is None or found.primary.span.text == under


def test_a_picture_of_a_task_sets_no_fields(tmp_path):
    written(tmp_path, "momentum := 1")
    task = tmp_path / "task.yaml"
    task.write_text(
        "task: stamped\nrules: powderworld\nsize: [64, 64]\nfill: empty\nstamps: {hill: {scene: small.yaml}}\n"
        "generate: [stamp hill at (3, 3)]\nagent: {may: [sand], speed: 20, actions: 64}\nreward: {each: count(sand)}\n"
    )
    result = command("check", str(task), exits=2)
    assert "PD605" in result.output
    assert "sets `momentum`" in result.output
