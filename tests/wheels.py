"""The wheel of the repository as it is now."""

from __future__ import annotations

import fcntl
import os
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Callable
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


def run(*command: str | Path, cwd: Path) -> subprocess.CompletedProcess[str]:
    """Run a command without the caller's PYTHONPATH, which could lead back to the repository."""
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    return subprocess.run(
        command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=1800, check=False
    )


def succeed(*command: str | Path, cwd: Path) -> str:
    """Run a command that must succeed; its stdout."""
    done = run(*command, cwd=cwd)
    assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
    return done.stdout


def once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], object]) -> Path:
    """A folder that one process of a test run fills, and all processes of the run read."""
    base = factory.getbasetemp()
    home = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / name
    with open(f"{home}.lock", "w", encoding="utf-8") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (home / "done").exists():
            shutil.rmtree(home, ignore_errors=True)
            home.mkdir()
            make(home)
            (home / "done").touch()
    return home


def build_wheel(folder: Path) -> Path:
    """Build the wheel in an empty folder, without the network."""
    succeed(sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", folder, ROOT, cwd=folder)
    (built,) = folder.glob("*.whl")
    return built


def install_wheel(wheel: Path, home: Path) -> None:
    """Make a fresh environment with the wheel in it. Third parties come from this environment."""
    succeed(sys.executable, "-m", "venv", "--without-pip", home, cwd=home)
    places = sysconfig.get_paths(scheme="venv", vars={"base": str(home), "platbase": str(home)})
    # A path in a .pth file is searched last, and .pth files in it, such as an editable one's, are not read.
    Path(places["purelib"], "outer.pth").write_text(sysconfig.get_paths()["purelib"], encoding="utf-8")
    python = Path(places["scripts"], "python")
    pip = (sys.executable, "-m", "pip", "--python", python, "install", "--no-deps", "--no-index", wheel)
    succeed(*pip, cwd=home)


def scripts_of(home: Path) -> Path:
    return Path(sysconfig.get_path("scripts", scheme="venv", vars={"base": str(home)}))
