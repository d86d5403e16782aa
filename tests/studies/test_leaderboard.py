"""The kept results of studies: what is in the files, and that a sample of them can be repeated."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from typing import Any

import pytest

from tests.studies.test_ray import run_study, written

DOCS = Path(__file__).resolve().parents[2] / "docs"
RESULTS = sorted((DOCS / "results").glob("*.json"))


@pytest.fixture(scope="module")
def leaderboard() -> Any:
    spec = importlib.util.spec_from_file_location("leaderboard", DOCS / "leaderboard.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("path", RESULTS, ids=lambda path: path.stem)
def test_kept_results_say_how_to_repeat_them(path: Path, leaderboard: Any) -> None:
    entry = json.loads(path.read_text())
    assert path.stem == entry["study"]
    assert entry["rules"]
    tasks = {point["values"]["task"] for point in entry["points"] if "task" in point["values"]}
    assert tasks <= {*entry["rules"]}
    for point in entry["points"]:
        assert leaderboard.command_of(entry, point)[:3] == ["powderdsl", "study", entry["study"]]


@pytest.mark.slow
def test_a_sample_is_repeated(leaderboard: Any, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    written(folder, 2, [12])
    run = run_study(folder, "--out", "made", "--jobs", "1")
    assert run.returncode == 0, run.stderr
    path = leaderboard.add(folder / "made", folder, study="study.yaml")
    entry = json.loads(path.read_text())
    assert [*entry["rules"]] == ["dig.yaml"]
    assert len(entry["points"]) == 2
    assert leaderboard.replay([path], 1, 0, 1e-6)
    assert "study.yaml" in capsys.readouterr().out

    for point in entry["points"]:
        point["measures"]["reward"] += 0.5
    path.write_text(json.dumps(entry))
    assert not leaderboard.replay([path], 1, 0, 1e-6)
    assert "largest difference 0.5" in capsys.readouterr().out

    (folder / "dig.yaml").write_text((folder / "dig.yaml").read_text().replace("brush: 2", "brush: 3"))
    assert not leaderboard.replay([path], 0, 0, 1e-6)
    assert "dig.yaml or its rules have changed" in capsys.readouterr().out
