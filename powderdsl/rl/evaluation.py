"""Evaluation of policies: returns in many worlds of each split, compared with other policies; and videos."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from powderdsl.envs.actions import FrameStack, Policy, random_policy
from powderdsl.envs.mixed import environment
from powderdsl.envs.tensor_env import observation_of
from powderdsl.experiments.runs import Estimate, RunFolder, find_run, mean_and_interval, write_json
from powderdsl.rl.config import BASELINES, TrainConfig, chosen_policies
from powderdsl.rl.policies import TrainedPolicy, config_of, load_policy, task_of
from powderdsl.simulation.draw import OUTLINES, contact_sheet, looks, outline, rgb, scale, shown_fields
from powderdsl.simulation.simulator import World
from powderdsl.system.random import action_keys
from powderdsl.tasks.episodes import Episodes, TaskProgram, compile_task
from powderdsl.tasks.players import ExpertPlayer
from powderdsl.tasks.shipped import check_split
from powderdsl.tasks.task import BLOW, Task
from powderdsl.tasks.tensors.actions import cells_of

EVALUATION = "evaluation.json"
BATCH = 256
"""Number of episodes played at once."""
TRAINING_STARTS = 1024
"""Number of training worlds to compare others with."""


class Played(NamedTuple):
    """Played episodes: `returns` float64 [n]; `lengths` int64 [n], in actions; `success` bool [n], at the end."""

    returns: Tensor
    lengths: Tensor
    success: Tensor


@dataclass(frozen=True)
class Score:
    """The score of a policy on a split. `interval` is half of the 95 % interval of `mean`; None for one episode.

    `above` has the mean difference from each other policy of BASELINES played in the same worlds, with its interval.
    `success` is None for tasks without a condition for success. `normalized` is the mean on a scale where doing nothing
    is 0 and the task's expert 1, with its interval, paired by world (delta method); None unless both were played and
    the expert is better.
    """

    split: str
    policy: str
    episodes: int
    mean: float
    interval: float | None
    success: float | None
    length: float
    above: Mapping[str, Estimate]
    normalized: Estimate | None = None


@dataclass(frozen=True)
class Seen:
    """Worlds of a split that start like one of the first TRAINING_STARTS training worlds: their number, and the means
    and intervals of policies without them."""

    worlds: int
    without: Mapping[str, Estimate]


@dataclass(frozen=True)
class Evaluation:
    """Scores of policies on splits. `step`: the number of interactions of the trained policy.

    `unchanged`: for each split, the number of worlds in which all policies got the same return, if there are several.
    `seen`: for each split except the training split.
    """

    task: str
    step: int | None
    deterministic: bool
    seed: int
    scores: tuple[Score, ...]
    unchanged: Mapping[str, int]
    seen: Mapping[str, Seen]

    def as_json(self) -> dict[str, Any]:
        """The evaluation as plain values, for JSON: scores by split and policy."""
        data = asdict(self)
        splits: dict[str, dict[str, Any]] = {}
        for score in data.pop("scores"):
            splits.setdefault(score.pop("split"), {})[score.pop("policy")] = score
        return {**data, "splits": splits}


def play(
    program: TaskProgram,
    policy: Policy | ExpertPlayer | None,
    worlds: Tensor,
    *,
    observation: str = "ids",
    numbers: Tensor | None = None,
    seed: int = 0,
    recorder: Film | None = None,
) -> Played:
    """One episode in each of some worlds.

    Args:
        policy: an expert sees the episodes themselves. None: the worlds run without an agent.
        worlds: numbers of worlds, int64 [n]. numbers: numbers of the episodes, int64 [n], which with `seed` determine a
            policy's random numbers; by default 0, 1, ….
        recorder: receives all worlds and actions.
    """
    numbers = torch.arange(len(worlds)) if numbers is None else numbers
    if program.is_mixed:  # one ruleset after another
        how: dict[str, Any] = {"observation": observation, "seed": seed}
        rulesets = [*program.apart(worlds)]
        parts = [play(own, policy, worlds[at], numbers=numbers[at], **how) for at, own in rulesets]
        order = torch.cat([at for at, _ in rulesets]).argsort()
        return Played(*(torch.cat(part)[order] for part in zip(*parts, strict=True)))
    if isinstance(policy, ExpertPlayer):
        policy = policy.under(program.ruleset or 0)
    sight = observation_of(observation, program)
    episodes = program.start(worlds)
    device = episodes.seed.device
    numbers = numbers.to(device)
    returns = torch.zeros(len(worlds), dtype=torch.float64, device=device)
    lengths, going = torch.zeros_like(episodes.seed), torch.ones_like(episodes.failed)
    succeeded = torch.zeros_like(going)
    if recorder is not None:
        recorder.begin(episodes)
    stack = FrameStack(getattr(policy, "frames", 1))
    for step in range(program.task.agent.actions):
        keys = action_keys(seed, numbers, step)
        actions = None
        if isinstance(policy, ExpertPlayer):
            actions = policy(episodes)
        elif policy is not None:
            actions = policy(stack.push(sight.of(episodes)), keys)
        seen = None
        if recorder is not None:
            seen, recorder.actions = recorder.see, actions
        # Finished episodes continue to run, but are ignored.
        episodes, reward, success, over = program.act(episodes, actions, reuse=seen is None, seen=seen)
        returns += torch.where(going, reward.double(), 0.0)
        lengths += going
        succeeded |= success & going
        going = going & ~over
        if recorder is not None:
            recorder.acted(returns, ~going)
        if not bool(going.any()):
            break
    return Played(returns.cpu(), lengths.cpu(), succeeded.cpu())


def evaluate(
    run_or_task: RunFolder | Task | str | Path,
    *,
    splits: Sequence[str] | None = None,
    policies: Sequence[str] | None = None,
    episodes: int = 256,
    deterministic: bool = False,
    seed: int = 0,
    backend: str | None = None,
    device: str | None = None,
    packs: Sequence[str] = (),
) -> Evaluation:
    """Play policies on splits; for a run, write ``evaluation.json`` into its folder.

    Episode i is played in world i of a split, by all policies; in the run's own split in world i mod the number of
    worlds that it trained on.

    Args:
        run_or_task: a run, its path or its name; or a `Task`, which has no trained policy.
        splits: names of splits; by default, all splits of the task.
        policies: some of ``trained``, ``expert``, ``random``, ``nothing``. By default, all available ones except an
            expert that searches, which is slow.
        episodes: the number of episodes on each split.
        deterministic: the trained policy takes the most likely action instead of sampling one.
        seed: seed of the policies' random numbers.
        backend: by default, that of the run.
        device: by default, that of the run.
        packs: names or files of packs to add to the rules of a run's task.

    Returns:
        The mean return of each policy on each split with its 95 % interval, lengths of episodes, and rates of success.

    Raises:
        CompileError: PD620 if there is no such run, PD801 if there is no such split.
        ValueError: another argument is wrong.
    """
    run, config, task = subject(run_or_task, packs)
    names = [split.name for split in task.splits] if splits is None else list(dict.fromkeys(splits))
    for name in names:
        check_split(task, name)
    if episodes < 1 or not names:
        raise ValueError("an evaluation needs at least one episode and one split")
    chosen = chosen_policies(policies, task, trained=run is not None)
    backend, device = backend or config.backend, device or config.device
    first = compile_task(task, split=names[0], backend=backend, device=device, threads=config.threads)
    players = {name: player(name, first, run, deterministic=deterministic) for name in chosen}
    trained = players.get("trained")
    step = trained.step if isinstance(trained, TrainedPolicy) else None
    own = TaskProgram(task, config.split, first.simulator, rulesets=config.rulesets)
    training_worlds = torch.arange(min(TRAINING_STARTS, config.worlds))
    training = set() if own.is_mixed else {*_starts(own, training_worlds)}
    scores: list[Score] = []
    unchanged: dict[str, int] = {}
    seen: dict[str, Seen] = {}
    for name in names:
        program = own if name == own.split else TaskProgram(task, name, first.simulator)
        count = config.worlds if run is not None and name == config.split else episodes
        worlds = torch.arange(episodes) % count
        if "expert" in chosen:
            players["expert"] = ExpertPlayer(program)
        played = {
            name: _play_all(program, players[name], worlds, config.observation, seed) for name in chosen
        }
        if len(chosen) > 1:
            returns = torch.stack([play.returns for play in played.values()])
            unchanged[name] = int((returns == returns[0]).all(0).sum())
        if name != config.split:
            if own.is_mixed:  # only worlds under rules of both splits can be equal
                both = torch.tensor([rules in program.rulesets for rules in own.rulesets])
                training = {*_starts(own, training_worlds[both[own.ruleset_of(training_worlds)]])}
            new = torch.tensor([start not in training for start in _starts(program, worlds)])
            others = played if bool(new.any()) else {}
            without = {name: mean_and_interval(of.returns[new].tolist()) for name, of in others.items()}
            seen[name] = Seen(int((~new).sum()), without)
        scores += [_score(name, policy, played, task) for policy in chosen]
    evaluation = Evaluation(task.name, step, deterministic, seed, tuple(scores), unchanged, seen)
    if run is not None:
        write_json(run.path / EVALUATION, evaluation.as_json())
    return evaluation


def subject(
    run_or_task: RunFolder | Task | str | Path, packs: Sequence[str] = ()
) -> tuple[RunFolder | None, TrainConfig, Task]:
    """A run, its settings, and its task with some packs added; a task has no run. Raises CompileError."""
    if isinstance(run_or_task, Task):
        return None, TrainConfig(run_or_task.name), run_or_task
    run = find_run(run_or_task, "ppo")
    return run, config_of(run), task_of(run, packs)


def player(
    name: str, program: TaskProgram, run: RunFolder | None = None, *, deterministic: bool = False
) -> Policy | ExpertPlayer | None:
    """The policy with a name among POLICIES; None does nothing. Raises CompileError as `load_policy`.

    `run`: the run of the trained policy. `deterministic`: it takes the most likely action.
    """
    if name == "trained" and run is not None:
        env = environment(program, 1, observation=config_of(run).observation)
        return load_policy(run, env, deterministic=deterministic)
    if name == "expert":
        return ExpertPlayer(program)
    return random_policy(program.action_nvec) if name == "random" else None


def _play_all(
    program: TaskProgram, policy: Policy | ExpertPlayer | None, worlds: Tensor, observation: str, seed: int
) -> Played:
    kind = observation if policy is not None else "ids"
    parts = [
        play(program, policy, worlds[numbers], observation=kind, numbers=numbers, seed=seed)
        for numbers in torch.arange(len(worlds)).split(BATCH)
    ]
    return Played(*map(torch.cat, zip(*parts, strict=True)))


def _starts(program: TaskProgram, worlds: Tensor) -> list[bytes]:
    """Digests of start worlds: elements, fields and laws."""
    digests = []
    if program.is_mixed:
        for world, number in zip(worlds[:, None], program.ruleset_of(worlds).tolist(), strict=True):
            rules = "+".join(program.rulesets[number]).encode()
            digests += [rules + digest for digest in _starts(program.under(number), world)]
        return digests
    for part in worlds.split(BATCH):
        episodes = program.start(part)
        parts = (*episodes.world.state.values(), *episodes.params.values())
        state = [value.cpu().numpy() for value in parts]
        digests += [sha256(b"".join(map(bytes, rows))).digest() for rows in zip(*state, strict=True)]
    return digests


def _score(split: str, policy: str, all_played: Mapping[str, Played], task: Task) -> Score:
    played = all_played[policy]
    above = {
        other: mean_and_interval((played.returns - all_played[other].returns).tolist())
        for other in BASELINES
        if other != policy and other in all_played
    }
    normalized = None
    if {"expert", "nothing"} <= all_played.keys():
        nothing = all_played["nothing"].returns
        normalized = _ratio(played.returns - nothing, all_played["expert"].returns - nothing)
    success = float(played.success.double().mean()) if task.goal.success is not None else None
    length = float(played.lengths.double().mean())
    returns = mean_and_interval(played.returns.tolist())
    episodes = len(played.returns)
    return Score(split, policy, episodes, returns.mean, returns.interval, success, length, above, normalized)


def _ratio(values: Tensor, scale: Tensor) -> Estimate | None:
    """The ratio of two means of the same worlds, and half of its 95 % interval; None unless the second is positive."""
    whole = float(scale.mean())
    if whole <= 0:
        return None
    ratio = float(values.mean()) / whole
    _, half = mean_and_interval((values - ratio * scale).tolist())
    return Estimate(ratio, None if half is None else half / whole)


# Videos: worlds side by side, with regions, actions, and the return so far


LINE = 14
"""Pixels below each world, for the return."""

HAND = (0, 0, 0)
INK = (235, 235, 235)
PAPER = (30, 30, 30)


class FilmScene(NamedTuple):
    """All worlds between two steps: `ids` uint8 [B, H, W]; `fields` [B, H, W] or of vectors [B, 2, H, W], those that
    pictures show; `actions` int64 [B, 5] or None before the first and where nobody acts; `returns`
    float64 [B] before them; `over` bool [B]."""

    ids: NDArray[np.uint8]
    fields: dict[str, NDArray[Any]]
    actions: Tensor | None
    returns: Tensor
    over: Tensor


def film(
    program: TaskProgram,
    policy: Policy | ExpertPlayer | None,
    worlds: Tensor,
    *,
    observation: str = "ids",
    seed: int = 0,
    factor: int = 4,
) -> tuple[Played, Iterator[NDArray[np.uint8]]]:
    """Play worlds, int64 [n], as `rl.evaluation.play` does; return the results and the pictures, uint8 [H', W', 3].

    There is a picture of the start, and one after each action and each step, free steps included. Worlds whose
    episode is over no longer change.
    """
    if not program.is_mixed:
        recorder = Film(program.task, len(worlds), factor)
        played = play(program, policy, worlds, observation=observation, seed=seed, recorder=recorder)
        return played, recorder.pictures()
    parts, films = [], []
    for number, ruleset in enumerate(program.ruleset_of(worlds).tolist()):
        own, place = program.under(ruleset), torch.tensor([number])
        recorder = Film(own.task, 1, factor)
        how: dict[str, Any] = {"observation": observation, "seed": seed, "recorder": recorder}
        parts.append(play(own, policy, worlds[place], numbers=place, **how))
        films.append(list(recorder.pictures()))
    longest = max(map(len, films))
    scenes = zip(*([*film, *[film[-1]] * (longest - len(film))] for film in films), strict=True)
    columns = min(4, len(films))
    pictures = (contact_sheet([*scene], columns=columns) for scene in scenes)
    return Played(*map(torch.cat, zip(*parts, strict=True))), pictures


class Film:
    """Stores the scenes of `play`, and draws them with cells of `factor`² pixels."""

    def __init__(self, task: Task, count: int, factor: int) -> None:
        self.task, self.factor = task, factor
        self.regions: dict[str, NDArray[np.bool_]] = {}
        self.scenes: list[FilmScene] = []
        self.actions: Tensor | None = None
        """The actions that lead to the following scenes."""
        self._returns = torch.zeros(count, dtype=torch.float64)
        self._over = torch.zeros(count, dtype=torch.bool)
        self._fields = shown_fields(task.ruleset)
        self._looks, self._font = looks(task.ruleset.elements, task.ruleset.fields), ImageFont.load_default()

    def begin(self, episodes: Episodes) -> None:
        """Record the worlds at their start."""
        self.regions = {name: value.cpu().numpy() for name, value in episodes.regions.items()}
        self.see(episodes.world)

    def see(self, world: World) -> None:
        """Record the worlds after an action or a step."""
        fields = {name: world[name].cpu().numpy().copy() for name in self._fields}
        ids = world.ids.cpu().numpy().copy()
        self.scenes.append(FilmScene(ids, fields, self.actions, self._returns, self._over))

    def acted(self, returns: Tensor, over: Tensor) -> None:
        """Add the returns and ends of episodes to the last scene and to those that follow."""
        self._returns, self._over = returns.cpu().clone(), over.cpu().clone()
        self.scenes[-1] = self.scenes[-1]._replace(returns=self._returns, over=self._over)

    def pictures(self) -> Iterator[NDArray[np.uint8]]:
        """A picture of each scene, all worlds side by side."""
        over: dict[int, NDArray[np.uint8]] = {}
        columns = min(4, len(self._over))
        for scene in self.scenes:
            tiles = []
            for world in range(len(scene.ids)):
                tile = over[world] if world in over else self._tile(scene, world)
                if scene.over[world]:
                    over[world] = tile
                tiles.append(tile)
            yield contact_sheet(tiles, columns=columns)

    def _tile(self, scene: FilmScene, world: int) -> NDArray[np.uint8]:
        """One world, uint8 [H·factor + LINE, W·factor, 3]."""
        task, factor = self.task, self.factor
        fields = {name: values[world] for name, values in scene.fields.items()}
        picture = np.array(scale(rgb(scene.ids[world], fields=fields, **self._looks), factor))
        for number, masks in enumerate(self.regions.values()):
            outline(picture, masks[world % len(masks)], factor, OUTLINES[number % len(OUTLINES)])
        words = ""
        if scene.actions is not None:
            action = scene.actions[world].cpu()
            choice, *blow = action[2:].tolist()
            words = _words(task, choice, blow)
            if words:
                block = cells_of(task.agent, task.size, action[1:2], action[:1])[0]
                outline(picture, block.numpy(), factor, HAND)
        image = Image.new("RGB", (picture.shape[1], picture.shape[0] + LINE), PAPER)
        image.paste(Image.fromarray(picture), (0, 0))
        mark = "over" if scene.over[world] else words
        text = f"{float(scene.returns[world]):.2f}  {mark}"
        ImageDraw.Draw(image).text((2, picture.shape[0] + 1), text, fill=INK, font=self._font)
        return np.array(image)


def _words(task: Task, choice: int, blow: list[int]) -> str:
    """An action in a word or two; an empty string if it changes nothing."""
    number = task.agent.choices[choice]
    if number >= 0:
        return next(element.name for element in task.ruleset.elements if element.id == number)
    if number != BLOW:
        return ""
    parts = ("left", "", "right")[blow[0]], ("up", "", "down")[blow[1]]
    return "blow " + (" ".join(part for part in parts if part) or "still")
