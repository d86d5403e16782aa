"""`powderdsl wm`: train and test networks that predict worlds, and fine-tune them on new packs."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from powderdsl.cli import options as opt
from powderdsl.cli.exits import BadInput, user_values
from powderdsl.cli.output import print_json, progress
from powderdsl.system.reports import table
from powderdsl.worldmodel.config import PRESETS, DataConfig, Machine, TrainConfig

if TYPE_CHECKING:
    from powderdsl.model.types import Ruleset
    from powderdsl.worldmodel.evaluation import Strip, Tested
    from powderdsl.worldmodel.networks import CustomNetwork
    from powderdsl.worldmodel.training import Trained
    from powderdsl.worldmodel.worlds import Recording


OF_WORLDS = {field.name for field in fields(DataConfig)} - {"task"}
OF_WORLDS |= {"packs", "held_out", "settings", "worlds", "after"}
"""Options that select worlds: a dataset has its own."""

_recording = opt.path("--data", "DATASET", "Transitions with actions, recorded by `powderdsl record`.")
_machine_options = opt.several(
    opt.option(
        "--network",
        "MODULE:CLASS",
        "Your own network, which is imported.  [default: the U-net]",
        to="network_name",
    ),
    opt.machine,
)
_test_options = opt.several(
    click.argument("run", metavar="RUN"),
    opt.option("--task", "TASK", "A shipped task or a task file.  [default: the run's]"),
    opt.option(
        "--split", "SPLIT", "Split of the task to test on.  [default: designed, or the one used in training]"
    ),
    opt.option("--rules", "RULES", "Rules to test under.  [default: the run's]"),
    _recording,
    _machine_options,
)
_run_options = opt.several(
    _machine_options,
    opt.path(
        "--run", "DIR", "Folder of the run.  [default: named after TASK, or RUN and packs]", to="folder"
    ),
    opt.option("--store", ["auto", "memory", "disk"], "Storage of the buffer.", "auto"),
    opt.option(
        "--save-every", click.FloatRange(0, 1e6), "Minutes between checkpoints.", 1.0, metavar="MINUTES"
    ),
    opt.option("--validate-every", (0, 10**9), "Iterations between tests on held-out worlds; 0: none.", 100),
)


@click.group("wm")
def command() -> None:
    """World models: networks that predict a world some steps ahead.

    \b
        powderdsl wm train --held-out PACK --run runs/less
        powderdsl wm eval runs/less
        powderdsl wm finetune runs/less --packs PACK --iterations 100
    """


@command.command("train", cls=opt.Command)
@opt.option(
    "--preset",
    ["small", "paper"],
    "Base settings, which other options override: `small` for a CPU, `paper` for a GPU.",
    "small",
)
@click.argument("task", metavar="TASK", required=False)
@_recording
@opt.option("--ignore-actions", bool, "With --data: hide the actions from the network.")
@opt.settings_of(DataConfig, {name: vars(preset.data) for name, preset in PRESETS.items()})
@opt.settings_of(TrainConfig, {name: vars(preset) for name, preset in PRESETS.items()})
@opt.option("--rules", "RULES", "Rules of the worlds.  [default: the task's own]")
@opt.pack_list("--packs", "Use only these packs of the rules, or add them.")
@opt.pack_list("--held-out", "Exclude these packs of the rules.")
@opt.knobs("Set a knob of the task.")
@opt.parameters
@_run_options
def train_command(folder: Path | None, ignore_actions: bool, **values: Any) -> None:
    """Train a world model on worlds without agent actions.

    TASK is a shipped task (default: world-model) or a file. Repeat the same command to resume a stopped run; the result
    is the same as without the stop.
    """
    if values["network_name"] and values["width"]:
        raise BadInput("--width is for the U-net: omit it with --network")
    if values["data"] is None:
        if ignore_actions:
            raise BadInput("--ignore-actions requires --data")
        config = new_config(values, rules_of)
        _run(config, folder or Path("runs") / (Path(config.data.task).stem or "run"), values)
        return
    _refuse_world_options(values)
    from powderdsl.worldmodel.worlds import open_recording

    recording = open_recording(values["data"], values["task"])
    recorded = replace(recording.recorded, actions=not ignore_actions)
    with user_values():
        given = opt.given_settings(values, TrainConfig)
        config = replace(PRESETS[values["preset"]], recorded=recorded, **given)
    name = f"{recording.task.name}-blind" if ignore_actions else recording.task.name
    _run(config, folder or Path("runs") / name, values, recording=recording)


def new_config(values: Mapping[str, Any], rules_of: Callable[..., str]) -> TrainConfig:
    """The settings of a new run on worlds. Raises CompileError and BadInput for invalid ones.

    `values`: the options' values. `rules_of`: the function of this name, or a cached version.
    """
    packs, held_out = values["packs"], values["held_out"]
    if packs and held_out:
        raise BadInput("--packs and --held-out cannot be combined")
    with user_values():
        config = replace(PRESETS[values["preset"]], **opt.given_settings(values, TrainConfig))
        rules, task = values["rules"] or "", values["task"] or config.data.task
        changes = {
            **opt.given_settings(values, DataConfig),
            "rules": rules_of(rules, task, packs, held_out) if packs or held_out else rules,
            "knobs": values["knobs"],
            "params": values["settings"],
        }
        return replace(config, data=replace(config.data, **changes))


@command.command("finetune", cls=opt.Command)
@click.argument("run", metavar="RUN")
@opt.pack_list(
    "--packs",
    "Packs to learn, by name or file: they are added to the run's rules, and worlds draw nothing else.",
    required=True,
)
@opt.settings_of(TrainConfig, only=("iterations", "batch", "learning_rate", "seed"))
@_run_options
def finetune_command(run: str, packs: tuple[str, ...], folder: Path | None, **values: Any) -> None:
    """Continue a run on worlds that draw only elements of other packs.

    RUN is a run's folder, or its name in runs/. The result is a new run.
    """
    from powderdsl.worldmodel.training import finetuned, load_trained

    network = _import_network(values["network_name"])
    trained = load_trained(run, device="cpu", network=network)
    with user_values():
        config = finetuned(trained, packs, **opt.given_settings(values, TrainConfig))
    words = "-".join(config.data.only)
    target = folder or trained.run.path.with_name(f"{trained.run.path.name}-{words}")
    note = {"parent": {"path": str(trained.run.path), "iterations": trained.checkpoint.step}}
    _run(config, target, values, parent=trained.checkpoint, note=note)


@command.command("eval", cls=opt.Command)
@_test_options
@opt.pack_list("--only", "Draw elements of these packs only.  [default: the run's]")
@opt.knobs("Set a knob of the task.  [default: the run's]")
@opt.option("--worlds", (1, 1 << 20), "Worlds of the split, or futures per designed world.  [default: 32, 4]")
@opt.option("--steps", (1, 4096), "Steps to predict.  [default: as trained]")
@opt.option("--json", bool, "Print one JSON object instead of a table.", to="as_json")
def eval_command(run: str, as_json: bool, **values: Any) -> None:
    """Compare a network with two baselines.

    They predict no change, or each element's most frequent outcome. RUN is a run's folder, or its name in runs/. Losses
    are cross-entropies per cell, in nats. The worlds have seeds that training never uses. A network trained on a
    dataset is tested on its test worlds or on another dataset, with and without actions. Results are also written to
    the run's evaluation.json.
    """
    from powderdsl.experiments.runs import write_json
    from powderdsl.worldmodel.evaluation import evaluate, evaluate_recording

    trained, recording, machine = _load_network(run, values)
    times = _times(trained, values["steps"])
    if recording is not None and times > 1:
        raise BadInput(f"--steps {values['steps']}: recorded transitions have {trained.config.data.steps}")
    if recording is not None:
        tested = evaluate_recording(trained, recording, machine=machine)
    else:
        how = {"worlds": values["worlds"], "times": times, "machine": machine}
        tested = evaluate(trained, **how, **tested_on(values))
    plain = tested.plain()
    write_json(trained.run.path / "evaluation.json", plain)
    if as_json:
        print_json(plain)
    else:
        click.echo("\n".join(_result_tables(tested, plain)))


def _times(trained: Trained, steps: int | None) -> int:
    """The number of times to apply a network to predict some steps."""
    times, rest = divmod(steps or trained.config.data.steps, trained.config.data.steps)
    if rest:
        step = trained.config.data.steps
        raise BadInput(f"--steps {steps}: this network predicts {step} steps, or several times as many")
    return times


@command.command("show", cls=opt.Command)
@_test_options
@opt.output("--out", "FILE", "The picture to write.", ".png", required=True)
@opt.option("--steps", (1, 4096), "Steps to predict.  [default: as trained]")
@opt.option("--after", (0, 10**6), "Steps that worlds run before the prediction starts.  [default: 0]")
@opt.option("--scale", (1, 16), "Pixels per cell.", 4)
def show_command(run: str, out: Path, scale: int, **values: Any) -> None:
    """Draw each test as a strip: start, truth, prediction, mistakes.

    For multiples of the trained number of steps, the network is applied to its own prediction.
    """
    from powderdsl.worldmodel.evaluation import recorded_strips, strips, unseen_worlds

    trained, recording, machine = _load_network(run, values)
    if recording is not None:
        _show(recorded_strips(trained.network, recording), recording.rules, out, scale)
        return
    step, times = trained.config.data.steps, _times(trained, values["steps"])
    worlds = unseen_worlds(trained, machine=machine, **tested_on(values))
    tests = strips(trained.network, worlds, step=step, times=times, after=values["after"] or 0)
    _show(tests, worlds.rules, out, scale)
    for variant in worlds.missing:
        click.echo(f"left out: {variant.name}, which needs {', '.join(variant.elements)}", err=True)


def _show(strips: list[Strip], rules: Ruleset, out: Path, scale: int) -> None:
    """Draw strips, and count the wrong cells in each."""
    from powderdsl.worldmodel.evaluation import sheet
    from powderdsl.worlds.media import write_png

    write_png(out, sheet(strips, rules, factor=scale))
    for number, strip in enumerate(strips, 1):
        click.echo(f"{number}  {strip.name}: {strip.wrong.sum():,} of {strip.truth.size:,} cells wrong")


def tested_on(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options that select the worlds of a test."""
    return opt.given_options(values, ("task", "split", "rules", "only", "knobs"))


def _machine(values: Mapping[str, Any]) -> Machine:
    """The device and storage in the options of a command."""
    import torch

    from powderdsl.simulation.programs import find_device

    find_device(values["device"])
    torch.set_num_threads(values["threads"])
    return Machine(**opt.given_settings(values, Machine))


def _refuse_world_options(values: Mapping[str, Any]) -> None:
    """Reject options that select worlds, since a dataset has its own."""
    for option in click.get_current_context().command.params:
        if option.name in opt.given_options(values, OF_WORLDS):
            raise BadInput(f"{option.opts[0]} selects worlds, and --data has its own")


def _load_network(run: str, values: dict[str, Any]) -> tuple[Trained, Recording | None, Machine]:
    """The network of a run, its test recording if it has actions, and the device."""
    from powderdsl.worldmodel.training import load_trained
    from powderdsl.worldmodel.worlds import open_recording

    machine, folder = _machine(values), values["data"]
    trained = load_trained(run, device=machine.device, network=_import_network(values["network_name"]))
    if trained.config.recorded is None:
        if folder is not None:
            raise BadInput("--data is for networks that learned from a dataset")
        return trained, None, machine
    _refuse_world_options(values)
    recorded = trained.run.about.get("dataset")
    if folder is None and not isinstance(recorded, str):
        raise BadInput("--data: say which dataset")
    task = values["task"] or trained.config.data.task
    return trained, open_recording(folder or Path(str(recorded)), task), machine


def _import_network(name: str | None) -> CustomNetwork | None:
    """The network that the user names, imported."""
    if name is None:
        return None
    from powderdsl.worldmodel.networks import custom_network

    return custom_network(name)


def rules_of(rules: str, task: str, packs: tuple[str, ...], held_out: tuple[str, ...]) -> str:
    """Rules, or those of a task, limited to some packs or without others."""
    from powderdsl.tasks.shipped import load_task
    from powderdsl.worldmodel.training import keep, leave_out

    base = rules or "+".join(load_task(task).rules)
    return keep(base, packs) if packs else leave_out(base, held_out)


def _run(config: TrainConfig, folder: Path, values: dict[str, Any], **more: Any) -> None:
    from powderdsl.worldmodel.training import train

    machine, network = _machine(values), _import_network(values["network_name"])
    began = time.monotonic()
    with progress("wm", config.iterations, lines=True, resumes=folder) as show:

        def tell(done: int, loss: float | None, held_out: float | None) -> None:
            losses = [("loss", loss), ("held out", held_out)]
            show(done, ", ".join(f"{name} {value:.4f}" for name, value in losses if value is not None))

        run = train(
            config,
            folder,
            machine=machine,
            network=network,
            tell=tell,
            save_seconds=60 * values["save_every"],
            validate_every=values["validate_every"],
            **more,
        )
    spent = f"{config.iterations:,} iterations, {time.monotonic() - began:.0f} s here"
    click.echo(f"{run.path}: {spent}; powderdsl wm eval {run.path}")


# Reports


def _result_tables(tested: Tested, plain: Mapping[str, Any]) -> Iterator[str]:
    """The results of a test as tables. `plain` has them for JSON."""
    yield f"{tested.rules}, {tested.task}/{tested.split}, after {plain['iterations']:,} iterations"
    rows = [["test", "predictor", *next(iter(plain["mean"].values()))]]
    for name, scores in {**plain["tests"], "mean": plain["mean"]}.items():
        rows += [[name, who, *map(_number, score.values())] for who, score in scores.items()]
    yield from ("", *table(rows), "")
    elements = [[name, *map(_number, score.values())] for name, score in plain["elements"].items()]
    yield from table([["element", "cells", "recall", "precision"], *elements])
    for name, lacking in plain["left_out"].items():
        yield f"left out: {name}, which needs {', '.join(lacking)}"


def _number(value: float | None) -> str:
    if value is None:
        return "–"
    return f"{value:,}" if isinstance(value, int) else f"{value:.4f}"
