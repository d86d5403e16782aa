"""`powderdsl train`: train an agent on a task; `powderdsl evaluate` and `powderdsl watch` show the result."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from powderdsl.cli import options as opt
from powderdsl.cli.exits import BadInput
from powderdsl.cli.output import print_json, progress
from powderdsl.rl.config import PRESETS, TrainConfig, from_json, preset
from powderdsl.system.reading import read_json


@click.command("train", cls=opt.Command)
@click.argument("task", metavar="TASK", required=False)
@opt.path("--run", "DIR", "Folder of the run.  [default: runs/TASK-seedN]", to="folder")
@opt.path("--resume", "DIR", "Resume a run with its own settings.")
@opt.option(
    "--preset",
    list(PRESETS),
    "Base settings, which other options override: the paper's, or a few minutes on one core."
    "  [default: small; paper with --device cuda]",
    to="preset_name",
)
@opt.path("--init-from", "DATASET", "Dataset whose actions the network imitates first (behavior cloning).")
@opt.settings_of(TrainConfig, PRESETS, checkpoint_minutes="save-every")
@opt.task_options
@opt.backend(None, "Backend that runs the rules.  [default: auto]")
@opt.option("--json", bool, "Print one JSON object instead of text.", to="as_json")
def command(task: str | None, folder: Path | None, resume: Path | None, as_json: bool, **values: Any) -> None:
    """Train an agent with PPO on TASK, a shipped task's name or a task file.

    The same command, or --resume DIR, resumes an interrupted run; a larger --steps extends a finished one. DIR contains
    checkpoints, metrics.jsonl and events for TensorBoard.
    """
    if resume is not None:
        if task is not None or folder is not None:
            raise BadInput("--resume cannot be used with TASK or --run: the run has its own task")
        config, folder = _continued(resume, values)
    else:
        config = new_config({**values, "task": task})
        folder = folder or Path("runs") / f"{Path(config.task).stem}-seed{config.seed}"
    from powderdsl.rl.training import SPEED, train

    with progress(Path(config.task).stem, config.steps, lines=True, resumes=folder) as show:

        def tell(step: int, mean: float | None) -> None:
            show(min(step, config.steps), "" if mean is None else f"return {mean:.3f}")

        run = train(config, folder, progress=tell)
    step, speed = run.checkpoint().step, read_json(run.path / SPEED) or {}
    if as_json:
        return print_json({"run": str(folder), "step": step, "speed": speed})
    click.echo(f"{folder}: {step:,} interactions")
    if speed:
        seconds, parts = speed["seconds"], ("env", "policy", "update")
        shares = ", ".join(f"{part} {speed[part] / seconds:.0%}" for part in parts)
        click.echo(f"{speed['interactions'] / seconds:,.0f} a second: {shares}")
    click.echo(f"powderdsl evaluate {folder}; powderdsl watch {folder}", err=True)


WHAT = ("knobs", "settings", "packs")
"""Options that determine worlds and rules."""


def new_config(values: Mapping[str, Any]) -> TrainConfig:
    """The settings of a new run, from options. Raises CompileError and BadInput for invalid ones."""
    task = values["task"]
    if task is None:
        raise BadInput("pass TASK or --resume DIR")
    settings = opt.given_settings(values, TrainConfig, (*WHAT, "task"))
    if "init_from" in settings:
        settings["init_from"] = str(settings["init_from"].absolute())
    name = str(Path(task).absolute()) if Path(task).suffix else task
    what = {"knobs": values["knobs"], "params": values["settings"], "packs": values["packs"]}
    usual = "paper" if settings.get("device", "cpu").startswith("cuda") else "small"
    return preset(values["preset_name"] or usual, name, **settings, **what)


def _continued(folder: Path, values: Mapping[str, Any]) -> tuple[TrainConfig, Path]:
    """The settings of a run, with permitted changes, and its folder."""
    from powderdsl.experiments.runs import find_run
    from powderdsl.rl.config import HOW
    from powderdsl.rl.policies import config_of
    from powderdsl.rl.training import ASKED, KIND

    settings = opt.given_settings(values, TrainConfig, WHAT)
    if any(name not in HOW for name in settings) or opt.given_options(values, WHAT):
        raise BadInput(f"--resume continues the same training; only {', '.join(HOW)} may change")
    run = find_run(folder, KIND)
    latest = read_json(run.path / ASKED) or {}
    how = {name: latest[name] for name in HOW if name in latest}
    return from_json({**config_of(run).as_json(), **how, **settings}), run.path
