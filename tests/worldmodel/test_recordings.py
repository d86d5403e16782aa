"""World models with actions: what the network sees is what the simulator does."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from powderdsl.datasets import record
from powderdsl.tasks.episodes import compile_task
from powderdsl.tasks.shipped import load_task
from powderdsl.worldmodel import Machine, TrainConfig, load_trained, train
from powderdsl.worldmodel.evaluation import evaluate, evaluate_recording
from powderdsl.worldmodel.networks import NO_ELEMENT, ActionChannels, without_actions
from powderdsl.worldmodel.training import finetuned
from powderdsl.worldmodel.worlds import Recording, open_recording
from tests.cli.commands import powderdsl as run
from tests.refusals import refusal

HERE = Machine(backend="torch")

BUILDERS = """
task: builders
about: Sand and stone may be placed anywhere, and blown.
rules: core+sand+water+stone+wind
size: [12, 20]
fill: empty
generate:
  - scatter water chance 10%
agent: {may: [sand, stone, blow, nothing], brush: [4, 7], bins: [5, 6], speed: 3, actions: 6, steps_per_action: 2, free_steps: 9}
reward: {final: count(sand)}
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A task, forty episodes of it as ids and as compact observations, and a run that learned from the ids."""
    torch.set_num_threads(1)
    place = tmp_path_factory.mktemp("builders")
    (place / "builders.yaml").write_text(BUILDERS, encoding="utf-8")
    for kind in ("ids", "compact"):
        record(
            str(place / "builders.yaml"),
            "random",
            place / kind,
            episodes=40,
            shard=16,
            observation=kind,
            backend="torch",
        )
    train(tiny(iterations=1), place / "run", machine=HERE, recording=opened(place))
    return place


@pytest.fixture(params=["ids", "compact"])
def recording(request: pytest.FixtureRequest, folder: Path) -> Recording:
    return opened(folder, request.param)


def opened(folder: Path, kind: str = "ids") -> Recording:
    return open_recording(folder / kind, str(folder / "builders.yaml"))


def tiny(**changes: object) -> TrainConfig:
    return replace(TrainConfig(width=4, iterations=30, batch=8, learning_rate=0.01, seed=3), **changes)  # type: ignore[arg-type]


# What the network sees


@pytest.mark.parametrize("task", ["builders", "path-building", "sand-pushing"])
def test_channels_are_what_the_simulator_does(task: str, folder: Path) -> None:
    """Every bin and choice: the elements after the action, and the speed of blown cells."""
    loaded = load_task(str(folder / "builders.yaml") if task == "builders" else task)
    program = compile_task(loaded, backend="torch")
    recording = object.__new__(Recording)
    recording.task, recording.size = loaded, loaded.size
    columns, rows, choices, _, _ = program.action_nvec
    xy = torch.cartesian_prod(torch.arange(columns), torch.arange(rows))
    more = torch.arange(len(xy))
    actions = torch.cat([xy, torch.stack([more % choices, more % 3, more // 3 % 3], 1)], 1)
    start = program.start(torch.zeros(len(actions), dtype=torch.int64)).world
    after, done = program.hands.act(start, actions, reuse=False)
    placed, rows_of_speed, columns_of_speed = recording.painted(actions).unbind(1)
    assert torch.equal(torch.where(placed != NO_ELEMENT, placed, start.ids), after.ids)
    assert torch.equal((placed != NO_ELEMENT).flatten(1).any(1), done["placed"].bool())
    blown = rows_of_speed != 0
    assert torch.equal(blown, columns_of_speed != 0)
    assert torch.equal(blown.flatten(1).any(1), done["blown"].bool())
    if loaded.agent.speed_field is not None:
        speed = loaded.agent.speed * (torch.stack([rows_of_speed, columns_of_speed], 1).float() - 2)
        field = loaded.agent.speed_field
        untouched = start.state[field].clone()
        untouched[(placed != NO_ELEMENT)[:, None].expand_as(untouched)] = 0
        assert torch.equal(torch.where(blown[:, None], speed, untouched), after.state[field])


def test_the_encoder_has_elements_fields_and_actions() -> None:
    encoder = ActionChannels(slots=4, observed=2)
    inputs = torch.tensor([[[3, 1]], [[128, 255]], [[NO_ELEMENT, 2]], [[1, 0]], [[3, 0]]], dtype=torch.uint8)
    cells = encoder(inputs[:, 0][None, :, None]).squeeze()
    assert encoder.channels == 4 + 1 + 4 == len(cells)
    assert cells[:4].T.tolist() == [[0, 0, 0, 1], [0, 0, 1, 0]]  # the second cell holds what was placed
    assert cells[4].tolist() == [0, 255 / 128 - 1]
    assert cells[5:].T.tolist() == [[0, 1, -1, 1], [1, 0, 0, 0]]
    hidden = encoder(without_actions(inputs[:, 0][None, :, None])).squeeze()
    assert hidden[:4].T.tolist() == [[0, 0, 0, 1], [0, 1, 0, 0]]
    assert not hidden[5:].any()
    blind = ActionChannels(slots=4, observed=2, actions=False)
    assert torch.equal(blind(inputs[:, 0][None, :, None]).squeeze(), hidden[: blind.channels])


def test_pairs_are_transitions_of_the_dataset(recording: Recording) -> None:
    numbers = recording.eligible(recording.all)
    inputs, ends = recording.pairs(recording.all, numbers)
    observed = len(recording.dataset.recipe.channels)
    assert inputs.shape[1] == observed + 3
    place = 0
    for number in range(len(recording.dataset)):
        episode = recording.dataset.episode(number)
        count = len(episode.action) - 1  # the last action has nine free steps besides
        assert torch.equal(inputs[place : place + count, :observed], episode.observation[:count])
        assert torch.equal(ends[place : place + count], episode.observation[1 : count + 1, 0])
        assert torch.equal(
            inputs[place : place + count, observed:], recording.painted(episode.action[:count])
        )
        place += count
    assert place == len(numbers)


def test_parts_share_no_world(recording: Recording) -> None:
    worlds = [set(one.worlds.tolist()) for one in recording.parts]
    assert all(worlds)
    assert sum(map(len, worlds)) == len(set.union(*worlds)) == 40


# Training


@pytest.mark.slow
def test_a_network_learns_what_the_action_does(folder: Path, tmp_path: Path) -> None:
    config, recording = tiny(iterations=150), opened(folder, "compact")
    found = train(config, tmp_path / "run", machine=HERE, recording=recording, validate_every=50)
    trained = load_trained(found)
    (scores,) = evaluate_recording(trained, recording, machine=HERE).scores.values()
    blind = recording.configured(config).recorded
    assert blind is not None
    ignoring = replace(config, recorded=replace(blind, actions=False))
    other = load_trained(train(ignoring, tmp_path / "blind", machine=HERE, recording=recording))
    (without,) = evaluate_recording(other, recording, machine=HERE).scores.values()
    assert list(scores) == ["model", "action hidden", "nothing changes", "most frequent outcome"]
    assert list(without) == ["model", "nothing changes", "most frequent outcome"]
    assert scores["model"].loss < 0.8 * without["model"].loss
    assert scores["model"].loss < scores["action hidden"].loss
    seen, hidden = (some["model"].plain()["change_f1"] or 0 for some in (scores, without))
    assert seen > hidden


# The command line


@pytest.fixture
def copy(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of recordings, to change and to work in."""
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


QUICK = ("--width", 4, "--batch", 4, "--iterations", 3)


def test_train_eval_and_show(copy: Path) -> None:
    words = ("wm", "train", "builders.yaml", "--data", "compact", *QUICK)
    run(*words, "--slots", 20, exits=0)
    about = json.loads(Path("runs/builders/run.json").read_text())
    assert about["dataset"] == "compact"
    assert about["config"]["recorded"]["channels"][0] == "element"
    assert len(about["config"]["palette"]) == 20
    found = json.loads(run("wm", "eval", "builders", "--json", exits=0).stdout)
    assert list(found["mean"]) == ["model", "action hidden", "nothing changes", "most frequent outcome"]
    assert list(found["tests"]) == ["transitions"]
    assert len(run("wm", "show", "builders", "--out", "strips.png", exits=0).stdout.splitlines()) == 8
    run(*words, "--ignore-actions", exits=0)
    run("wm", "eval", "builders-blind", exits=0)


def test_a_network_is_tested_on_another_recording_of_the_task(copy: Path) -> None:
    record("builders.yaml", "nothing", "still", episodes=30, seed=500, backend="torch")
    tested = run("wm", "eval", "run", "--data", "still", "--json", exits=0)
    assert json.loads(tested.stdout)["worlds_each"] == 30 * 5  # all transitions but the last ones
    other = run("wm", "eval", "run", "--data", "compact", exits=2)
    assert "PD623" in other.output
    assert "`channels`" in other.output


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("train", "--data", "nowhere"), "PD630"),
        (("train", "--data", "ids"), "pass its file, too"),
        (("train", "--data", "ids", "sand-pushing"), "does not fit the task sand-pushing"),
        (("train", "--data", "ids", "builders.yaml", "--worlds", 10), "--worlds selects worlds"),
        (("train", "--data", "ids", "--held-out", "sand"), "--held-out selects worlds"),
        (("train", "--ignore-actions"), "--ignore-actions requires --data"),
        (("eval", "run", "--split", "train"), "--split selects worlds"),
        (("eval", "run", "--worlds", "3"), "--worlds selects worlds"),
        (("show", "run", "--out", "a.png", "--steps", "4"), "--steps selects worlds"),
        (("finetune", "run", "--packs", "lava"), "it was trained on a dataset"),
    ],
)
def test_options_that_make_no_sense_are_refused(words: tuple[object, ...], said: str, copy: Path) -> None:
    assert said in run("wm", *words, exits=2).output
    assert not Path("runs").exists()


def test_a_run_of_worlds_takes_no_dataset(copy: Path, dunes: str) -> None:
    run("wm", "train", dunes, "--run", "own", *QUICK, "--worlds", 4, "--backend", "torch", exits=0)
    result = run("wm", "eval", "own", "--data", "ids", exits=2)
    assert "--data is for networks that learned from a dataset" in result.output
    assert refusal(evaluate_recording, load_trained("own"), opened(copy))[0].code == "PD623"
    recorded = load_trained("run")
    for action in (lambda: evaluate(recorded), lambda: finetuned(recorded, ["lava"])):
        assert refusal(action)[0].code == "PD623"


def test_another_dataset_is_another_run(copy: Path) -> None:
    record("builders.yaml", "nothing", "still", episodes=40, backend="torch")
    other = open_recording("still", "builders.yaml")
    errors = refusal(train, tiny(iterations=1), "run", machine=HERE, recording=other)
    assert errors[0].code == "PD621"
    assert any("`recorded.digest`" in note for note in errors[0].notes)


# Strangers' files


def test_a_manifest_does_not_choose_which_file_is_read(copy: Path) -> None:
    path = copy / "ids" / "dataset.json"
    about = json.loads(path.read_text())
    for name in (str(copy / "builders.yaml"), "../builders.yaml", "builders.yaml"):
        about["recipe"]["task"] = name
        path.write_text(json.dumps(about))
        assert refusal(open_recording, copy / "ids")[0].code == "PD631"


def test_a_changed_task_and_too_few_worlds_are_refused(copy: Path) -> None:
    record("builders.yaml", "nothing", "few", episodes=3, worlds=1, backend="torch")
    (found,) = refusal(open_recording, "few", "builders.yaml")
    assert found.code == "PD631"
    assert "too few worlds" in found.message
    Path("builders.yaml").write_text(BUILDERS.replace("brush: [4, 7]", "brush: [4, 6]"), encoding="utf-8")
    (found,) = refusal(open_recording, "ids", "builders.yaml")
    assert found.code == "PD631"
    assert "have changed since" in found.notes[0]


def test_damaged_runs_are_refused(copy: Path) -> None:
    path = Path("run/run.json")
    about = json.loads(path.read_text())
    for wrong in (
        {"channels": []},
        {"channels": ["element"] * 5000},
        {"channels": ["wind", "element"]},
        {"channels": 3},
        {"channels": ["element", "more"]},
        {"actions": False},
        {"evil": 1},
    ):
        recorded = {**about["config"]["recorded"], **wrong}
        path.write_text(json.dumps({**about, "config": {**about["config"], "recorded": recorded}}))
        assert refusal(load_trained, "run")[0].code in ("PD620", "PD623"), wrong
