"""The compiler runs without torch, NumPy and platformdirs, as in a browser."""

from __future__ import annotations

import subprocess
import sys

import pytest

from powderdsl.compiler import BACKENDS

BLOCKED = """
import sys


class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("torch", "numpy", "platformdirs"):
            raise ImportError(f"{name} is blocked")


sys.meta_path.insert(0, Blocked())
from powderdsl.cli.dispatch import main

main()
"""


PRINTED = [name for name in BACKENDS if name not in ("auto", "reference")]


@pytest.mark.parametrize(
    "arguments",
    [
        ("check", "powderworld", "--quick"),
        *(("compile", "powderworld", "--emit", stage) for stage in ("tree", "model", "ir", "planes")),
        ("compile", "powderworld", "--emit", "schedule", "--backend", "native"),
        *(("compile", "powderworld", "--emit", "kernels", "--backend", name) for name in PRINTED),
        ("explain", "PD301"),
    ],
    ids=" ".join,
)
def test_command(arguments: tuple[str, ...]) -> None:
    ended = subprocess.run([sys.executable, "-c", BLOCKED, *arguments], capture_output=True, text=True)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert ended.stdout
