"""A world on which a mutant differs, as a test that can be pasted into the pack, and put there with all else kept."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import cycle
from pathlib import Path
from textwrap import indent

import numpy as np

from powderdsl.diagnostics import Reporter, Source
from powderdsl.model.composition.names import needs_of
from powderdsl.model.declarations import PackDecl
from powderdsl.model.types import Element, Ruleset
from powderdsl.simulation.draw import to_numpy
from powderdsl.simulation.simulator import Simulator, World
from powderdsl.syntax.yaml_tree import Mapping, parse_yaml
from powderdsl.syntax.yaml_tree import Sequence as YamlSequence
from powderdsl.system.writing import write_text
from powderdsl.testing.generators.cases import Array, Start
from powderdsl.testing.mutation.operators import Mutant
from powderdsl.testing.pack_tests.runner import ANYTHING, SEEDS, field_rows
from powderdsl.testing.properties.running import State, first_difference, random_samples, run_sample
from powderdsl.testing.properties.shrink import Work, shrink_while

GENERATED = "generated "
"""How names of tests begin that the tool has written: they are counted apart from those written by hand."""

LETTERS = "abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789"


@dataclass(frozen=True)
class GeneratedTest:
    """A test of a pack. `text` is an item of `tests:` without indentation."""

    pack: str
    name: str
    text: str


def written_test(
    mutant: Mutant, distinction: Distinction, sim: Simulator, packs: Sequence[PackDecl]
) -> GeneratedTest:
    """The test that the original passes and the mutant fails. `sim` runs the original.

    A test names no seed if the original does the same with all that a test runs with by itself.
    """
    ruleset = sim.ruleset
    seed: int | None = int(distinction.sample.seed[0])
    others = replace(distinction.sample.repeated(len(SEEDS)), seed=np.array(SEEDS, np.int64))
    after = run_sample(sim, others, distinction.steps)[0][-1][distinction.slot]
    if seed in SEEDS and (after == distinction.first[distinction.slot]).all():
        seed = None
    before, wanted = distinction.sample.ids[0], distinction.first["element"][0]
    there = [e for e in ruleset.elements if e.id in np.unique([*before.ravel(), *wanted.ravel()])]
    glyphs, legend = _legend(there, ruleset, packs, mutant.pack)
    digest = hashlib.sha256(re.sub(r":\d+", "", mutant.key).encode()).hexdigest()[:6]
    name = f"{GENERATED}{digest} against {mutant.operator} in {_where(mutant)}"
    lines = [f"- {name}:"]
    if legend:
        quoted = [(glyph if glyph.isalpha() else f'"{glyph}"', element) for glyph, element in legend]
        items = ", ".join(f"{glyph}: {element}" for glyph, element in quoted)
        lines.append(f"    legend: {{{items}}}")
    lines += ["    given: |", *_drawn(before, glyphs)]
    needed = needs_of({decl.name.text: decl for decl in packs})[mutant.pack]
    start = run_sample(sim, distinction.sample, 0)[1]
    usual = sim.world(distinction.sample.ids)
    for field in distinction.sample.fields:
        same = _same(*(to_numpy(world.state[field][0]) for world in (start, usual)))
        words = _words(field, start, same, ".")
        if words:
            lines += ["    fields:"] if "    fields:" not in lines else []
            lines += [f"      {_known(field, ruleset, needed)}: |", *words]
    lines.append(f"    after: {distinction.steps} step{'' if distinction.steps == 1 else 's'}")
    if distinction.slot == "element":
        lines += ["    expect: |", *_drawn(wanted, glyphs)]
    else:
        end = run_sample(sim, distinction.sample, distinction.steps)[1]
        same = _same(distinction.first[distinction.slot][0], distinction.second[distinction.slot][0])
        name_ = _known(distinction.slot, ruleset, needed)
        lines += ["    expect_fields:", f"      {name_}: |", *_words(distinction.slot, end, same, ANYTHING)]
    if seed is not None:
        lines.append(f"    seed: {seed}")
    return GeneratedTest(mutant.pack, name, "\n".join(lines) + "\n")


def _same(first: Array, second: Array) -> Array:
    """bool [H, W]: cells in which a field of two worlds is the same."""
    same = np.asarray(first == second)
    return np.asarray(same.all(0)) if same.ndim == 3 else same


def _words(field: str, world: World, same: np.ndarray, filler: str) -> list[str]:
    """A drawing of a field, with a filler for cells that do not matter; empty if no cell matters."""
    if same.all():
        return []
    rows = [row.split() for row in field_rows(field, world, 0)]
    rows_ = [[filler if same[y, x] else word for x, word in enumerate(words)] for y, words in enumerate(rows)]
    return ["        " + " ".join(words) for words in rows_]


def _known(field: str, ruleset: Ruleset, needed: Collection[str]) -> str:
    """A field's name, with `?` if its pack may be absent."""
    declared = ruleset.property(field) or ruleset.field(field)
    assert declared is not None
    return field if declared.pack in needed else f"{field}?"


def _drawn(ids: np.ndarray, glyphs: dict[int, str]) -> list[str]:
    return ["      " + " ".join(glyphs[number] for number in row) for row in ids.tolist()]


def _where(mutant: Mutant) -> str:
    """The words that were changed, as far as a name of a test can hold them."""
    old = " ".join(mutant.source.text[mutant.change.start : mutant.change.end].split())
    words = re.sub(r"[^A-Za-z0-9_ .<>=+*/()%-]", " ", old or mutant.pack)
    return " ".join(words.split())[:40].strip(" -") or mutant.pack


def _legend(
    there: Sequence[Element], ruleset: Ruleset, packs: Sequence[PackDecl], pack: str
) -> tuple[dict[int, str], list[tuple[str, str]]]:
    """A character for each element, and those that a legend must explain.

    Characters that packs choose themselves are known wherever these are loaded; all others depend on what else is
    loaded. Elements of packs that this one does not need may be absent: the test then waits.
    """
    needed = needs_of({decl.name.text: decl for decl in packs})[pack]
    chosen = {f"{pack.name.text}.{decl.name.text}" for pack in packs for decl in pack.elements if decl.glyph}
    known = {e.qualified: e.glyph for e in ruleset.elements if e.pack in needed and e.qualified in chosen}
    glyphs: dict[int, str] = {}
    legend = []
    for element in sorted(there, key=lambda element: element.qualified not in known):
        if element.qualified in known and element.glyph not in glyphs.values():
            glyphs[element.id] = element.glyph
            continue
        taken = {*glyphs.values(), *known.values(), *"?\"'\\#"}
        wanted = [element.glyph, *element.name, *element.name.upper(), *LETTERS]
        glyphs[element.id] = next(glyph for glyph in wanted if glyph not in taken)
        legend.append((glyphs[element.id], element.name if element.pack in needed else f"{element.name}?"))
    return glyphs, legend


def with_tests(source: Source, tests: Sequence[GeneratedTest]) -> str:
    """A pack's text with more tests at the end of its `tests:`; comments and all else stay as they are.

    Raises:
        ValueError: `tests:` is written in a way that nothing can be added to, as in `tests: [...]`.
    """
    root = parse_yaml(source, Reporter())
    text = source.text if source.text.endswith("\n") or not source.text else source.text + "\n"
    node = root.get("tests") if isinstance(root, Mapping) else None
    if node is None:
        return text + "tests:\n" + indent("".join(test.text for test in tests), "  ")
    if not isinstance(node, YamlSequence) or source.text[node.span.start] == "[":
        raise ValueError(f"{source.name}: `tests:` is not a list with a line for each test")
    first = source.text.rfind("\n", 0, node.span.start) + 1
    margin = " " * (len(source.text[first:]) - len(source.text[first:].lstrip(" ")))
    # The list ends before the next key of the file, or at its end; blank lines and comments between stay below it.
    following = [key.span.start for key, _ in root.entries if key.span.start > node.span.start]  # type: ignore[union-attr]
    end = min(following, default=len(text))
    lines = text[:end].splitlines(keepends=True)
    while lines and (not lines[-1].strip() or lines[-1].startswith("#")):
        end -= len(lines.pop())
    return text[:end] + indent("".join(test.text for test in tests), margin) + text[end:]


def add_tests(path: Path, tests: Sequence[GeneratedTest]) -> None:
    """Write more tests into a pack's file, whole or not at all."""
    path = path.resolve()
    write_text(path, with_tests(Source(str(path), path.read_text(encoding="utf-8")), tests))


WORLDS = 6144
"""Random worlds on which a mutant is compared with the original."""

STEPS = (2, 4, 8, 16, 48)
"""How many steps batches run, one after the other."""

TRIED_SEEDS = 16
"""With how many seeds a smaller world is tried."""

WORK = 1_000_000_000
"""Work for making a world smaller, see `testing.properties.shrink`."""


@dataclass(frozen=True)
class Distinction:
    """One world on which two compositions differ after some steps: in `slot`, if not already in elements.

    `first` and `second` are the states after the last step.
    """

    sample: Start
    steps: int
    slot: str
    first: State
    second: State


def distinguish(
    first: Simulator, second: Simulator, focus: Sequence[int] = (), seed: int = 0
) -> Distinction | None:
    """A small world on which two simulators differ, or None if none was found.

    Args:
        focus: ids of elements that are likely to matter: half of the worlds are made of them.
        seed: other worlds for another seed, the same for the same.
    """
    known = {slot.name for slot in second.slots}
    names = tuple(slot.name for slot in first.slots if slot.name in known)
    tries = TRIED_SEEDS if first.ruleset.streams or second.ruleset.streams else 1

    def states(sample: Start, steps: int) -> tuple[list[State], list[State]]:
        return run_sample(first, sample, steps)[0], run_sample(second, sample, steps)[0]

    def differs(compared: Sequence[str], sample: Start, steps: int) -> Array:
        return first_difference(*states(sample, steps), compared)

    for compared in (names[:1], names):  # the worlds' elements show more than their fields
        for sample, steps in _samples(first, second, focus, seed):
            when = differs(compared, sample, steps)
            if not when.any():
                continue
            soonest = int(np.where(when > 0, when, steps + 1).argmin())
            small, steps = shrink_while(
                partial(differs, compared),
                sample.one(soonest),
                int(when[soonest]),
                tries,
                Work(first.ruleset, WORK),
            )
            if tries == 1:
                small = replace(small, seed=np.zeros_like(small.seed))
            mine, theirs = (ran[-1] for ran in states(small, steps))
            slot = next(name for name in compared if (mine[name] != theirs[name]).any())
            return Distinction(small, steps, slot, mine, theirs)
    return None


def _samples(
    first: Simulator, second: Simulator, focus: Sequence[int], seed: int
) -> Iterator[tuple[Start, int]]:
    """Worlds with the usual parameters, and how many steps they run. Every other batch is made of `focus` alone."""
    kinds, same = np.array(focus, np.uint8), set(first.slots) == set(second.slots)
    batches = zip(random_samples(first.ruleset, seed, WORLDS), cycle(STEPS), strict=False)
    for number, (sample, steps) in enumerate(batches):
        sample = replace(sample, params={}, step=np.zeros_like(sample.step))
        if number % 2 and len(kinds) > 1:
            sample = replace(sample, ids=kinds[sample.ids % len(kinds)], fields={})
        yield sample if same else replace(sample, fields={}), steps
