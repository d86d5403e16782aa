"""The wheel in Pyodide, the Python of browsers, which Node.js runs here: the same compiler, the same code, the same worlds."""

from __future__ import annotations

import hashlib
import shutil
import sys
import zipfile
from importlib import metadata
from pathlib import Path

import pytest

import powderdsl
from tests.web.packages import PACKAGES, needed_in_pyodide, write_packages
from tests.wheels import succeed

HERE = Path(__file__).parent

BROKEN = """\
pack: broken
elements:
  ash: {id: 40, about: "what is left, 100 %", color: "#888888", density: heavy}
passes:
  settle:
    - ash -> [empty?, ash.row?]
    - ash falls
"""

pytestmark = pytest.mark.wheel


def test_metadata_asks_only_for_pure_packages(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        written = metadata.PathDistribution(zipfile.Path(wheel, name.rpartition("/")[0] + "/"))
        assert set(needed_in_pyodide(written.requires)) == PACKAGES


@pytest.mark.slow
def test_the_same_code_and_worlds(wheel: Path, tmp_path: Path, torch) -> None:  # type: ignore[no-untyped-def]
    node = shutil.which("node")
    if node is None or not (HERE / "node_modules" / "pyodide").is_dir():
        pytest.skip("Pyodide is tested in Node.js: `make web` fetches it with npm")
    packages = tmp_path / "packages.zip"
    write_packages(packages, PACKAGES)
    generator = torch.Generator().manual_seed(1)
    ids = torch.randint(0, 14, (2, 64, 64), generator=generator)
    speed = 8 * torch.randn((2, 2, 64, 64), generator=generator)
    there, here = tmp_path / "there", tmp_path / "here"
    for folder in (there, here):
        folder.mkdir()
        (folder / "broken.yaml").write_text(BROKEN, encoding="utf-8")
        (folder / "ids").write_bytes(ids.to(torch.uint8).numpy().tobytes())
        (folder / "velocity").write_bytes(speed.numpy().tobytes())
    script = HERE / "in_pyodide.py"
    succeed(node, HERE / "pyodide.mjs", there, script, wheel, packages, cwd=tmp_path)
    succeed(sys.executable, script, cwd=here)
    written = {path.name: path.read_bytes() for path in here.iterdir()}
    assert {path.name: path.read_bytes() for path in there.iterdir()} == written
    statuses = [text for name, text in sorted(written.items()) if name.startswith("status")]
    assert [int(text) for text in statuses] == [0, 2, 0, 0, 0, 0, 0, 0, 0]

    native = powderdsl.compile("powderworld", backend="native")
    world = native.step(native.replace(native.world(ids, seed=3), velocity=speed), 200)
    state = {name: value.contiguous().numpy().tobytes() for name, value in world.state.items()}
    expected = [f"{name} {hashlib.sha256(state[name]).hexdigest()}\n" for name in sorted(state)]
    assert written["hashes"].decode() == "".join(expected)
