"""The installed wheel: what a user gets has the rules and tasks in it, and runs far from the repository."""

from __future__ import annotations

import re
import zipfile
from pathlib import Path

import pytest

from tests.wheels import ROOT, run, succeed

pytestmark = pytest.mark.wheel


def shipped(folder: str) -> dict[str, bytes]:
    """The files of a folder at the root of the repository, by their paths within the repository."""
    files = [path for path in (ROOT / folder).rglob("*") if path.is_file()]
    return {path.relative_to(ROOT).as_posix(): path.read_bytes() for path in files}


def test_wheel_holds_what_ships(wheel: Path) -> None:
    assert wheel.stat().st_size <= 20 << 20
    with zipfile.ZipFile(wheel) as archive:
        inside = {name: archive.read(name) for name in archive.namelist()}
    data = {f"powderdsl/data/{name}": text for name, text in (shipped("rules") | shipped("tasks")).items()}
    pages = shipped("docs/examples") | {"docs/short.md": (ROOT / "docs" / "short.md").read_bytes()}
    data |= {name.replace("docs", "powderdsl/data", 1): text for name, text in pages.items()}
    package = {name: text for name, text in shipped("powderdsl").items() if "__pycache__" not in name}
    assert data, "nothing ships"
    assert {name for name in inside if ".dist-info/" not in name} == data.keys() | package.keys()
    assert all(inside[name] == text for name, text in (data | package).items())
    assert any(name.endswith(".dist-info/licenses/LICENSE") for name in inside)
    assert not [name for name in inside if "fuzz" in name or "emulation" in name], "tools of developers ship"


def test_wheel_runs_elsewhere(scripts: Path, tmp_path: Path) -> None:
    where = succeed(scripts / "python", "-c", "import powderdsl; print(powderdsl.__file__)", cwd=tmp_path)
    assert Path(where.strip()).is_relative_to(scripts.parent), "the test found another powderdsl"
    succeed(scripts / "powderdsl", "check", "powderworld", cwd=tmp_path)
    missing = run(scripts / "python", "-c", "import tests.fuzz", cwd=tmp_path)
    assert "No module named 'tests'" in missing.stderr
    refused = run(scripts / "powderdsl", "check", "no-such-rules", cwd=tmp_path)
    assert refused.returncode == 2, "the line above proves nothing if `check` never says no"


def test_links_of_the_readme_lead_somewhere_on_pypi(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        text = archive.read(name).decode()
    targets = re.findall(r"\]\(([^)\s]+)\)", text)
    assert len(targets) > 20
    assert [target for target in targets if not target.startswith("https://")] == []
