"""Plugin for pytest: packs are collected like test files. Every test and every invariant of a pack is an item.

`pytest rules/` runs them. A pack is tested in the ruleset of its folder that lists it, so that packs are tested in
combination; otherwise, with the packs that it needs.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from powderdsl.model.types import Example, Invariant, Ruleset
    from powderdsl.testing.properties.search import InvariantSearch

HEAD = re.compile(r"^(pack|ruleset):[ \t]*[A-Za-z_]\w*[ \t]*$", re.MULTILINE)

WORLDS = 300
"""Number of random worlds on which to try each invariant; `powderdsl test` tries more."""


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--powderdsl-worlds",
        type=int,
        default=WORLDS,
        help="number of random worlds on which to try each invariant of a pack",
    )


def pytest_collect_file(file_path: Path, parent: pytest.Collector) -> PackFile | None:
    """Collect YAML files that start like packs and rulesets; other files are ignored."""
    is_pack = file_path.suffix in (".yaml", ".yml") and HEAD.search(_text(file_path))
    return PackFile.from_parent(parent, path=file_path) if is_pack else None


def _text(path: Path) -> str:
    """The text of a rule file, nothing of one that cannot be read."""
    from powderdsl.syntax.sources import MAX_BYTES
    from powderdsl.system.reading import read_bytes

    try:
        return read_bytes(path, MAX_BYTES).decode("utf-8")
    except (OSError, UnicodeDecodeError):
        return ""


def home_of(path: Path) -> str:
    """The rules to test a pack in, as for `powderdsl.load`."""
    text = _text(path)
    if re.search(r"^ruleset:", text, re.MULTILINE):
        return str(path)
    for other in sorted(path.parent.glob("*.yaml")):
        head = _text(other)
        if re.search(r"^ruleset:", head, re.MULTILINE) and path.stem in _members(head):
            return str(other)
    return str(path)


def _members(text: str) -> list[str]:
    """The packs that a ruleset lists."""
    match = re.search(r"^packs:(.*?)(?=^\w|\Z)", text, re.MULTILINE | re.DOTALL)
    return re.findall(r"\w+", re.sub(r"#.*", "", match[1])) if match else []


@cache
def loaded(rules: str, stamp: float) -> Ruleset:
    """A ruleset, once for all of its packs; `stamp` tells versions of the files apart."""
    from powderdsl.compiler import load

    return load(rules)


@cache
def search_of(rules: str, stamp: float, worlds: int) -> InvariantSearch:
    """The search for a ruleset's invariants, made once: the ledger takes a second."""
    from powderdsl.testing.properties.running import Runner
    from powderdsl.testing.properties.search import InvariantSearch, SearchPlan

    return InvariantSearch.of(Runner(loaded(rules, stamp)), SearchPlan(worlds))


class PackFile(pytest.File):
    """A pack or ruleset."""

    def collect(self) -> Iterator[pytest.Item]:
        home = home_of(self.path), self.path.stat().st_mtime
        from powderdsl.diagnostics.printable import printable

        ruleset = loaded(*home)
        names: dict[str, int] = {}
        subjects: list[Example | Invariant] = [*ruleset.tests, *ruleset.invariants]
        for subject in subjects:
            if Path(subject.span.source.name).resolve() != self.path.resolve():
                continue
            name = printable(getattr(subject, "name", "") or " ".join(subject.span.text.split()))
            names[name] = names.get(name, 0) + 1
            unique = name if names[name] == 1 else f"{name} ({names[name]})"
            yield PackItem.from_parent(self, name=unique, home=home, subject=subject)


class PackItem(pytest.Item):
    """One test or invariant of a pack."""

    def __init__(self, *, home: tuple[str, float], subject: Example | Invariant, **options: Any):
        super().__init__(**options)
        self.home, self.subject = home, subject

    def runtest(self) -> None:
        from dataclasses import replace

        from powderdsl.model.types import Example
        from powderdsl.testing.pack_tests.runner import run_examples

        if isinstance(self.subject, Example):
            (result,) = run_examples(replace(loaded(*self.home), tests=(self.subject,)))
            if result.failed:
                after = "\n".join(result.after)
                self.fail(f"{result.problem} (seed {result.seed}, after {result.step} steps)\n{after}")
            return
        from powderdsl.testing.properties.outcomes import counterexample_lines

        whole = search_of(*self.home, self.config.getoption("--powderdsl-worlds"))
        search = whole.only([" ".join(self.subject.span.text.split())])
        if search.trials:
            search.try_random()
            for outcome in search.finish():
                if outcome.counterexample is not None and not outcome.holds:
                    self.fail("\n".join(counterexample_lines(outcome.counterexample, loaded(*self.home))))

    def fail(self, words: str) -> None:
        """Fail with the location of the item and the fault."""
        span = self.subject.span
        pytest.fail(f"{span.source.name}:{span.line}: {words}", pytrace=False)

    def reportinfo(self) -> tuple[Path, int, str]:
        return self.path, self.subject.span.line - 1, self.name
