"""Worlds as pictures: exact colors, the tint of motion, scaling, contact sheets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from powderdsl.simulation.draw import CellTint, contact_sheet, palette, rgb, scale
from tests.unit.elements import ELEMENTS, ID

COLORS = palette(ELEMENTS)
TINT = CellTint("wind", (200 / 255, 100 / 255, 100 / 255), 2, 0.5)
SAND = (0xF3, 0xC2, 0x3A)


def tinted(ids, wind):
    return rgb(ids, COLORS, tints=[TINT], fields={"wind": wind})


def test_the_palette_is_by_id():
    assert COLORS.shape == (256, 4)
    assert COLORS.dtype == np.uint8
    assert tuple(COLORS[ID["sand"]]) == (*SAND, 0)
    gapped = palette([replace(ELEMENTS[2], id=5)])
    assert gapped.tolist() == [[0] * 4] * 5 + [[*SAND, 0]] + [[0] * 4] * 250
    assert not palette([]).any()


@pytest.mark.parametrize("dtype", [np.uint8, np.int64])
def test_every_cell_has_its_elements_color(dtype):
    image = rgb(np.arange(14, dtype=dtype).reshape(2, 7), COLORS)
    assert image.dtype == np.uint8
    assert np.array_equal(image, COLORS[:14, :3].reshape(2, 7, 3))


@pytest.mark.parametrize(
    ("motion", "tint"),
    [
        ((0, 0), 0),
        ((0.5, 0), 0.25),
        ((0.3, -0.4), 0.25),
        ((0, -1), 0.5),
        ((20, 20), 0.5),
        ((float("inf"), 0), 0.5),
    ],
)
def test_motion_tints_by_half_the_speed_up_to_a_half(motion, tint):
    field = np.array(motion, dtype=np.float32).reshape(2, 1, 1)
    expected = [int(a + (b - a) * tint) for a, b in zip(SAND, (200, 100, 100), strict=True)]
    assert tinted(np.array([[ID["sand"]]]), field)[0, 0].tolist() == expected


def test_the_components_of_motion_are_not_mixed_up_with_the_batch():
    """Two worlds, and a tint in exactly one cell of the second."""
    motion = np.zeros((2, 2, 3, 4), dtype=np.float32)
    motion[1, 0, 2, 1] = 1
    image = tinted(np.zeros((2, 3, 4), dtype=np.uint8), motion)
    changed = (image != COLORS[0, :3]).any(axis=-1)
    assert np.argwhere(changed).tolist() == [[1, 2, 1]]


@settings(max_examples=50, deadline=None)
@given(
    ids=arrays(np.uint8, (2, 3, 4), elements=st.integers(0, 13)),
    motion=arrays(np.float32, (2, 2, 3, 4), elements=st.floats(-8, 8, width=32)),
)
def test_tensors_are_drawn_as_arrays(ids, motion):
    tensor = torch.tensor(motion, requires_grad=True)
    assert np.array_equal(tinted(torch.tensor(ids), tensor), tinted(ids, motion))
    assert np.array_equal(rgb(torch.tensor(ids), COLORS), rgb(ids, COLORS))


def test_an_empty_batch_is_drawn():
    assert rgb(np.zeros((0, 3, 4), dtype=np.uint8), COLORS).shape == (0, 3, 4, 3)
    assert rgb(torch.zeros((0, 3, 4), dtype=torch.uint8), COLORS).shape == (0, 3, 4, 3)


def test_scaling_makes_squares():
    image = np.arange(12, dtype=np.uint8).reshape(2, 2, 3)
    assert np.array_equal(scale(image, 3), image.repeat(3, 0).repeat(3, 1))
    assert np.array_equal(scale(image, 1), image)
    assert scale(image[None], 2).shape == (1, 4, 4, 3)


def test_a_contact_sheet_puts_pictures_row_by_row():
    images = np.stack([np.full((2, 3, 3), value, dtype=np.uint8) for value in (10, 20, 30)])
    sheet = contact_sheet(images, columns=2, gap=1)
    assert sheet.shape == (7, 9, 3)
    assert sheet[:, :, 0].tolist() == [
        [255] * 9,
        [255, 10, 10, 10, 255, 20, 20, 20, 255],
        [255, 10, 10, 10, 255, 20, 20, 20, 255],
        [255] * 9,
        [255, 30, 30, 30, 255, 255, 255, 255, 255],
        [255, 30, 30, 30, 255, 255, 255, 255, 255],
        [255] * 9,
    ]
    assert sheet[0, 0].tolist() == [255, 255, 255]
    assert np.array_equal(contact_sheet(torch.tensor(images), columns=2, gap=1), sheet)
    assert contact_sheet(images, gap=0).shape == (4, 6, 3)
    assert contact_sheet(images, columns=9, gap=0).shape == (2, 9, 3)
