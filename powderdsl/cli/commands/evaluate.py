"""`powderdsl evaluate`: compare an agent with a random policy and with doing nothing, on each split of its task."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from powderdsl.cli import options as opt
from powderdsl.cli.exits import user_values
from powderdsl.cli.output import print_json
from powderdsl.system.reports import table

if TYPE_CHECKING:
    from powderdsl.rl.evaluation import Evaluation


@click.command("evaluate", cls=opt.Command)
@click.argument("run", metavar="RUN|TASK")
@opt.option("--split", opt.NAMES, "Sets of worlds.  [default: all]", to="splits", metavar="SPLIT,SPLIT")
@opt.option(
    "--policies",
    opt.NAMES,
    "Policies: trained, expert, random, nothing.  [default: all, except an expert that searches]",
)
@opt.option("--episodes", (1, 10**6), "Episodes per split and policy.", 256)
@click.option(
    "--deterministic/--sampled", default=False, help="Take the likeliest action, or sample as in training."
)
@opt.option("--seed", (0, 2**32 - 1), "Seed of the policies.", 0)
@opt.task_options
@click.option("--backend", type=opt.BACKEND, help="Backend that runs the rules.  [default: the run's]")
@click.option("--device", help="A torch device.  [default: the run's]")
@opt.option("--json", bool, "Print one JSON object instead of a table.", to="as_json")
def command(
    run: str,
    knobs: dict[str, int],
    settings: dict[str, str],
    packs: tuple[str, ...],
    as_json: bool,
    **how: Any,
) -> None:
    """Print the mean return and 95 % interval of a RUN's agent and of other policies, on the same worlds of each split.

    The result is also written to evaluation.json in the run's folder. For a TASK, only untrained policies are compared.
    """
    played = opt.find_played(run, knobs, settings, packs)
    from powderdsl.rl.evaluation import evaluate

    with user_values():
        evaluation = evaluate(played, packs=packs, **how)
    if as_json:
        print_json(evaluation.as_json())
    else:
        click.echo("\n".join(_text(evaluation)))


def _text(evaluation: Evaluation) -> list[str]:
    from powderdsl.experiments.runs import Estimate
    from powderdsl.rl.config import BASELINES

    after = "" if evaluation.step is None else f", after {evaluation.step:,} interactions"
    rows = [["split", "policy", "return", "above random", "above nothing", "of expert", "success", "actions"]]
    for score in evaluation.scores:
        above = [str(score.above.get(other, "")) for other in BASELINES]
        success = "" if score.success is None else f"{score.success:.0%}"
        means = [str(Estimate(score.mean, score.interval)), *above, str(score.normalized or "")]
        rows.append([score.split, score.policy, *means, success, f"{score.length:.1f}"])
    worlds = {score.split: score.episodes for score in evaluation.scores}
    same = [
        f"{name}: all policies got the same return in {count} of {worlds[name]} worlds"
        for name, count in evaluation.unchanged.items()
        if count
    ]
    same += [
        f"{name}: {overlap.worlds} of {worlds[name]} worlds start like a training world; returns without them: "
        + ", ".join(f"{policy} {estimate}" for policy, estimate in overlap.without.items())
        for name, overlap in evaluation.seen.items()
        if overlap.worlds
    ]
    return [f"{evaluation.task}{after}", *same, *table(rows)]
