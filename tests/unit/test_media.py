"""PNG, GIF and MP4 files: what is in them, and that they appear whole or not at all."""

from __future__ import annotations

import os
import stat
import subprocess
import sys

import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image, ImageSequence

from powderdsl.diagnostics import CompileError
from powderdsl.simulation.draw import CellTint, contact_sheet, palette, rgb, scale
from powderdsl.worlds import media
from powderdsl.worlds.media import write_gif, write_mp4, write_png
from tests.unit.elements import ELEMENTS

COLORS = palette(ELEMENTS)


def world(seed: int, height: int = 8, width: int = 10) -> np.ndarray:
    return rgb(np.random.default_rng(seed).integers(0, 14, (height, width)), COLORS)


def gif_frames(path) -> tuple[list[np.ndarray], list[int]]:
    """The frames of a film that repeats, and how many milliseconds they last."""
    with Image.open(path) as image:
        assert image.info["loop"] == 0
        found = [
            (np.array(one.convert("RGB")), one.info["duration"]) for one in ImageSequence.Iterator(image)
        ]
    frames, durations = zip(*found, strict=True)
    return list(frames), list(durations)


def mp4_frames(path, width: int, height: int) -> np.ndarray:
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-i", str(path)]
    output = subprocess.run(
        [*command, "-f", "rawvideo", "-pix_fmt", "rgb24", "-"], capture_output=True, check=True
    )
    return np.frombuffer(output.stdout, dtype=np.uint8).reshape(-1, height, width, 3)


def test_gif_keeps_every_color_of_worlds(tmp_path):
    frames = [contact_sheet(scale(np.stack([world(seed), world(seed + 5)]), 3)) for seed in range(5)]
    write_gif(tmp_path / "x.gif", iter(frames), fps=20)
    found, durations = gif_frames(tmp_path / "x.gif")
    assert np.array_equal(found, frames)
    assert durations == [50] * 5


def test_gif_keeps_exactly_256_colors_and_comes_close_with_more(tmp_path):
    levels = np.arange(256, dtype=np.uint8).reshape(16, 16)
    frame = np.stack([levels, 255 - levels, levels // 2], axis=-1)
    write_gif(tmp_path / "x.gif", [frame])
    assert np.array_equal(gif_frames(tmp_path / "x.gif")[0], [frame])
    ids = np.random.default_rng(0).integers(0, 14, (32, 32))
    wind = np.random.default_rng(1).uniform(-1, 1, (2, 32, 32))
    tint = CellTint("wind", (0.8, 0.4, 0.4), 2, 0.5)
    tinted = rgb(ids, COLORS, tints=[tint], fields={"wind": wind})
    assert len(np.unique(tinted.reshape(-1, 3), axis=0)) > 256
    write_gif(tmp_path / "y.gif", [tinted])
    (small,) = gif_frames(tmp_path / "y.gif")[0]
    assert np.abs(small.astype(int) - tinted).mean() < 6
    write_gif(tmp_path / "z.gif", [scale(tinted, 5)])
    assert np.array_equal(gif_frames(tmp_path / "z.gif")[0], [scale(small, 5)])


def test_gif_lasts_as_long_as_its_frames_and_is_no_faster_than_browsers_play_it(tmp_path):
    write_gif(tmp_path / "x.gif", [world(0)] * 10 + [world(1)], fps=10)
    assert sum(gif_frames(tmp_path / "x.gif")[1]) == 1100
    write_gif(tmp_path / "x.gif", [world(0), world(1)], fps=1000)
    assert gif_frames(tmp_path / "x.gif")[1] == [20, 20]


def test_mp4(tmp_path):
    frames = [scale(world(seed), 8) for seed in range(12)]
    write_mp4(tmp_path / "x.mp4", iter(frames), fps=12)
    found = mp4_frames(tmp_path / "x.mp4", 80, 64)
    assert len(found) == 12
    # Lossy, but the middle of every cell has its color, in its place.
    assert np.abs(found[:, 4::8, 4::8].astype(int) - np.stack(frames)[:, 4::8, 4::8]).max() < 24
    assert (tmp_path / "x.mp4").read_bytes()[4:8] == b"ftyp"


def test_mp4_of_odd_size_repeats_the_border(tmp_path):
    image = np.zeros((5, 7, 3), dtype=np.uint8)
    image[-1] = 255
    write_mp4(tmp_path / "x.mp4", [image] * 3)
    found = mp4_frames(tmp_path / "x.mp4", 8, 6)
    assert len(found) == 3
    assert found[0][4:].min() > 200
    assert found[0][:3].max() < 60


def test_mp4_needs_its_encoder(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(CompileError, match=r"PD612[\s\S]*powderdsl\[video\]"):
        write_mp4(tmp_path / "x.mp4", [world(0)])
    assert list(tmp_path.iterdir()) == []


def test_a_failing_encoder_is_reported(tmp_path, monkeypatch):
    monkeypatch.setattr(media, "_ENCODING", "-vcodec no-such-codec -f mp4")
    with pytest.raises(CompileError, match=r"encoder failed \(status \d+\): .*no-such-codec"):
        write_mp4(tmp_path / "x.mp4", [world(seed, 200, 200) for seed in range(20)])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("write", [write_gif, write_mp4])
@pytest.mark.parametrize("error", [KeyboardInterrupt(), RuntimeError()])
def test_an_interrupted_or_empty_animation_leaves_the_older_file(tmp_path, write, error):
    def interrupted():
        yield world(0)
        yield world(1)
        raise error

    path = tmp_path / f"x.{write.__name__.removeprefix('write_')}"
    path.write_bytes(b"older")
    with pytest.raises(type(error)):
        write(path, interrupted())
    with pytest.raises(ValueError, match="at least one frame"):
        write(path, iter([]))
    assert path.read_bytes() == b"older"
    assert list(tmp_path.iterdir()) == [path]


def test_places_that_cannot_be_written(tmp_path):
    file = tmp_path / "file"
    file.write_text("")
    (tmp_path / "x.png").mkdir()
    for path in (tmp_path / "nowhere" / "x.png", file / "x.png", "bad\0name.png", tmp_path / "x.png"):
        with pytest.raises(CompileError, match="PD613"):
            write_png(path, world(0))
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["file", "x.png"]


def test_a_written_file_has_the_permissions_of_any_new_file(tmp_path):
    old = os.umask(0o027)
    try:
        write_png(tmp_path / "x.png", world(0))
    finally:
        assert os.umask(old) == 0o027
    assert stat.S_IMODE((tmp_path / "x.png").stat().st_mode) == 0o640
