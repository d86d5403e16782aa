"""Test tiers: campaigns are left out unless somebody asks for them, and the documentation lists them all."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.tiers import tiered

ROOT = Path(__file__).resolve().parents[1]
TESTS = ROOT / "tests"

TWO_TESTS = """
import pytest

def test_smoke(): pass

@pytest.mark.campaign
def test_long(): pass
"""


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ([], "1 passed, 1 deselected"),
        (["--campaigns"], "2 passed"),
        (["-m", "campaign"], "1 passed, 1 deselected"),
        (["test_it.py::test_long"], "1 passed"),
        (["test_it.py"], "1 passed, 1 deselected"),
    ],
)
def test_campaigns_run_where_they_are_asked_for(options: list[str], told: str, tmp_path: Path) -> None:
    shutil.copy(TESTS / "conftest.py", tmp_path)
    (tmp_path / "test_it.py").write_text(TWO_TESTS, encoding="utf-8")
    (tmp_path / "pytest.ini").write_text("[pytest]\nmarkers = campaign: long\n", encoding="utf-8")
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", *options]
    run = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False)
    assert run.returncode == 0, run.stdout
    assert run.stdout.splitlines()[-1].startswith(f"{told} in ")


def test_parameters_of_the_smoke_test_must_be_some_of_all() -> None:
    marks = [getattr(one, "marks", ()) for one in tiered("abc", "b")]
    assert [bool(one) for one in marks] == [True, False, True]
    for smoke in ("", "d"):
        with pytest.raises(ValueError, match="must be some of"):
            tiered("abc", smoke)


def test_every_campaign_is_documented() -> None:
    """The table in docs/testing.md names the files that hold campaigns, and no others."""
    files = {
        str(path.relative_to(TESTS))
        for path in TESTS.rglob("test_*.py")
        if re.search(r"mark\.campaign|import tiered", path.read_text(encoding="utf-8"))
    }
    page = (ROOT / "docs" / "testing.md").read_text(encoding="utf-8")
    section = page.partition("## Test tiers")[2].partition("\n#")[0]
    listed = re.findall(r"^\| `(\S+\.py)`", section, re.MULTILINE)
    assert listed == sorted(set(listed))
    assert set(listed) == files - {Path(__file__).name}
