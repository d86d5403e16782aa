"""`powderdsl watch`: record a video of an agent at its task."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from powderdsl.cli import options as opt
from powderdsl.cli.exits import BadInput, user_values
from powderdsl.cli.pictures import MAX_SIDE
from powderdsl.tasks.task import Task


@click.command("watch", cls=opt.Command)
@click.argument("run", metavar="RUN|TASK")
@click.option("--split", help="Split: the set of worlds.  [default: test if the task has it, else train]")
@opt.option("--worlds", (1, 64), "Number of worlds of the split, side by side.", 4)
@opt.option(
    "--policy",
    ("trained", "expert", "random", "nothing"),
    "Policy that acts.  [default: trained; for a TASK: random]",
)
@click.option("--deterministic/--sampled", default=False, help="Take the most likely action, or sample one.")
@opt.option("--seed", (0, 2**32 - 1), "Seed of the policy.", 0)
@opt.task_options
@opt.output("--out", "FILE", "Video file to write.  [default: watch.gif in the run's folder]", ".gif", ".mp4")
@opt.option("--fps", (1, 240), "Frames per second.", 15)
@opt.option("--scale", (1, 32), "Pixels per cell.", 4)
@click.option("--backend", type=opt.BACKEND, help="Backend that runs the rules.  [default: the run's]")
def command(
    run: str,
    split: str | None,
    worlds: int,
    policy: str | None,
    deterministic: bool,
    seed: int,
    out: Path | None,
    fps: int,
    scale: int,
    backend: str | None,
    **changes: Any,
) -> None:
    """Play worlds of a RUN's task with its agent, side by side, and write a video.

    Regions and the agent's brush are outlined; the return so far and the action are shown below each world. For a TASK,
    actions are random, or there is no agent.
    """
    played = opt.find_played(run, **changes)
    policy = policy or ("random" if isinstance(played, Task) else "trained")
    if isinstance(played, Task) and policy == "trained":
        raise BadInput("a task has no trained policy: name a run, or choose --policy random")
    from powderdsl.rl.evaluation import film, player, subject

    own, config, task = subject(played, changes["packs"])
    names = [split.name for split in task.splits]
    split = split or ("test" if "test" in names else names[0])
    if out is None:
        out = own.path / "watch.gif" if own else Path("watch.gif")
        opt.check_writable(out)
    if max(task.size) * scale * min(worlds, 4) > MAX_SIDE:
        raise BadInput("the video would be too large: choose a smaller --scale, or fewer --worlds")
    import torch

    from powderdsl.tasks.episodes import compile_task
    from powderdsl.worlds.media import write_gif, write_mp4

    program = compile_task(task, split=split, backend=backend or config.backend)
    with user_values():
        acts = player(policy, program, own, deterministic=deterministic)
    observation = config.observation if policy == "trained" else "ids"
    numbers = torch.arange(worlds)
    episodes, pictures = film(program, acts, numbers, observation=observation, seed=seed, factor=scale)
    write = write_gif if out.suffix.lower() == ".gif" else write_mp4
    write(out, pictures, fps=fps)
    returns = ", ".join(f"{total:.2f}" for total in episodes.returns.tolist())
    click.echo(f"wrote {out}: {task.name}, {policy}, worlds 0 to {worlds - 1} of {split}: {returns}")
