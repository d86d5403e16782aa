"""The settings of a training run, as one frozen, checked value that converts to JSON. Does not need torch."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from powderdsl.compiler import BACKENDS
from powderdsl.diagnostics import CompileError, Diagnostic, Label, with_suggestion
from powderdsl.system.settings import read_record, setting
from powderdsl.tasks.shipped import check_split

if TYPE_CHECKING:
    from powderdsl.tasks.task import Task

OBSERVATIONS = ("compact", "ids", "matrix", "laws")
USUAL_OBSERVATION = MappingProxyType({"paper": "compact", "small": "ids", "fcn": "ids"})
"""The networks, with the default observation of each."""

POLICIES = ("trained", "expert", "random", "nothing")
"""Policies to compare. `trained` needs a run; `expert` needs a task that has one."""
BASELINES = ("random", "nothing")
"""Baselines, with which other policies are compared in the same worlds."""


@dataclass(frozen=True)
class TrainConfig:
    """Settings of a PPO run. The defaults are the paper's, or Stable-Baselines3's if the paper gives none."""

    task: str
    """A shipped task's name, or a file's path."""
    split: str = setting("train", "Split: the set of worlds.  [default: train]", form="a name")
    knobs: Mapping[str, int] = setting(dict)
    params: Mapping[str, Any] = setting(dict)
    """Parameters of the rules: numbers, or text such as ``5%``."""
    packs: tuple[str, ...] = setting(())
    """Packs to add to the task's rules, by name or file."""
    slots: int = setting(0, "Number of element slots, to leave room for packs added later.", 0, 256)
    curriculum: str = setting(
        "uniform",
        "Choice of training worlds: uniform, or prioritized level replay.",
        choices=("uniform", "prioritized"),
    )
    worlds: int = setting(1_000_000, "Number of worlds to draw from.", 1, 2**62)
    rulesets: int = setting(0, "Use only the first N rulesets of the split; 0: all.", 0, 4096)
    observation: str = setting("compact", "Observation of the network.", choices=OBSERVATIONS)
    network: str = setting(
        "paper",
        "The paper's network, a small one, or a fully convolutional one.",
        choices=tuple(USUAL_OBSERVATION),
    )
    features: int = setting(256, "Width of the fully connected layers, or channels of `fcn`.", 1, 1 << 16)
    frames: int = setting(1, "Number of stacked observations.", 1, 16)
    reward: str = setting("task", "The task's reward, or its `shaped` one.", choices=("task", "shaped"))
    init_from: str = setting("", form="the folder of a dataset")
    """Dataset whose actions the network imitates first (behavior cloning)."""
    init_expert: int = setting(0, "Episodes of the task's expert to imitate first; 0: none.", 0, 1_000_000)
    init_epochs: int = setting(10, "Epochs of cloning over recorded actions.", 1, 100_000)
    envs: int = setting(32, "Number of parallel worlds.", 1, 1 << 20)
    rollout: int = setting(2048, "Actions per world between two updates.", 1, 1 << 20)
    batch: int = setting(256, "Minibatch size.", 2, 1 << 24)
    epochs: int = setting(10, "Passes over each rollout.", 1, 1000)
    learning_rate: float = setting(3e-4, "Of Adam.", 1e-9, 10.0)
    schedule: str = setting(
        "constant",
        "Learning rate schedule over `steps`: constant, or linear to zero.",
        choices=("constant", "linear"),
    )
    gamma: float = setting(0.99, "Discount factor.", 0.0, 1.0)
    gae_lambda: float = setting(0.95, "Lambda of generalized advantage estimation.", 0.0, 1.0)
    clip: float = setting(0.2, "PPO clip range.", 1e-6, 10.0)
    entropy: float = setting(0.0, "Entropy coefficient.", 0.0, 100.0)
    vf_coef: float = setting(0.5, "Coefficient of the value loss.", 0.0, 100.0)
    max_grad_norm: float = setting(0.5, "Maximum norm of gradients, which are clipped to it.", 1e-6, 1e6)
    target_kl: float = setting(0.0, "KL divergence that ends an update early; 0: none.", 0.0, 1e6)
    normalize: str = setting(
        "advantage", "What to normalize.", choices=("advantage", "reward", "both", "none")
    )
    precision: str = setting(
        "float32", "Precision of layers; weights are float32.", choices=("float32", "bfloat16")
    )
    seed: int = setting(0, "Seed of the worlds, the network and the actions.", 0, 2**32 - 1)
    steps: int = setting(
        1_000_000, "Interactions in all worlds together, such as 2e5.", 1, 10**12, may_change=True
    )
    """A run ends with the first complete rollout that reaches it."""
    backend: str = setting("auto", choices=tuple(BACKENDS), may_change=True)
    device: str = setting(
        "cpu", "A torch device: cpu, cuda, cuda:1.  [default: cpu]", form="a name", may_change=True
    )
    threads: int = setting(1, "CPU threads.  [default: 1]", 1, 1024, may_change=True)
    checkpoint_minutes: float = setting(
        2.0,
        "Minutes between checkpoints; 0: after each rollout.  [default: 2]",
        0.0,
        1e6,
        option="checkpoint-every",
        may_change=True,
    )
    """The work that may be lost if the process is killed."""
    eval_every: int = setting(
        0, "Interactions between evaluations on held-out worlds; 0: none.", 0, 10**12, may_change=True
    )
    eval_split: str = setting("test", "Split of the held-out worlds.", form="a name", may_change=True)
    eval_episodes: int = setting(64, "Number of held-out worlds.", 1, 1 << 20, may_change=True)

    def as_json(self) -> dict[str, Any]:
        """Return all settings as plain values, for JSON."""
        return asdict(self)

    @property
    def identity(self) -> dict[str, Any]:
        """The settings that determine the result: all except those of HOW, plus `steps` with a linear schedule."""
        settings = {name: value for name, value in self.as_json().items() if name not in HOW}
        if self.precision == "float32":
            del settings["precision"]  # missing in older runs
        return settings if self.schedule == "constant" else {**settings, "steps": self.steps}


HOW = tuple(field.name for field in fields(TrainConfig) if field.metadata.get("may_change"))
"""Settings that may change when a run is resumed, because they do not affect the result."""

PRESETS: Mapping[str, Mapping[str, Any]] = MappingProxyType(
    {
        "paper": {},
        "small": {
            "network": "small",
            "observation": "ids",
            "features": 128,
            "rollout": 128,
            "epochs": 2,
            "learning_rate": 1e-3,
            "entropy": 0.01,
            "steps": 200_000,
        },
        "fcn": {
            "network": "fcn",
            "observation": "ids",
            "features": 32,
            "rollout": 128,
            "epochs": 4,
            "learning_rate": 1e-3,
            "schedule": "linear",
            "entropy": 0.003,
            "gamma": 0.97,
            "target_kl": 0.03,
            "steps": 200_000,
        },
    }
)
"""``paper``: its network and settings. ``small``: a network and settings for a few minutes on one CPU core. ``fcn``: a
fully convolutional network with a score for each bin and operation."""


def preset(name: str, task: str, **changes: Any) -> TrainConfig:
    """Return the settings of a preset for a task, with changes.

    Args:
        name: one of `PRESETS`: ``paper``, ``small``, ``fcn``.
        task: name of a shipped task, or path of a task file.
        changes: fields of `TrainConfig`, which replace those of the preset.

    Raises:
        CompileError: PD640, with all mistakes at once.
    """
    problems = []
    if name not in PRESETS:
        problems.append(with_suggestion(f"there is no preset `{name}`", name, PRESETS, "presets"))
    values = {"task": task, **PRESETS.get(name, {}), **changes}
    # The default observation depends on the network.
    if "observation" not in changes and changes.get("network") in USUAL_OBSERVATION:
        values["observation"] = USUAL_OBSERVATION[changes["network"]]
    return from_json(values, problems)


def from_json(values: Mapping[str, Any], mistakes: Sequence[str] = ()) -> TrainConfig:
    """Read settings written by `TrainConfig.as_json`; missing ones get their defaults.

    Raises CompileError (PD640) with all mistakes in them, after those in `mistakes`.
    """
    problems = [*mistakes]
    config = read_record(TrainConfig, values, problems)
    if config is not None:
        problems += _contradictions(config)
    if config is None or problems:
        raise CompileError([_mistake(problem) for problem in problems])
    return config


def check_task(config: TrainConfig, task: Task) -> None:
    """Raise CompileError if a task lacks a split (PD801) or something else (PD640) that the settings need."""
    check_split(task, config.split)
    if config.eval_every:
        check_split(task, config.eval_split)
    wrong = []
    if config.reward == "shaped" and task.goal.shaped is None:
        wrong.append(_mistake(f"`reward`: the task {task.name} has no `shaped` reward"))
    if config.init_expert and task.expert is None:
        wrong.append(_mistake(f"`init_expert`: the task {task.name} has no expert"))
    if wrong:
        raise CompileError(wrong)


def chosen_policies(policies: Sequence[str] | None, task: Task, *, trained: bool) -> list[str]:
    """The policies to play, in the order of POLICIES. Raises ValueError.

    `policies`: some of POLICIES; None: all except an expert that searches. `trained`: there is a trained policy.
    """
    there = {"trained": trained, "expert": task.expert is not None}
    known = [policy for policy in POLICIES if there.get(policy, True)]
    slow = {"expert"} if task.expert is not None and task.expert.search else set()
    chosen = [policy for policy in known if (policy not in slow if policies is None else policy in policies)]
    unknown = [policy for policy in policies or () if policy not in known]
    if unknown or not chosen:
        raise ValueError(f"policies are {', '.join(known)}; found {unknown[0] if unknown else 'none'}")
    return chosen


def _contradictions(config: TrainConfig) -> Iterator[str]:
    if config.init_from and config.init_expert:
        yield "`init_from` and `init_expert` cannot be combined"
    if config.observation == "laws" and config.network != "small":
        yield "`observation`: only the network `small` reads laws"
    if config.init_from or config.init_expert:
        if config.frames != 1:
            yield "`frames`: recorded actions belong to single observations, so cloning requires 1"
        if config.observation == "matrix":
            yield "`observation`: episodes are recorded as `ids`, `compact` or `laws`, not as `matrix`"
    if config.rollout * config.envs < 2:
        yield "`rollout` × `envs` is 1: an update needs at least two actions"


def _mistake(message: str) -> Diagnostic:
    """A diagnostic about settings, which have no location in a file."""
    return Diagnostic("PD640", message, Label(None))
