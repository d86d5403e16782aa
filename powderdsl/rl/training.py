"""Stable-Baselines3's PPO in a run folder. A killed run resumes with the same result.

Everything that later rollouts depend on is saved between two rollouts: the policy and its optimizer, the worlds, all
random numbers. Files are read with ``weights_only``: networks are built from the settings, so loading executes nothing.
"""

from __future__ import annotations

import ctypes
import random
import sys
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from copy import deepcopy
from functools import partial
from itertools import accumulate
from pathlib import Path
from statistics import fmean
from typing import Any, cast

import numpy as np
import torch
from gymnasium.spaces import Box
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack, VecNormalize
from torch.distributions import Distribution

from powderdsl.compiler import whole_palette
from powderdsl.datasets.dataset import Dataset, Transitions, drawn
from powderdsl.datasets.recorder import record
from powderdsl.envs.curriculum import Prioritized
from powderdsl.envs.features import Patches
from powderdsl.envs.sb3 import PowderVecEnv
from powderdsl.envs.tensor_env import channels_of, check_cells
from powderdsl.experiments.runs import (
    Metrics,
    RunFolder,
    lock_folder,
    mean_and_interval,
    open_run,
    reporting_misfits,
    write_json,
)
from powderdsl.rl.config import TrainConfig, check_task, from_json
from powderdsl.rl.evaluation import play
from powderdsl.rl.policies import TrainedPolicy, compute_in, policy_of
from powderdsl.simulation.observe import Observer
from powderdsl.system.settings import fingerprint
from powderdsl.system.writing import failure
from powderdsl.tasks.episodes import TaskProgram, compile_task
from powderdsl.tasks.shipped import load_task

KIND = "ppo"
ASKED = "asked.json"
"""The settings of the latest call, including those that may change."""
SPEED = "speed.json"
"""The interactions and seconds of the latest call, and how the seconds were spent."""
DEMONSTRATIONS = "demonstrations"
"""The dataset of `init_expert`."""
CLONING_RATE, CLONING_BATCH = 3e-3, 256
"""Adam's learning rate, and the minibatch size, in behavior cloning."""

Progress = Callable[[int, float | None], None]
"""Called after every action with the interactions so far, and the mean return of the last 100 episodes."""


def train(config: TrainConfig, folder: str | Path, *, progress: Progress | None = None) -> RunFolder:
    """Train until `config.steps` interactions are reached.

    A run ends with the first complete rollout that reaches `steps`. On a CPU, interrupting and resuming a run, or
    raising its `steps`, gives the same weights, bit for bit, as an uninterrupted run.

    Args:
        config: the settings.
        folder: the folder of a new run, or of the run to resume.
        progress: called after every action with the interactions so far, and the mean return of the last 100 episodes.

    Returns:
        The folder of the run, with its checkpoints and metrics.

    Raises:
        CompileError: PD640 with all mistakes in settings; the errors of `load_task`; PD621 if the folder contains
            another run; PD622 if another process trains there.
        KeyboardInterrupt: after saving the state before the current rollout.
    """
    from_json(config.as_json())  # check settings that were created without `preset`
    how: dict[str, Any] = {name: getattr(config, name) for name in ("knobs", "params", "packs")}
    used = whole_palette(*load_task(config.task, **how).rules)
    palette = (*used, *[None] * (config.slots - len(used)))  # slots for the rules, and free ones
    task = load_task(config.task, **how, palette=palette)
    check_task(config, task)
    trained_on = task.with_shaped_reward() if config.reward == "shaped" else task
    try:
        check_cells(config.envs, task.size)
    except ValueError as error:
        raise failure("PD640", f"`envs`: {error}") from None
    plain = {
        **config.identity,
        "task_fingerprint": fingerprint(task),
        "palette": palette,
        "channels": channels_of(config.observation, Observer(task.ruleset, torch.device("cpu"))),
    }
    if trained_on is not task:
        plain["shaped_fingerprint"] = fingerprint(trained_on)
    half = config.precision == "bfloat16" and config.device == "cpu"
    if half and not torch.cpu._is_avx512_bf16_supported():
        raise failure("PD640", "`precision`: this processor does not support bfloat16")
    run = open_run(folder, KIND, plain)
    with lock_folder(run.path), _own_random_numbers(config.threads):
        write_json(run.path / ASKED, config.as_json())
        checkpoint = run.latest_checkpoint()
        step = 0 if checkpoint is None else checkpoint.step
        if step >= config.steps:
            return run
        program = compile_task(
            trained_on,
            split=config.split,
            backend=config.backend,
            device=config.device,
            threads=config.threads,
            rulesets=config.rulesets,
        )
        learner = _Learner(config, program)
        with Metrics(run.path, step) as metrics:
            learner.model.set_logger(Logger(None, [_MetricsWriter(metrics)]))
            if checkpoint is not None:
                with reporting_misfits(checkpoint.path, "its state belongs to another run"):
                    learner.restore(checkpoint.state)
            elif config.init_from or config.init_expert:
                _clone(learner, run, config, metrics)
            held_out = None
            if config.eval_every:
                held_out = TaskProgram(task, config.eval_split, program.simulator)
            played = -1 if checkpoint is None else step
            keeper = _Keeper(run, learner, metrics, progress, held_out, played)
            began = time.perf_counter()
            try:
                learner.model.learn(config.steps - step, keeper, reset_num_timesteps=checkpoint is None)
            except KeyboardInterrupt:
                # The state before the current rollout, unless it has been saved.
                if keeper.latest is not None and keeper.latest[0]:
                    run.save_checkpoint(*keeper.latest)
                raise
            passed = {"interactions": learner.step - step, "seconds": time.perf_counter() - began}
            write_json(run.path / SPEED, {**passed, **learner.seconds})
            keeper.play_held_out(learner.step)
            run.save_checkpoint(learner.step, learner.state())
    return run


class _Rollout(RolloutBuffer):
    """A rollout. If `see` is given, it stores that network's counts of observations once for all epochs."""

    def __init__(self, size: int, space: Any, *rest: Any, see: Patches | None, **how: Any):
        self.see = see
        if see is not None:
            cells = round(
                1 / float(see.get_buffer("share").min())
            )  # the number of cells of the largest patch
            space = Box(0, cells, (*see.patches, see.elements), np.uint8 if cells < 256 else np.int32)
        super().__init__(size, space, *rest, **how)

    def add(self, obs: Any, *rest: Any) -> None:
        """Add an action in every world, with its observation and results."""
        if self.see is not None:
            obs = self.see.count(torch.as_tensor(obs, device=self.device)).cpu().numpy()
        super().add(obs, *rest)

    def scores(self, worlds: Any) -> tuple[torch.Tensor, torch.Tensor]:
        """The worlds of episodes, int64 [n], and the mean positive advantage in each, float64 [n].

        `worlds`: of all observations, int64 [steps, envs].
        """
        part = self.episode_starts.cumsum(0).astype(np.int64) + np.arange(self.n_envs) * (
            self.buffer_size + 1
        )
        _, first, episode = np.unique(part, return_index=True, return_inverse=True)
        gains = np.bincount(episode.ravel(), np.maximum(self.advantages, 0).ravel())
        return torch.from_numpy(worlds.ravel()[first]), torch.from_numpy(gains / np.bincount(episode.ravel()))


class _Learner:
    """The PPO of a run, and its environment, possibly with stacked observations and normalized rewards."""

    def __init__(self, config: TrainConfig, program: TaskProgram):
        self.config = config
        self.curriculum = Prioritized() if config.curriculum == "prioritized" else None
        self.shown: list[Any] = []
        """The worlds of the observations of a rollout, int64 [envs] each, for a curriculum."""
        self.worlds = PowderVecEnv(
            program,
            config.envs,
            observation=config.observation,
            worlds=config.worlds,
            actions="full",
            curriculum=self.curriculum,
        )
        env: VecEnv = self.worlds
        self.stack = self.normal = None
        if config.frames > 1:
            env = self.stack = VecFrameStack(env, config.frames, channels_order="first")
        if config.normalize in ("reward", "both"):
            env = self.normal = VecNormalize(env, norm_obs=False, gamma=config.gamma)
        kind, how = policy_of(config, self.worlds.tensors)
        see = (how if "see" in how else how["features_extractor_kwargs"])["see"]
        with warnings.catch_warnings():
            # If batches do not divide a rollout, the last one of an epoch is smaller, which is fine.
            warnings.filterwarnings("ignore", "You have specified a mini-batch size", UserWarning)
            self.model = PPO(
                kind,
                env,
                learning_rate=_rate(config),
                n_steps=config.rollout,
                batch_size=config.batch,
                n_epochs=config.epochs,
                gamma=config.gamma,
                gae_lambda=config.gae_lambda,
                clip_range=config.clip,
                ent_coef=config.entropy,
                vf_coef=config.vf_coef,
                max_grad_norm=config.max_grad_norm,
                target_kl=config.target_kl or None,
                normalize_advantage=config.normalize in ("advantage", "both"),
                policy_kwargs=how,
                rollout_buffer_class=_Rollout,
                rollout_buffer_kwargs={"see": see if isinstance(see, Patches) and see.one_channel else None},
                device=config.device,
                seed=config.seed,
            )

        compute_in(config.precision, self.model.policy)
        self.seconds = {"env": 0.0, "policy": 0.0, "update": 0.0}
        methods = (self.worlds, "step_wait"), (self.model.policy, "forward"), (self.model, "train")
        for part, (owner, name) in zip(self.seconds, methods, strict=True):
            setattr(owner, name, partial(self._timed, part, getattr(owner, name)))

    def _timed(self, part: str, method: Callable[..., Any], *arguments: Any) -> Any:
        if self.curriculum is not None and part == "env":
            self.shown.append(self.worlds.tensors.episodes.seed.numpy().copy())  # type: ignore[union-attr]  # begun
        if self.curriculum is not None and part == "update":
            buffer = cast(_Rollout, self.model.rollout_buffer)
            self.curriculum.learn(*buffer.scores(np.stack(self.shown)))
            self.shown = []
        began = time.perf_counter()
        result = method(*arguments)
        self.seconds[part] += time.perf_counter() - began
        return result

    @property
    def step(self) -> int:
        """The interactions so far."""
        return self.model.num_timesteps

    def state(self) -> dict[str, Any]:
        """Everything that later training depends on, without copies of the model's tensors."""
        model = self.model
        state = {
            "policy": model.policy.state_dict(),
            "optimizer": model.policy.optimizer.state_dict(),
            "env": self.worlds.state(),
            "starts": torch.as_tensor(np.asarray(model._last_episode_starts)),
            "episodes": [[episode[key] for key in "rlt"] for episode in model.ep_info_buffer or ()],
            "successes": [bool(success) for success in model.ep_success_buffer or ()],
            "updates": model._n_updates,
            # Logged values of the update, which are shown after the next rollout.
            "logged": _numbers(model.logger.name_to_value),
            "steps": self.step,
            "random": _random_state(),
        }
        if self.curriculum is not None:
            state["curriculum"] = self.curriculum.state()
        if self.stack is not None:
            state["frames"] = torch.from_numpy(self.stack.stacked_obs.stacked_obs.copy())
        if self.normal is not None:
            spread = self.normal.ret_rms
            state["rewards"] = [float(spread.mean), float(spread.var), float(spread.count)]
            state["returns"] = torch.from_numpy(self.normal.returns.copy())
        return state

    def restore(self, state: Mapping[str, Any]) -> None:
        model = self.model
        model.policy.load_state_dict(state["policy"])
        if self.curriculum is not None:
            self.curriculum.restore(state["curriculum"])
        model.policy.optimizer.load_state_dict(state["optimizer"])
        model._last_obs = self.worlds.restore(state["env"])
        if self.stack is not None:
            self.stack.stacked_obs.stacked_obs[...] = state["frames"].numpy()
            model._last_obs = self.stack.stacked_obs.stacked_obs.copy()
        if self.normal is not None:
            spread: Any = self.normal.ret_rms
            spread.mean, spread.var, spread.count = (np.float64(value) for value in state["rewards"])
            self.normal.returns[...] = state["returns"].numpy()
        model._last_episode_starts = state["starts"].numpy()
        size = model._stats_window_size
        episodes = (dict(zip("rlt", values, strict=True)) for values in state["episodes"])
        model.ep_info_buffer = deque(episodes, maxlen=size)
        model.ep_success_buffer = deque(state["successes"], maxlen=size)
        model._n_updates, model.num_timesteps = state["updates"], state["steps"]
        for name, value in state["logged"].items():
            model.logger.record(name, value)
        _set_random_state(state["random"])


def _rate(config: TrainConfig) -> float | Callable[[float], float]:
    """The learning rate, or its schedule as a function of the share of `steps` left after a rollout.

    It falls linearly over the updates: the first of n has the full rate, the last 1/n of it. The share left cannot be
    used directly, since it is negative if the last rollout exceeds `steps`.
    """
    if config.schedule == "constant":
        return config.learning_rate
    rollout = config.envs * config.rollout
    updates = -(-config.steps // rollout)

    def rate(left: float) -> float:
        done = round((1 - left) * config.steps / rollout) - 1
        return config.learning_rate * (1 - max(done, 0) / updates)

    return rate


def _clone(learner: _Learner, run: RunFolder, config: TrainConfig, metrics: Metrics) -> None:
    """Behavior cloning from `config.init_from` or the task's expert. Its results are metrics of the run at step 0."""
    env, folder = learner.worlds.tensors, Path(config.init_from)
    if config.init_expert:
        folder = run.path / DEMONSTRATIONS
        record(
            env.program,
            "expert",
            folder,
            episodes=config.init_expert,
            seed=config.seed * config.init_expert,
            observation=config.observation,
            compress=True,
            envs=config.envs,
            worlds=config.worlds,
        )
    dataset = Dataset.open(folder)
    dataset.require(env)
    metrics.write(0, {"clone/loss": clone(learner.model.policy, dataset, config)})


def clone(policy: ActorCriticPolicy, dataset: Dataset, config: TrainConfig) -> float:
    """Behavior cloning: fit a policy to the actions of a dataset, and its values to the discounted returns.

    It draws `config.init_epochs` times the number of transitions, depending only on `config.seed`. The learning rate
    falls to zero. Returns the mean loss of the actions over the last hundred updates.
    """
    rows, returns = Transitions(dataset), _returns(dataset, config.gamma)
    updates = max(1, config.init_epochs * len(rows) // CLONING_BATCH)
    spread = max(float(returns.var()), 1e-6)  # so that values do not outweigh actions
    optimizer = torch.optim.Adam(policy.parameters(), lr=CLONING_RATE)
    rate = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda number: 1 - number / updates)
    policy.set_training_mode(True)
    losses = []
    for number in range(updates):
        numbers = drawn(config.seed, number, CLONING_BATCH, len(rows))
        batch = rows[numbers]
        observed = batch.observation.to(policy.device)
        actions = batch.action.long().to(policy.device)
        targets = torch.from_numpy(returns[numbers]).to(policy.device)
        values, likelihood, _ = policy.evaluate_actions(observed, actions)
        error = (values.flatten() - targets).square().mean()
        loss = -likelihood.mean() + config.vf_coef * error / spread
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(policy.parameters(), config.max_grad_norm)
        optimizer.step()
        rate.step()
        losses.append(-float(likelihood.detach().mean()))
    policy.set_training_mode(False)
    return fmean(losses[-100:])


def _returns(dataset: Dataset, gamma: float) -> NDArray[np.float32]:
    """The discounted return from each transition onward, float32 [transitions], in the order of the dataset."""
    parts = []
    for number in range(len(dataset)):
        reward = dataset.episode(number).reward.double().numpy()
        returns = [*accumulate(reward[::-1], lambda later, now: now + gamma * later)]
        parts.append(np.asarray(returns[::-1], np.float32))
    return np.concatenate(parts)


class _Keeper(BaseCallback):
    """Between rollouts, saves the state or keeps it in memory, and plays the policy in held-out worlds.

    Training does not depend on these worlds, whose return is the metric ``held_out/return``. `played` is the number of
    interactions at the last evaluation; -1 for a new run.
    """

    def __init__(
        self,
        run: RunFolder,
        learner: _Learner,
        metrics: Metrics,
        progress: Progress | None,
        held_out: TaskProgram | None,
        played: int,
    ):
        super().__init__()
        self.run, self.learner, self.metrics, self.progress = run, learner, metrics, progress
        self.held_out, self.played = held_out, played
        self.saved_at = time.monotonic()
        self.latest: tuple[int, dict[str, Any]] | None = None
        self.mean: float | None = None

    def _on_rollout_start(self) -> None:
        step, state = self.learner.step, self.learner.state()
        self.play_held_out(step)
        if step and time.monotonic() - self.saved_at >= 60 * self.learner.config.checkpoint_minutes:
            self.run.save_checkpoint(step, state)
            self.saved_at, self.latest = time.monotonic(), None
        else:
            self.latest = step, deepcopy(state)
        recent = [episode["r"] for episode in self.learner.model.ep_info_buffer or ()]
        self.mean = sum(recent) / len(recent) if recent else None

    def _on_step(self) -> bool:
        if self.progress is not None:
            self.progress(self.learner.step, self.mean)
        return True

    def play_held_out(self, step: int) -> None:
        """Play if a multiple of `eval_every` is in the last rollout, and before the first rollout."""
        config, policy = self.learner.config, self.learner.model.policy
        before, played = step - config.rollout * config.envs, self.played
        self.played = step
        if self.held_out is None or step <= played:
            return
        if step and step // config.eval_every <= before // config.eval_every:
            return
        channels = len(self.learner.worlds.tensors.observation.channels)
        trained = TrainedPolicy(policy, config.observation, channels, step, frames=config.frames)
        policy.set_training_mode(False)
        worlds = torch.arange(config.eval_episodes)
        returns = play(self.held_out, trained, worlds, observation=config.observation).returns
        mean, half = mean_and_interval(returns.tolist())
        interval = {} if half is None else {"held_out/interval": half}
        self.metrics.write(step, {"held_out/return": mean, **interval})


class _MetricsWriter(KVWriter):
    """Writes the log of Stable-Baselines3 as metrics of the run."""

    def __init__(self, metrics: Metrics):
        self.metrics = metrics

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, Any], step: int = 0) -> None:
        self.metrics.write(step, _numbers(key_values))


def _numbers(values: Mapping[str, Any]) -> dict[str, float]:
    """The values that are numbers: Python's or NumPy's."""
    kinds = int | float | np.number
    return {name: float(value) for name, value in values.items() if isinstance(value, kinds)}


# Random numbers


def _random_state() -> dict[str, Any]:
    """The global generators, which Stable-Baselines3 draws from."""
    name, keys, *rest = np.random.get_state(legacy=True)
    state = {
        "python": random.getstate(),
        "numpy": [name, torch.from_numpy(np.asarray(keys).astype(np.int64)), *rest],
        "torch": torch.get_rng_state(),
    }
    if torch.cuda.is_available() and torch.cuda.is_initialized():
        state["cuda"] = torch.cuda.get_rng_state_all()
    return state


def _set_random_state(state: Mapping[str, Any]) -> None:
    random.setstate(state["python"])
    name, keys, *rest = state["numpy"]
    np.random.set_state((name, keys.numpy().astype(np.uint32), *rest))
    torch.set_rng_state(state["torch"])
    # A run may resume on other devices.
    if torch.cuda.is_available() and len(state.get("cuda", ())) == torch.cuda.device_count():
        torch.cuda.set_rng_state_all(state["cuda"])


@contextmanager
def _own_random_numbers(threads: int) -> Iterator[None]:
    """Restore the caller's generators and number of threads at the end. Until then, distributions skip validation."""
    before, used, checks = _random_state(), torch.get_num_threads(), Distribution._validate_args
    torch.set_num_threads(threads)
    Distribution.set_default_validate_args(False)
    _keep_memory(1 << 30)
    try:
        yield
    finally:
        _keep_memory(1 << 25)
        Distribution.set_default_validate_args(checks)
        torch.set_num_threads(used)
        _set_random_state(before)


def _keep_memory(size: int) -> None:
    """Let glibc keep this many free bytes: each update needs tensors of the same size, and new pages are slow."""
    library: Any = ctypes.CDLL(None) if sys.platform == "linux" else None
    for parameter in (-1, -3) if hasattr(library, "mallopt") else ():  # M_TRIM_THRESHOLD, M_MMAP_THRESHOLD
        library.mallopt(parameter, size)
