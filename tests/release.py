"""Checks built distributions as users meet them: `python -m tests.release dist/* [--torch VERSION …]`.

Each file is installed in a fresh environment of each Python from 3.11 to 3.14 that the machine has, with each version of
torch (the one that constraints.txt pins if none is named), and runs a few commands far from the repository.
"""

from __future__ import annotations

import argparse
import re
import shutil
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from tests.wheels import ROOT, run, scripts_of, succeed

PYTHONS = ("python3.11", "python3.12", "python3.13", "python3.14")
COMMANDS = (
    ("powderdsl", "--version"),
    ("powderdsl", "check", "powderworld"),
    ("powderdsl", "run", "powderworld", "--world", "garden", "--steps", "8", "--out", "garden.gif"),
    ("powderdsl", "run", "powderworld", "--steps", "2", "--backend", "torch", "--out", "world.npz"),
    ("powderdsl", "play", "--no-open", "--export", "page"),
    ("powderdsl", "train", "sand-pushing", "--preset", "small", "--steps", "64", "--run", "run"),
)


def pinned_torch() -> str:
    pins = (ROOT / "constraints.txt").read_text(encoding="utf-8")
    return re.findall(r"^torch==(\S+)$", pins, re.MULTILINE)[0]


def check(distribution: Path, python: str, torch: str) -> None:
    """Install a wheel or an sdist in a fresh environment and run the commands."""
    with tempfile.TemporaryDirectory() as folder:
        home = Path(folder, "venv")
        succeed(python, "-m", "venv", home, cwd=Path(folder))
        scripts = scripts_of(home)
        pip = (scripts / "python", "-m", "pip", "install", "--quiet", "--disable-pip-version-check")
        # Each in a call: pip would otherwise weigh newer versions of torch, of gigabytes.
        succeed(*pip, f"torch=={torch}", cwd=Path(folder))
        # pip would keep the wheel that it builds from an sdist, and use it for the next file of that name.
        succeed(
            *pip, "--no-cache-dir", f"powderdsl[rl] @ {distribution.resolve().as_uri()}", cwd=Path(folder)
        )
        for command, *words in COMMANDS:
            succeed(scripts / command, *words, cwd=Path(folder))


def main(words: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("distributions", nargs="+", type=Path)
    parser.add_argument("--torch", nargs="+", default=[pinned_torch()], metavar="VERSION")
    options = parser.parse_args(words)
    failed = False
    for python in PYTHONS:
        if shutil.which(python) is None or run(python, "-c", "import ensurepip", cwd=ROOT).returncode:
            print(f"{python}: not on this machine")
            continue
        for torch in options.torch:
            for distribution in options.distributions:
                try:
                    check(distribution, python, torch)
                    print(f"{python}, torch {torch}, {distribution.name}: works", flush=True)
                except AssertionError as error:
                    failed = True
                    print(f"{python}, torch {torch}, {distribution.name}: fails\n{error}", file=sys.stderr)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
