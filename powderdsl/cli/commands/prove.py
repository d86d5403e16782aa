"""`powderdsl prove`: prove that two rulesets are equivalent, or that a claim holds in every world."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from powderdsl.cli import options as opt
from powderdsl.cli.exits import FAILED, OK, BadInput
from powderdsl.cli.output import counted, print_json
from powderdsl.compiler import load, load_with_claim
from powderdsl.model.types import Ruleset


@click.command("prove", cls=opt.Command)
@click.argument("words", nargs=-1, required=True, metavar="A == B | RULES CLAIM")
@opt.proof
@opt.option("--json", bool, "Print one JSON object.", to="as_json")
def command(words: tuple[str, ...], prove: int, as_json: bool) -> int:
    """Prove that two rulesets are equivalent, or that a claim holds in every world.

    A and B are RULES, or one pass of them, as in powderworld:flow. Elements, fields, parameters and streams are matched
    by name. If A and B differ, a small world shows how. CLAIM has the syntax of an invariant.

    \b
        powderdsl prove mine.yaml == life
        powderdsl prove mine.yaml "mirrored worlds agree"

    Exit code: 0 if proven, 1 if refuted or undecided, 2 for bad rules.
    """
    text = " ".join(words)
    sides = text.split(" == ") if "==" in words else re.findall(r"\S+", text.replace(" == ", " "))
    if "==" in words or re.fullmatch(r"\S+ == \S+", text):
        if len(sides) != 2:
            raise BadInput("write two rulesets: A == B")
        first, second = sides
        status, lines, data = _compared(first, second, prove)
    elif len(words) < 2:
        raise BadInput(
            'write `A == B`, or rules and a claim, such as: powderdsl prove life "mirrored worlds agree"'
        )
    else:
        status, lines, data = _claimed(words[0], " ".join(words[1:]), prove)
    if as_json:
        print_json({"status": status, **data})
    else:
        click.echo("\n".join(lines))
    return OK if status in ("equal", "proven") else FAILED


def _compared(first: str, second: str, seconds: int) -> tuple[str, list[str], dict[str, Any]]:
    """A status, and the report as lines of text and as JSON."""
    from powderdsl.testing.properties.comparison import compare_rules
    from powderdsl.testing.properties.outcomes import world_lines

    (_, mine), (other, theirs) = map(_side, (first, second))
    result = compare_rules(mine, other, theirs, seconds)
    lines = [
        f"{result.status}: {first} == {second} ({result.reason})",
        *(f"  given: {words}" for words in result.given),
    ]
    data: dict[str, Any] = {"reason": result.reason, "given": list(result.given)}
    if (shown := result.distinction) is not None:
        steps = counted(shown.steps, "step")
        by = "these draws" if shown.draws else f"seed {int(shown.sample.seed[0])}"
        lines.append(f"  in {shown.slot}, after {steps} with {by}")
        ids = {"before": shown.sample.ids, "first": shown.first["element"], "second": shown.second["element"]}
        lines += [f"  {line}" for line in world_lines(shown.sample, {k: v[0] for k, v in ids.items()}, mine)]
        data |= {title: values[0].tolist() for title, values in ids.items()}
        data |= {"steps": shown.steps, "slot": shown.slot, "seed": int(shown.sample.seed[0])}
        if shown.slot != "element":
            ends = ("A", shown.first), ("B", shown.second)
            data["fields"] = {title: state[shown.slot][0].tolist() for title, state in ends}
            lines += [f"  {shown.slot} in {title}: {values}" for title, values in data["fields"].items()]
        data["draws"] = {name: values[0].tolist() for name, values in shown.draws.items()}
        lines += [f"  draws of {name}: {values}" for name, values in data["draws"].items()]
    return result.status, lines, data


def _side(text: str) -> tuple[str, Ruleset]:
    """The RULES that a side names, and their model, limited to the pass if it names one."""
    rules, colon, word = text.rpartition(":")
    if not colon or Path(text).exists() or not re.fullmatch(r"[^\W\d]\w*", word):
        return text, load(text)
    ruleset = load(rules)
    passes = tuple(pass_ for pass_ in ruleset.passes if pass_.name == word)
    if not passes:
        known = ", ".join(pass_.name for pass_ in ruleset.passes)
        raise BadInput(f"no pass `{word}` in {rules}: it has {known}")
    return rules, replace(ruleset, passes=passes)


def _claimed(rules: str, claim: str, seconds: int) -> tuple[str, list[str], dict[str, Any]]:
    from powderdsl.testing.properties.outcomes import counterexample_lines, result_data, result_line
    from powderdsl.testing.properties.search import quick_results

    ruleset = load_with_claim(rules, claim)
    (result,) = quick_results(ruleset, seconds)
    lines = [result_line(result)]
    if result.counterexample is not None:
        lines += [f"      {line}" for line in counterexample_lines(result.counterexample, ruleset)]
    return result.status, lines, result_data(result)
