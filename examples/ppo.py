"""Proximal policy optimization (Schulman et al., 2017) in one file, after CleanRL.

    pip install 'powderdsl[rl]'
    python examples/ppo.py --task burn-the-weeds

Actor and critic share a fully convolutional network; the actor has one output for each operation at each bin of the
action grid. The script prints the returns of training episodes, then a table of returns on worlds that training has
never seen, and writes the learning curve to a CSV file.
"""

from __future__ import annotations

import argparse
import csv
import time
from collections import deque
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor, nn
from torch.distributions import Categorical
from torch.nn import functional

from powderdsl.envs import PowderVectorEnv
from powderdsl.tasks.players import ExpertPlayer


class Agent(nn.Module):
    """From observations, uint8 [B, 1, H, W], to logits [B, actions] and values [B]."""

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
        self.critic = nn.Sequential(nn.Linear(2 * width, 64), nn.ReLU(), nn.Linear(64, 1))
        for last in (self.per_bin, self.idle):
            nn.init.normal_(last.weight, std=0.01)  # nearly uniform at first
            nn.init.zeros_(last.bias)

    def forward(self, observed: Tensor) -> tuple[Tensor, Tensor]:
        embedded = self.elements(observed[:, 0].long()).permute(0, 3, 1, 2)
        found = functional.adaptive_avg_pool2d(functional.relu(self.cells(embedded)), self.bins)
        y, x = (torch.linspace(-1, 1, count, device=found.device) for count in self.bins)
        where = torch.stack(torch.meshgrid(y, x, indexing="ij")).expand(len(found), -1, -1, -1)
        found = self.blocks(torch.cat([found, where], 1))
        mean = found.mean((2, 3))
        logits = torch.cat([self.per_bin(found).flatten(1), self.idle(mean)], 1)[:, : self.actions]
        return logits, self.critic(torch.cat([mean, found.amax((2, 3))], 1))[:, 0]


def make_env(args: argparse.Namespace, count: int, split: str) -> PowderVectorEnv:
    """Environments of a split, in which an action is one number and episodes restart within a step."""
    return PowderVectorEnv(
        args.task,
        count,
        split=split,
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


def compare(env: PowderVectorEnv, agent: Agent) -> dict[str, np.ndarray]:
    """Returns of random actions, of the agent, and of the task's expert, if it has one, in the same worlds."""
    tensors, random = env.tensors, np.random.default_rng(0)

    def ppo(observed: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            return Categorical(logits=agent(torch.from_numpy(observed))[0]).sample().numpy()

    found = {
        "random": returns_of(env, lambda shown: random.integers(env.single_action_space.n, size=len(shown))),
        "ppo": returns_of(env, ppo),
    }
    if tensors.task.expert is not None:
        expert = ExpertPlayer(tensors.program)
        encode = tensors.action_form.encode
        found["expert"] = returns_of(env, lambda _: encode(expert(tensors.episodes)).numpy())
    return found


def train(agent: Agent, envs: PowderVectorEnv, args: argparse.Namespace) -> list[dict[str, float]]:
    """Improve the agent for `args.steps` interactions. Returns the learning curve, one row for each update."""
    shape = (args.rollout, args.envs)
    observations = torch.zeros(*shape, *envs.single_observation_space.shape, dtype=torch.uint8)
    actions = torch.zeros(shape, dtype=torch.int64)
    log_probs, rewards, dones, values = (torch.zeros(shape) for _ in range(4))
    optimizer = torch.optim.Adam(agent.parameters(), args.lr, eps=1e-5)
    updates = max(1, args.steps // (args.rollout * args.envs))
    recent: deque[float] = deque(maxlen=100)
    curve, begun = [], time.perf_counter()
    shown, _ = envs.reset(seed=args.seed)
    observed = torch.from_numpy(shown)
    for update in range(updates):
        optimizer.param_groups[0]["lr"] = args.lr * (1 - update / updates)

        # Play.
        for step in range(args.rollout):
            with torch.no_grad():
                logits, values[step] = agent(observed)
            distribution = Categorical(logits=logits)
            observations[step], actions[step] = observed, distribution.sample()
            log_probs[step] = distribution.log_prob(actions[step])
            shown, reward, terminated, truncated, info = envs.step(actions[step].numpy())
            rewards[step], dones[step] = torch.from_numpy(reward), torch.from_numpy(terminated | truncated)
            recent.extend(info["episode_return"][terminated | truncated])
            if (
                truncated.any()
            ):  # the critic estimates the rewards that a truncated episode would still have had
                last = torch.from_numpy(np.stack(list(info["final_obs"][truncated])))
                with torch.no_grad():
                    rewards[step, torch.from_numpy(truncated)] += args.gamma * agent(last)[1]
            observed = torch.from_numpy(shown)

        # Estimate advantages (GAE).
        advantages, following = torch.zeros(shape), torch.zeros(args.envs)
        with torch.no_grad():
            next_value = agent(observed)[1]
        for step in reversed(range(args.rollout)):
            goes_on = 1 - dones[step]
            delta = rewards[step] + args.gamma * next_value * goes_on - values[step]
            following = delta + args.gamma * args.gae * goes_on * following
            advantages[step], next_value = following, values[step]
        targets = (advantages + values).flatten()
        advantages = advantages.flatten()

        # Learn.
        rows = [one.flatten(0, 1) for one in (observations, actions, log_probs)]
        for _ in range(args.epochs):
            for chosen in torch.randperm(len(targets)).split(args.batch):
                old_observed, action, old_log_prob = (one[chosen] for one in rows)
                logits, value = agent(old_observed)
                distribution = Categorical(logits=logits)
                ratio = (distribution.log_prob(action) - old_log_prob).exp()
                gain = advantages[chosen]
                gain = (gain - gain.mean()) / (gain.std() + 1e-8)
                clipped = ratio.clamp(1 - args.clip, 1 + args.clip)
                policy_loss = -torch.min(gain * ratio, gain * clipped).mean()
                value_loss = functional.mse_loss(value, targets[chosen])
                entropy = distribution.entropy().mean()
                loss = policy_loss + args.vf_coef * value_loss - args.ent_coef * entropy
                optimizer.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(agent.parameters(), args.max_grad_norm)
                optimizer.step()

        row = {
            "interactions": (update + 1) * args.rollout * args.envs,
            "seconds": round(time.perf_counter() - begun, 1),
            "return": round(float(np.mean(recent)), 4) if recent else float("nan"),
            "entropy": round(float(entropy.detach()), 4),
            "value_loss": round(float(value_loss.detach()), 4),
        }
        curve.append(row)
        if (update + 1) % args.every == 0 or update + 1 == updates:
            print("  ".join(f"{name} {value:g}" for name, value in row.items()))
    return curve


def main(arguments: list[str] | None = None) -> dict[str, float]:
    """Train and compare. Returns the mean return of each policy."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--task", default="burn-the-weeds", help="a shipped task, or a task file")
    parser.add_argument("--steps", type=int, default=50_000, help="interactions to train for")
    parser.add_argument("--envs", type=int, default=32, help="environments that are stepped together")
    parser.add_argument("--rollout", type=int, default=32, help="interactions of each between updates")
    parser.add_argument("--epochs", type=int, default=3)
    parser.add_argument("--batch", type=int, default=256)
    parser.add_argument("--lr", type=float, default=1e-3, help="falls to zero")
    parser.add_argument("--gamma", type=float, default=0.99)
    parser.add_argument("--gae", type=float, default=0.95, help="lambda of the advantages")
    parser.add_argument("--clip", type=float, default=0.2)
    parser.add_argument("--vf-coef", type=float, default=0.5)
    parser.add_argument("--ent-coef", type=float, default=0.003)
    parser.add_argument("--max-grad-norm", type=float, default=0.5)
    parser.add_argument("--every", type=int, default=5, help="updates between printed rows")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--worlds", type=int, default=64, help="worlds of the split `test` to play in")
    parser.add_argument("--backend", default="auto", help="backend of the simulation")
    parser.add_argument("--out", default="ppo.csv")
    args = parser.parse_args(arguments)

    torch.manual_seed(args.seed)
    envs = make_env(args, args.envs, "train")
    agent = Agent(envs.tensors.task.agent.bins, int(envs.single_action_space.n))
    curve = train(agent, envs, args)
    with open(args.out, "w", newline="") as file:
        writer = csv.DictWriter(file, curve[0])
        writer.writeheader()
        writer.writerows(curve)

    found = compare(make_env(args, args.worlds, "test"), agent)
    print(f"\n{'policy':<8} {'return':>8} {'± standard error':>17}   ({args.worlds} worlds, split test)")
    for name, returns in found.items():
        print(f"{name:<8} {returns.mean():8.2f} {returns.std(ddof=1) / len(returns) ** 0.5:17.2f}")
    return {name: float(returns.mean()) for name, returns in found.items()}


if __name__ == "__main__":
    main()
