"""Studies are refused before anything runs, with all that is wrong and where; `--dry-run` prints what a shell takes."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest

from powderdsl.cli.commands.study import check_study, commands
from powderdsl.diagnostics import CompileError, Diagnostic, Reporter, Source
from powderdsl.experiments.studies.study import Study, load_study, read_study, shipped_studies
from tests.cli.commands import powderdsl
from tests.refusals import refusal

AGENTS = """
study: patience
about: Longer training, more reward.
seeds: 3
vary:
  steps: {about: interactions, small: [100, 200], paper: [1000, 2000]}
  task: [sand-pushing, destroying]
  few: {small: [some], paper: [some], sets: {some: {lines: 2}}}
steps:
  trained: {command: train, on: $task, preset: $size, steps: $steps, knob: lines=$lines, seed: $seed}
  tested: {command: evaluate, on: trained, episodes: 4, split: "test,train", policies: "trained,random"}
measures:
  reward: {of: trained, value: splits/test/trained/above/random/mean, expect: rises}
"""

MODELS = """
study: transfer
seeds: 2
vary: {elements: [1, 4]}
steps:
  trained: {command: wm train, held-out: [gas, acid], knob: kinds=$elements, seed: $seed}
  tuned: {command: wm finetune, on: trained, packs: [gas, acid], iterations: 5, seed: $seed}
  tested: {command: wm eval, on: tuned, split: held_out}
measures:
  loss: {of: tuned, value: mean/model/loss, scale: log}
"""


def read(text: str, name: str = "study.yaml") -> Study:
    return read_study(Source(name, text), Reporter(), commands(), check_study)


def refused(text: str) -> list[tuple[str, str]]:
    """The code and the text under the caret of everything that is said of a study."""
    return [(one.code, under(one)) for one in refusal(read, text)]


def under(one: Diagnostic) -> str:
    assert one.primary.span is not None, one
    assert one.primary.span.source.name == "study.yaml", one
    return one.primary.span.text


def test_the_seed_of_a_study_with_one_seed_need_not_be_used() -> None:
    text = AGENTS.replace(", seed: $seed", "")
    assert refused(text) == [("PD806", "3")]
    assert read(text.replace("seeds: 3", "seeds: 1")).seeds == 1


@pytest.mark.parametrize(
    ("settings", "steps", "number"),
    [(9, 1, "10,000 combinations"), (7300, 1, "10,000 combinations"), (2, 60, "50,000 calls")],
)
def test_a_study_of_too_many_points_is_refused_before_it_is_checked(
    settings: int, steps: int, number: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Products with 14 and with more than 4,300 digits, which Python does not print."""
    monkeypatch.setattr(Study, "points", None)
    vary = "".join(f"\n  a{i}: {[*range(30 if settings < 10 else 4)]}" for i in range(settings))
    calls = "".join(f"\n  s{i}: {{command: train, on: sand-pushing, seed: $a0}}" for i in range(steps))
    text = f"study: s\nseeds: 1\nvary:{vary}\nsteps:{calls}\nmeasures: {{m: {{of: s0, value: mean}}}}\n"
    (error,) = refusal(read, text)
    assert (error.code, error.message) == ("PD806", f"more than {number} at the size `small`")


@pytest.mark.parametrize("name", shipped_studies())
def test_shipped_studies_pass(name: str) -> None:
    load_study(name, commands(), check_study)


@pytest.mark.parametrize(
    ("text", "old", "new", "code", "caret"),
    [
        # what a step works on
        (AGENTS, "on: trained", "on: trianed", "PD806", "trianed"),
        (AGENTS, "on: trained, ", "", "PD806", "tested"),
        (AGENTS, "destroying]", "destorying]", "PD801", "destorying"),
        (AGENTS, "command: evaluate, on: trained, episodes: 4, split: \"test,train\", policies: \"trained,random\"",
         "command: wm eval, on: trained", "PD806", "trained"),
        (AGENTS, "command: evaluate, on: trained", "command: evaluate, on: tested", "PD806", "tested"),
        (MODELS, "command: wm train", "command: wm train, on: powderworld", "PD801", "powderworld"),
        (MODELS, "on: tuned", "on: later", "PD806", "later"),
        (MODELS, "command: wm eval, on: tuned, split: held_out", "command: evaluate, on: tuned", "PD806", "tuned"),
        # values of options
        (AGENTS, "[100, 200]", "[100, lots]", "PD806", "lots"),
        (AGENTS, "episodes: 4", "episodes: 4.5", "PD806", "4.5"),
        (AGENTS, "episodes: 4", "episodes: ４", "PD806", "４"),
        (AGENTS, "preset: $size", "gamma: 0.٩", "PD806", "0.٩"),
        (AGENTS, "episodes: 4", "deterministic: maybe", "PD806", "maybe"),
        (AGENTS, "preset: $size", "preset: smal", "PD806", "smal"),
        (AGENTS, "preset: $size", "gamma: 7", "PD640", "7"),
        (AGENTS, "preset: $size", "envs: 1, rollout: 1", "PD640", "trained"),
        (AGENTS, "seed: $seed", "seed: $seed, batch: 100$", "PD806", "100$"),
        (MODELS, "iterations: 5", "iterations: 0", "PD806", "0"),
        (AGENTS, "preset: $size", "device: cdua", "PD701", "cdua"),
        (AGENTS, "episodes: 4", "device: cuda:99", "PD701", "cuda:99"),
        (MODELS, "split: held_out", "device: [cpu, cdua]", "PD806", "cdua"),
        # names in tasks and rules
        (AGENTS, "lines: 2", "lines: 999", "PD803", "999"),
        (AGENTS, "knob: lines=$lines", "knob: lnies=$lines", "PD803", "2"),
        (AGENTS, "knob: lines=$lines", "knob: lines=$lines, set: water.melt=500%", "PD402", "water.melt=500%"),
        (AGENTS, "test,train", "test,tran", "PD801", '"test,tran"'),
        (AGENTS, "trained,random", "trained,rnadom", "PD806", '"trained,rnadom"'),
        (MODELS, "[1, 4]", "[1, 99]", "PD803", "99"),
        (MODELS, "packs: [gas, acid]", "packs: [gas, acdi]", "PD304", "acdi"),
        (MODELS, "packs: [gas, acid], ", "", "PD806", "tuned"),
        (MODELS, "split: held_out", "split: held_out, only: [gas, wood]", "PD304", "wood"),
        (MODELS, "split: held_out", "rules: powderwolrd", "PD304", "powderwolrd"),
        (MODELS, "held-out: [gas, acid]", "on: world-modle", "PD801", "world-modle"),
        # measures
        (MODELS, "of: tuned", "of: trained", "PD806", "trained"),
        # what makes no difference
        (AGENTS, ", steps: $steps", "", "PD806", "steps"),
        (AGENTS, "{lines: 2}", "{lines: 2, disks: 3}", "PD806", "3"),
        (AGENTS, ", seed: $seed", "", "PD806", "3"),
    ],
)  # fmt: skip
def test_a_mistake_is_found_before_anything_runs(
    text: str, old: str, new: str, code: str, caret: str
) -> None:
    assert text.count(old) >= 1
    assert set(refused(text.replace(old, new, 1))) == {(code, caret)}


def test_consequences_are_told_too_where_they_are_mistakes_of_their_own() -> None:
    assert refused(AGENTS.replace("on: $task, ", "")) == [("PD806", "task"), ("PD806", "trained")]
    again = AGENTS.replace("measures:", "  again: {command: train, on: trained}\nmeasures:")
    assert refused(again) == [("PD806", "trained")]


def test_a_value_is_shown_where_it_is_written_and_used() -> None:
    (one,) = refusal(read, AGENTS.replace("[100, 200]", "[100, lots]"))
    (used,) = one.secondary
    assert (used.span.text, used.text) == ("$steps", "as `lots`")


def test_all_mistakes_are_told_at_once() -> None:
    text = AGENTS
    for old, new in (
        ("[100, 200]", "[100, lots]"),
        ("destroying]", "destorying]"),
        ("lines: 2", "lines: 999"),
        ("on: trained", "on: trianed"),
        ("preset: $size", "split: tran, gamma: 7, gammma: 7"),
        ("expect: rises", "expect: grows"),
    ):
        text = text.replace(old, new)
    carets = {caret for _, caret in refused(text)}
    assert carets >= {"lots", "destorying", "999", "trianed", "tran", "7", "gammma", "grows"}


def test_mistakes_in_a_task_file_are_shown_there(tmp_path: Path) -> None:
    (tmp_path / "dig.yaml").write_text(
        "task: dig\nrules: core+sadn\nsize: [8, 8]\nfill: empty\n", encoding="utf-8"
    )
    text = AGENTS.replace("[sand-pushing, destroying]", "[dig.yaml]")
    errors = refusal(read, text, str(tmp_path / "study.yaml"))
    places = {Path(one.primary.span.source.name).name for one in errors if one.primary.span}
    assert "dig.yaml" in places


def test_files_elsewhere_are_not_even_read(tmp_path: Path) -> None:
    (tmp_path / "dig.yaml").write_text("secret: words\n", encoding="utf-8")
    inner = tmp_path / "studies"
    inner.mkdir()
    text = AGENTS.replace("[sand-pushing, destroying]", "[sand-pushing]").replace(
        "on: $task", "on: ../dig.yaml"
    )
    with pytest.raises(CompileError) as caught:
        read(text.replace("  task: [sand-pushing]\n", ""), str(inner / "study.yaml"))
    assert [one.code for one in caught.value.diagnostics] == ["PD112"]
    assert "secret" not in str(caught.value)


def test_a_dry_run_prints_what_a_shell_takes(folder: Path) -> None:
    text = AGENTS.replace("episodes: 4", "episodes: 4, deterministic: yes").replace(
        'split: "test,train"', 'split: "test, train"'
    )
    Path("my study.yaml").write_text(text, encoding="utf-8")
    result = powderdsl("study", "my study.yaml", "--dry-run", "--seeds", 1, "--out", "it's here", exits=0)
    lines = result.stdout.splitlines()
    assert len(lines) == 2 * 2 * 2
    words = shlex.split(lines[1])
    assert words[:2] == ["powderdsl", "evaluate"]
    assert words[2].startswith("it's here/runs/")
    options = "--episodes 4 --deterministic --split 'test, train' --policies trained,random"
    assert words[3:] == shlex.split(options)


def test_nothing_is_written_for_a_study_that_is_refused(folder: Path) -> None:
    Path("study.yaml").write_text(AGENTS.replace("preset: $size", "preset: smal"), encoding="utf-8")
    assert "study.yaml:10:" in powderdsl("study", "study.yaml", exits=2).stderr
    assert [path.name for path in folder.iterdir()] == ["study.yaml"]


@pytest.mark.parametrize(("study", "right"), [(AGENTS, "trained"), (MODELS, "tuned")])
def test_a_measure_of_the_step_that_evaluates_is_led_to_the_run(study: str, right: str) -> None:
    """What the message proposes is accepted."""
    wrong = study.replace(f"{{of: {right},", "{of: tested,")
    (found,) = refusal(read, wrong)
    assert (found.code, under(found)) == ("PD806", "tested")
    assert f"`of: {right}`" in found.helps[0]
    assert read(study.replace("{of: tested,", f"{{of: {right},")).measures[0].of.text == right
