"""The playground in headless Chromium, from the installed wheel, as people use it."""

from __future__ import annotations

import json
import shutil
import subprocess
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image

from powderdsl.web.site import PARTS
from tests.wasm.standalone_world import CHROMIUM
from tests.wheels import once, succeed

HERE = Path(__file__).parent

pytestmark = [pytest.mark.slow, pytest.mark.wheel]


def needed() -> str:
    """What is missing for these tests; empty if nothing is."""
    if shutil.which("node") is None or not (HERE / "node_modules" / "playwright-core").is_dir():
        return "the page is tested with Node.js and playwright-core: `make web` fetches it with npm"
    if not (PARTS / "editor.js").is_file():
        return "the page needs Pyodide and CodeMirror: `make web` fetches them with npm"
    return "" if CHROMIUM else "the page is tested in Chromium: apt install chromium-headless-shell"


@contextmanager
def played(scripts: Path, folder: Path) -> Iterator[str]:
    """The address of a page that the installed command serves."""
    command = [scripts / "powderdsl", "play", "--no-open"]
    with subprocess.Popen(
        command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as server:
        try:
            yield server.stdout.readline().split()[0]
        finally:
            server.terminate()


@pytest.fixture(scope="module")
def seen(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What page.mjs saw, which runs once for all processes of a run."""
    if words := needed():
        pytest.skip(words)
    scripts = request.getfixturevalue("scripts")

    def use(folder: Path) -> None:
        with played(scripts, folder) as address:
            text = succeed(str(shutil.which("node")), HERE / "page.mjs", address, folder, cwd=folder)
        (folder / "seen.json").write_text(text, encoding="utf-8")

    folder = once(tmp_path_factory, "page", use)
    found: dict[str, Any] = json.loads((folder / "seen.json").read_text(encoding="utf-8"))
    return found | {"folder": folder}


def fnv(data: bytes) -> int:
    found = 0x811C9DC5
    for byte in data:
        found = (found ^ byte) * 0x01000193 & 0xFFFFFFFF
    return found


def hashes(path: Path) -> dict[str, int]:
    """What `hashes` of page.mjs finds, of a saved world."""
    with np.load(path) as world:
        return {
            "ids": fnv(world["slot_element"].tobytes()),
            "field": fnv(world["slot_velocity"].tobytes()),
            "step": int(world["step"][0]),
        }


def test_painted_sand_falls_and_edits_can_be_undone(seen: dict[str, Any]) -> None:
    assert seen["painted"] > 60
    assert seen["lyingBefore"] == 0 < seen["lyingAfter"]
    assert seen["fallen"] == seen["painted"] == seen["redone"]
    assert seen["undone"]
    assert seen["wind"] > 1
    assert seen["keyboard"] == ["Erase", "erase", "Paint", "brush", "water", "water.water", True, True]


def test_broken_rules_are_explained_while_the_world_runs(seen: dict[str, Any]) -> None:
    assert "error[PD108]: unknown property `densit`" in seen["problem"]
    assert "sand.yaml:5" in seen["problem"]
    assert "^^^^^^" in seen["problem"]
    assert "did you mean `density`?" in seen["problem"]
    assert seen["ranWhileBroken"] > 5
    assert seen["applied"] == "The new rules run."
    assert seen["stepsAfterFix"] >= seen["ranWhileBroken"]
    assert seen["sandAfterFix"] == seen["painted"]
    assert seen["own"] == 1


def test_a_link_holds_the_world_and_its_rules(seen: dict[str, Any]) -> None:
    assert seen["sameFromLink"]
    assert seen["ownFromLink"] == 1
    assert seen["link"] < 20_000


def test_a_downloaded_world_continues_on_the_command_line(seen: dict[str, Any], scripts: Path) -> None:
    folder: Path = seen["folder"]
    arguments = ("powderworld", "--world", "world.npz", "--steps", "20", "--out", "later.npz")
    succeed(scripts / "powderdsl", "run", *arguments, cwd=folder)
    assert hashes(folder / "later.npz") == seen["continued"]


def test_a_world_of_edited_rules_continues_as_the_status_line_says(
    seen: dict[str, Any], scripts: Path
) -> None:
    folder: Path = seen["folder"] / "own"
    assert seen["command"] == "powderdsl run powderworld.yaml+mine.yaml --world world.npz"
    with zipfile.ZipFile(folder / "rules.zip") as archive:
        assert set(archive.namelist()) == {"powderworld.yaml", "sand.yaml", "mine.yaml"}
        archive.extractall(folder)
    program, *arguments = seen["command"].split()
    succeed(scripts / program, *arguments, "--steps", "5", "--out", "later.npz", cwd=folder)
    assert hashes(folder / "later.npz") == seen["ownContinued"]
    assert "All 3 edited rule files (.zip)" in seen["entries"]
    assert seen["noVideo"] == [True, "This browser has no encoder for VP8 or VP9 videos."]


def test_pictures(seen: dict[str, Any], scripts: Path) -> None:
    """The page draws as `powderdsl render` does; its animation ends with the same picture, in fewer colors."""
    folder: Path = seen["folder"]
    words = ("render", "powderworld", "--world", "later.npz", "--scale", "8", "--out", "later.png")
    succeed(scripts / "powderdsl", *words, cwd=folder)
    with np.load(folder / "later.npz") as later:
        assert (np.abs(later["slot_velocity"]) > 0.1).sum() > 100
    with Image.open(folder / "world.png") as picture, Image.open(folder / "later.png") as wanted:
        pixels = np.asarray(picture.convert("RGB")).astype(int)
        assert np.array_equal(pixels, np.asarray(wanted.convert("RGB")))
    with Image.open(folder / "world.gif") as film:
        assert film.size == (256, 256)
        assert getattr(film, "n_frames", 1) > 5
        film.seek(film.n_frames - 1)  # type: ignore[attr-defined]
        last = np.asarray(film.convert("RGB")).astype(int)
    assert np.abs(last - pixels[::2, ::2]).max() <= 24  # 15 bits a pixel, and 256 colors
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", str(folder / "world.webm")]
    raw = subprocess.run(
        [*command, "-f", "rawvideo", "-pix_fmt", "rgb24", "-"], capture_output=True, check=True
    )
    video = np.frombuffer(raw.stdout, np.uint8).reshape(-1, 512, 512, 3)
    assert len(video) == film.n_frames  # type: ignore[attr-defined]
    assert f"Duration: 00:00:{len(video) / 20:05.2f}".encode() in raw.stderr
    assert np.abs(video[-1].astype(int) - pixels).mean() < 6


def test_reports(seen: dict[str, Any]) -> None:
    assert "ledger of powderworld" in seen["checks"]
    assert "of powderworld" in seen["checks"]
    assert "/tmp" not in seen["checks"]


def test_strangers_reach_nothing(seen: dict[str, Any]) -> None:
    assert (seen["htmlInserted"], seen["htmlShown"]) == (0, True)
    assert seen["origins"] == []
    assert seen["problems"] == []


def test_layout(seen: dict[str, Any]) -> None:
    assert seen["gallery"] >= 12
    assert not seen["tooWide"]


@pytest.mark.slow
def test_damaged_packs_links_and_files_give_messages(scripts: Path, tmp_path: Path) -> None:
    if words := needed():
        pytest.skip(words)
    with played(scripts, tmp_path) as address:
        text = succeed(str(shutil.which("node")), HERE / "hostile.mjs", address, "200", cwd=tmp_path)
    found = json.loads(text)
    assert (found["packs"], found["links"], found["files"]) == (100, 50, 50)
    assert found["refused"] > 50
    assert (found["silent"], found["dead"], found["problems"]) == ([], [], [])
    assert found["compiles"]
    assert 2 <= found["stopped"]["seconds"] < 40
    assert (found["stopped"]["running"], found["stopped"]["after"]) == (True, "The new rules run.")
    assert found["memory"][-1] <= 2 * found["memory"][1]
