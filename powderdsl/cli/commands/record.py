"""`powderdsl record`: record episodes of a task for offline learning and world models."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from powderdsl.cli import options as opt
from powderdsl.cli.exits import OK, BadInput, user_values
from powderdsl.cli.output import counted, progress
from powderdsl.datasets.manifest import check_place
from powderdsl.tasks.shipped import check_split, load_task
from powderdsl.tasks.task import Task

if TYPE_CHECKING:
    from powderdsl.datasets.dataset import Dataset
    from powderdsl.experiments.runs import RunFolder


@click.command("record", cls=opt.Command)
@click.argument("task", required=False)
@opt.path("--out", "FOLDER", "Folder of the dataset.")
@opt.option("--episodes", (1, 1 << 32), "Number of episodes to record.")
@opt.option("--split", "SPLIT", "The set of worlds.", "train")
@opt.option(
    "--policy",
    "expert|random|nothing|RUN",
    "Policy: the task's expert, uniformly random actions, no action, or a trained agent.",
    "random",
)
@opt.option("--observation", ("ids", "compact"), "Record only elements, or the whole state.", "ids")
@opt.option("--seed", (0, (1 << 61) - 1), "Number of the first episode's world, and seed of the policy.", 0)
@opt.option("--worlds", (1, (1 << 61) - 1), "Number of worlds to draw from.", 1_000_000)
@opt.task_options
@opt.option("--shard", (1, 1 << 32), "Episodes per file.  [default: 256, or 256 MiB]")
@opt.option("--compress", bool, "Smaller files, slower to read.")
@opt.option("--envs", (1, 1 << 20), "Maximum number of episodes played at once.", 256)
@opt.backend("auto")
@opt.device
@opt.path("--verify", "FOLDER", "Only verify a dataset, reading every byte.")
@opt.option("--to-minari", "ID", "Only convert the dataset --out to a Minari dataset, namespace/name-v0.")
@opt.option(
    "--from-minari",
    "ID",
    "Only convert a Minari dataset written by --to-minari to the folder --out.",
)
def command(
    task: str | None,
    out: Path | None,
    episodes: int | None,
    policy: str,
    verify: Path | None,
    to_minari: str | None,
    from_minari: str | None,
    **how: Any,
) -> int:
    """Record episodes of TASK: observations, actions, rewards, and whether each step ends the episode.

    The data depend only on the options, but not on --envs. After an interruption, the same command resumes.

    \b
        powderdsl record TASK --out data --episodes 1000
        powderdsl record --verify data
        powderdsl record --out data --to-minari me/data-v0
    """
    modes = {"--verify": verify, "--to-minari": to_minari, "--from-minari": from_minari}
    mode, *others = [name for name, value in modes.items() if value is not None] or [""]
    needs = NEEDS[mode]
    values = {"TASK": task, "--out": out, "--episodes": episodes}
    arguments = [*others, *(name for name, value in values.items() if value is not None)]
    if extra := [name for name in arguments if name not in needs]:
        raise BadInput(f"{mode} cannot be used with {', '.join(extra)}")
    if missing := [name for name in needs if name not in arguments]:
        raise BadInput(f"missing {', '.join(missing)}")
    from powderdsl.datasets.dataset import Dataset

    with user_values():
        if mode == "":
            dataset = _recorded(str(task), Path(out or ""), policy, episodes=episodes, **how)
        elif from_minari is not None:
            from powderdsl.datasets import minari

            dataset = minari.from_minari(from_minari, out or "")
        else:
            dataset = Dataset.open(verify or out or "")
        if verify is not None:
            dataset.check()
        if to_minari is not None:
            from powderdsl.datasets import minari

            minari.to_minari(dataset, to_minari)
    recipe, size = dataset.recipe, sum(row.bytes for row in dataset.manifest.shards)
    click.echo(
        f"{to_minari or verify or out}: {counted(len(dataset), 'episode')} of {recipe.task} "
        f"({recipe.split}, {recipe.policy}), {dataset.steps:,} transitions, "
        f"{counted(recipe.shards, 'shard')}, {size / 1e6:,.1f} MB{', all as recorded' if verify else ''}",
        err=True,
    )
    return OK


NEEDS = {
    "": ("TASK", "--out", "--episodes"),
    "--verify": (),
    "--to-minari": ("--out",),
    "--from-minari": ("--out",),
}
"""The arguments that each mode of the command requires; it rejects those of other modes."""


def _recorded(
    name: str,
    out: Path,
    policy: str,
    *,
    knobs: dict[str, int],
    settings: dict[str, str],
    packs: tuple[str, ...],
    **how: Any,
) -> Dataset:
    from powderdsl.datasets.recorder import SCRIPTED, record
    from powderdsl.experiments.runs import find_run, recorded_palette

    check_place(out)
    run = None if policy in SCRIPTED else find_run(policy, "ppo")
    palette = None if run is None else recorded_palette(run)
    task = load_task(name, knobs=knobs, params=settings, packs=packs, palette=palette)
    check_split(task, how["split"])
    with progress(task.name, how["episodes"], lines=True, resumes=out) as show:
        acting = {"policy": policy} if run is None else _trained(run, task, how)
        return record(task, folder=out, progress=lambda done, total: show(done, "episodes"), **acting, **how)


def _trained(run: RunFolder, task: Task, how: dict[str, Any]) -> dict[str, Any]:
    """The policy of a run, its name and its observation, as arguments of `record`.

    Raises CompileError (PD620), and ValueError if the run does not fit.
    """
    from powderdsl.envs.mixed import environment
    from powderdsl.rl.policies import config_of, load_policy

    sees = config_of(run).observation
    where = {name: how[name] for name in ("split", "backend", "device")}
    env = environment(task, 1, observation=sees, **where)
    name = f"{run.path.name}, checkpoint {run.checkpoint().path.stem}"
    return {"policy": load_policy(run, env), "policy_name": name, "sees": sees}
