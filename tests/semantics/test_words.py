"""Two hundred words that our code, its targets and YAML use, as names of everything that users name."""

from __future__ import annotations

import keyword
from collections.abc import Callable
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest

import powderdsl
from powderdsl.diagnostics import CompileError, Diagnostic
from powderdsl.model.types import Ruleset
from powderdsl.simulation.simulator import Simulator, World
from tests.cli.commands import ROOT
from tests.compilers import skip_without_compiler
from tests.semantics.texts import load_text

LINES = (ROOT / "tests" / "data" / "words.txt").read_text(encoding="utf-8").splitlines()
LISTED = [word for line in LINES if line[0] != "#" for word in line.split()]
WORDS = tuple(dict.fromkeys((*keyword.kwlist, *keyword.softkwlist, *LISTED)))

HEAD = """pack: {pack}
{more}elements:
  air: {{id: 0, color: "#F8F9FA", glyph: "."}}
  ball: {{id: 1, color: "#264653"{tags}}}
{elements}fields:
  score: {{type: 0..58, at: place}}
{sections}passes:
{passes}"""


def pack(words: list[str], name: str = "words", **parts: Callable[[int, str], str]) -> str:
    """A pack in which each part has a text for each word."""
    texts = {part: "".join(write(at, word) for at, word in enumerate(words)) for part, write in parts.items()}
    filled = {"more": "", "tags": "", "elements": "", "sections": "", "passes": "", **texts}
    return HEAD.format(pack=name, **filled)


def score(where: str, at: int) -> str:
    return f"  p{at}:\n    do: score := (score + {at + 1}) mod 59 where {where}\n"


def named(kind: str, words: list[str]) -> str:
    """A pack whose names of a kind are the words; each changes the score in a way of its own."""
    match kind:
        case "field":
            return pack(
                words,
                sections=lambda at, word: f"  {word}: {{type: 0..3, at: place}}\n",
                passes=lambda at, word: (
                    f"  p{at}:\n    do: {word} := ({word} + 1) mod 4 where ball or {word} == 2\n"
                ),
            )
        case "property":
            text = pack(
                words,
                sections=lambda at, word: f"  {word}: {{type: 0..3, ball: {at % 4}}}\n",
                passes=lambda at, word: score(f"{word} > 1 and left is air", at),
            )
            return text.replace(
                "  score: {type: 0..58, at: place}\n", "  score: {type: 0..58, at: place}\nproperties:\n"
            )
        case "parameter":
            text = pack(
                words,
                sections=lambda at, word: f"  {word}: {1 + at}%\n",
                passes=lambda at, word: score(f"chance_of < {word}", at),
            )
            return text.replace("at: place}\n", "at: place}\nstreams: [chance_of]\nparams:\n", 1)
        case "stream":
            text = pack(
                words,
                sections=lambda at, word: f"{word}, ",
                passes=lambda at, word: score(f"{word} < 50%", at),
            )
            return text.replace("at: place}\n", "at: place}\nstreams: [", 1).replace(
                ", passes:", "]\npasses:"
            )
        case "let":
            return pack(
                words,
                passes=lambda at, word: score(f"{word} > {at % 3}", at).replace(
                    "    do:", f"    let: {{{word}: count(ball)}}\n    do:"
                ),
            )
        case "loop":
            return pack(words, passes=lambda at, word: score(f"any({word} is ball for {word} in sides)", at))
        case "tag":
            text = pack(
                words,
                more=lambda at, word: f"  {word}: a tag\n",
                passes=lambda at, word: score(f"left is {word}", at),
            )
            text = text.replace("pack: words\n", "pack: words\ntags:\n")
            return text.replace('"#264653"}', f'"#264653", tags: [{", ".join(words[::2])}]}}')
        case "element":
            return pack(
                words,
                elements=lambda at, word: f"  {word}: {{id: {at + 2}, color: '#{at + 1:06X}'}}\n",
                passes=lambda at, word: f"  p{at}:\n    do: ball -> {word} if count(ball) == {at % 9}\n",
            )
        case _:
            return pack(
                words,
                passes=lambda at, word: score(f"count(ball) > {at % 9}", at).replace(f"p{at}:", f"{word}:"),
            )


KINDS = ("field", "property", "parameter", "stream", "let", "loop", "tag", "element", "pass")


def refusals(path: Path) -> tuple[Diagnostic, ...]:
    try:
        powderdsl.load(path)
    except CompileError as error:
        return error.diagnostics
    return ()


@cache
def usable(kind: str, among: tuple[str, ...] = WORDS) -> tuple[str, ...]:
    """The words that can be names of this kind. For others, an error says so at the word, with a fix."""
    words = []
    with TemporaryDirectory() as folder:
        for word in among:
            path = Path(folder) / "words.yaml"
            path.write_text(named(kind, [word]))
            errors = refusals(path)
            clear = [found for found in errors if found.code in NAMES and found.helps and found.primary.span]
            assert clear or not errors or (kind == "loop" and errors[0].code == "PD201"), (
                kind,
                word,
                str(CompileError(errors)),
            )
            words += [] if errors else [word]
    return tuple(words)


NAMES = ("PD107", "PD111", "PD302", "PD308", "PD311")
"""Errors about a name: of another type in YAML, not a name, defined twice, hiding another one, reserved."""


def states(ruleset: Ruleset, backend: str) -> World:
    ids = np.random.default_rng(1).integers(0, 2, (2, 5, 9))
    sim = powderdsl.compile(ruleset, backend=backend)
    return sim.step(sim.world(ids, seed=3), 3)


@pytest.mark.parametrize("kind", ["field", "stream", "let"])
def test_names_of_users_are_their_own(kind: str, tmp_path: Path) -> None:
    compare(kind, usable(kind, WORDS[:: len(KINDS)]), "wasm", tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("backend", ["wasm", "torch", "native"])
def test_all_names_of_users_are_their_own(kind: str, backend: str, tmp_path: Path) -> None:
    skip_without_compiler(backend)
    assert len(usable(kind)) > 120
    compare(kind, usable(kind), backend, tmp_path)


def compare(kind: str, words: tuple[str, ...], backend: str, folder: Path) -> None:
    """Run packs of these words on a backend and on the oracle, and save and load the worlds."""
    for first in range(0, len(words), 60):
        ruleset = load_text(named(kind, list(words[first : first + 60])))
        expected, found = states(ruleset, "reference"), states(ruleset, backend)
        assert [*found.state] == [*expected.state]
        assert all((found[name] == expected[name]).all() for name in expected.state)
        assert (
            len(
                np.unique(np.asarray(expected["score"] if kind not in ("field", "element") else expected.ids))
            )
            > 1
        )
        powderdsl.save(found, folder / "words.npz")
        again = powderdsl.load_world(folder / "words.npz", found.sim)
        assert all((again[name] == found[name]).all() for name in found.state)


@pytest.mark.slow
def test_packs_of_these_names_are_loaded_together(tmp_path: Path) -> None:
    paths: list[str] = []
    for at, word in enumerate(usable("pass")[::4]):
        path = tmp_path / f"{word}.yaml"
        text = f"pack: {word}\nneeds: core\nelements:\n  thing{at}: {{id: {at + 20}, color: '#123456'}}\n"
        path.write_text(text + f"passes:\n  p{at}: {{do: thing{at} -> empty if left is {word}.thing{at}}}\n")
        paths += [] if refusals(path) else [str(path)]
    assert len(paths) > 40
    sim: Simulator = powderdsl.compile("+".join(["core", *paths]), backend="wasm")
    assert len(sim.passes) >= len(paths)
