"""A study from a stranger reads beside its own file and writes in its own results, whatever it names."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

import click
import pytest

from powderdsl.cli.commands.study import CALLED, NOT_FOR_STUDIES, commands
from powderdsl.experiments.studies.study import READ, RULES, RUN_OR_TASK, TASK, confined, load_study
from tests.cli.commands import powderdsl
from tests.refusals import refusal, refused_codes

STUDY = """
study: odd
seeds: 1
vary: {steps: [10]}
steps:
  trained: {command: train, on: sand-pushing, steps: $steps}
  tested: {command: evaluate, on: trained}
measures:
  reward: {of: trained, value: splits/test/trained/mean}
"""

ELSEWHERE = (
    "/tmp/x.yaml",
    "../x.yaml",
    "a/../../x.yaml",
    "~/x.yaml",
    "..\\\\x.yaml",
    "C:\\\\x.yaml",
    '"a\\0b.yaml"',
    '"\\e[2J.yaml"',
    "link/x.yaml",
)


def errors(path: Path, text: str) -> list[str]:
    path.write_text(text, encoding="utf-8")
    return refused_codes(load_study, str(path), commands())


@pytest.mark.parametrize(
    ("old", "new"),
    [
        *(("on: sand-pushing", f"on: {name}") for name in ELSEWHERE),
        ("on: trained", "on: ../run"),
        ("on: trained", "on: /home/run"),
        ("on: trained", 'on: "~/run"'),
    ],
)
def test_what_a_step_works_on_lies_beside_the_study(old, new, tmp_path):
    (tmp_path / "link").symlink_to("/tmp")
    assert errors(tmp_path / "s.yaml", STUDY.replace(old, new)) == ["PD112"]


@pytest.mark.parametrize("option", ["rules", "packs", "held-out", "on"])
def test_rules_and_tasks_lie_beside_the_study(option, tmp_path):
    text = STUDY.replace("{command: train, on: sand-pushing,", f'{{command: wm train, {option}: "OTHER",')
    text = text.replace("command: evaluate", "command: wm eval")
    text = text.replace("steps: $steps", "iterations: $steps")
    mark = "," if option in ("packs", "held-out") else "+"
    for name in ("../x.yaml", "/etc/x.yaml" if option == "on" else f"core{mark}/etc/x.yaml"):
        assert errors(tmp_path / "s.yaml", text.replace("OTHER", name)) == ["PD112"]


def test_a_path_made_of_values_is_checked_too(tmp_path):
    text = STUDY.replace("vary: {steps: [10]}", "vary: {steps: [10], up: [a, ..]}")
    assert errors(tmp_path / "s.yaml", text.replace("sand-pushing", "$up/x.yaml")) == ["PD112"]
    text = STUDY.replace(
        "vary: {steps: [10]}", "vary: {steps: {small: [10], paper: [10], sets: {10: {to: /etc/x.yaml}}}}"
    )
    assert errors(tmp_path / "s.yaml", text.replace("sand-pushing", "$to")) == ["PD112"]


@pytest.mark.parametrize(
    ("command", "option"),
    [
        *(("train", option) for option in ("run", "resume")),
        *((command, "network") for command in ("wm train", "wm finetune", "wm eval")),
    ],
)
def test_a_study_cannot_choose_folders_or_code(command, option, tmp_path):
    text = STUDY.replace(", steps: $steps}", f", seed: $steps, {option}: elsewhere}}")
    text = text.replace("command: train, on: sand-pushing", f"command: {command}, on: world-model")
    (tmp_path / "s.yaml").write_text(text, encoding="utf-8")
    found = [one.message for one in refusal(load_study, str(tmp_path / "s.yaml"), commands())]
    assert any(f"`{command}` has no option `{option}`" in message for message in found)


def test_good_paths_become_paths_of_the_study(tmp_path):
    (tmp_path / "s.yaml").write_text(STUDY.replace("on: sand-pushing", "on: mine/task.yaml"))
    study = load_study(str(tmp_path / "s.yaml"), commands())
    point = next(iter(study.points("small")))
    place = tmp_path / "results" / "runs" / point.name
    assert str(tmp_path / "mine" / "task.yaml") in study.command(study.steps[0], point, place)


def test_each_kind_of_word(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "a+b"
    assert confined(TASK, "sand-pushing", folder) == "sand-pushing"
    assert confined(RUN_OR_TASK, "sand-pushing", folder) == "sand-pushing"
    assert confined(RUN_OR_TASK, "base", folder) == str(folder / "base")
    assert confined(RULES, "core+x.yaml+water-gas", folder) == f"core+{folder / 'x.yaml'}+water-gas"
    (tmp_path / "secret").write_text("x")
    with pytest.raises(ValueError, match="shipped rules"):
        confined(RULES, "core+secret", folder)


def test_results_with_a_link_that_leads_out_are_refused(tmp_path):
    (tmp_path / "s.yaml").write_text(STUDY)
    victim = tmp_path / "victim"
    victim.mkdir()
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "runs").symlink_to(victim)
    assert "PD112" in powderdsl("study", tmp_path / "s.yaml", "--out", tmp_path / "results", exits=2).stderr
    assert list(victim.iterdir()) == []


def test_every_word_that_stands_for_a_value_is_known():
    """An option with a new kind of value must say what it is before studies may give it."""
    plain = ["N", "A,B", "NAME=N", "PACK.PARAM=VALUE", "PROPERTY", "CHANCE", "MINUTES"]
    plain += ["SPLIT", "SPLIT,SPLIT", "DIR", "DEVICE", "SWAP"]
    found = commands()
    assert set(found) == set(CALLED)
    for words in CALLED:
        command: click.Command = import_module(f"powderdsl.cli.commands.{words[0]}").command
        for word in words[1:]:
            command = command.commands[word]  # type: ignore[attr-defined]
        for one in command.params:
            offered = {name[2:] for name in one.opts} & found[words].keys()
            assert not offered or not {*one.opts} & {*NOT_FOR_STUDIES}
            if offered or isinstance(one, click.Argument):
                assert (one.metavar or "") in {"", *READ, *plain}, one.name
            if isinstance(one.type, click.Path):
                assert one.opts[0] == "--run" or one.opts[0][2:] not in found[words]
