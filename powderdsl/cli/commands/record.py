"""`powderdsl record`: record episodes of a task for offline learning and world models."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from powderdsl.cli import options as opt
from powderdsl.cli.exits import OK, BadInput, user_values
from powderdsl.cli.output import counted, progress
from powderdsl.datasets.manifest import check_place
from powderdsl.tasks.shipped import check_split, load_task
from powderdsl.tasks.task import Task

SCRIPTED = ("expert", "random", "nothing")


@click.command("record", cls=opt.ManyWords)
@click.argument("task", required=False)
@opt.path("--out", "FOLDER", "Folder of the dataset.")
@opt.option("--episodes", (1, 1 << 32), "Number of episodes to record.")
@opt.option("--split", "SPLIT", "The set of worlds.", "train")
@opt.option(
    "--policy",
    "expert|random|nothing|RUN",
    "Policy: the task's expert, every action equally likely, no action, or a trained agent.",
    "random",
)
@opt.option("--observation", ("ids", "compact"), "Record elements only, or the whole state.", "ids")
@opt.option("--seed", (0, (1 << 61) - 1), "World of the first episode, and seed of the policy.", 0)
@opt.option("--worlds", (1, (1 << 61) - 1), "Number of worlds: they are numbered from 0.", 1_000_000)
@opt.knobs("Another value for a knob of the task.")
@opt.parameters
@opt.packs
@opt.option("--shard", (1, 1 << 32), "Episodes per file.  [default: 256, or 256 MiB]")
@opt.option("--compress", bool, "Smaller files, slower to read.")
@opt.option("--envs", (1, 1 << 20), "Maximum number of episodes played at once.", 256)
@opt.backend("auto")
@opt.device
@opt.path("--verify", "FOLDER", "Record nothing: read every byte of a dataset.")
@opt.option(
    "--to-minari", "ID", "Record nothing: write the dataset --out as a Minari dataset, namespace/name-v0."
)
@opt.option(
    "--from-minari",
    "ID",
    "Record nothing: read a Minari dataset into the folder --out; of TASK, unless --to-minari wrote it.",
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
    """Record whole episodes of TASK: observations, actions, rewards, ends.

    The data depend only on the options, and not on --envs. After an interruption, the same command continues.

    \b
        powderdsl record TASK --out data --episodes 1000
        powderdsl record --verify data
        powderdsl record --out data --to-minari me/data-v0
    """
    if verify is not None:
        if task is not None or out is not None or episodes is not None:
            raise BadInput("--verify takes a folder, and no TASK, --out or --episodes")
        return _verify(verify)
    if to_minari is not None or from_minari is not None:
        return _exchanged(task, out, episodes, to_minari, from_minari, how)
    knobs, settings, packs = (how.pop(name) for name in ("knobs", "settings", "packs"))
    if task is None or out is None or episodes is None:
        required = {"TASK": task, "--out": out, "--episodes": episodes}
        raise BadInput(f"missing {', '.join(name for name, value in required.items() if value is None)}")
    with user_values():
        check_place(out)
        palette = None
        if policy not in SCRIPTED:
            from powderdsl.experiments.runs import find_run, recorded_palette

            palette = recorded_palette(find_run(policy, "ppo"))
        loaded = load_task(task, knobs=knobs, params=settings, packs=packs, palette=palette)
        check_split(loaded, how["split"])
    require_gymnasium()
    from powderdsl.datasets.recorder import record

    with user_values(), progress(loaded.name, episodes, lines=True, resumes=out) as show:
        acting = {"policy": policy} if policy in SCRIPTED else _trained(policy, loaded, how)
        dataset = record(
            loaded,
            folder=out,
            episodes=episodes,
            progress=lambda done, total: show(done, "episodes"),
            **acting,
            **how,
        )
    size = sum(row.bytes for row in dataset.manifest.shards)
    click.echo(
        f"{out}: {counted(len(dataset), 'episode')}, {dataset.steps:,} transitions, "
        f"{counted(dataset.recipe.shards, 'shard')}, {size / 1e6:,.1f} MB",
        err=True,
    )
    return OK


def _trained(path: str, task: Task, how: dict[str, Any]) -> dict[str, Any]:
    """The policy of a run, its name and what it observes, as arguments of `record`.

    Raises CompileError (PD620), and ValueError if the run does not fit.
    """
    from powderdsl.envs.tensor_env import TensorEnv
    from powderdsl.experiments.runs import find_run
    from powderdsl.rl.policies import config_of, load_policy

    run = find_run(path, "ppo")
    sees = config_of(run).observation
    where = {name: how[name] for name in ("split", "backend", "device")}
    env = TensorEnv(task, 1, observation=sees, **where)
    name = f"{run.path.name}, checkpoint {run.checkpoint().path.stem}"
    return {"policy": load_policy(run, env), "policy_name": name, "sees": sees}


def require_gymnasium() -> None:
    """Raises CompileError (PD612) if the environments' package is not installed."""
    from powderdsl.system.packages import require

    require("gymnasium", "recording", "pip install 'powderdsl[rl]'")


def _verify(folder: Path) -> int:
    require_gymnasium()
    from powderdsl.datasets.dataset import Dataset

    dataset = Dataset.open(folder)
    dataset.check()
    recipe = dataset.recipe
    click.echo(
        f"{folder}: {counted(len(dataset), 'episode')} of {recipe.task} ({recipe.split}, {recipe.policy}), "
        f"{dataset.steps:,} transitions, {counted(recipe.shards, 'shard')}: all as recorded"
    )
    return OK


def _exchanged(
    task: str | None,
    out: Path | None,
    episodes: int | None,
    to_minari: str | None,
    from_minari: str | None,
    how: dict[str, Any],
) -> int:
    """Write a dataset as a Minari dataset, or read one."""
    if out is None or episodes is not None or None not in (to_minari, from_minari):
        raise BadInput("--to-minari and --from-minari take --out and no --episodes; give one of them")
    if to_minari is not None and task is not None:
        raise BadInput("--to-minari takes no TASK: it writes what --out holds")
    require_gymnasium()
    from powderdsl.datasets import minari
    from powderdsl.datasets.dataset import Dataset

    minari.require_minari()
    with user_values():
        if to_minari is not None:
            dataset = Dataset.open(out)
            minari.to_minari(dataset, to_minari)
        elif task is None:
            dataset = minari.from_minari(str(from_minari), out)
        else:
            loaded = load_task(task, knobs=how["knobs"], params=how["settings"], packs=how["packs"])
            names = ("split", "observation", "worlds", "shard", "compress", "backend", "device")
            dataset = minari.from_minari(
                str(from_minari), out, task=loaded, **{name: how[name] for name in names}
            )
    counts = f"{counted(len(dataset), 'episode')}, {dataset.steps:,} transitions"
    click.echo(f"{to_minari or out}: {counts}", err=True)
    return OK
