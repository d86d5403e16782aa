"""Worlds as PNG pictures: exact there and back, and every picture that is no world refused."""

from __future__ import annotations

import struct
import tracemalloc
import zlib
from dataclasses import replace
from time import process_time

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from powderdsl.diagnostics import CompileError
from powderdsl.simulation.draw import palette, rgb
from powderdsl.worlds.image import MAX_REPORTED, read_image
from powderdsl.worlds.media import write_png
from tests.refusals import refusal
from tests.unit.elements import ELEMENTS

IDS = np.arange(14, dtype=np.uint8).reshape(2, 7)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "world.png"


def write_image(path, ids) -> None:
    write_png(path, rgb(ids, palette(ELEMENTS)))


def refused(path, elements=ELEMENTS) -> tuple:
    found = refusal(read_image, path, elements)
    str(CompileError(found))
    return found


def test_what_is_written_is_read_back(path):
    for ids in (IDS, torch.tensor(IDS), IDS.astype(np.int64)):
        write_image(path, ids)
        found = read_image(path, ELEMENTS)
        assert found.dtype == np.uint8
        assert np.array_equal(found, IDS)
    with Image.open(path) as image:
        assert image.size == (7, 2)
        assert image.getpixel((2, 0)) == (0xF3, 0xC2, 0x3A)  # sand, in the published color
        for converted in (image.convert("RGB"), image.convert("RGBA"), image.quantize(256)):
            converted.save(path)
            assert np.array_equal(read_image(path, ELEMENTS), IDS)


def test_black_and_white_and_gray(path):
    gray = (replace(ELEMENTS[0], color="#000000"), replace(ELEMENTS[1], color="#FFFFFF"))
    pixels = np.array([[0, 255, 255], [255, 0, 0]], dtype=np.uint8)
    for mode in ("L", "1", "LA"):
        Image.fromarray(pixels).convert(mode).save(path)
        assert np.array_equal(read_image(path, gray), pixels // 255)


def test_a_wrong_color_names_the_pixel_the_color_and_the_nearest_element(path):
    write_image(path, IDS)
    pixels = np.array(Image.open(path))
    pixels[1, 3] = (0xF4, 0xC2, 0x3B)
    pixels[1, 5] = (0xF4, 0xC2, 0x3B)
    pixels[0, 6] = (0, 0, 0)
    Image.fromarray(pixels).save(path)
    black, sand = refused(path)
    assert (black.code, sand.code) == ("PD609", "PD609")
    assert sand.message == "the pixel at row 1, column 3 is #F4C23B, which is not any element's color"
    assert sand.helps == ("the nearest is `sand`, #F3C23A",)
    assert sand.notes == (f"{path}: 2 such pixels, this is the first",)
    assert "row 0, column 6" in black.message
    assert "`stone`" in black.helps[0]


def test_a_smoothed_picture_is_summed_up(path):
    write_image(path, np.random.default_rng(0).integers(0, 14, (16, 16)))
    with Image.open(path) as image:
        image.resize((64, 64), Image.Resampling.BICUBIC).save(path)
    found = refused(path)
    assert len(found) == MAX_REPORTED + 1
    assert "without smoothing" in found[-1].helps[0]


def test_transparent_pixels_are_not_guessed(path):
    pixels = np.full((2, 2, 4), (0xEC, 0xF0, 0xF1, 255), dtype=np.uint8)
    pixels[1, 0, 3] = 128
    Image.fromarray(pixels).save(path)
    (found,) = refused(path)
    assert found.message == "the pixel at row 1, column 0 is #ECF0F1 at 50% opacity"


def test_a_color_of_two_elements_is_refused_where_it_is_used(path):
    twins = (*ELEMENTS[:13], replace(ELEMENTS[13], color=ELEMENTS[2].color))
    write_image(path, np.array([[0, 1]]))
    assert read_image(path, twins).tolist() == [[0, 1]]
    write_image(path, np.array([[0, 2]]))
    (found,) = refused(path, twins)
    assert "`sand` and `cloner`" in found.message


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(width: int, height: int, *chunks: bytes) -> bytes:
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + b"".join(chunks) + chunk(b"IEND", b"")


@pytest.mark.parametrize("side", [4097, 60_000, 2**31 - 1])
def test_a_picture_of_too_many_pixels_is_not_decoded(path, side):
    path.write_bytes(png(side, side, chunk(b"IDAT", zlib.compress(bytes(1 << 20)))))
    tracemalloc.start()
    try:
        found = refused(path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert [one.code for one in found] == ["PD607"]
    assert peak < 4 << 20


def test_sixteen_bit_pictures_are_refused(path):
    Image.fromarray(np.full((2, 2), 60000, dtype=np.uint16)).save(path)
    (found,) = refused(path)
    assert found.code == "PD602"
    assert "8 bits" in found.notes[0]


def test_files_that_are_not_png_pictures_are_refused(path):
    bomb = chunk(b"zTXt", b"note\0\0" + zlib.compress(bytes(100 << 20)))
    full = png(1, 1, bomb, chunk(b"IDAT", zlib.compress(bytes(4))))
    for data in (b"", b"GIF89a", b"\x89PNG\r\n\x1a\n", b"scene: a\n", png(0, 0), png(3, 3), full):
        path.write_bytes(data)
        assert [one.code for one in refused(path)] == ["PD602"]


def test_files_that_cannot_be_read(tmp_path):
    for path in (tmp_path / "nowhere.png", tmp_path, "bad\0name.png"):
        assert [one.code for one in refused(path)] == ["PD101"]


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_damaged_file_gives_a_world_or_a_diagnostic(path, data):
    write_image(path, IDS)
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(content[: data.draw(st.integers(len(content) // 2, len(content)))])
    codes = set()
    try:
        read_image(path, ELEMENTS)
    except CompileError as error:
        codes = {one.code for one in error.diagnostics}
    assert codes <= {"PD602", "PD607", "PD609"}


@pytest.mark.parametrize("shape", [(1100, 1000), (1 << 21, 1)])
def test_large_pictures_are_read_in_parts(path, shape) -> None:
    ids = np.random.default_rng(3).integers(0, len(ELEMENTS), shape).astype(np.uint8)
    write_image(path, ids)
    begun = process_time()
    assert np.array_equal(read_image(path, ELEMENTS), ids)
    assert process_time() - begun < 3  # not a round of Python for each row
