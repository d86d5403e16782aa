"""Test tiers: slow tests are left out unless they are selected."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.tiers import tiered

TESTS = Path(__file__).resolve().parent

TWO_TESTS = """
import pytest

def test_smoke(): pass

@pytest.mark.slow
def test_long(): pass
"""


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ([], "1 passed, 1 deselected"),
        (["--slow"], "2 passed"),
        (["test_it.py::test_long"], "1 passed"),
    ],
)
def test_slow_tests_run_only_when_they_are_selected(options: list[str], told: str, tmp_path: Path) -> None:
    shutil.copy(TESTS / "conftest.py", tmp_path)
    (tmp_path / "test_it.py").write_text(TWO_TESTS, encoding="utf-8")
    (tmp_path / "pytest.ini").write_text("[pytest]\nmarkers = slow: long\n", encoding="utf-8")
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", *options]
    run = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False)
    assert run.returncode == 0, run.stdout
    assert run.stdout.splitlines()[-1].startswith(f"{told} in ")


def test_parameters_of_the_smoke_test_must_be_some_of_all() -> None:
    marks = [getattr(value, "marks", ()) for value in tiered("abc", "b")]
    assert [bool(mark) for mark in marks] == [True, False, True]
    for smoke in ("", "d"):
        with pytest.raises(ValueError, match="must be some of"):
            tiered("abc", smoke)
