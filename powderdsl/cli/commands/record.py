"""`powderdsl record`: episodes of a task, written to disk for offline learning and world models."""

from __future__ import annotations

import shlex
import sys
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from powderdsl.cli.exits import BAD_INPUT, OK, BadInput, counted, user_values, write_diagnostics
from powderdsl.cli.options import PATH, Integer, ManyWords, backend_option, packs_option, set_option
from powderdsl.cli.progress import progress
from powderdsl.cli.task_sheets import knob_values
from powderdsl.datasets.manifest import check_place, read_manifest
from powderdsl.diagnostics import CompileError, Diagnostic
from powderdsl.tasks.shipped import check_split, load_task
from powderdsl.tasks.task import Task

SCRIPTED = ("random", "nothing")


@click.command("record", cls=ManyWords)
@click.argument("task", required=False)
@click.option("--out", type=PATH, metavar="FOLDER", help="Where the dataset goes.")
@click.option("--episodes", type=Integer(1, 1 << 32), help="How many are recorded.")
@click.option("--split", default="train", help="Split: which worlds.")
@click.option(
    "--policy",
    metavar="random|nothing|RUN",
    default="random",
    help="What acts in them: every action equally likely, one that does nothing, or a trained agent.",
)
@click.option(
    "--observation",
    type=click.Choice(("ids", "compact")),
    default="ids",
    help="Elements, or everything that lasts.",
)
@click.option(
    "--seed",
    type=Integer(0, (1 << 61) - 1),
    default=0,
    help="The first episode's world, and the policy's draws.",
)
@click.option(
    "--worlds",
    type=Integer(1, (1 << 61) - 1),
    default=1_000_000,
    help="How many worlds there are: their numbers lie below.",
)
@click.option("--knob", "knobs", multiple=True, metavar="NAME=N", help="Another value for a knob.")
@set_option
@packs_option
@click.option("--shard", type=Integer(1, 1 << 32), help="Episodes a file.  [default: 256, or 256 MiB]")
@click.option("--compress", is_flag=True, help="Smaller files, slower to read.")
@click.option("--envs", type=Integer(1, 1 << 20), default=256, help="Episodes at once, at most.")
@backend_option("auto")
@click.option("--device", default="cpu", help="A torch device: cpu, cuda, cuda:1.")
@click.option("--verify", type=PATH, metavar="FOLDER", help="Record nothing: read every byte of a dataset.")
def command(
    task: str | None,
    out: Path | None,
    episodes: int | None,
    split: str,
    policy: str,
    knobs: tuple[str, ...],
    settings: dict[str, str],
    packs: tuple[str, ...],
    backend: str,
    device: str,
    verify: Path | None,
    **asked: Any,
) -> int:
    """Record whole episodes of TASK: observations, actions, rewards, ends.

    What is recorded follows from the options alone, and not from --envs. When it was interrupted, the same command
    continues.

    \b
        powderdsl record TASK --out data --episodes 1000
        powderdsl record --verify data
    """
    if verify is not None:
        if task is not None or out is not None or episodes is not None:
            raise BadInput("--verify takes a folder, and no TASK, --out or --episodes")
        return _verify(verify)
    found = _checked(task, out, episodes, split, policy, knobs, settings, packs)
    if found is None:
        return BAD_INPUT
    assert out is not None
    assert episodes is not None
    _require_gymnasium()
    from powderdsl.datasets.recorder import record

    try:
        with user_values(), progress(found.name, episodes, lines=True) as show:
            act = _policy(policy, found, split, backend, device)
            dataset = record(
                found,
                act.policy,
                out,
                episodes=episodes,
                policy_name=act.name,
                sees=act.sees,
                progress=lambda done, total: show(done, "episodes"),
                split=split,
                backend=backend,
                device=device,
                **asked,
            )
    except KeyboardInterrupt:
        _say_how_to_go_on(out, episodes)
        raise
    size = sum(row.bytes for row in dataset.manifest.shards)
    click.echo(
        f"{out}: {counted(len(dataset), 'episode')}, {dataset.steps:,} transitions, "
        f"{counted(dataset.recipe.shards, 'shard')}, {size / 1e6:,.1f} MB",
        err=True,
    )
    return OK


def _checked(
    task: str | None,
    out: Path | None,
    episodes: int | None,
    split: str,
    policy: str,
    knobs: tuple[str, ...],
    settings: dict[str, str],
    packs: tuple[str, ...],
) -> Task | None:
    """The task, or None after saying everything that is wrong, before anything is imported that takes long."""
    missing = [
        name for name, value in (("TASK", task), ("--out", out), ("--episodes", episodes)) if value is None
    ]
    wrong = [f"missing {', '.join(missing)}"] if missing else []
    diagnostics: list[Diagnostic] = []
    values: dict[str, int] = {}
    for knob in knobs:
        try:
            values |= knob_values([knob])
        except BadInput as error:
            wrong.append(error.format_message())
    found = None
    try:
        if out is not None:
            check_place(out)
    except CompileError as error:
        diagnostics.extend(error.diagnostics)
    palette = None
    if policy not in SCRIPTED:
        from powderdsl.experiments.runs import find_run
        from powderdsl.rl.policies import recorded_palette

        try:
            palette = recorded_palette(find_run(policy, "ppo"))
        except CompileError as error:
            diagnostics.extend(error.diagnostics)
    try:
        if task is not None:
            found = load_task(task, knobs=values, params=settings, packs=packs, palette=palette)
            check_split(found, split)
    except CompileError as error:
        diagnostics.extend(error.diagnostics)
    if found is not None and policy == "nothing":
        _require_gymnasium()
        from powderdsl.datasets.scripted import still_action

        try:
            still_action(found)
        except ValueError as error:
            wrong.append(str(error))
    if diagnostics:
        write_diagnostics(diagnostics, sys.stderr)
    for line in wrong:
        click.echo(f"error: {line}", err=True)
    return None if wrong or diagnostics else found


@dataclass(frozen=True)
class _Act:
    """What acts: see `record`."""

    policy: Any
    name: str | None = None
    sees: str | None = None


def _policy(policy: str, task: Task, split: str, backend: str, device: str) -> _Act:
    """A policy by name, or the one of a run. Raises CompileError (PD620), and ValueError if the run does not fit."""
    if policy in SCRIPTED:
        return _Act(policy)
    from powderdsl.envs.tensor_env import TensorEnv
    from powderdsl.experiments.runs import find_run
    from powderdsl.rl.policies import config_of, load_policy

    run = find_run(policy, "ppo")
    sees = config_of(run).observation
    env = TensorEnv(task, 1, split=split, observation=sees, backend=backend, device=device)
    name = f"{run.path.name}, checkpoint {run.checkpoint().path.stem}"
    return _Act(load_policy(run, env), name, sees)


def _require_gymnasium() -> None:
    """Raises CompileError (PD612) if the environments' package is not installed."""
    try:
        import powderdsl.envs  # noqa: F401  only whether it can be imported
    except ModuleNotFoundError as error:
        from powderdsl.system.writing import failure

        raise failure(
            "PD612", f"recording needs the package {error.name}", helps=("pip install 'powderdsl[rl]'",)
        ) from None


def _verify(folder: Path) -> int:
    _require_gymnasium()
    from powderdsl.datasets.dataset import Dataset

    dataset = Dataset.open(folder)
    dataset.check()
    recipe = dataset.recipe
    click.echo(
        f"{folder}: {counted(len(dataset), 'episode')} of {recipe.task} ({recipe.split}, {recipe.policy}), "
        f"{dataset.steps:,} transitions, {counted(recipe.shards, 'shard')}: all as recorded"
    )
    return OK


def _say_how_to_go_on(out: Path, episodes: int) -> None:
    there = 0
    with suppress(CompileError):  # interrupted before anything was written
        manifest = read_manifest(out)
        there = sum(len(manifest.recipe.episodes_of(row.number)) for row in manifest.shards)
    click.echo(
        f"stopped with {there:,} of {episodes:,} episodes in {shlex.quote(str(out))}: the same command continues",
        err=True,
    )
