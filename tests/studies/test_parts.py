"""Studies in parts: selections and shards, points that others hold, and results merged out of several folders."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import threading
from pathlib import Path
from typing import Any

import pytest
from filelock import FileLock

from powderdsl.cli.commands.study import SHARD, commands, part, selected
from powderdsl.cli.commands.study import command as study_command
from powderdsl.cli.exits import BadInput
from powderdsl.diagnostics import Reporter, Source
from powderdsl.experiments.studies.run import StudyRun
from powderdsl.experiments.studies.study import Point, StudyStep, load_study, read_study
from tests.cli.commands import ROOT, powderdsl

STUDY = """
study: patience
about: Longer training, more reward.
seeds: 2
vary:
  steps: {about: interactions, small: [100, 200, 300], paper: [1000]}
  obstacles: {small: [none, some], paper: [none], sets: {none: {lines: 0}, some: {lines: 5}}}
steps:
  trained: {command: train, on: sand-pushing, steps: $steps, knob: lines=$lines, seed: $seed}
  tested: {command: evaluate, on: trained, episodes: 4}
measures:
  reward: {of: trained, value: splits/test/trained/mean, about: mean reward, expect: rises}
"""
RESULTS = ("results.md", "results.json", "figure.png")
POINTS = 12


@pytest.fixture
def steps_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Work in a folder with `study.yaml`, whose steps write a number at once. The names of the points that were run."""
    found: list[str] = []

    def step(self: StudyRun, step: StudyStep, point: Point, place: Path) -> None:
        folder = place / "trained"
        folder.mkdir(exist_ok=True)
        reward = int(dict(point.values)["steps"]) / 100 + 0.1 * point.seed + len(point.names["lines"])
        about = {"splits": {"test": {"trained": {"mean": reward}}}}
        (folder / "evaluation.json").write_text(json.dumps(about), encoding="utf-8")
        if step.name == "tested":
            found.append(point.name)

    monkeypatch.setattr(StudyRun, "_step", step)
    monkeypatch.chdir(tmp_path)
    Path("study.yaml").write_text(STUDY, encoding="utf-8")
    return found


@pytest.fixture
def quick(steps_run: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """No figures."""
    monkeypatch.setattr("powderdsl.cli.commands.study.find_spec", lambda name: None)


def contents(folder: str) -> list[bytes]:
    return [(Path(folder) / name).read_bytes() for name in RESULTS]


# Selections


@pytest.mark.parametrize("of", [1, 2, 3, 5, 12, 13, 40])
def test_shards_are_all_points_each_once(of: int) -> None:
    study = read_study(Source("study.yaml", STUDY), Reporter(), commands())
    points = selected(study, "small", None, {})
    shards = [part(points, (number, of)) for number in range(1, of + 1)]
    assert [point for shard in shards for point in shard] == points
    assert max(map(len, shards)) - min(map(len, shards)) <= 1


@pytest.mark.parametrize(
    ("only", "count"),
    [
        (["steps=100"], 4),
        (["steps=100,300"], 8),
        (["steps=100,200", "seed=1"], 4),
        (["seed=0,1"], 12),
        (["obstacles=some", "seed=1"], 3),
        (["lines=5"], 6),
        (["lines=5", "obstacles=none"], "no combination has lines=5 and obstacles=none"),
        (["steps=150"], "`steps` has no value `150` here"),
        (["seed=2"], "`seed` has no value `2` here"),
        (["stpes=100"], "no setting is called `stpes`"),
    ],
)
def test_only_selects_settings_and_seeds(only: list[str], count: int | str) -> None:
    study = read_study(Source("study.yaml", STUDY), Reporter(), commands())
    wanted = dict(word.split("=") for word in only)
    if isinstance(count, int):
        assert len(selected(study, "small", None, wanted)) == count
        return
    with pytest.raises(BadInput, match=count):
        selected(study, "small", None, wanted)


def test_seeds_that_make_too_many_combinations_are_refused() -> None:
    text = STUDY.replace("[100, 200, 300]", str([*range(100, 200)]))
    study = read_study(Source("study.yaml", text), Reporter(), commands())
    assert len(selected(study, "small", 50, {})) == 10_000
    with pytest.raises(BadInput, match="a study has at most 10,000"):
        selected(study, "small", 51, {})


@pytest.mark.parametrize("text", ["0/2", "3/2", "1", "1/0", "a/b", "1/2/3", "-1/2", "1/99999999", ""])
def test_an_invalid_shard_is_refused(text: str, steps_run: list[str]) -> None:
    assert "is not a shard: write 1/4" in powderdsl("study", "study.yaml", "--shard", text, exits=2).stderr
    assert steps_run == []


# Shards and `collect`


def test_shards_are_collected_with_the_same_selection(steps_run: list[str]) -> None:
    chosen = ("--only", "steps=100,300", "--seeds", "3")  # of these there are 12 points too
    whole = powderdsl("study", "study.yaml", "--out", "whole", *chosen, exits=0)
    assert len(steps_run) == POINTS
    for number in (1, 2, 3):
        shard = ("--shard", f"{number}/3", "--out", f"part{number}")
        found = powderdsl("study", "study.yaml", *shard, *chosen, exits=0)
        assert "8 combinations of other parts are not done in part" in found.stdout
        assert not Path(f"part{number}/results.md").exists()
    assert len(steps_run) == 2 * POINTS
    collected = powderdsl("study", "collect", "part2", "part1", "part3", "--out", "all", *chosen, exits=0)
    assert contents("all") == contents("whole")
    assert collected.stdout == whole.stdout.replace("whole/", "all/")
    powderdsl("study", "collect", "part2", "part1", "part3", "whole", *chosen, exits=0)
    assert contents("part2") == contents("whole")  # the first folder


def test_the_last_shard_in_a_common_folder_writes_the_table(steps_run: list[str]) -> None:
    powderdsl("study", "study.yaml", "--out", "whole")
    for number in (2, 1):
        assert not Path("common/results.md").exists()
        powderdsl("study", "study.yaml", "--shard", f"{number}/2", "--out", "common", exits=0)
    assert contents("common") == contents("whole")


def test_collect_tells_what_is_missing(steps_run: list[str], quick: None) -> None:
    powderdsl("study", "study.yaml", "--out", "part", "--shard", "1/2")
    result = powderdsl("study", "collect", "part", "--out", "all", exits=1)
    assert "6 combinations did not finish" in result.stderr
    text = Path("all/results.md").read_text(encoding="utf-8")
    assert text.count("not done in any of these folders") == 6


def test_collect_needs_results_of_one_study_that_agree(steps_run: list[str], quick: None) -> None:
    powderdsl("study", "study.yaml", "--out", "one")
    powderdsl("study", "study.yaml", "--out", "two")
    name = "steps=200,obstacles=some,seed=1"
    other = {"trained": {"splits": {"test": {"trained": {"mean": 99.0}}}}}
    Path(f"two/done/{name}.json").write_text(json.dumps(other), encoding="utf-8")
    Path("study.yaml").write_text(STUDY.replace("of: trained", "scale: log, of: trained"), encoding="utf-8")
    powderdsl("study", "study.yaml", "--out", "three")
    Path("plain").mkdir()
    for folders, error in (
        (("one", "two"), f"error[PD627]: one and two have different results of {name}"),
        (("one", "three"), "error[PD621]"),
        (("plain",), "error[PD620]"),
        (("one", "nowhere"), "error[PD620]"),
    ):
        assert error in powderdsl("study", "collect", *folders, "--out", "all", exits=2).stderr
    powderdsl("study", "collect", exits=2)
    assert not Path("all").exists()


def test_results_of_strangers_are_numbers(quick: None) -> None:
    powderdsl("study", "study.yaml", "--out", "one")
    path = Path("one/done/steps=100,obstacles=none,seed=0.json")
    odd = ('"5"', "NaN", "1e999", "1" + "0" * 400, "true", "null", "[1]", '{"a": 1}', '"\\u001b[2J"')
    for value in odd:
        about = f'{{"trained": {{"splits": {{"test": {{"trained": {{"mean": {value}}}}}}}}}}}'
        path.write_text(about, encoding="utf-8")
        for words in (("collect", "one"), ("study.yaml", "--out", "one")):
            Path("one/results.md").unlink(missing_ok=True)
            powderdsl("study", *words, exits=1)
            assert "is not a finite number" in Path("one/results.md").read_text(encoding="utf-8"), value


def test_results_of_strangers_have_a_right_study(quick: None) -> None:
    powderdsl("study", "study.yaml", "--out", "one")
    path = Path("one/study.json")
    text = path.read_text(encoding="utf-8")
    for old, new in (
        ('"size": "small"', '"size": "../x"'),
        ('"size": "small"', '"size": ["small"]'),
        ('"text": "', '"text": "]'),
        ('"text": "', '"text": "\\ud800'),
        ('"text": "', '"text": "\\u0000'),
        ('"text": "', '"txet": "'),
        ("sand-pushing", "../sand-pushing.yaml"),
        ("about: Longer", "about: \\u001b[2J"),
    ):
        assert old in text
        path.write_text(text.replace(old, new), encoding="utf-8")
        result = powderdsl("study", "collect", "one", "--out", "all", exits=2)
        assert "error[PD" in result.stderr, new
        assert "\x1b" not in result.stderr, new
    assert not Path("all").exists()


def test_collect_follows_no_link_out_of_a_folder(quick: None, tmp_path: Path) -> None:
    powderdsl("study", "study.yaml", "--out", "one")
    os.rename("one/done", "elsewhere")
    Path("one/done").symlink_to(tmp_path / "elsewhere")
    assert "PD112" in powderdsl("study", "collect", "one", exits=2).stderr


# Points that others hold


def test_points_that_others_hold_are_left_to_them(steps_run: list[str], quick: None) -> None:
    prepared("out")
    place = Path("out/runs/steps=200,obstacles=none,seed=1")
    place.mkdir()
    with FileLock(place / ".lock"):
        result = powderdsl("study", "study.yaml", "--out", "out", exits=1)
        assert "the study is not complete: other processes are running 1 combination" in result.stderr
        assert f"{place.name}: another process works on it" in result.stderr
        assert len(steps_run) == POINTS - 1
        assert place.name not in steps_run
        assert not Path("out/results.md").exists()
    powderdsl("study", "study.yaml", "--out", "out", exits=0)
    assert steps_run[-1] == place.name
    assert len(steps_run) == POINTS


def test_who_finishes_last_writes_the_table(
    steps_run: list[str], quick: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    powderdsl("study", "study.yaml", "--out", "one")
    _, point, place = prepared("out")
    run = StudyRun.run

    def run_beside_another(self: StudyRun, *arguments: Any) -> list[Any]:
        outcomes = run(self, *arguments)
        shutil.copy(f"one/done/{point.name}.json", "out/done")
        return outcomes

    monkeypatch.setattr(StudyRun, "run", run_beside_another)
    with FileLock(place / ".lock"):
        powderdsl("study", "study.yaml", "--out", "out", exits=0)
    assert Path("out/results.md").read_bytes() == Path("one/results.md").read_bytes()


def prepared(folder: str) -> tuple[StudyRun, Point, Path]:
    study = load_study("study.yaml", commands())
    found = StudyRun(study, Path(folder), "small")
    found.prepare()
    point = next(study.points("small"))
    place = Path(folder) / "runs" / point.name
    place.mkdir(parents=True)
    return found, point, place


def test_a_task_of_a_cluster_waits_for_who_holds_its_point(steps_run: list[str]) -> None:
    study, point, place = prepared("out")
    lock = FileLock(place / ".lock", thread_local=False)
    with lock:
        thread = threading.Timer(0.5, lock.release)
        thread.start()
        (outcome,) = study.run([point], 1, patient=True)
        assert outcome.problem is None
        assert steps_run == [point.name]
    thread.join()


def test_the_recipe_for_slurm_runs_each_combination_once(tmp_path: Path) -> None:
    page = (ROOT / "docs" / "studies.md").read_text(encoding="utf-8")
    script = next(block for block in page.split("```") if "#SBATCH" in block).removeprefix("text\n")
    jobs = re.search(r"--array=1-(\d+)\n", script)
    assert jobs
    called = tmp_path / "powderdsl"
    called.write_text('#!/bin/sh\necho "$@"\n', encoding="utf-8")
    called.chmod(0o755)
    known = commands()
    found = []
    for job in range(1, int(jobs[1]) + 1):
        slurm = {
            "SLURM_ARRAY_TASK_ID": str(job),
            "SLURM_ARRAY_TASK_COUNT": jobs[1],
            "SLURM_CPUS_PER_TASK": "2",
        }
        environment = {**os.environ, **slurm, "PATH": f"{tmp_path}:{os.environ['PATH']}"}
        options = {"env": environment, "capture_output": True, "text": True, "check": True}
        said = subprocess.run(["bash", "-c", script], **options)
        words = said.stdout.split()
        assert words[0] == "study"
        given = dict(zip(words[2::2], words[3::2], strict=True))
        assert set(given) <= {name for one in study_command.params for name in one.opts}
        points = selected(load_study(words[1], known), given["--size"], None, {})
        found.append(part(points, SHARD.convert(given["--shard"], None, None)))
    assert all(len(points) == 1 for points in found)
    assert [points[0] for points in found] == list(load_study("start-states", known).points("paper"))


def test_a_step_waits_for_what_a_killed_study_has_started(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The run's own lock outlives the study, in the process that saves its last checkpoint."""
    Path("study.yaml").write_text(STUDY, encoding="utf-8")
    study, point, place = prepared("out")
    (place / "trained").mkdir()
    (place / "trained" / "run.json").touch()
    began = threading.Event()

    def begin(*words: object, **options: object) -> None:
        began.set()
        raise OSError("that is enough")

    monkeypatch.setattr(subprocess, "Popen", begin)
    thread = threading.Thread(target=study.run, args=([point], 1))
    with FileLock(place / "trained" / ".lock"):
        thread.start()
        assert not began.wait(0.5)
    assert began.wait(30)
    thread.join()
