"""Implicit Q-learning (Kostrikov et al., 2021) in one file: offline reinforcement learning from recorded episodes.

    pip install 'powderdsl[rl]'
    powderdsl record sand-pushing --policy expert --episodes 64 --out pushes
    powderdsl record sand-pushing --policy random --episodes 192 --out random-pushes
    python examples/iql.py --task sand-pushing --data pushes random-pushes

Episodes are not labeled as good or bad. IQL learns a value V above the average outcome of the recorded actions (an
expectile), a Q by one step of look-ahead to V, and a policy that imitates the actions whose Q exceeds V. It never
needs the value of an action that was not recorded. Here, Q and V are two heads of one network.

It prints a table of returns on worlds that training has never seen, and writes the learning curve to a CSV file.
"""

from __future__ import annotations

import argparse
import copy
import csv
import time
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from powderdsl.datasets import Dataset, Transitions
from powderdsl.envs import PowderVectorEnv
from powderdsl.tasks.players import ExpertPlayer


class Grid(nn.Module):
    """From observations, uint8 [B, 1, H, W], to one number for each action [B, actions], and one for the world [B]."""

    def __init__(self, bins: tuple[int, int], actions: int, width: int = 32):
        super().__init__()
        self.bins, self.actions = bins, actions
        self.elements = nn.Embedding(256, 8)
        self.cells = nn.Conv2d(8, width // 2, 4, stride=2, padding=1)
        self.blocks = nn.Sequential(
            nn.Conv2d(width // 2 + 2, width, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(width, width, 3, padding=1),
            nn.ReLU(),
        )
        self.per_bin = nn.Conv2d(width, actions // (bins[0] * bins[1]), 1)
        self.idle = nn.Linear(width, 1)  # doing nothing has no location; drop it unless it is an action
        self.whole = nn.Sequential(nn.Linear(2 * width, 64), nn.ReLU(), nn.Linear(64, 1))

    def forward(self, observed: Tensor) -> tuple[Tensor, Tensor]:
        embedded = self.elements(observed[:, 0].long()).permute(0, 3, 1, 2)
        found = functional.adaptive_avg_pool2d(functional.relu(self.cells(embedded)), self.bins)
        y, x = (torch.linspace(-1, 1, count, device=found.device) for count in self.bins)
        where = torch.stack(torch.meshgrid(y, x, indexing="ij")).expand(len(found), -1, -1, -1)
        found = self.blocks(torch.cat([found, where], 1))
        mean = found.mean((2, 3))
        each = torch.cat([self.per_bin(found).flatten(1), self.idle(mean)], 1)[:, : self.actions]
        return each, self.whole(torch.cat([mean, found.amax((2, 3))], 1))[:, 0]


def returns_of(env: PowderVectorEnv, act: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """The return of one episode in each of the worlds 0, 1, …: float [B]."""
    observed, _ = env.reset(seed=0)
    returns, over = np.zeros(env.num_envs), np.zeros(env.num_envs, bool)
    while not over.all():
        observed, reward, terminated, truncated, _ = env.step(act(observed))
        returns += reward * ~over  # a finished environment plays another episode meanwhile
        over |= terminated | truncated
    return returns


def compare(env: PowderVectorEnv, policy: Grid, data: list[Dataset]) -> dict[str, np.ndarray]:
    """Returns of the recorded episodes, of random actions, of the policy, and of the task's expert, if it has one."""
    tensors, random = env.tensors, np.random.default_rng(0)

    def iql(observed: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            return policy(torch.from_numpy(observed))[0].argmax(1).numpy()

    recorded = [float(one.episode(number).reward.sum()) for one in data for number in range(len(one))]
    found = {
        "data": np.array(recorded),
        "random": returns_of(env, lambda shown: random.integers(env.single_action_space.n, size=len(shown))),
        "iql": returns_of(env, iql),
    }
    if tensors.task.expert is not None:
        expert = ExpertPlayer(tensors.program)
        encode = tensors.action_form.encode
        found["expert"] = returns_of(env, lambda _: encode(expert(tensors.episodes)).numpy())
    return found


def train(
    policy: Grid, data: list[Dataset], encode: Callable[[Tensor], Tensor], args: argparse.Namespace
) -> list[dict[str, float]]:
    """Learn V, Q and the policy from the recorded transitions. Returns the learning curve."""
    rows = Transitions(data)
    critic = copy.deepcopy(policy)  # Q has a number for each action, V one for the world
    target = copy.deepcopy(critic).requires_grad_(False)
    optimizer = torch.optim.Adam([*policy.parameters(), *critic.parameters()], args.lr)
    generator = torch.Generator().manual_seed(args.seed)
    curve, begun = [], time.perf_counter()
    for update in range(1, args.updates + 1):
        batch = rows[torch.randint(len(rows), (args.batch,), generator=generator)]
        action = encode(batch.action)[:, None]
        q, value = critic(batch.observation)
        with torch.no_grad():
            target_q = target(batch.observation)[0].gather(1, action)[:, 0]
            next_value = critic(batch.next_observation)[1]
            wanted_q = batch.reward + args.gamma * next_value * ~batch.terminated

        # V: the expectile of Q over the recorded actions. Falling short of Q costs more than exceeding it.
        advantage = target_q - value
        weight = torch.where(advantage > 0, args.expectile, 1 - args.expectile)
        value_loss = (weight * advantage**2).mean()

        # Q: the reward, plus V of the next observation.
        q_loss = functional.mse_loss(q.gather(1, action)[:, 0], wanted_q)

        # Policy: cloning, weighted by the advantage over V. Advantages are standardized, as in PPO, so that one beta
        # fits large and small rewards, and a constant error of V does not matter.
        gain = advantage.detach()
        gain = (gain - gain.mean()) / (gain.std() + 1e-8)
        trust = (args.beta * gain).exp().clamp(max=100)
        cross_entropy = functional.cross_entropy(policy(batch.observation)[0], action[:, 0], reduction="none")
        policy_loss = (trust * cross_entropy).sum() / trust.sum()

        optimizer.zero_grad()
        (value_loss + q_loss + policy_loss).backward()
        optimizer.step()
        with torch.no_grad():
            for slow, fast in zip(target.parameters(), critic.parameters(), strict=True):
                slow.lerp_(fast, args.tau)
        if update % args.every == 0 or update == args.updates:
            row = {
                "update": update,
                "seconds": round(time.perf_counter() - begun, 1),
                "value_loss": round(float(value_loss.detach()), 5),
                "q_loss": round(float(q_loss.detach()), 5),
                "policy_loss": round(float(policy_loss.detach()), 4),
                "q": round(float(target_q.mean()), 4),
                "advantage_above_zero": round(float((advantage > 0).float().mean()), 4),
            }
            curve.append(row)
            print("  ".join(f"{name} {value:g}" for name, value in row.items()))
    return curve


def main(arguments: list[str] | None = None) -> dict[str, float]:
    """Train and compare. Returns the mean return of each policy, and that of the recorded episodes."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--task", default="sand-pushing", help="a shipped task, or a task file")
    parser.add_argument("--data", required=True, nargs="+", help="folders of `powderdsl record TASK`")
    parser.add_argument("--updates", type=int, default=600)
    parser.add_argument("--batch", type=int, default=64, help="transitions of an update")
    parser.add_argument("--every", type=int, default=100, help="updates between rows of the learning curve")
    parser.add_argument("--lr", type=float, default=1e-3)
    parser.add_argument("--gamma", type=float, default=0.97)
    parser.add_argument("--expectile", type=float, default=0.8)
    parser.add_argument("--beta", type=float, default=2.0, help="weight of better actions")
    parser.add_argument("--tau", type=float, default=0.01, help="rate at which the target follows Q")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--worlds", type=int, default=64, help="worlds of the split `test` to play in")
    parser.add_argument("--backend", default="auto", help="backend of the simulation")
    parser.add_argument("--out", default="iql.csv")
    args = parser.parse_args(arguments)

    torch.manual_seed(args.seed)
    env = PowderVectorEnv(
        args.task,
        args.worlds,
        split="test",
        actions="discrete",
        autoreset_mode="same_step",
        backend=args.backend,
    )
    data = [Dataset.open(folder) for folder in args.data]
    for dataset in data:
        dataset.require(env.tensors)  # the same elements, sizes and actions
    policy = Grid(env.tensors.task.agent.bins, int(env.single_action_space.n))
    curve = train(policy, data, env.tensors.action_form.encode, args)
    with open(args.out, "w", newline="") as file:
        writer = csv.DictWriter(file, curve[0])
        writer.writeheader()
        writer.writerows(curve)

    found = compare(env, policy, data)
    print(f"\n{'policy':<8} {'return':>8} {'± standard error':>17}   ({args.worlds} worlds, split test)")
    for name, returns in found.items():
        print(f"{name:<8} {returns.mean():8.2f} {returns.std(ddof=1) / len(returns) ** 0.5:17.2f}")
    return {name: float(returns.mean()) for name, returns in found.items()}


if __name__ == "__main__":
    main()
