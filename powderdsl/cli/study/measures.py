"""Measures and settings of a study: whether they lead to numbers, and make a difference."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from string import Template
from typing import Any

from powderdsl.cli.study.places import Places, Values, Word, names_in
from powderdsl.diagnostics import suggest
from powderdsl.experiments.studies.study import SEED, Measure, StudyStep
from powderdsl.tasks.task import Task

LEADS_TO = "*"
"""A key that stands for any name, where names are known only after worlds have been drawn."""

EVALUATES: dict[tuple[str, ...], tuple[tuple[str, ...], ...]] = {
    ("evaluate",): (("train",),),
    ("wm", "eval"): (("wm", "train"), ("wm", "finetune")),
}
"""Commands that write an evaluation.json, and whose runs they write it to."""
POLICIES = ("trained", "expert", "random", "nothing")
BASELINES = ("random", "nothing")
PREDICTORS = ("model", "nothing changes", "most frequent outcome")


def check_measure(
    places: Places, measure: Measure, task_of: Callable[[StudyStep, Values], Task | None]
) -> None:
    """Report a measure whose keys do not lead to a number in the last evaluation.

    Args:
        task_of: the task that a step plays with some values; None if it is not known.
    """
    if measure.step not in places.steps or not places.steps[measure.step].makes_run:
        return  # reported by who reads the file
    steps = [
        one
        for one in places.study.steps
        if one.on_step
        and not (one.command == ("wm", "eval") and "out" in dict(one.options))  # it writes there instead
        and (maker := places.maker(one)).name == measure.step
        and maker.command in EVALUATES.get(one.command, ())
    ]
    if not steps and any(one.command in EVALUATES and one.name in places.wrong for one in places.study.steps):
        return  # that may be the one
    if not steps:
        made = places.steps[measure.step].command
        command = next((" ".join(one) for one, runs in EVALUATES.items() if made in runs), "evaluate")
        helps = (f"add a step such as `tested: {{command: {command}, on: {measure.step}}}`",)
        message = f"no step evaluates `{measure.step}`"
        places.reporter.error("PD806", message, places.place("of", measure.name), helps=helps)
        return
    last = steps[-1]
    if {last.name, measure.step} & places.wrong:
        return
    used = names_in(measure.keys) | places.names_of(last)
    if not places.known(used):
        return
    for values in places.values(used):
        split = next(iter(places.words(places.steps[measure.step], values).get("split", ())), None)
        trained_on = "train" if split is None else split.filled
        tree = _evaluation(last, places.words(last, values), task_of(last, values), trained_on)
        if tree is not None:
            _follow(places, measure, tree, [Template(key).safe_substitute(values) for key in measure.keys])


def _evaluation(
    step: StudyStep, words: Mapping[str, Sequence[Word]], task: Task | None, trained_on: str
) -> Mapping[str, Any] | None:
    """What is in the evaluation.json that a step writes; None if that is not known."""
    if step.command == ("wm", "eval"):
        return values_of_world_model()
    if task is None:
        return None
    splits, policies = (
        [one.strip() for word in words.get(option, ()) for one in word.filled.split(",")]
        for option in ("splits", "policies")
    )
    return values_of_agent(
        splits or [one.name for one in task.splits],
        policies or [one for one in POLICIES if one != "expert" or (task.expert and task.expert.scripted)],
        trained_on=trained_on,
        success=task.goal.success is not None,
        interval=all(word.filled != "1" for word in words.get("episodes", ())),
    )


def _follow(places: Places, measure: Measure, tree: Mapping[str, Any], keys: Sequence[str]) -> None:
    span = places.place("keys", measure.name)
    here: Any = tree
    for number, key in enumerate(keys):
        if not isinstance(here, Mapping):
            before = "/".join(keys[:number])
            places.reporter.error("PD806", f"`{before}` is a number already", span, f"without `/{key}`")
            return
        if key not in here and LEADS_TO not in here:
            where = f"`{'/'.join(keys[:number])}`" if number else f"the evaluation of `{measure.step}`"
            helps = suggest(key, here, "there is")
            places.reporter.error("PD806", f"{where} has no `{key}`", span, helps=helps)
            return
        here = here.get(key, here.get(LEADS_TO))
    if isinstance(here, Mapping):
        helps = (f"such as `{'/'.join([*keys, *_first_number(here)])}`",)
        message = f"`{'/'.join(keys)}` is not a number but a group of them"
        places.reporter.error("PD806", message, span, helps=helps)


def values_of_agent(
    splits: Sequence[str],
    policies: Sequence[str],
    *,
    trained_on: str = "train",
    success: bool = True,
    interval: bool = True,
) -> Mapping[str, Any]:
    """The numbers that `evaluate` writes, as nested mappings; each number is a 0. A test compares with real ones.

    Args:
        trained_on: the split of training. success: whether the task says what success is. interval: whether more than one
            episode is played.
    """
    half = {"interval": 0} if interval else {}
    scores = {
        policy: {
            "episodes": 0,
            "mean": 0,
            **half,
            **({"success": 0} if success else {}),
            "length": 0,
            "above": {
                other: {"mean": 0, **half} for other in BASELINES if other != policy and other in policies
            },
            **({"normalized": {"mean": 0, **half}} if {"expert", "nothing"} <= {*policies} else {}),
        }
        for policy in policies
    }
    step = {"step": 0} if "trained" in policies else {}
    unchanged = {"unchanged": dict.fromkeys(splits, 0)} if len(policies) > 1 else {}
    without = {policy: {"mean": 0, **half} for policy in policies}
    seen = {split: {"worlds": 0, "without": without} for split in splits if split != trained_on}
    return {**step, "seed": 0, "splits": dict.fromkeys(splits, scores), **unchanged, "seen": seen}


def values_of_world_model() -> Mapping[str, Any]:
    """The numbers that `wm eval` writes."""
    from powderdsl.worldmodel.scores import MEASURES

    numbers = dict.fromkeys(MEASURES, 0)
    by_predictor = dict.fromkeys(PREDICTORS, numbers)
    return {
        "worlds_each": 0,
        "iterations": 0,
        "mean": by_predictor,
        "tests": {LEADS_TO: by_predictor},
        "elements": {LEADS_TO: dict.fromkeys(("cells", "recall", "precision"), 0)},
    }


def check_unused(places: Places) -> None:
    """Report settings, names and seeds that make no difference."""
    used = names_in(
        word for step in places.study.steps for _, words in step.options for word in (step.on or "", *words)
    )
    used |= names_in(step.on or "" for step in places.study.steps)
    used |= names_in(key for measure in places.study.measures for key in measure.keys)
    for axis in places.study.axes:
        names = list(dict.fromkeys(name for values in axis.sets.values() for name in values))
        if not used & {axis.name, *names}:
            what = names[0] if names else axis.name
            helps = (f"write `${what}` in a step, or leave the setting out",)
            message = f"no step uses the setting `{axis.name}`"
            label = "every value gives the same runs"
            places.reporter.error("PD806", message, places.place("axis", axis.name), label, helps=helps)
            continue
        for name in names:
            if name not in used:
                place = places.place("set", axis.name, next(iter(axis.sets)), name)
                helps = (f"write `${name}` in a step, or leave it out",)
                places.reporter.error("PD806", f"no step uses `{name}`", place, helps=helps)
    if places.study.seeds > 1 and SEED not in used and places.study.steps:
        helps = ("write `seed: $seed` in a step that trains, or `seeds: 1`",)
        label = "every seed gives the same runs"
        places.reporter.error("PD806", "no step uses `$seed`", places.place("seeds"), label, helps=helps)


def _first_number(tree: Mapping[str, Any]) -> list[str]:
    found = []
    here: Any = tree
    while isinstance(here, Mapping):
        key = next(iter(here))
        found.append("NAME" if key == LEADS_TO else key)
        here = here[key]
    return found
