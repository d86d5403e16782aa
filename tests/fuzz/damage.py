"""Random damage to rule files: what loading makes of it must be a ruleset or diagnostics, soon, and in little memory."""

from __future__ import annotations

import json
import re
import resource
import sys
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass
from functools import cache
from itertools import islice
from pathlib import Path

from powderdsl.compiler import shipped_rules
from powderdsl.diagnostics import CompileError, Diagnostic, Reporter, Source
from powderdsl.diagnostics.diagnostic import diagnostic_data, render_text
from powderdsl.model.check import check
from powderdsl.model.declarations import PackDecl, RulesetDecl, read_file
from powderdsl.model.types import Ruleset
from powderdsl.syntax.sources import shipped
from powderdsl.system.writing import replacing
from powderdsl.testing.generators.cases import Choices
from tests.fuzz.crew import Lost, work_through
from tests.fuzz.grammar import weighted
from tests.fuzz.rulemaker import Manner, ruleset_text

HANGS = 300
"""Seconds after which an input counts as one that never ends: by the clock, so a busy machine needs some."""

TOKEN = re.compile(r"\w+|\s+|.", re.DOTALL)

MAX_SECONDS = 2.0
"""Processor time that a file may take."""

MAX_MEGABYTES = 500
"""Resident memory of a process that loads files."""

MAX_HEAVY = 10_000
"""Characters of the rules of a heavy input: what is merely long takes its time."""

ODD = "\x00\x01\t\r\n\u0085\u00a0\u200b\u2028\ufeff\ufffd\ud7ff𝟘é×→#:-?[]{}&*!|>'\"%@`\\"
"""Characters that mean something to YAML, to Python's str methods, or to nobody."""


@cache
def rule_texts() -> dict[str, str]:
    """The shipped rule files by name."""
    return {name: (shipped("rules") / f"{name}.yaml").read_text(encoding="utf-8") for name in shipped_rules()}


@cache
def vocabulary() -> tuple[str, ...]:
    """Every word and sign of the shipped files."""
    return tuple(
        sorted({token for text in rule_texts().values() for token in TOKEN.findall(text) if token.strip()})
    )


@cache
def whole(name: str) -> PackDecl | RulesetDecl:
    """A shipped file, undamaged."""
    found = read_file(Source(f"{name}.yaml", rule_texts()[name]), Reporter())
    assert found is not None
    return found


def needed(text: str) -> list[PackDecl]:
    """The shipped packs that a file says it needs."""
    names = re.search(r"^needs: \[?([\w, ]*)", text, re.MULTILINE)
    words = [word for word in re.findall(r"\w+", names[1] if names else "") if word in rule_texts()]
    return [pack for word in words if isinstance(pack := whole(word), PackDecl)]


def load_damaged(text: str) -> Ruleset | None:
    """What `powderdsl.load` does with a file and the packs it needs; None after printing what is wrong.

    Raises:
        AssertionError: a diagnostic cannot be printed. Anything else but CompileError is a mistake as well.
    """
    reporter = Reporter()
    try:
        found = read_file(Source("damaged.yaml", text), reporter)
        reporter.raise_if_errors()
        assert found is not None
        return check([*needed(text), found], None, reporter) if isinstance(found, PackDecl) else None
    except CompileError as error:
        check_printable(error.diagnostics)
        return None


def check_printable(diagnostics: tuple[Diagnostic, ...]) -> None:
    """Raises AssertionError unless every diagnostic points into its text and can be printed in both ways."""
    assert diagnostics
    for one in diagnostics:
        span = one.primary.span
        assert span is None or 0 <= span.start < max(span.end, 1) <= max(len(span.source.text), 1) + 1
        assert render_text(one)
    assert json.dumps([diagnostic_data(one, utf16=True) for one in diagnostics])


# Kinds of damage


def damaged(parts_of: Callable[[Choices], list[str]]) -> Callable[[Choices], str]:
    """A text after some deletions, repetitions, exchanges and insertions of its parts."""
    return lambda choices: _damaged(choices, parts_of(choices))


def shipped_text(choices: Choices) -> str:
    return choices.pick(list(rule_texts().values()))


def _damaged(choices: Choices, parts: list[str]) -> str:
    for _ in range(choices.integer(1, 4)):
        place = choices.below(max(len(parts), 1))
        match choices.pick(("delete", "repeat", "swap", "word", "character", "indent")):
            case "delete":
                del parts[place : place + choices.integer(1, 3)]
            case "repeat":
                parts[place:place] = parts[place : place + 1] * choices.integer(1, 3)
            case "swap" if len(parts) > 1:
                other = choices.below(len(parts))
                parts[place], parts[other] = parts[other], parts[place]
            case "word":
                parts[place : place + choices.below(2)] = [choices.pick(vocabulary())]
            case "character":
                parts.insert(place, _character(choices))
            case "indent":
                parts.insert(place, " " * choices.integer(1, 3))
    return "".join(parts)


def _character(choices: Choices) -> str:
    code = weighted(
        choices, [(3, 32 + choices.below(95)), (2, ord(choices.pick(ODD))), (1, choices.below(0xD800))]
    )
    return chr(code)


def any_rule(choices: Choices) -> str:
    """A good file with a rule of words in any order."""
    rule = " ".join(choices.pick(vocabulary()) for _ in range(choices.below(15))).replace("'", "")
    return f"pack: damaged\nneeds: core\npasses:\n  damaged:\n    do: '{rule}'\n"


def any_expression(choices: Choices) -> str:
    """A good file with a condition of signs in any order."""
    signs = "".join(choices.pick("abf019.%()<>=!:+-*/,? \n") for _ in range(choices.below(41)))
    fields = "fields: {f: {type: 0..9, at: place}}\n"
    elements = 'elements: {a: {id: 0, color: "#000000"}, b: {id: 1, color: "#FFFFFF"}}\n'
    return f"pack: damaged\n{elements}{fields}passes:\n  damaged:\n    do: 'a -> b if {signs}'\n"


def heavy(choices: Choices) -> str:
    """A file that asks for much: deep nesting, long chains, large numbers, loops in loops."""
    many = choices.pick([10, 50, 200, 1000])
    number = choices.pick(["1", "9" * min(many, 4000), "1e999", "0." + "3" * min(many, 4000), "-7", "64"])
    condition = choices.pick(
        [
            "(" * many + "a" + ")" * many,
            " and ".join(["a"] * many),
            " + ".join(["f"] * many) + " > 3",
            "not " * many + "a",
            "count(" * many + "a" + ")" * many,
            f"f > {number}",
            f"at({number}, {number}) is a",
            f"f mod {number} == 1",
            " * ".join(["f"] * min(many, 60)) + " > 3",
            "any(" * min(many, 12) + "a" + "".join(f" for x{i} in octants)" for i in range(min(many, 12))),
            "below." * many + "f > 3",
        ]
    )
    rules = [f"a -> b if {condition}"]
    rules *= choices.pick([1, 1, 1, 5, max(1, MAX_HEAVY // len(rules[0]))])
    depth = choices.below(6)
    loops = [
        choices.pick(["repeat 64", f"for i{i} in 0..63", f"for i{i} in octants, j{i} in octants"])
        for i in range(depth)
    ]
    lines = [f"{'  ' * (level + 2)}{'- ' if level else ''}{loop}:" for level, loop in enumerate(loops)]
    indent = "  " * (depth + 3)
    lines += [f"{'  ' * (depth + 2)}do:"] if not depth else []
    lines += [f"{indent}- '{rule}'" for rule in rules]
    elements = [f'  e{i}: {{id: {i}, color: "#000000"}}' for i in range(2, choices.pick([2, 20, 256, 300]))]
    let = "".join(
        f"      v{i}: {'v' + str(i - 1) if i else 'a'} or {'v' + str(i - 1) if i else 'b'}\n"
        for i in range(choices.pick([0, 0, 30, many]))
    )
    return "\n".join(
        ["pack: heavy", "fields: {f: {type: 0..1000, at: place}}", "elements:", '  a: {id: 0, color: "#000000"}', '  b: {id: 1, color: "#FFFFFF"}', *elements, "passes:", "  p:", *([f"    let:\n{let}"] if let else []), *lines, ""]
    )  # fmt: skip


KINDS: dict[str, tuple[int, Callable[[Choices], str]]] = {
    "lines": (5, damaged(lambda choices: shipped_text(choices).splitlines(keepends=True))),
    "tokens": (5, damaged(lambda choices: TOKEN.findall(shipped_text(choices)))),
    "random rules": (4, damaged(lambda choices: TOKEN.findall(ruleset_text(choices, Manner())))),
    "rule": (3, any_rule),
    "expression": (3, any_expression),
    "heavy": (2, heavy),
}
"""Kinds of input: how often, and how they are made."""


@dataclass(frozen=True)
class Trial:
    """What came of loading an input: processor seconds, the process's largest resident memory in megabytes."""

    seed: int
    kind: str
    accepted: bool
    seconds: float
    megabytes: float
    problem: str | None

    @property
    def file_name(self) -> str:
        return f"front-end-{self.seed}.yaml"


def damaged_text(seed: int) -> tuple[str, str]:
    """Kind and text of the input of a seed."""
    choices = Choices.seeded(seed)
    kind = weighted(choices, [(weight, name) for name, (weight, _) in KINDS.items()])
    return kind, KINDS[kind][1](choices)


def run_trials(seeds: Iterator[int], jobs: int, folder: Path, until: float) -> Generator[Trial, None, None]:
    """Load the inputs of seeds in some processes until they or the time are over; what fails is saved in the folder.

    Args:
        until: the end, on `time.monotonic`'s clock.
    """
    tasks: deque[int] = deque(islice(seeds, 2 * jobs))
    for heard in work_through(tasks, run_trial, jobs, HANGS, recycle=2000):
        if isinstance(heard, Lost):
            trial = Trial(heard.task, damaged_text(heard.task)[0], False, 0.0, 0.0, heard.reason)
        else:
            trial = heard.result
        if trial.problem is not None:
            folder.mkdir(parents=True, exist_ok=True)
            with replacing(folder / trial.file_name) as temporary:
                temporary.write_text(damaged_text(trial.seed)[1], encoding="utf-8", newline="")
        yield trial
        if time.monotonic() < until:
            tasks.extend(islice(seeds, max(0, 2 * jobs - len(tasks))))
        else:
            tasks.clear()


def run_trial(seed: int) -> Trial:
    """Load the input of a seed."""
    kind, text = damaged_text(seed)
    began = time.process_time()
    problem, accepted = None, False
    try:
        accepted = load_damaged(text) is not None
    except Exception as error:  # the finding
        problem = f"{type(error).__name__}: {' '.join(str(error).split())[:500]}"
    seconds = time.process_time() - began
    megabytes = _resident_megabytes()
    if problem is None and seconds > MAX_SECONDS:
        problem = f"took {seconds:.1f} s"
    if problem is None and megabytes > MAX_MEGABYTES:
        problem = f"took {megabytes:.0f} MB"
    return Trial(seed, kind, accepted, seconds, megabytes, problem)


def _resident_megabytes() -> float:
    size = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return size / (1 << 20) if sys.platform == "darwin" else size / (1 << 10)
