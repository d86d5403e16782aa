"""Studies: files are checked, grids are complete, what is done is not done again, and intervals are right."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import pytest

from powderdsl.cli.commands.study import commands
from powderdsl.diagnostics import Reporter, Source
from powderdsl.experiments.studies.results import (
    Interval,
    as_data,
    as_markdown,
    findings,
    interval,
    show_interval,
    write_figure,
)
from powderdsl.experiments.studies.run import Outcome, StudyRun
from powderdsl.experiments.studies.study import (
    RUN_OR_TASK,
    TASK,
    TEXT,
    Point,
    Study,
    load_study,
    read_study,
)
from tests.refusals import refusal
from tests.studies.test_ray import written

KNOWN: Mapping[tuple[str, ...], Mapping[str, str]] = {
    ("train",): {"on": TASK, **dict.fromkeys(("run", "seed", "steps", "knob"), TEXT)},
    ("evaluate",): {"on": RUN_OR_TASK, "episodes": TEXT},
}

TEXT = """
study: patience
about: Longer training, more reward.
seeds: 3
vary:
  steps: {about: interactions, small: [100, 200], paper: [1000, 2000, 4000]}
  squares: [0, 5]
steps:
  trained: {command: train, on: sand-pushing, steps: $steps, knob: [lines=2, squares=$squares], seed: $seed}
  tested: {command: evaluate, on: trained, episodes: 4}
measures:
  reward: {of: trained, value: splits/test/trained/mean, about: mean reward, expect: rises}
"""


def read(text: str) -> Study:
    return read_study(Source("study.yaml", text), Reporter(), KNOWN)


def outcomes(study: Study, values: Mapping[tuple[str, ...], Sequence[float]]) -> list[Outcome]:
    return [
        Outcome(point, {"reward": values[tuple(value for _, value in point.values)][point.seed]})
        for point in study.points("small")
    ]


def test_a_grid_is_complete_and_each_size_has_its_own() -> None:
    study = read(TEXT)
    points = list(study.points("small"))
    assert len(points) == len(set(points)) == 2 * 2 * 3
    assert points[0] == Point((("steps", "100"), ("squares", "0")), 0)
    assert [point.seed for point in points] == [0] * 4 + [1] * 4 + [2] * 4
    assert len(list(study.points("paper", seeds=1))) == 3 * 2


def test_a_step_becomes_a_command(tmp_path: Path) -> None:
    study = read(TEXT)
    point = next(study.points("small"))
    place = tmp_path / "runs" / "x"
    trained, tested = (study.command(step, point, place) for step in study.steps)
    words = "train sand-pushing --steps 100 --knob lines=2 --knob squares=0 --seed 0 --run"
    assert trained == [*words.split(), str(place / "trained")]
    assert tested == ["evaluate", str(place / "trained"), "--episodes", "4"]


def test_a_value_may_set_several_names() -> None:
    several = "{small: [few, both], paper: [few], sets: {few: {l: 2, d: 0}, both: {l: 2, d: 5}}}"
    study = read(
        TEXT.replace("[0, 5]", several).replace("[lines=2, squares=$squares]", "[lines=$l, disks=$d]")
    )
    words = [study.command(study.steps[0], point, Path("y"))[4:8] for point in study.points("small", seeds=1)]
    few, both = (["--knob", "lines=2", "--knob", f"disks={number}"] for number in (0, 5))
    assert words == [few, both, few, both]
    assert next(study.points("small", seeds=1)).name == "steps=100,squares=few,seed=0"


@pytest.mark.parametrize(
    ("old", "new", "code", "caret"),
    [
        ("study: patience", "study: ../patience", "PD111", "../patience"),
        ("seeds: 3", "seeds: 0", "PD402", "0"),
        ("seeds: 3", "sedes: 3", "PD108", "sedes"),
        ("command: train,", "command: rm,", "PD806", "rm"),
        ("command: train,", "", "PD109", "trained"),
        ("steps: $steps", "stepps: $steps", "PD806", "stepps"),
        ("steps: $steps", "run: elsewhere", "PD806", "run"),
        ("$squares", "$circles", "PD806", "squares=$circles"),
        ("on: trained,", "on: --run,", "PD806", "--run"),
        ("[0, 5]", "[]", "PD109", "squares"),
        ("[0, 5]", "[0, ../5]", "PD110", "../5"),
        ("[0, 5]", "{small: [0]}", "PD109", "{"),
        ("squares: [0, 5]", "seed: [0, 5]", "PD111", "seed"),
        ("of: trained", "of: tested", "PD806", "tested"),
        ("expect: rises", "expect: grows", "PD110", "grows"),
        ("expect: rises", "scale: square", "PD110", "square"),
        ("[0, 5]", "{small: [a], paper: [a, b], sets: {a: {lines: 1}}}", "PD109", "b"),
        ("[0, 5]", "{small: [a], paper: [b], sets: {a: {lines: 1}, b: {disks: 2}}}", "PD109", "a"),
        ("[0, 5]", "{small: [a], paper: [a], sets: {a: {steps: 1}}}", "PD111", "steps"),
        ("[0, 5]", "{small: [a], paper: [a], sets: {a: 1}}", "PD107", "1"),
        ("[0, 5]", "{small: [a], paper: [a], sets: a}", "PD107", "a"),
        ("[0, 5]", "{small: [a], paper: [a], sets: {a: {x: 1}}}\n  x: [1]", "PD111", "x"),
        ("paper: [1000, 2000, 4000]", f"paper: [{', '.join(map(str, range(2000)))}]", "PD806", "patience"),
    ],
)
def test_a_mistake_is_reported_at_its_place(old: str, new: str, code: str, caret: str) -> None:
    assert old in TEXT
    errors = refusal(read, TEXT.replace(old, new, 1))
    found = [(one.code, one.primary.span.text if one.primary.span else "") for one in errors]
    assert (code, caret) in found


def test_an_interval_is_that_of_student() -> None:
    found = interval([1.0, 2.0, 3.0, 4.0])
    half = 3.182 * math.sqrt(5 / 3) / 2
    assert found.mean == 2.5
    assert (found.low, found.high) == pytest.approx((2.5 - half, 2.5 + half), rel=1e-6)
    assert interval([7.0]) == Interval(7.0, -math.inf, math.inf)
    ratios = interval([2.0, 8.0], "log")
    factor = 2 ** (12.706 * math.sqrt(2) / math.sqrt(2))
    assert (ratios.mean, ratios.low, ratios.high) == pytest.approx((4.0, 4 / factor, 4 * factor), rel=1e-6)


@pytest.mark.parametrize(
    ("found", "scale", "text"),
    [
        ((0.12345, 0.11675, 0.13015), "linear", "0.1235 ± 0.0067"),
        ((12.3, 8.9, 15.7), "linear", "12.3 ± 3.4"),
        ((1.0, -math.inf, math.inf), "linear", "1"),
        ((250.0, 219.0, 281.0), "linear", "250 ± 31"),
        ((0.5, 0.25, 1.0), "log", "0.500 (0.250 to 1.00)"),
    ],
)
def test_numbers_are_rounded_by_their_interval(
    found: tuple[float, float, float], scale: str, text: str
) -> None:
    assert show_interval(Interval(*found), scale) == text


@pytest.mark.parametrize(
    ("first", "last", "scale", "verdict"),
    [
        ((1.0, 1.1, 0.9), (2.0, 2.1, 2.0), "linear", "rises (last − first: +1.03"),
        ((1.0, 3.0, 0.9), (2.0, 2.1, 2.0), "linear", "rises, but the interval holds 0"),
        ((2.0, 2.0, 2.0), (1.0, 1.0, 1.0), "linear", "does not rise"),
        ((1.0, 2.0, 4.0), (2.0, 4.0, 8.0), "log", "rises (last / first: 2.00 (2.00 to 2.00))"),
        ((1.0, 2.0, 4.0), (2.0, 1.0, 9.0), "log", "rises, but the interval holds 1"),
    ],
)
def test_verdicts_follow_the_intervals(
    first: tuple[float, ...], last: tuple[float, ...], scale: str, verdict: str
) -> None:
    text = TEXT.replace("  squares: [0, 5]\n", "").replace(", squares=$squares", "")
    study = read(text.replace("expect: rises", f"expect: rises, scale: {scale}"))
    (found,) = findings(study, outcomes(study, {("100",): first, ("200",): last}))
    assert found.verdict.startswith(verdict)
    assert found.cells[0].over_seeds == interval(first, scale)


def test_each_value_of_another_setting_has_a_verdict_of_its_own() -> None:
    study = read(TEXT)
    rising, falling = (1.0, 1.1, 0.9), (9.0, 9.1, 9.2)
    points = {
        ("100", "0"): rising,
        ("100", "5"): falling,
        ("200", "0"): (2.0, 2.0, 2.0),
        ("200", "5"): rising,
    }
    (found,) = findings(study, outcomes(study, points))
    one, other = found.verdict.split("; ")
    assert one.startswith("squares 0: rises (last − first: +1.00")
    assert other.startswith("squares 5: does not rise (last − first: -8.1")
    assert as_markdown(study, "small", outcomes(study, points)).count("- ") == 2


def test_a_table_names_what_did_not_finish(tmp_path: Path) -> None:
    study = read(TEXT)
    found = outcomes(study, {(s, q): (1.0, 2.0, 3.0) for s in ("100", "200") for q in ("0", "5")})
    found[-1] = Outcome(found[-1].point, {}, "trained ended with 2")
    text = as_markdown(study, "small", found)
    assert "| 100 | 0 | 2.0 ± 2.5 | 3 |" in text
    assert "| 200 | 5 |" in text
    assert "steps=200,squares=5,seed=2: trained ended with 2" in text
    assert json.loads(json.dumps(as_data(study, "small", found)))["findings"][0]["cells"][0]["mean"] == 2.0
    write_figure(tmp_path / "figure.png", study, "small", found)
    assert (tmp_path / "figure.png").stat().st_size > 1000


def test_words_have_a_figure_too(tmp_path: Path) -> None:
    study = load_study("shapes", commands())
    found = [
        Outcome(point, {"loss": 0.1 + 0.01 * number}) for number, point in enumerate(study.points("small"))
    ]
    write_figure(tmp_path / "figure.png", study, "small", found)
    assert (tmp_path / "figure.png").stat().st_size > 1000
    assert "| lines+disks | 0.191 (" in as_markdown(study, "small", found)


def test_a_study_runs_goes_on_and_refuses_another(folder: Path) -> None:
    written(folder, 1, [12, 24])
    text = Path("study.yaml").read_text(encoding="utf-8")
    study = read_study(Source("study.yaml", text), Reporter(), commands())
    points = list(study.points("small"))
    run = StudyRun(study, folder / "out", "small")
    run.prepare()
    found = run.run(points, jobs=2)
    assert [one.problem for one in found] == [None, None]
    assert all(1.0 <= one.values["reward"] <= 12.0 for one in found)
    logs = {path: path.stat().st_mtime_ns for path in (folder / "out").rglob("*.log")}
    assert len(logs) == 4
    again = StudyRun(study, folder / "out", "small")
    again.prepare()
    assert again.run(points, jobs=1) == found
    assert {path: path.stat().st_mtime_ns for path in logs} == logs

    def changed(old: str, new: str) -> StudyRun:
        assert old in text
        file = Source("study.yaml", text.replace(old, new))
        return StudyRun(read_study(file, Reporter(), commands()), folder / "out", "small")

    renamed = changed("reward:", "mean: {of: trained, value: splits/test/random/mean, scale: log}\n  reward:")
    renamed.prepare()
    more = renamed.run(points, jobs=1)
    assert [one.values["reward"] for one in more] == [one.values["reward"] for one in found]
    assert all(one.values["mean"] > 0 for one in more)
    assert {path: path.stat().st_mtime_ns for path in logs} == logs
    assert refusal(changed("episodes: 4", "episodes: 5").prepare)[0].code == "PD621"


@pytest.mark.slow
def test_a_step_that_fails_is_told_with_its_last_words(tmp_path: Path) -> None:
    text = TEXT.replace("on: sand-pushing", "on: no-such-task")
    study = read(text)
    run = StudyRun(study, tmp_path / "out", "small")
    run.prepare()
    (outcome,) = run.run(list(study.points("small"))[:1], jobs=1)
    assert outcome.problem is not None
    assert "trained ended with 2" in outcome.problem
    assert "PD801" in outcome.problem
