"""Behavior cloning: learn a task's scripted expert from recorded episodes, as a classifier of actions.

    pip install 'powderdsl[rl]'
    powderdsl record sand-pushing --policy expert --episodes 256 --out pushes
    python examples/behavior_cloning.py --task sand-pushing --data pushes

The policy is fully convolutional: it maps a picture of element ids to one number for each operation at each bin of the
action grid. What it learns in one corner of the world therefore applies in all others.

It prints a table of returns on worlds that training has never seen, and writes the learning curve to a CSV file.
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
from torch.utils.data import BatchSampler, DataLoader, RandomSampler

from powderdsl.datasets import Dataset, Transitions, split
from powderdsl.envs import PowderVectorEnv
from powderdsl.tasks.players import ExpertPlayer


class ConvPolicy(nn.Module):
    """From observations, uint8 [B, 1, H, W], to logits [B, actions]: operations × rows × columns of bins."""

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

    def forward(self, observed: Tensor) -> Tensor:
        embedded = self.elements(observed[:, 0].long()).permute(0, 3, 1, 2)
        found = functional.adaptive_avg_pool2d(functional.relu(self.cells(embedded)), self.bins)
        y, x = (torch.linspace(-1, 1, count, device=found.device) for count in self.bins)
        where = torch.stack(torch.meshgrid(y, x, indexing="ij")).expand(len(found), -1, -1, -1)
        found = self.blocks(torch.cat([found, where], 1))
        logits = torch.cat([self.per_bin(found).flatten(1), self.idle(found.mean((2, 3)))], 1)
        return logits[:, : self.actions]


def make_env(args: argparse.Namespace, worlds: int, name: str = "test") -> PowderVectorEnv:
    """Environments of a split, in which an action is one number."""
    return PowderVectorEnv(
        args.task,
        worlds,
        split=name,
        actions="discrete",
        autoreset_mode="same_step",
        backend=args.backend,
    )


def returns_of(env: PowderVectorEnv, act: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """The return of one episode in each of the worlds 0, 1, …: float [B]."""
    observed, _ = env.reset(seed=0)
    returns, over = np.zeros(env.num_envs), np.zeros(env.num_envs, bool)
    while not over.all():
        observed, reward, terminated, truncated, _ = env.step(act(observed))
        returns += reward * ~over  # a finished environment plays another episode meanwhile
        over |= terminated | truncated
    return returns


def compare(env: PowderVectorEnv, policy: nn.Module) -> dict[str, np.ndarray]:
    """Returns of the clone, its expert and random actions, in the same worlds."""
    tensors, random = env.tensors, np.random.default_rng(0)
    expert = ExpertPlayer(tensors.program)

    def clone(observed: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            return policy(torch.from_numpy(observed)).argmax(1).numpy()

    return {
        "random": returns_of(
            env, lambda observed: random.integers(env.single_action_space.n, size=len(observed))
        ),
        "clone": returns_of(env, clone),
        "expert": returns_of(env, lambda _: tensors.action_form.encode(expert(tensors.episodes)).numpy()),
    }


def evaluate(policy: nn.Module, rows: Transitions, encode: Callable[[Tensor], Tensor]) -> tuple[float, float]:
    """Cross-entropy, and the share of rows in which the likeliest action is the expert's."""
    loss, right = 0.0, 0
    with torch.no_grad():
        for batch in DataLoader(
            rows, batch_size=None, sampler=BatchSampler(range(len(rows)), 256, drop_last=False)
        ):
            logits, wanted = policy(batch.observation), encode(batch.action)
            loss += float(functional.cross_entropy(logits, wanted, reduction="sum"))
            right += int((logits.argmax(1) == wanted).sum())
    return loss / len(rows), right / len(rows)


def train(policy: nn.Module, env: PowderVectorEnv, args: argparse.Namespace) -> list[dict[str, float]]:
    """Fit the policy to the recorded actions. Returns the learning curve, one row for each evaluation."""
    data = [Dataset.open(folder) for folder in args.data]
    for dataset in data:
        dataset.require(env.tensors)  # the same elements, sizes and actions
    training, held_out = split(Transitions(data), (0.9, 0.1), seed=args.seed)  # by world
    encode = env.tensors.action_form.encode  # from five recorded numbers to one
    optimizer = torch.optim.Adam(policy.parameters(), args.lr)
    curve, begun, update = [], time.perf_counter(), 0
    generator = torch.Generator().manual_seed(args.seed)
    while update < args.updates:
        sampler = BatchSampler(RandomSampler(training, generator=generator), args.batch, drop_last=True)
        for batch in DataLoader(training, batch_size=None, sampler=sampler):
            loss = functional.cross_entropy(policy(batch.observation), encode(batch.action))
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            update += 1
            if update % args.every == 0 or update == args.updates:
                held_out_loss, accuracy = evaluate(policy, held_out, encode)
                row = {
                    "update": update,
                    "seconds": round(time.perf_counter() - begun, 1),
                    "loss": round(float(loss.detach()), 4),
                    "held_out_loss": round(held_out_loss, 4),
                    "held_out_accuracy": round(accuracy, 4),
                }
                curve.append(row)
                print("  ".join(f"{name} {value:g}" for name, value in row.items()))
            if update == args.updates:
                break
    return curve


def main(arguments: list[str] | None = None) -> dict[str, float]:
    """Train and compare. Returns the mean return of each policy and the accuracy on held-out worlds."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--task", default="sand-pushing", help="a shipped task, or a task file")
    parser.add_argument(
        "--data", required=True, nargs="+", help="folders of `powderdsl record TASK --policy expert`"
    )
    parser.add_argument("--updates", type=int, default=600)
    parser.add_argument("--batch", type=int, default=64, help="transitions of an update")
    parser.add_argument("--every", type=int, default=100, help="updates between evaluations")
    parser.add_argument("--lr", type=float, default=2e-3)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--worlds", type=int, default=64, help="worlds of the split `test` to play in")
    parser.add_argument("--backend", default="auto", help="backend of the simulation")
    parser.add_argument("--out", default="behavior_cloning.csv")
    args = parser.parse_args(arguments)

    torch.manual_seed(args.seed)
    env = make_env(args, args.worlds)
    policy = ConvPolicy(env.tensors.task.agent.bins, int(env.single_action_space.n))
    curve = train(policy, env, args)
    with open(args.out, "w", newline="") as file:
        writer = csv.DictWriter(file, curve[0])
        writer.writeheader()
        writer.writerows(curve)

    found = compare(env, policy)
    print(f"\n{'policy':<8} {'return':>8} {'± standard error':>17}   ({args.worlds} worlds, split test)")
    for name, returns in found.items():
        print(f"{name:<8} {returns.mean():8.2f} {returns.std(ddof=1) / len(returns) ** 0.5:17.2f}")
    return {name: float(returns.mean()) for name, returns in found.items()} | {
        "held_out_accuracy": curve[-1]["held_out_accuracy"]
    }


if __name__ == "__main__":
    main()
