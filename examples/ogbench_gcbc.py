"""Goal-conditioned behavioral cloning on OGBench's Powderworld: learn from scripted play how to reach a goal.

    pip install 'powderdsl[rl]'
    powderdsl ogbench easy --episodes 100 --out ogbench-data
    python examples/ogbench_gcbc.py --data ogbench-data

The policy maps an observation and a goal to one of eight actions. It is trained on pairs from one episode: a row, its
action, and as its goal a world that the same episode reaches a little later. It prints success on the level's five
tasks, compared with uniformly random actions, and writes the learning curve to a CSV file.
"""

from __future__ import annotations

import argparse
import csv
import time
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

# With OGBench: from ogbench import make_env_and_datasets
from powderdsl.ogbench import PowderworldVectorEnv, make_env_and_datasets

Policy = Callable[[np.ndarray, np.ndarray], np.ndarray]


class GoalPolicy(nn.Module):
    """From observations and goals, uint8 [B, 32, 32, 6] each, to logits [B, actions]."""

    def __init__(self, actions: int, side: int, width: int):
        super().__init__()
        self.blocks = nn.Conv2d(12, width, 4, stride=4)  # as large as the blocks that are painted
        self.around = nn.Conv2d(width, width, 3, padding=1)
        self.hidden = nn.Linear(width * (side // 4) ** 2, 4 * width)
        self.logits = nn.Linear(4 * width, actions)

    def forward(self, observed: Tensor, goal: Tensor) -> Tensor:
        both = torch.cat([observed, goal], -1).permute(0, 3, 1, 2).float() / 255 - 0.5
        found = functional.relu(self.blocks(both))
        found = found + functional.relu(self.around(found))
        return self.logits(functional.relu(self.hidden(found.flatten(1))))


class Pairs:
    """Rows of a compact data set, with goals from the same episode."""

    def __init__(self, data: dict[str, np.ndarray], ahead: float):
        self.data, self.ahead = data, ahead
        ends = np.flatnonzero(data["valids"] == 0)
        starts = np.append(0, ends[:-1] + 1)
        self.rows = np.flatnonzero(data["valids"])
        episode = np.searchsorted(ends, self.rows)
        self.first, self.last = starts[episode], ends[episode]

    def sample(self, count: int, random: np.random.Generator) -> tuple[Tensor, Tensor, Tensor]:
        """Observations, goals, and the actions taken. A goal is a world after 1, 2, … more painted blocks."""
        at = random.integers(len(self.rows), size=count)
        row, first = self.rows[at], self.first[at]
        painted = (row - first) // 3 + random.geometric(1 / self.ahead, count)
        goal = np.minimum(first + 3 * painted, self.last[at] - (self.last[at] - first) % 3)
        shown = self.data["observations"]
        action = torch.from_numpy(self.data["actions"][row]).long()
        return torch.from_numpy(shown[row]), torch.from_numpy(shown[goal]), action


def successes(env: PowderworldVectorEnv, act: Policy) -> np.ndarray:
    """The share of episodes of each task that succeed: float [tasks]."""
    tasks = np.arange(env.num_envs) % len(env.level.tasks) + 1
    observed, infos = env.reset(seed=0, options={"task_id": tasks.tolist()})
    goals = infos["goal"]
    reached, over = np.zeros(env.num_envs, bool), np.zeros(env.num_envs, bool)
    while not over.all():
        observed, _, terminated, truncated, _ = env.step(act(observed, goals))
        reached |= terminated & ~over
        over |= terminated | truncated
    return np.array([reached[tasks == task].mean() for task in range(1, len(env.level.tasks) + 1)])


def chooser(policy: nn.Module, temperature: float, seed: int) -> Policy:
    """Actions drawn from the policy's logits."""
    generator = torch.Generator().manual_seed(seed)

    def act(observed: np.ndarray, goals: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            logits = policy(torch.from_numpy(observed), torch.from_numpy(goals)) / temperature
        return torch.multinomial(logits.softmax(1), 1, generator=generator)[:, 0].numpy()

    return act


def train(
    policy: nn.Module, args: argparse.Namespace, data: Pairs, held_out: Pairs
) -> list[dict[str, float]]:
    """Fit the policy. Returns the learning curve, one row for each evaluation."""
    optimizer = torch.optim.Adam(policy.parameters(), args.lr)
    random, begun = np.random.default_rng(args.seed), time.perf_counter()
    check = held_out.sample(2048, np.random.default_rng(0))
    curve = []
    for update in range(1, args.updates + 1):
        observed, goal, action = data.sample(args.batch, random)
        loss = functional.cross_entropy(policy(observed, goal), action)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if update % args.every == 0 or update == args.updates:
            with torch.no_grad():
                validation = functional.cross_entropy(policy(*check[:2]), check[2])
            row = {
                "update": update,
                "seconds": round(time.perf_counter() - begun, 1),
                "loss": round(float(loss.detach()), 4),
                "held_out_loss": round(float(validation), 4),
            }
            curve.append(row)
            print(", ".join(f"{name} {value}" for name, value in row.items()), flush=True)
    return curve


def main(argv: list[str] | None = None) -> dict[str, float]:
    """Train and compare. Returns the mean success of each policy."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--dataset", default="powderworld-easy-play-v0")
    parser.add_argument("--data", default="ogbench-data", help="folder of the data set")
    parser.add_argument("--updates", type=int, default=3000)
    parser.add_argument("--batch", type=int, default=256)
    parser.add_argument("--width", type=int, default=64)
    parser.add_argument("--lr", type=float, default=1e-3)
    parser.add_argument("--ahead", type=float, default=20, help="painted blocks to a goal, on average")
    parser.add_argument("--temperature", type=float, default=0.3)
    parser.add_argument("--episodes", type=int, default=20, help="evaluation episodes of each task")
    parser.add_argument(
        "--steps", type=int, help="steps of an evaluation episode; the level's, 500, by default"
    )
    parser.add_argument("--every", type=int, default=500)
    parser.add_argument("--backend", default="auto")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", default="gcbc.csv")
    args = parser.parse_args(argv)
    torch.manual_seed(args.seed)

    env, training, validation = make_env_and_datasets(
        args.dataset, dataset_dir=args.data, compact_dataset=True, backend=args.backend
    )
    level = env.unwrapped.level
    actions = int(env.action_space.n)
    policy = GoalPolicy(actions, level.side, args.width)
    curve = train(policy, args, Pairs(training, args.ahead), Pairs(validation, args.ahead))
    with open(args.out, "w", newline="") as file:
        writer = csv.DictWriter(file, curve[0])
        writer.writeheader()
        writer.writerows(curve)

    # The same episodes as `env` plays, all at once.
    count = args.episodes * len(level.tasks)
    batch = PowderworldVectorEnv(
        level.name,
        count,
        max_episode_steps=args.steps,
        autoreset_mode="same_step",
        backend=args.backend,
    )
    random = np.random.default_rng(args.seed)
    found = {
        "random": successes(batch, lambda observed, goals: random.integers(actions, size=len(observed))),
        "cloned": successes(batch, chooser(policy, args.temperature, args.seed)),
    }
    for name, rates in found.items():
        shares = ", ".join(f"{task.name} {rate:.2f}" for task, rate in zip(level.tasks, rates, strict=True))
        print(f"{name}: {rates.mean():.2f} ({shares})")
    return {name: float(rates.mean()) for name, rates in found.items()}


if __name__ == "__main__":
    main()
