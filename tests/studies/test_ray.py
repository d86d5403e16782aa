"""Studies on Ray: what a cluster computes is what one machine computes, whoever dies on the way."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from contextlib import ExitStack
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import pytest

from powderdsl.cli.commands.study import commands
from powderdsl.diagnostics import Reporter, Source
from powderdsl.experiments.runs import read_metrics
from powderdsl.experiments.studies import run as on_cluster
from powderdsl.experiments.studies.run import StudyRun
from powderdsl.experiments.studies.study import Study, read_study
from powderdsl.system.writing import MARK
from tests.cli.commands import command_line, environment_with, powderdsl
from tests.cli.endless import STUDY
from tests.cli.endless import TASK as DIG
from tests.processes import started, waited
from tests.studies.ray_nodes import Nodes, cluster

needs_ray = pytest.mark.skipif(find_spec("ray") is None, reason="needs Ray: pip install 'powderdsl[ray]'")
needs_proc = pytest.mark.skipif(not Path("/proc/self/environ").exists(), reason="finds processes in /proc")

RESULTS = ("results.md", "results.json", "figure.png")


def written(folder: Path, seeds: int, steps: list[int]) -> None:
    (folder / "dig.yaml").write_text(DIG, encoding="utf-8")
    (folder / "study.yaml").write_text(STUDY.format(seeds=seeds, steps=steps), encoding="utf-8")


def run_study(folder: Path, *words: str, seconds: float = 900) -> subprocess.CompletedProcess[str]:
    command = command_line("study", "study.yaml", *words)
    options = {"capture_output": True, "text": True, "timeout": seconds, "check": False}
    return subprocess.run(command, env=environment_with(), cwd=folder, **options)  # type: ignore[call-overload, no-any-return]


def read(text: str) -> Study:
    return read_study(Source("study.yaml", text), Reporter(), commands())


def test_a_run_declares_what_it_needs() -> None:
    text = STUDY.format(seeds=1, steps=[12]).replace("seed: $seed", "seed: $seed, device: cpu")
    study, gpu = read(text), read(text.replace("device: cpu", "device: cuda"))
    (point,) = study.points("small")
    assert on_cluster.resources(study, point, 2) == {"num_cpus": 2, "num_gpus": 0}
    assert on_cluster.resources(gpu, point, 1) == {"num_cpus": 1, "num_gpus": 1}


def test_a_node_without_the_folder_runs_nothing(tmp_path: Path) -> None:
    study = read(STUDY.format(seeds=1, steps=[12]))
    (point,) = study.points("small")
    folder = tmp_path / "elsewhere"
    found = on_cluster.run_point(study, folder, "small", 1, point)
    assert "it must be on storage that all nodes share" in str(found.problem)
    assert not folder.exists()


def test_what_a_node_refuses_is_a_problem_of_the_run(tmp_path: Path) -> None:
    """On this node, the task that the study names is a link that leads out of its folder."""
    (tmp_path / "beside").mkdir()
    (tmp_path / "beside/dig.yaml").symlink_to(tmp_path / "dig.yaml")
    study = replace(read(STUDY.format(seeds=1, steps=[12])), folder=tmp_path / "beside")
    (point,) = study.points("small")
    run = StudyRun(study, tmp_path / "out", "small")
    run.prepare()
    found = on_cluster.run_point(study, tmp_path / "out", "small", 1, point)
    assert "the path `dig.yaml` leaves the study's folder" in str(found.problem)


def test_without_ray_the_user_learns_what_to_install(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written(folder, 1, [12])
    monkeypatch.setitem(sys.modules, "ray", None)
    assert "pip install 'powderdsl[ray]'" in powderdsl("study", "study.yaml", "--ray", "auto", exits=2).stderr
    assert not (folder / "studies").exists()


@needs_ray
@pytest.mark.parametrize("address", ["nonsense", "127.0.0.1:1", "127.0.0.1:99999", "", "ray://"])
def test_where_no_cluster_is_the_user_is_told_at_once(address: str, folder: Path) -> None:
    written(folder, 1, [12])
    assert "error[PD626]" in powderdsl("study", "study.yaml", "--ray", address, exits=2).stderr
    assert not (folder / "studies").exists()


@pytest.mark.slow
@needs_ray
@needs_proc
def test_a_cluster_runs_a_study_and_sigterm_ends_one(tmp_path: Path) -> None:
    with cluster(1) as nodes:
        written(tmp_path, 1, [900_000_000])
        with ExitStack() as stack:
            endless = _Driver(tmp_path, nodes, stack, "endless")
            place = tmp_path / "endless/runs/steps=900000000,seed=0"
            assert waited(
                lambda: endless.running.poll() is not None or any(place.glob("trained/checkpoints/[0-9]*"))
            )
            endless.running.send_signal(signal.SIGTERM)
            endless.running.wait(timeout=120)
            assert endless.running.returncode == 143, endless.said()
            assert endless.said().endswith("terminated by SIGTERM\n")
            assert "Traceback" not in endless.said()
        assert (place / "trained.log").read_text(encoding="utf-8").endswith("terminated by SIGTERM\n")
        assert not [line for line in nodes.processes().values() if " train " in line]
        written(tmp_path, 1, [12, 24])
        found = run_study(tmp_path, "--out", "out", "--ray", nodes.address)
    assert found.returncode == 0, found.stderr
    results = json.loads((tmp_path / "out/results.json").read_text(encoding="utf-8"))
    assert [one["problem"] for one in results["points"]] == [None, None]
    again = run_study(tmp_path, "--out", "out")  # from what is there
    assert (again.returncode, again.stdout) == (0, found.stdout)


KILLS = ("worker", "worker", "worker", "worker", "node", "node", "node", "driver", "driver", "driver")


@pytest.mark.slow
@needs_ray
@needs_proc
def test_ten_deaths_change_no_number(tmp_path: Path) -> None:
    """24 runs on two nodes, and ten kills, spread over the study: the table is that of an undisturbed one."""
    written(tmp_path, 8, [300, 600, 900])
    undisturbed = run_study(tmp_path, "--out", "undisturbed", seconds=3600)
    assert undisturbed.returncode == 0, undisturbed.stderr
    chance = random.Random(os.environ.get("POWDERDSL_KILLS", "powderdsl"))
    kills = zip(
        chance.sample(KILLS, len(KILLS)), sorted(chance.choices(range(16), k=len(KILLS))), strict=True
    )
    done: dict[str, tuple[int, int]] = {}
    with cluster(2) as nodes, ExitStack() as stack:
        study = _Driver(tmp_path, nodes, stack, "out")
        node = nodes.started
        for kill, least in kills:
            while len(_finished(tmp_path / "out")) < least:
                assert study.running.poll() is None, study.said()
                time.sleep(0.5)
            time.sleep(chance.uniform(0.5, 8))
            assert study.running.poll() is None, study.said()
            match kill:
                case "worker":
                    assert waited(lambda: nodes.kill_worker("tiny", chance), 300), study.said()
                case "node":
                    assert nodes.kill_node(node) > 1
                    node = nodes.start_node()
                case "driver":
                    study.running.kill()
                    study.running.wait()
                    study.start()
            print(f"killed a {kill}; done: {len(_finished(tmp_path / 'out'))}")
            _compare(done, _finished(tmp_path / "out"))
        study.running.wait(timeout=3600)
        assert study.running.returncode == 0, study.said()
    _compare(done, _finished(tmp_path / "out"))
    assert len(done) == 24
    for name in RESULTS:
        assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "undisturbed" / name).read_bytes()
    for run in (tmp_path / "out/runs").glob("*"):
        steps = [line["step"] for line in read_metrics(run / "trained")]
        assert steps == list(range(12, steps[-1] + 1, 12)), run  # no line is lost or written twice
        whole = read_metrics(tmp_path / "undisturbed/runs" / run.name / "trained")
        assert steps == [line["step"] for line in whole]
    left = [path for path in (tmp_path / "out").rglob("*") if MARK in path.name]
    assert left == []


class _Driver:
    """The process that submits the study, which may be killed and started again."""

    def __init__(self, folder: Path, nodes: Nodes, stack: ExitStack, out: str):
        self.folder, self.nodes, self.stack, self.out = folder, nodes, stack, out
        self.start()

    def start(self) -> None:
        log = (self.folder / "driver.log").open("a", encoding="utf-8")
        command = command_line("study", "study.yaml", "--out", self.out, "--ray", self.nodes.address)
        options = {"stdout": log, "stderr": log, "cwd": self.folder, "env": environment_with()}
        self.running = self.stack.enter_context(started(command, **options))
        log.close()

    def said(self) -> str:
        return (self.folder / "driver.log").read_text(encoding="utf-8")


def _finished(folder: Path) -> dict[str, tuple[int, int]]:
    stats = {path.name: path.stat() for path in folder.glob("done/*.json")}
    return {name: (one.st_ino, one.st_mtime_ns) for name, one in stats.items()}


def _compare(before: dict[str, tuple[int, int]], now: dict[str, tuple[int, int]]) -> None:
    """What is done stays done, and is not done again."""
    assert {name: now.get(name) for name in before} == before
    before.update(now)
