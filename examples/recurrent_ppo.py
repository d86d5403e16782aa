"""Recurrent PPO of sb3-contrib: an agent with a memory, in universes that training never shows.

    pip install 'powderdsl[sb3-contrib]'
    python examples/recurrent_ppo.py --task find-the-solvent --rulesets 64 --seeds 5

The settings are those of `powderdsl train --preset small --epochs 4`, with an LSTM between the features and the policy, so
its returns can be compared with those of the study `unseen-laws`. It prints the mean return of each run on its training
worlds and on worlds of the split `test`, and writes them to a JSON file. A second call resumes an interrupted one.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import torch
from sb3_contrib import RecurrentPPO

from powderdsl.envs.features import small_policy
from powderdsl.envs.sb3 import PowderVecEnv
from powderdsl.rl.config import preset
from powderdsl.tasks.episodes import compile_task
from powderdsl.tasks.shipped import load_task


def make_env(args: argparse.Namespace, count: int, split: str) -> PowderVecEnv:
    """`count` worlds of a split; training worlds use the first `--rulesets` rulesets."""
    rulesets = args.rulesets if split == "train" else 0
    program = compile_task(load_task(args.task), split=split, backend=args.backend, rulesets=rulesets)
    return PowderVecEnv(program, count, observation="ids", actions="full")


def train(args: argparse.Namespace, seed: int) -> RecurrentPPO:
    """An agent after `--steps` interactions."""
    config = preset("small", args.task)
    env = make_env(args, config.envs, "train")
    network = {**small_policy(env.tensors, config.features), "lstm_hidden_size": config.features}
    model = RecurrentPPO(
        "CnnLstmPolicy",
        env,
        learning_rate=config.learning_rate,
        n_steps=config.rollout,
        batch_size=config.batch,
        n_epochs=4,
        gamma=config.gamma,
        ent_coef=config.entropy,
        policy_kwargs=network,
        seed=seed,
        device="cpu",
    )
    return model.learn(args.steps)


def play(model: RecurrentPPO, env: PowderVecEnv) -> float:
    """The mean return of an episode in each world, with actions drawn by the agent."""
    env.seed(0)
    observed, memory = env.reset(), None
    total, playing = np.zeros(env.num_envs), np.ones(env.num_envs, bool)
    starts = playing.copy()
    while playing.any():
        action, memory = model.predict(observed, memory, starts)
        observed, reward, starts, _ = env.step(action)
        total += np.where(playing, reward, 0)
        playing &= ~starts
    return float(total.mean())


def main(arguments: list[str] | None = None) -> dict[str, float]:
    """Run the missing parts. Returns the mean return on each split, over seeds."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--task", default="find-the-solvent", help="a shipped task, or a task file")
    parser.add_argument("--rulesets", type=int, default=0, help="training rulesets; 0: all of the task's")
    parser.add_argument("--steps", type=int, default=40_960, help="interactions to train for")
    parser.add_argument("--seeds", type=int, default=1, help="runs")
    parser.add_argument("--worlds", type=int, default=128, help="worlds of each split to play in")
    parser.add_argument("--backend", default="auto", help="backend of the simulation")
    parser.add_argument("--out", type=Path, default=Path("recurrent.json"))
    args = parser.parse_args(arguments)

    torch.set_num_threads(1)
    runs = json.loads(args.out.read_text()) if args.out.exists() else {}
    names = [
        f"task={args.task},rulesets={args.rulesets},steps={args.steps},seed={seed}"
        for seed in range(args.seeds)
    ]
    for seed, name in enumerate(names):
        if name not in runs:
            model = train(args, seed)
            runs[name] = {
                split: play(model, make_env(args, args.worlds, split)) for split in ("train", "test")
            }
            args.out.write_text(json.dumps(runs, indent=1))
        print(name, *(f"{split} {mean:.3f}" for split, mean in runs[name].items()), flush=True)
    return {split: float(np.mean([runs[name][split] for name in names])) for split in ("train", "test")}


if __name__ == "__main__":
    main()
