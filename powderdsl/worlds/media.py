"""Pictures and animations on disk: PNG, GIF, MP4. Frames are uint8 [H, W, 3]. Files are written atomically."""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import suppress
from itertools import chain
from math import gcd
from pathlib import Path
from typing import TYPE_CHECKING, Any

from powderdsl.arrays import NDArray, np
from powderdsl.simulation.draw import to_numpy
from powderdsl.system.interrupts import delay_signal
from powderdsl.system.packages import require
from powderdsl.system.writing import replacing

if TYPE_CHECKING:
    from powderdsl.simulation.simulator import World

MIN_GIF_DELAY = 20
"""Milliseconds. Browsers slow down GIFs whose frames are shorter."""


def write_png(path: str | Path, image: Any) -> None:
    """Write one picture, uint8 [H, W, 3] (array or tensor).

    Raises CompileError: PD612 if Pillow is not installed, PD613 if the file cannot be written.
    """
    images, frame = require("PIL.Image", "writing a picture", "pip install pillow"), to_numpy(image)
    with replacing(Path(path), follow=True) as temporary:
        picture = images.frombytes("RGB", (frame.shape[1], frame.shape[0]), frame.tobytes())
        picture.save(temporary, format="PNG", optimize=True)


def write_gif(path: str | Path, frames: Iterable[Any], *, fps: float = 30) -> None:
    """Write an endless animation as GIF.

    Frames of up to 256 colors keep them exactly; others are reduced, without dithering.

    Args:
        frames: at least one, arrays or tensors, from an iterable that may be lazy.
        fps: frames per second, at most 50.

    Raises:
        CompileError: PD612 if NumPy or Pillow is not installed, PD613 if the file cannot be written.
        ValueError: there is no frame.
    """
    delay = max(round(100 / fps) * 10, MIN_GIF_DELAY)  # GIF counts hundredths of a second
    require("numpy", "writing an animation", "pip install numpy")
    module = require("PIL.Image", "writing an animation", "pip install pillow")
    images = (_indexed(module, to_numpy(frame)) for frame in frames)
    first = _first(images)
    with replacing(Path(path), follow=True) as temporary:
        first.save(
            temporary, "GIF", save_all=True, append_images=images, duration=delay, optimize=False, loop=0
        )


def gif(worlds: Iterable[World], path: str | Path, *, fps: float = 30, scale: int | None = None) -> None:
    """Write a sequence of worlds, such as `Simulator.frames`, as an endless GIF. The worlds of a batch are drawn side
    by side.

    Args:
        fps: frames per second, at most 50. scale: pixels per cell, see `World.picture`.

    Raises:
        CompileError, ValueError: as `write_gif`.
    """
    if Path(path).suffix.lower() != ".gif":
        raise ValueError(f"an animation's name ends in .gif, found {str(path)!r}")
    write_gif(path, (world.picture(scale) for world in worlds), fps=fps)


def write_mp4(path: str | Path, frames: Iterable[Any], *, fps: float = 30) -> None:
    """Write an animation as H.264. Odd sizes grow by one row or column.

    Args:
        frames: as in `write_gif`.
        fps: frames a second.

    Raises:
        CompileError: PD612 if imageio-ffmpeg is not installed, PD613 with the encoder's message if it fails.
        ValueError: there is no frame.
    """
    helps = ("pip install 'powderdsl[video]'", "or write a .gif, which needs nothing")
    ffmpeg = require("imageio_ffmpeg", "writing MP4", *helps).get_ffmpeg_exe()
    pictures = (_even(to_numpy(frame)) for frame in frames)
    first = _first(pictures)
    size = f"{first.shape[1]}x{first.shape[0]}"
    command = [ffmpeg, "-v", "error", "-y", "-f", "rawvideo", "-pix_fmt", "rgb24"]
    command += ["-s", size, "-r", str(fps), "-i", "-", *_ENCODING.split()]
    with replacing(Path(path), follow=True) as temporary:
        _encode([*command, str(temporary)], chain([first], pictures))


def _first(pictures: Iterator[Any]) -> Any:
    """The first picture of an animation. Raises ValueError if there is none."""
    for picture in pictures:
        return picture
    raise ValueError("an animation needs at least one frame")


_ENCODING = (
    "-an -vcodec libx264 -crf 18 -pix_fmt yuv420p -f mp4 -movflags +faststart"
    # Without these options, players guess the color conversion and get it slightly wrong.
    " -vf scale=out_color_matrix=bt709:out_range=tv -colorspace bt709"
    " -color_primaries bt709 -color_trc bt709 -color_range tv"
)


def _encode(command: list[str], frames: Iterable[NDArray[np.uint8]]) -> None:
    """Feed frames to an encoder and raise OSError if it fails.

    The writer of imageio_ffmpeg ignores the exit status, so a full disk would leave a broken file.
    """
    with tempfile.TemporaryFile() as log:
        encoder = None
        try:
            # In a new session, Ctrl-C reaches only this process, which ends the encoder. A signal must wait until the
            # encoder has started: otherwise, it would write its file after this process removed it.
            with delay_signal():
                encoder = subprocess.Popen(command, stdin=subprocess.PIPE, stderr=log, start_new_session=True)
            assert encoder.stdin is not None
            # If the encoder fails, its log has the reason.
            with suppress(BrokenPipeError), encoder.stdin as pipe:
                for frame in frames:
                    pipe.write(np.ascontiguousarray(frame).data)
            status = encoder.wait()
        except BaseException:
            if encoder is not None:
                encoder.kill()
                encoder.wait()
            raise
        if status != 0:
            log.seek(0)
            words = log.read(2000).decode(errors="replace").strip()
            raise OSError(f"the video encoder failed (status {status}): {words}")


def _indexed(images: Any, frame: NDArray[np.uint8]) -> Any:
    """A frame with its own palette, exact if it has at most 256 colors."""
    # Cells are squares of pixels, so repeated rows and columns add no colors. Sorting all pixels would take longer than
    # the simulation.
    rows = np.append(True, (frame[1:] != frame[:-1]).any(axis=(1, 2)))
    cells = frame[rows]
    columns = np.append(True, (cells[:, 1:] != cells[:, :-1]).any(axis=0).any(axis=1))
    packed = cells[:, columns].astype(np.uint32) @ np.array([1 << 16, 1 << 8, 1], dtype=np.uint32)
    colors, index = np.unique(packed, return_inverse=True)
    if len(colors) > 256:
        # Which ones remain depends on shares of pixels: the same in one pixel of each square.
        down, across = (gcd(len(starts), *np.flatnonzero(starts).tolist()) for starts in (rows, columns))
        image = images.fromarray(np.ascontiguousarray(frame[::down, ::across]))
        image = image.quantize(256, dither=images.Dither.NONE)
        return image.resize((frame.shape[1], frame.shape[0]), images.Resampling.NEAREST)
    index = index.reshape(packed.shape).astype(np.uint8)
    image = images.fromarray(index[np.cumsum(rows) - 1][:, np.cumsum(columns) - 1])
    image.putpalette(b"".join(int(color).to_bytes(3, "big") for color in colors))
    return image


def _even(frame: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The frame with even sides: H.264 stores color at half the size. The last row or column is repeated."""
    height, width = frame.shape[:2]
    return np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), "edge")
