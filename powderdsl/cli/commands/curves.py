"""`powderdsl curves`: learning curves of runs, over seeds."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import click

from powderdsl.cli import options as opt
from powderdsl.cli.exits import BadInput


@click.command("curves")
@click.argument("runs", metavar="RUN…", nargs=-1, required=True)
@opt.option("--metric", opt.NAMES, "Numbers of metrics.jsonl.", "held_out/return", to="metrics")
@opt.output("--out", "FILE", "Picture to write; without it, print a table.")
def command(runs: tuple[str, ...], metrics: tuple[str, ...], out: Path | None) -> None:
    """Show what agents or world models learned, step by step.

    Runs that differ only in their seed form one curve: the mean with its 95 % interval. For agents, train with
    --eval-every and evaluate one run: its expert, random and do-nothing policies are drawn as lines.
    """
    from powderdsl.experiments.runs import find_run, read_metrics
    from powderdsl.experiments.studies.results import as_table, baselines_of, curves_of, write_curves

    folders = [find_run(name) for name in runs]
    curves = [
        curve if len(metrics) == 1 else replace(curve, label=f"{metric} {curve.label}".rstrip())
        for metric in metrics
        for curve in curves_of(folders, metric)
    ]
    if not curves:
        known = sorted(
            {name for run in folders for line in read_metrics(run.path) for name in line} - {"step"}
        )
        there = f"there are {', '.join(known)}" if known else "nothing has been written yet"
        raise BadInput(f"no run has the metric {' or '.join(metrics)}; {there}")
    if out is None:
        click.echo(as_table(curves), nl=False)
        return
    title = str(folders[0].config.get("task", ""))
    of_agents = metrics == ("held_out/return",)
    axis = "return in held-out worlds" if of_agents else ", ".join(metrics)
    write_curves(out, curves, axis, baselines_of(folders) if of_agents else {}, Path(title).stem)
    click.echo(str(out))
