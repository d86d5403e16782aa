"""The forms of actions: which numbers they have, that they do the same as five numbers each, masks, and bad input."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from gymnasium.spaces import Discrete, MultiDiscrete

from powderdsl.diagnostics import Reporter, Source
from powderdsl.envs.actions import KINDS, UNREAD, action_form
from powderdsl.envs.gym import PowderEnv, PowderVectorEnv
from powderdsl.envs.sb3 import PowderVecEnv
from powderdsl.envs.tensor_env import TensorEnv
from powderdsl.tasks.episodes import TaskProgram
from powderdsl.tasks.file import read_task
from powderdsl.tasks.task import BLOW, NO_CHANGE, Agent

CPU = torch.device("cpu")


def agent(*choices: int, bins: tuple[int, int] = (3, 4)) -> Agent:
    return Agent(choices, (2, 2), bins, 5, 1, 0, "velocity" if BLOW in choices else None, 1.0)


def varied(small: TaskProgram, task_file: Path, may: str) -> TaskProgram:
    """The small task with other actions."""
    text = task_file.read_text().replace("[sand, blow]", may).replace("bins: 4", "bins: [4, 3]")
    task = read_task(Source("other.yaml", text), Reporter())
    assert task is not None
    return TaskProgram(task, "train", small.simulator)


@pytest.mark.parametrize(
    ("made", "names", "nvec", "count"),
    [
        (agent(4), "x y", (4, 3), 12),
        (agent(4, 7), "x y choice", (4, 3, 2), 24),
        (agent(BLOW), "x y vx vy", (4, 3, 3, 3), 108),
        (agent(4, BLOW, NO_CHANGE), "x y choice vx vy", (4, 3, 3, 3, 3), 121),
        (agent(4, NO_CHANGE), "x y choice", (4, 3, 2), 13),
        (agent(4, 7, bins=(1, 4)), "x choice", (4, 2), 8),
        (agent(4, bins=(1, 1)), "choice", (1,), 1),
        (agent(BLOW, bins=(1, 1)), "vx vy", (3, 3), 9),
        (agent(NO_CHANGE), "choice", (1,), 1),
    ],
)
def test_forms_have_what_the_task_reads(made: Agent, names: str, nvec: tuple[int, ...], count: int) -> None:
    form = action_form("multidiscrete", made, CPU)
    assert form.names == tuple(names.split())
    assert form.nvec == nvec
    assert form.space == MultiDiscrete(np.array(nvec))
    assert form.mask.shape == (sum(nvec),)
    assert form.mask.all()
    single = action_form("discrete", made, CPU)
    assert single.space == Discrete(count)
    assert single.mask.shape == (count,)
    assert single.mask.all()
    every = torch.arange(count)
    found = single.decode(every)
    assert len({tuple(row) for row in found.tolist()}) == count
    assert torch.equal(single.encode(found), every)
    for kind in KINDS:
        action_form(kind, made, CPU).encode(found)
    assert torch.equal(found, single.decode(every)), "encoding writes to what it is given"


def test_the_order_of_discrete_actions() -> None:
    """As the documentation has it: what is done, y, x; and blowing goes through vx first."""
    form = action_form("discrete", agent(4, 7, BLOW, NO_CHANGE), CPU)
    rows, columns = 3, 4
    for action, (x, y, choice, vx, vy) in enumerate(form.decode(torch.arange(form.nvec[0])).tolist()):
        if choice == 3:
            assert action == form.nvec[0] - 1
            assert (x, y, vx, vy) == (0, 0, 1, 1)
            continue
        what = choice if choice < 2 else 2 + 3 * vy + vx
        assert action == (what * rows + y) * columns + x
        assert choice == 2 or (vx, vy) == (1, 1)


@pytest.mark.parametrize("kind", ["multidiscrete", "discrete"])
@pytest.mark.parametrize("may", ["[sand, blow, nothing]", "[sand, water, nothing]", "[blow]", "[wall]"])
def test_an_action_does_the_same_in_every_form(
    small: TaskProgram, task_file: Path, kind: str, may: str
) -> None:
    program = varied(small, task_file, may)
    full = TensorEnv(program, 8, observation="compact")
    other = TensorEnv(program, 8, observation="compact", actions=kind)
    full.reset(seed=0)
    other.reset(seed=0)
    for actions in np.random.default_rng(5).integers(0, full.action_nvec, (12, 8, 5)):
        wanted, found = full.step(actions), other.step(other.action_form.encode(actions))
        for one, same in zip(wanted[:4], found[:4], strict=True):
            assert torch.equal(one, same)


def test_full_masks_numbers_that_nothing_reads(small: TaskProgram, task_file: Path) -> None:
    calm = PowderEnv(varied(small, task_file, "[sand, nothing]"), actions="full")
    parts = [part.tolist() for part in np.split(calm.action_masks(), np.cumsum([3, 4, 2, 3]))]
    assert parts == [[True] * 3, [True] * 4, [True] * 2, [False, True, False], [False, True, False]]
    assert PowderEnv(small, actions="full").action_masks().all()  # which may blow
    idle = action_form("full", agent(NO_CHANGE), CPU)
    allowed = [part.nonzero()[:, 0].tolist() for part in idle.mask.split(idle.nvec)]
    assert allowed == [[value] for value in UNREAD]


@pytest.mark.parametrize("kind", KINDS)
def test_masks_are_as_maskable_ppo_asks_for_them(small: TaskProgram, kind: str) -> None:
    utils = pytest.importorskip("sb3_contrib.common.maskable.utils", reason="needs sb3-contrib")
    one = PowderEnv(small, actions=kind)
    batch, sb3 = PowderVectorEnv(small, 3, actions=kind), PowderVecEnv(small, 3, actions=kind)
    count = {"multidiscrete": 16, "full": 16, "discrete": 160}[kind]
    for env in (one, sb3):
        assert utils.is_masking_supported(env)
        masks = utils.get_action_masks(env)
        assert masks.dtype == bool
        assert masks.shape == ((count,) if env is one else (3, count))
    assert np.array_equal(batch.action_masks(), sb3.action_masks())
    assert len(sb3.env_method("action_masks", indices=[1])) == 1
    sb3.action_masks()[:] = False  # a copy
    assert sb3.action_masks().all()


@pytest.mark.parametrize("kind", KINDS)
def test_infos_have_masks_where_asked_for(small: TaskProgram, kind: str) -> None:
    env = PowderEnv(small, actions=kind, action_mask=True)
    _, info = env.reset(seed=0)
    mask = info["action_mask"]
    assert mask.dtype == np.int8
    assert np.array_equal(mask.astype(bool), env.action_masks())
    shaped = mask if kind == "discrete" else tuple(np.split(mask, np.cumsum(env.tensors.action_nvec)[:-1]))
    info = env.step(env.action_space.sample(mask=shaped))[4]
    assert np.array_equal(info["action_mask"], mask)
    batch = PowderVectorEnv(small, 2, actions=kind, action_mask=True)
    _, info = batch.reset(seed=0)
    assert info["action_mask"].shape == (2, len(mask))
    assert info["_action_mask"].all()
    assert "action_mask" not in PowderEnv(small, actions=kind).reset(seed=0)[1]


def test_bad_actions_name_what_is_wrong(small: TaskProgram, task_file: Path) -> None:
    env = TensorEnv(varied(small, task_file, "[sand, nothing]"), 2, actions="multidiscrete")
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"actions\[1, 2\] \(choice\) is 2: it must be in 0\.\.1"):
        env.step([[0, 0, 0], [0, 0, 2]])
    with pytest.raises(ValueError, match=r"shape \[episodes, 3\], found \[2, 5\]"):
        env.step([[0] * 5] * 2)
    single = TensorEnv(small, 2, actions="discrete")
    single.reset(seed=0)
    for bad, why in (
        ([0, 160], r"actions\[1, 0\] \(action\) is 160"),
        ([[0], [0]], r"\[episodes\]"),
        ([0], "1 actions"),
    ):
        with pytest.raises(ValueError, match=why):
            single.step(bad)
    with pytest.raises(TypeError, match="integers"):
        single.step([0.0, 1.0])
    with pytest.raises(ValueError, match="actions is one of multidiscrete, discrete, full"):
        TensorEnv(small, actions="discreet")
    with pytest.raises(ValueError, match="1,048,576 at most"):
        action_form("discrete", agent(*range(20), bins=(256, 256)), CPU)
