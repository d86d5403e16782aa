"""Batched episodes of a task, which restart automatically, and their observations, on the simulator's device."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode
from torch import Tensor

from powderdsl.envs.actions import action_form
from powderdsl.envs.curriculum import Curriculum
from powderdsl.model.state import property_values
from powderdsl.simulation.observe import Observer
from powderdsl.simulation.simulator import MAX_CELLS
from powderdsl.simulation.state_checks import check_mapping
from powderdsl.system.random import MASK, mix
from powderdsl.system.settings import check_choice, check_count
from powderdsl.tasks.episodes import Episodes, TaskProgram, load_program
from powderdsl.tasks.laws import Laws
from powderdsl.tasks.mixed import MixedEpisodes
from powderdsl.tasks.task import Task

OBSERVATIONS = ("ids", "compact", "matrix", "rgb", "laws")


@dataclass(frozen=True)
class Observation:
    """One form of observation of worlds of one ruleset and size. Channels come first, except in pictures.

    ``ids``: uint8 [1, H, W], element ids. ``compact``: uint8 [C, H, W], everything that persists between steps, as
    encoded by `Observer.compact`. ``matrix``: float32 [C, H, W], the channels of the ruleset's `matrix:` (the paper's
    20). ``rgb``: uint8 [H, W, 3]. ``laws``: uint8 [2, H, W], element ids, and the `Laws` of the world, row by row,
    padded with zeros.
    """

    kind: str
    space: Box
    """Of one world."""
    laws: Laws
    channels: tuple[str, ...]
    """The names of the channels."""

    def of(self, episodes: Episodes | MixedEpisodes) -> Tensor:
        """The observations of a batch in new memory: [B, *space.shape]."""
        if isinstance(episodes, MixedEpisodes):
            return episodes.joined(lambda program, part: replace(self, laws=program.laws).of(part))
        world = episodes.world
        shape, dtype = (len(world), *self.space.shape), getattr(torch, self.space.dtype.name)
        out = torch.empty(shape, dtype=dtype, device=world.seed.device)
        if self.kind in ("ids", "laws"):
            world.read("element", out[:, 0])
        else:
            getattr(world, self.kind)(out)
        if self.kind == "laws":
            laws = self.laws.of(episodes.params, len(episodes))
            out[:, 1] = 0
            out[:, 1].flatten(1)[:, : laws.shape[1]] = laws
        return out


def channels_of(kind: str, observer: Observer) -> tuple[str, ...]:
    """The names of the channels of a kind of observation. Raises ValueError for an unknown kind."""
    check_choice("observation", kind, OBSERVATIONS)
    few = {"ids": ("element",), "rgb": ("red", "green", "blue"), "laws": ("element", "laws")}
    if kind in few:
        return few[kind]
    return observer.compact_names if kind == "compact" else observer.matrix_names


def observation_of(kind: str, program: TaskProgram) -> Observation:
    """The observation of a kind. Raises ValueError for an unknown kind, or if there are no laws or too many."""
    observer, ruleset, laws = program.simulator.observer, program.simulator.ruleset, program.laws
    channels, size = channels_of(kind, observer), program.task.size
    shape = (*size, 3) if kind == "rgb" else (len(channels), *size)
    if kind == "laws" and not 0 < len(laws) <= size[0] * size[1]:
        much = "are the same in all worlds" if not len(laws) else f"take {len(laws)} bytes, more than cells"
        raise ValueError(f"observation `laws`: the laws of {program.task.name} {much}")
    if kind != "matrix":
        # Always bytes in 0..255, which Stable-Baselines3 recognizes and stores as pictures.
        return Observation(kind, Box(0, 255, shape, np.uint8), laws, channels)
    bounds = [abs(bound) for slot in observer.slots.values() for bound in (slot.kind.lo, slot.kind.hi)]
    bounds += [max(map(abs, property_values(ruleset, prop.name))) for prop in ruleset.properties]
    limit = max(ruleset.slots, *bounds)
    return Observation(kind, Box(-limit, limit, shape, np.float32), laws, channels)


Info = dict[str, Any]
"""Tensors [B] by name; if a key concerns only some of the worlds, ``_key``, bool [B], marks them."""

OPTIONS = ("params", "worlds", "reset_mask")
MAX_SEED = (1 << 62) - 1
"""The largest seed and world number."""

LAST_ACTIONS = ("auto", "truncates", "terminates")


def world_seeds(base: Tensor, episode: Tensor, worlds: int) -> Tensor:
    """The number of the world that each environment plays: int64 [B].

    Episode 0 of an environment with seed `base` plays world `base`. Later episodes play worlds below `worlds`, chosen
    by a hash of `base` and `episode` (both int64 [B]), so that environments are independent of one another.
    """
    key = mix(mix(base & MASK) ^ ((base >> 32) & MASK))
    high, low = mix((key + episode) & MASK), mix((key ^ mix(episode & MASK)) & MASK)
    drawn = ((high << 31) | (low >> 1)) % worlds
    return torch.where(episode == 0, base, drawn)


class TensorEnv:
    """`num_envs` episodes of a task at once. Returned tensors are never overwritten.

    Args:
        task: name of a shipped task, path of a task file, a `Task`, or a `TaskProgram`, which several environments can
            share and which fixes the split, knobs, parameters, backend and device.
        num_envs: the number of environments, B.
        split: the set of worlds: ``train``, ``test``, or another split of the task.
        observation: the form of observations: ``ids``, ``compact``, ``matrix``, ``rgb`` or ``laws``
                (docs/environments.md).
        knobs: values for the task's knobs, by name.
        params: values for parameters of the task's rules, by qualified name; `reset` may override them.
        worlds: later episodes use worlds 0 … worlds − 1 of the split.
        autoreset_mode: what happens after an episode's last step, as Gymnasium defines it: ``SAME_STEP`` returns the
            next episode's first observation, and the last one in the infos; ``NEXT_STEP`` starts it with the following
            call, whose action is ignored; ``DISABLED`` leaves it to `reset`.
        last_action: whether the last action ``truncates`` or ``terminates`` an episode. ``auto``: it terminates if the
            task has a `final` reward, and truncates otherwise, since rewards would continue.
        max_episode_steps: truncate episodes earlier than the task does.
        actions: the form of actions: ``multidiscrete``, ``discrete`` or ``full`` (docs/environments.md).
        action_mask: add ``action_mask``, int8 [B, n], to infos: see `action_masks`.
        backend: as in `powderdsl.compile`.
        device: as in `powderdsl.compile`.
        threads: as in `powderdsl.compile`.
        curriculum: chooses the worlds of later episodes instead of a hash.

    Attributes:
        num_envs: the number of environments, B.
        single_action_space: the Gymnasium space of the actions of one environment.
        action_nvec: the number of values of each number of an action.
        device: the torch device of all tensors.
        takes_mixed: true if worlds may run under different rulesets.

    Raises:
        CompileError: an unknown task, split, knob or parameter.
        ValueError: another argument is wrong.
    """

    takes_mixed = False
    rows: tuple[str, ...] = ("base", "episode", "returned", "ended")
    """Attributes (without `_`) that `state` saves: one number per environment."""

    def __init__(
        self,
        task: str | Path | Task | TaskProgram,
        num_envs: int = 1,
        *,
        split: str = "train",
        observation: str = "ids",
        knobs: Mapping[str, int] | None = None,
        params: Mapping[str, Any] | None = None,
        worlds: int = 1_000_000,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
        last_action: str = "auto",
        max_episode_steps: int | None = None,
        actions: str = "full",
        action_mask: bool = False,
        backend: str = "auto",
        device: str | torch.device = "cpu",
        threads: int = 1,
        curriculum: Curriculum | None = None,
    ):
        check_count("worlds", worlds, MAX_SEED)
        check_count("max_episode_steps", 1 if max_episode_steps is None else max_episode_steps, MAX_SEED)
        check_choice("last_action", last_action, LAST_ACTIONS)
        machine = {"backend": backend, "device": device, "threads": threads}
        self.program = load_program(task, split=split, knobs=knobs, params=params, **machine)
        self.task, self.split = self.program.task, self.program.split
        check_cells(num_envs, self.task.size)
        if self.program.is_mixed and not self.takes_mixed:
            message = f"the worlds of {self.task.name}, {self.split}, run under different rulesets"
            raise ValueError(f"{message}: use powderdsl.envs.mixed.environment")
        self.num_envs, self.worlds = num_envs, worlds
        self.simulator = self.program.simulator
        self.device = self.simulator.device
        self.curriculum = curriculum
        self.autoreset_mode = mode_of(autoreset_mode)
        self.observation = observation_of(observation, self.program)
        self.action_form = action_form(actions, self.task.agent, self.device)
        self.single_action_space, self.action_nvec = self.action_form.space, self.action_form.nvec
        self.shows_mask = action_mask
        ends = {"auto": self.task.goal.final is not None, "terminates": True, "truncates": False}
        self.last_action_terminates = ends[last_action]
        self.max_episode_steps = min(self.task.agent.actions, max_episode_steps or self.task.agent.actions)
        self.episodes: Episodes | None = None
        """The current worlds, read-only; the next call overwrites their tensors."""
        self.params: dict[str, Tensor] = {}
        """Parameters set by `reset`: float64 [B] each."""
        self._base: Tensor | None = None
        self._episode = torch.full((num_envs,), -1, dtype=torch.int64, device=self.device)
        self._returned = torch.zeros(num_envs, dtype=torch.float64, device=self.device)
        self._ended = torch.zeros(num_envs, dtype=torch.bool, device=self.device)

    # Beginning

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Tensor, Info]:
        """Begin all episodes, or those of a mask.

        Args:
            seed: an integer s gives environment i the seed s + i; a list has a seed or None for each. A seed determines
                the worlds of this and all later episodes: see `world_seeds`. Without a seed, an environment continues
                with its next episode.
            options: ``params``: parameters of the rules, each a number or [B]; they stay in effect until replaced, and
                ``{}`` restores the defaults. ``worlds``: numbers of the worlds of these episodes, a number or [B].
                ``reset_mask``: bool [B], the environments to reset.

        Returns:
            Observations [B, …], and the infos of `step` without those of ended episodes.

        Raises:
            TypeError: a seed or an option has the wrong type. After an error, nothing has changed.
            ValueError: a seed or an option is out of range, or has the wrong shape.
            KeyError: there is no such option or parameter.
        """
        settings = dict(options or {})
        check_options(settings, OPTIONS)
        mask = reset_mask(settings.get("reset_mask"), self.num_envs, self.episodes is not None, self.device)
        base, seeded = self._bases(seed)
        params = self._new_params(settings.get("params"), mask)
        episode = torch.where(mask, torch.where(seeded, 0, self._episode + 1), self._episode)
        if self._base is not None:
            base = torch.where(mask, base, self._base)
        worlds = self._choose(base, episode)
        if "worlds" in settings:
            worlds = self.simulator.numbers(settings["worlds"], "worlds", self.num_envs)
        self._base, self._episode, self.params = base, episode, params
        self._restart(mask, worlds)
        self._returned = self._returned.masked_fill(mask, 0)
        self._ended = self._ended & ~mask
        nobody = torch.zeros_like(mask)
        info: Info = {"success": nobody, "_success": nobody.clone()}
        self._add_ended(info, nobody)
        self._add_shown(info, mask)
        assert self.episodes is not None
        return self.observation.of(self.episodes), info

    def _restart(self, mask: Tensor, worlds: Tensor) -> None:
        """Begin episodes where `mask`, bool [B], is set, in the worlds of those numbers, int64 [B]."""
        if self.episodes is None:
            self.episodes = self.program.start(worlds)
        else:
            self.episodes = self.program.restart(self.episodes, mask, worlds, reuse=True)

    def _choose(self, base: Tensor, episode: Tensor) -> Tensor:
        """The worlds of environments' episodes, int64 [n]: chosen by `world_seeds` or a curriculum."""
        worlds = world_seeds(base, episode, self.worlds)
        return worlds if self.curriculum is None else self.curriculum.choose(base, episode, worlds)

    def adopt(self, episodes: Episodes, returned: Tensor, params: Mapping[str, Tensor]) -> None:
        """Continue with other, unfinished episodes; their number may differ.

        Args:
            returned: the returns so far, float64 [B].
            params: parameters as `params` has them, [B] each.
        """
        self.num_envs, self.episodes, self.params = len(episodes), episodes, dict(params)
        self._returned, self._ended = returned, torch.zeros_like(episodes.failed)
        self._base, self._episode = torch.zeros_like(episodes.seed), torch.zeros_like(episodes.seed)

    def _add_ended(self, info: Info, ended: Tensor) -> None:
        """Add return and length of the episodes where `ended`, bool [B], is set; zeros elsewhere."""
        assert self.episodes is not None
        info["episode_return"] = (self._returned * ended).float()
        info["episode_length"] = self.episodes.acted * ended
        info["_episode_return"] = info["_episode_length"] = ended.clone()

    def _add_shown(self, info: Info, mask: Tensor) -> None:
        """Add the numbers of the worlds shown and their action masks, valid where `mask`, bool [B], is set."""
        assert self.episodes is not None
        info["world"], info["_world"] = self.episodes.seed.clone(), mask.clone()
        if self.shows_mask:
            info["action_mask"], info["_action_mask"] = self.action_masks().to(torch.int8), mask.clone()

    def action_masks(self) -> Tensor:
        """Return the mask of allowed actions: bool [B, n], where n is the sum of `action_nvec`."""
        return self.action_form.mask.expand(self.num_envs, -1).clone()

    @property
    def returns(self) -> Tensor:
        """The return of each current episode so far: float64 [B]."""
        return self._returned.clone()

    def progress(self) -> tuple[float, int]:
        """The return and the length so far of the only episode."""
        assert self.episodes is not None
        return self.returns.item(), int(self.episodes.acted.item())

    def _bases(self, seed: Any) -> tuple[Tensor, Tensor]:
        """The seed of each environment, and whether it is a new one."""
        old = self._base
        if old is None:
            first = int(np.random.SeedSequence().generate_state(1, np.uint32)[0])
            old = torch.arange(first, first + self.num_envs, device=self.device)
        seeds = seeds_of(seed, self.num_envs)
        new = torch.tensor([number or 0 for number in seeds], device=self.device)
        is_new = torch.tensor([number is not None for number in seeds], device=self.device)
        return torch.where(is_new, new, old), is_new

    def _new_params(self, changes: Any, mask: Tensor) -> dict[str, Tensor]:
        if changes is None:
            return self.params
        whole = self.simulator.parameters(check_mapping("params", changes), self.num_envs)
        names = changes.keys() if bool(mask.all()) else {**changes, **self.params}.keys()
        drawn = {part.name for part in self.task.split(self.split).params}
        for name in drawn - {*changes}:
            whole[name] = torch.full_like(whole[name], torch.nan)  # each world keeps its draws
        old = {
            **self.simulator.parameters({}, self.num_envs),
            **dict.fromkeys(drawn, torch.tensor(torch.nan)),
        }
        old |= self.params
        return {name: torch.where(mask, whole[name], old[name]) for name in names}

    # Saving

    def state(self) -> dict[str, Any]:
        """Return everything that later steps depend on, as dicts of CPU tensors.

        Raises:
            ResetNeeded: before the first reset.
        """
        if self.episodes is None:
            raise ResetNeeded("reset the environment before saving it")
        return {
            **{name: getattr(self, f"_{name}").to("cpu", copy=True) for name in self.rows},
            "params": {name: value.to("cpu", copy=True) for name, value in self.params.items()},
            **self._saved(self.episodes),
        }

    def _saved(self, episodes: Episodes) -> dict[str, Any]:
        return {"episodes": self.program.saved(episodes)}

    def restore(self, state: Mapping[str, Any]) -> Tensor:
        """Continue from a result of `state`, also in another process or on another backend or device.

        Returns:
            The observations of the restored worlds, [B, …].

        Raises:
            ValueError: the state is of another task or number of worlds. Nothing has changed then.
            KeyError: `state` did not return it. Nothing has changed then.
        """
        if len(state["base"]) != self.num_envs:
            raise ValueError(f"{len(state['base'])} worlds were saved: {self.num_envs} are needed")
        rows = {name: state[name].to(self.device, copy=True) for name in self.rows}
        params = {name: value.to(self.device, copy=True) for name, value in state["params"].items()}
        episodes = self._loaded(state)
        self.episodes, self.params = episodes, params
        for name, value in rows.items():
            setattr(self, f"_{name}", value)
        return self.observation.of(episodes)

    def _loaded(self, state: Mapping[str, Any]) -> Episodes:
        return self.program.loaded(state["episodes"])

    # Stepping

    def step(self, actions: Any) -> tuple[Tensor, Tensor, Tensor, Tensor, Info]:
        """Take one action in every episode.

        Args:
            actions: integers [B, k], or [B] for discrete actions, each from 0 to ``action_nvec − 1``. ``full`` actions
                are x, y, choice, vx, vy.

        Returns:
            Observations [B, …]; reward float32 [B]; terminated and truncated, bool [B]; and infos, which have the same
            keys after every step: ``success``, bool [B], true if the task's condition for success holds; ``world``,
            int64 [B], the numbers of the worlds that observations show; where episodes ended ``episode_return`` and
            ``episode_length`` (zero elsewhere) and, under SAME_STEP, ``final_obs`` (the last observations, [n, …] in
            the order of the environments) and ``final_info``.

        Raises:
            ResetNeeded: before the first reset, or under DISABLED in an episode that has ended.
            TypeError: actions are not integers. Nothing has changed then.
            ValueError: actions have a wrong shape or are out of range. Nothing has changed then.
        """
        checked, waiting, params = self._checked(actions), self._ended, self.params or None
        assert self.episodes is not None
        after, reward, success, _ = self.program.act(self.episodes, checked, reuse=True, params=params)
        self.episodes = after
        failed, last = after.failed, after.acted >= self.task.agent.actions
        terminated = (success | failed | last) if self.last_action_terminates else success | failed
        if self.max_episode_steps != self.task.agent.actions:
            last = last | (after.acted >= self.max_episode_steps)
        truncated = last & ~terminated
        if self.autoreset_mode is AutoresetMode.NEXT_STEP:
            reward = reward.masked_fill(waiting, 0)
            terminated, truncated, success = (flags & ~waiting for flags in (terminated, truncated, success))
        self._returned = self._returned + reward
        ended = terminated | truncated
        info: Info = {"success": success, "_success": ~waiting}
        self._add_ended(info, ended)
        observed = self.observation.of(after)
        if self.autoreset_mode is AutoresetMode.SAME_STEP:
            self._begin(ended, observed, info)
        else:
            self._ended = ended
        if self.autoreset_mode is AutoresetMode.NEXT_STEP:
            self._begin(waiting, observed)
        self._add_shown(info, torch.ones_like(ended))
        return observed, reward, terminated, truncated, info

    def _checked(self, actions: Any) -> Tensor:
        """The five numbers of the actions of a step, int64 [B, 5]. Raises as `step`."""
        if self.episodes is None:
            raise ResetNeeded("reset the environment before its first step")
        checked = self.action_form.decode(actions)
        if len(checked) != self.num_envs:
            raise ValueError(f"{len(checked)} actions for {self.num_envs} environments")
        if self.autoreset_mode is AutoresetMode.DISABLED:
            check_going(self._ended)
        return checked

    def _begin(self, mask: Tensor, observed: Tensor, info: Info | None = None) -> None:
        """Begin the next episodes where `mask`, bool [B], is set, and write their first observations to `observed`.

        With `info`, add the last observations and the infos of the ended episodes.
        """
        assert self.episodes is not None
        assert self._base is not None
        places = mask.nonzero()[:, 0]
        if info is not None:
            last = {"world": self.episodes.seed.clone()}
            last |= {name: info[name] for name in ("success", "episode_return", "episode_length")}
            masked = info["_episode_return"]
            info["final_info"] = last | {f"_{name}": masked for name in last}
            info["final_obs"] = observed[places]
            info["_final_obs"] = info["_final_info"] = masked
        if not len(places):
            return
        self._episode = self._episode + mask
        self._returned = self._returned.masked_fill(mask, 0)
        fresh = self.program.start(self._choose(self._base[places], self._episode[places]))
        self.episodes = self.program.put(self.episodes, places, fresh, reuse=True)
        observed[places] = self.observation.of(fresh)


def seeds_of(seed: Any, count: int) -> list[int | None]:
    """The seeds of environments: an integer s gives environment i the seed s + i; a list has a seed or None for each.

    Raises TypeError or ValueError if it is neither, or has another length, or a seed is out of range.
    """
    if seed is None:
        return [None] * count
    if hasattr(seed, "__index__") and not isinstance(seed, bool):
        seeds: list[Any] = [int(seed) + number for number in range(count)]
    elif isinstance(seed, Sequence) and not isinstance(seed, str):
        seeds = list(seed)
    else:
        raise TypeError(f"seed takes an integer, a list of them, or None; found {seed!r}")
    if len(seeds) != count:
        raise ValueError(f"seed has {len(seeds)} numbers for {count} environments")
    for value in seeds:
        if value is not None:
            check_count("seed", value, MAX_SEED, least=0)
    return seeds


def check_options(options: Mapping[str, Any], known: Sequence[str]) -> None:
    """Raise KeyError for an unknown option of `reset`."""
    if unknown := sorted(options.keys() - {*known}):
        raise KeyError(f"no option `{unknown[0]}`: there are {', '.join(known)}")


def reset_mask(value: Any, count: int, begun: bool, device: torch.device) -> Tensor:
    """Read the option `reset_mask`: the environments to reset, bool [B]; None: all. Raises ValueError or ResetNeeded."""
    if value is None:
        return torch.ones(count, dtype=torch.bool, device=device)
    mask = torch.as_tensor(value, device=device)
    if mask.dtype != torch.bool or mask.shape != (count,) or not bool(mask.any()):
        shape = f"{mask.dtype} {list(mask.shape)}"
        raise ValueError(f"reset_mask must be bool [{count}], True for some environments; found {shape}")
    if not begun and not bool(mask.all()):
        raise ResetNeeded("the first reset begins all episodes: reset_mask must be True everywhere")
    return mask


def check_going(waiting: Tensor) -> None:
    """Raise ResetNeeded if any episode, bool [B], is over."""
    if bool(waiting.any()):
        over = waiting.nonzero()[:8, 0].tolist()
        raise ResetNeeded(f"the episodes of environments {over} are over: reset them with a reset_mask")


def check_cells(num_envs: int, size: tuple[int, int]) -> None:
    """Raise ValueError for zero worlds, or more than a simulator supports."""
    check_count("num_envs", num_envs, MAX_CELLS // (size[0] * size[1]))


def mode_of(value: AutoresetMode | str) -> AutoresetMode:
    """A Gymnasium mode, given as such or by its case-insensitive name."""
    if isinstance(value, AutoresetMode):
        return value
    check_choice("autoreset_mode", value.upper(), [mode.name for mode in AutoresetMode])
    return AutoresetMode[value.upper()]
