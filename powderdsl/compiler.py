"""The compiler's sequence: text → located tree → checked model → IR → passes → program.

`load` stops at the checked model, `lower` at optimized IR; neither needs torch. `simulation.simulator` continues from there.
"""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from difflib import get_close_matches
from functools import cache, lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from powderdsl.diagnostics import CompileError, Diagnostic, Label, Reporter, Source, Span, suggest
from powderdsl.model.declarations import SHARED, PackDecl, RulesetDecl, read_file
from powderdsl.model.types import Ruleset
from powderdsl.syntax.sources import OPEN, path_beside, read_source, shipped, shipped_names
from powderdsl.system.cache import Memo, collection_paused, persistent
from powderdsl.system.reading import inside, is_path
from powderdsl.system.writing import failure
from powderdsl.universes import is_universe, universe_seed, universe_source

if TYPE_CHECKING:
    from powderdsl.ir.bits import Segment
    from powderdsl.ir.ops import PassGraph, Program
    from powderdsl.model.composition.compose import Palette
    from powderdsl.model.reuse import Reuse

BACKENDS = {
    "auto": "`wasm` first, and `native` once it is compiled; `cuda`, or else `torch`, on other devices",
    "torch": "torch tensors with 64 cells per word, on any device",
    "torch-cells": "torch tensors with one value per cell, on any device; its code is the easiest to read",
    "torch-fused": "the functions of `torch`, compiled by torch's inductor, which takes minutes, and cached",
    "wasm": "generated WebAssembly, run by wasmtime on the CPU; starts instantly, needs no compiler",
    "native": "generated C++ for the CPU; compiled once and cached",
    "cuda": "generated CUDA C++ for a GPU; whole worlds stay on the chip, and a call takes one launch",
    "reference": "the slow reference in NumPy that defines what rules mean",
}
"""Backends by name. All of them compute the same worlds, bit for bit."""

MAX_BASES = 8
"""Maximum length of a chain of rulesets that extend each other."""

MAX_PLUSES = 16
"""Maximum number of `+` characters in one path."""


def shipped_rules() -> list[str]:
    """Names of the shipped packs and rulesets."""
    return shipped_names("rules")


@cache
def shipped_words() -> dict[str, str]:
    """The words that the shipped packs define, each with its pack."""
    packs: dict[str, str] = {}
    for source in _shipped_sources():
        for word in _words_in(source):
            packs.setdefault(word, Path(source.name).stem)
    return packs


@lru_cache(maxsize=128)
def _words_in(source: Source) -> tuple[str, ...]:
    """The words that a file defines."""
    from powderdsl.model.composition.names import words_of_tree
    from powderdsl.syntax.yaml_tree import parse_yaml

    return tuple(words_of_tree(parse_yaml(source, Reporter())))


@cache
def _shipped_sources() -> tuple[Source, ...]:
    paths = sorted(shipped("rules").glob("*.yaml"))
    return tuple(source for path in paths if (source := read_source(path, Reporter())))


def shipped_variants() -> set[str]:
    """The shipped rulesets that extend another ruleset."""
    decls = [_read_once(source)[0] for source in _shipped_sources()]
    return {decl.name.text for decl in decls if isinstance(decl, RulesetDecl) and decl.extends is not None}


def shipped_tests() -> list[str]:
    """The shipped rules that load alone: rulesets, and packs that neither need another pack nor belong to a ruleset."""
    decls = [decl for source in _shipped_sources() if (decl := _read_once(source)[0])]
    inside = {scalar.text for decl in decls if isinstance(decl, RulesetDecl) for scalar in decl.packs}
    return [
        decl.name.text
        for decl in decls
        if isinstance(decl, RulesetDecl) or not (decl.needs or decl.name.text in inside)
    ]


def load(
    *names: str | Path, params: Mapping[str, Any] | None = None, palette: Palette | None = None
) -> Ruleset:
    """Read rule files into a checked model.

    Args:
        names: shipped names (``"powderworld"``), paths of rule files, or several joined by ``+``. A name after ``-``
            is left out: ``"name-pack"``.
        params: values that replace the defaults of parameters, by qualified name: ``{"pack.param": 0.05}``.
        palette: recorded ids, such as those of a model: for each id the qualified name of its element, or None. Other
            elements get the free ids of the palette, then ids after its end.

    Returns:
        The checked model, which `powderdsl.compile` takes.

    Raises:
        CompileError: all mistakes in the files; PD304 for an unknown name, PD101 or PD102 for a file that cannot be
            read, PD309 for an unknown parameter, PD402 for a value out of its range.
        TypeError: `params` is not a mapping.
    """
    ruleset, _ = load_with_diagnostics(*names, params=params, palette=palette)
    return ruleset


@collection_paused()
def load_with_diagnostics(
    *names: str | Path,
    params: Mapping[str, Any] | None = None,
    palette: Palette | None = None,
    reuse: Reuse | None = None,
) -> tuple[Ruleset, tuple[Diagnostic, ...]]:
    """Read as `load` does; return the model, and warnings and notes in source order. `reuse` is as in `check`."""
    reporter = Reporter()
    reader = _Reader(reporter)
    packs, ruleset = reader.read_all(names)
    if reporter.has_errors:
        if reader.is_whole and not any(d.code == "PD111" for d in reporter.diagnostics):
            _report_more(packs, ruleset, reader, palette=palette, reuse=reuse)
        reporter.raise_if_errors()

    def checked() -> tuple[Ruleset, tuple[Diagnostic, ...]]:
        from powderdsl.model.check import check, demote_outgrown

        model = check(packs, ruleset, reporter, palette, shipped_words, reuse=reuse)
        reporter.raise_if_errors()
        return model, demote_outgrown(model, reporter.diagnostics)

    words = list(map(str, names))
    sources = (*reader.sources, *_shipped_sources())  # advice names shipped packs
    inputs = [words, [(source.name, source.text) for source in sources], palette]
    model, remarks = persistent(f"model of {'+'.join(words)}", repr(inputs), checked)
    if params:
        from powderdsl.model.definitions import set_params

        model = set_params(model, params, reporter)
        reporter.raise_if_errors()
    return model, remarks


def load_with_claim(name: str, claim: str) -> Ruleset:
    """Read rule files into a checked model whose only invariant is `claim`. Raises CompileError, as `load` does."""
    from powderdsl.model.check import check

    reporter = Reporter()
    packs, ruleset = read([name], reporter)
    reporter.raise_if_errors()
    needs = ", ".join(pack.name.text for pack in packs)
    text = f"pack: {CLAIM}\nneeds: [{needs}]\ninvariants:\n  - {' '.join(claim.split())}\n"
    decl = read_file(Source(CLAIM, text), reporter)
    reporter.raise_if_errors()
    assert isinstance(decl, PackDecl)
    model = check([*packs, decl], ruleset, reporter, None, shipped_words)
    reporter.raise_if_errors()
    return replace(model, invariants=tuple(claim for claim in model.invariants if claim.pack == CLAIM))


CLAIM = "command_line"
"""The name of the pack that contains a claim without a file."""


def _report_more(packs: Sequence[PackDecl], ruleset: RulesetDecl | None, reader: _Reader, **how: Any) -> None:
    """Report further mistakes in files, except those that may follow from the mistakes reported so far."""
    from powderdsl.model.check import check

    lost = {word for source in reader.sources for word in _words_in(source)}
    for pack in packs:
        lost -= {decl.name.text for section in (*SHARED, "passes") for decl in getattr(pack, section)}
    later = Reporter()
    with suppress(CompileError):
        check([replace(pack, tests=(), invariants=()) for pack in packs], ruleset, later, alone=True, **how)
    for diagnostic in later.diagnostics:
        span = diagnostic.primary.span
        word = span.text.removesuffix("?") if span else ""
        if INDEPENDENT.fullmatch(diagnostic.code) and word not in lost:
            with suppress(CompileError):  # more errors than the limit
                reader.reporter.add(diagnostic)


INDEPENDENT = re.compile("PD(108|110|301|311|40[12357]|406|409|410)")
"""The errors in rules and values, without those that name something that could not be read."""


def whole_palette(*names: str | Path) -> tuple[str | None, ...]:
    """The slots of a model for the elements of some rules, each a qualified name or None.

    Packs that are left out have slots too. The ids of a ruleset's own packs, or of a list of packs, do not change; the
    elements of packs that are added to a ruleset follow without gaps. Raises CompileError as `load`.
    """
    reporter = Reporter()
    packs, ruleset = read([word for name in names for word in split_names(name)[0]], reporter)
    reporter.raise_if_errors()
    from powderdsl.model.composition.compose import compose

    composition = compose(packs, ruleset, reporter)
    reporter.raise_if_errors()
    own = composition.own_slots if ruleset else composition.slots
    by_id = {element.id: element.qualified for element in composition.elements.values()}
    return tuple(by_id.get(number) for number in range(own)) + tuple(
        name for number, name in by_id.items() if number >= own
    )


def read(names: Sequence[str | Path], reporter: Reporter) -> tuple[list[PackDecl], RulesetDecl | None]:
    """Read the declarations of everything named, each pack once, in the order of first mention; report mistakes."""
    return _Reader(reporter).read_all(names)


def split_names(name: Any) -> tuple[list[str], list[str]]:
    """Split ``a+b-c`` into names to load and names to leave out.

    Existing files are paths, even if their names contain ``+`` or ``-``: the longest run of parts between ``+`` that
    names a file is one path. After ``.yaml``, a ``-`` leaves a pack out, too.
    """
    if not isinstance(name, str | Path):
        helps = ("write load('a', 'b') or load('a+b')",)
        raise failure("PD304", f"rules are named by strings, found {type(name).__name__}", helps=helps)
    if isinstance(name, Path):
        return [str(name)], []
    plus: list[str] = []
    minus: list[str] = []
    parts = name.split("+")
    while parts:
        count = min(len(parts), MAX_PLUSES + 1)
        head, rest = _without("+".join(parts[:count]))
        while count > 1 and (not _is_there(head) or "+" in "".join(rest)):  # names of packs have no `+`
            count -= 1
            head, rest = _without("+".join(parts[:count]))
        parts = parts[count:]
        plus.append(head)
        minus.extend(rest)
    return plus, minus


def _without(part: str) -> tuple[str, list[str]]:
    """Split a word without ``+`` into the name to load and the packs to leave out."""
    if _is_there(part):
        return part, []
    path = re.fullmatch(r"(.*\.ya?ml|universe:-?[^-]*)((?:-[^-/\\]*)*)", part, re.DOTALL)
    head, *rest = (path[1], *path[2].split("-")[1:]) if path else part.split("-")
    return head, rest


def names_in_file(text: str, span: Span, reporter: Reporter) -> list[str] | None:
    """Names for `read` from rules that a file names at `span`: shipped names, and paths in its folder or below.

    Returns None after reporting a path outside that folder (PD112) or an unknown name (PD304).
    """
    names: list[str] = []
    parts = text.split("+")
    for part in parts:
        head = part.split("-")[0]
        if is_universe(part):
            names += [part] if universe_seed(_without(part)[0], span, reporter) is not None else []
        elif is_path(part):
            path = path_beside(part, span, reporter)
            names += [str(path)] if path is not None else []
        elif head in shipped_rules():
            names.append(part)
        else:
            _report_unknown(head, span, reporter)
    return names if len(names) == len(parts) else None


def _is_there(text: str) -> bool:
    """True if a text names an existing path other than a folder, or a file that an editor has not saved yet."""
    try:
        there = os.path.exists(text) and not os.path.isdir(text)
        return there or (bool(OPEN) and Path(text).resolve() in OPEN)
    except (OSError, ValueError):
        return False


def _read_apart(source: Source) -> tuple[PackDecl | RulesetDecl | None, tuple[Diagnostic, ...]]:
    """The declaration of a file, and its diagnostics."""

    def read() -> tuple[PackDecl | RulesetDecl | None, tuple[Diagnostic, ...]]:
        reporter = Reporter()
        with suppress(CompileError):  # more errors than the limit
            return read_file(source, reporter), reporter.diagnostics
        return None, reporter.diagnostics

    return persistent(f"rules in {Path(source.name).name}", repr((source.name, source.text)), read)


SMALL = 1 << 16
"""Maximum size in characters of files whose declarations are cached; larger ones take too much memory."""

_read_once = lru_cache(maxsize=128)(_read_apart)
"""A cache, since tasks, tests and environments load the same packs repeatedly."""


class _Reader:
    """Reads declarations, each pack and ruleset once, in the order of first mention."""

    def __init__(self, reporter: Reporter):
        self.reporter = reporter
        self.packs: dict[str, PackDecl] = {}
        self.rulesets: list[RulesetDecl] = []
        self.sources: list[Source] = []
        self.is_whole = True
        """Whether all files could be read, if only in part."""

    def read_all(self, names: Sequence[str | Path]) -> tuple[list[PackDecl], RulesetDecl | None]:
        """Read the declarations of everything named; report mistakes."""
        packs, rulesets = self.packs, self.rulesets
        left_out: dict[str, None] = {}
        for name in names:
            plus, minus = split_names(name)
            left_out |= dict.fromkeys(minus)
            for word in plus:
                self.read(word)
        for word in left_out:
            if word not in packs:
                helps = suggest(word, packs, "packs")
                self.reporter.error("PD304", f"`{word}` is left out, but no pack loads it", None, helps=helps)
        if not names:
            example = "name a shipped ruleset or a file: `powderworld`"
            self.reporter.error("PD304", "no rules were named", None, helps=[example])
        loaded = {name: pack for name, pack in packs.items() if name not in left_out}
        loaded = {**self.needed_by(loaded, left_out), **loaded}
        if not rulesets:
            return list(loaded.values()), None
        *beside, last = rulesets
        for ruleset in last.lineage:
            for scalar in ruleset.without:  # the ids of their elements stay reserved
                lister = ruleset.base.members.get(scalar.text) if ruleset.base else None
                if lister is not None and scalar.text not in last.members:
                    self.read(scalar.text, lister)
        members = dict.fromkeys(name for ruleset in last.lineage for name in ruleset.members)
        reserved = {name: packs[name] for name in members if name not in loaded and name in packs}
        return list(loaded.values()), replace(last, beside=tuple(beside), left_out=reserved)

    def needed_by(self, loaded: Mapping[str, PackDecl], left_out: Collection[str]) -> dict[str, PackDecl]:
        """The required packs that were neither named nor left out, from files in the same folder or shipped."""
        needed: dict[str, PackDecl] = {}
        waiting = list(loaded.values())
        known = {
            name for pack in waiting for name in (pack.name.text, *(word.text for word in pack.provides))
        }
        for pack in waiting:  # grows on the way
            for need in pack.needs:
                word = need.text
                if word in known or word in left_out or is_path(word):
                    continue
                known.add(word)
                decl = self.declaration(_file_beside(word, self.reporter, pack, need.span))
                if isinstance(decl, PackDecl) and decl.name.text == word:
                    needed[word] = decl
                    waiting.append(decl)
        if len(needed) < 2:
            return needed
        from powderdsl.model.composition.names import needed_first

        return {name: needed[name] for name in needed_first(needed)}

    def declaration(self, path: Path | Source | None) -> PackDecl | RulesetDecl | None:
        source = read_source(path, self.reporter) if isinstance(path, Path) else path
        if source is None:
            return None
        self.sources.append(source)
        read_apart = _read_once if len(source.text) <= SMALL else _read_apart
        decl, diagnostics = read_apart(source)
        self.is_whole &= decl is not None
        for diagnostic in diagnostics:
            self.reporter.add(diagnostic)
        return decl

    def read(self, word: str, lister: RulesetDecl | None = None) -> None:
        """Read the pack or ruleset that a word names; `lister` is the ruleset that lists it."""
        if word in self.packs:
            return
        decl = self.declaration(_find(word, self.reporter, lister))
        if isinstance(decl, PackDecl):
            name = decl.name
            other = self.packs.setdefault(name.text, decl)
            if other.source.name != decl.source.name:
                message, label = f"pack `{name.text}` is loaded twice", f"also in {other.source.name}"
                self.reporter.error("PD302", message, name.span, label, helps=["rename one of them"])
        elif decl is not None and lister is not None:
            span = next(scalar.span for scalar in lister.packs if scalar.text == word)
            message, label = f"`{word}` is a ruleset, not a pack", "`packs:` lists packs only"
            helps = [f"to start from it, write `extends: {word}`"]
            self.reporter.error("PD304", message, span, label, helps=helps)
        elif decl is not None:
            ruleset = self.with_base(decl, (decl,))
            if ruleset is None or any(other.source.name == ruleset.source.name for other in self.rulesets):
                return
            self.rulesets.append(ruleset)
            for member, lister in ruleset.members.items():
                self.read(member, lister)

    def with_base(self, decl: RulesetDecl, path: tuple[RulesetDecl, ...]) -> RulesetDecl | None:
        """The ruleset with its base; `path` lists the rulesets from the first one to this one."""
        reporter = self.reporter
        if decl.extends is None:
            return decl
        span, name = decl.extends.span, decl.extends.text
        base = self.declaration(_find_beside(name, reporter, decl, span))
        if isinstance(base, PackDecl):
            reporter.error(
                "PD304", f"`{name}` is a pack, not a ruleset", span, "only a ruleset can be extended",
                helps=["list it under `packs:`"],
            )  # fmt: skip
        if not isinstance(base, RulesetDecl):
            return None
        sources = [ruleset.source.name for ruleset in path]
        if base.source.name in sources:
            cycle = [ruleset.name.text for ruleset in path[sources.index(base.source.name) :]]
            reporter.error(
                "PD314", "rulesets extend each other: " + " extends ".join(f"`{name}`" for name in [*cycle, cycle[0]]),
                span, "this leads back" if len(cycle) > 1 else "this is the ruleset itself",
                secondary=[Label(ruleset.extends.span, "by way of this") for ruleset in path[:-1] if ruleset.extends],
                helps=["take one `extends` out"],
            )  # fmt: skip
            return None
        if len(path) > MAX_BASES:
            reporter.error(
                "PD508", f"more than {MAX_BASES} rulesets extend each other in a row", span, "one too many",
                helps=["list packs instead of extending"],
            )  # fmt: skip
            return None
        whole = self.with_base(base, (*path, base))
        if whole is None:
            return None
        for scalar in decl.without:
            if scalar.text not in whole.members:
                message = f"`{scalar.text}` is left out, but `{name}` does not have it"
                helps = suggest(scalar.text, whole.members, "packs")
                reporter.error("PD304", message, scalar.span, "not there", helps=helps)
        return replace(decl, base=whole)


def _find(word: str, reporter: Reporter, ruleset: RulesetDecl | None) -> Path | Source | None:
    """A file by path or shipped name, or a universe; packs of a ruleset are in its folder or shipped."""
    span = next((s.span for s in ruleset.packs if s.text == word), None) if ruleset else None
    if is_universe(word):
        return universe_source(word, span, reporter)
    if ruleset is not None:
        return _find_beside(word, reporter, ruleset, span)
    path = shipped("rules") / f"{word}.yaml"
    if not is_path(word) and _is_there(str(path)):
        return path
    if _is_there(word):
        return Path(word)
    if is_path(word) or os.path.isdir(word):
        message = f"`{word}` is a folder" if os.path.isdir(word) else f"no file `{word}`"
        reporter.error("PD101", message, None, helps=["check the path of the rule file"])
    else:
        _report_unknown(word, None, reporter)
    return None


def _find_beside(word: str, reporter: Reporter, ruleset: RulesetDecl, span: Span | None) -> Path | None:
    """The file of a pack, or of the base, that a ruleset names at `span`."""
    if is_path(word):
        helps = ["put the file beside the ruleset and write its name, without `.yaml`"]
        message = f"a ruleset names other files without a path: `{word}`"
        reporter.error("PD304", message, span, helps=helps)
        return None
    path = _file_beside(word, reporter, ruleset, span)
    if path is None and not _is_there(str(Path(ruleset.source.name).parent / f"{word}.yaml")):
        _report_unknown(word, span, reporter)
    return path


def _file_beside(
    word: str, reporter: Reporter, decl: PackDecl | RulesetDecl, span: Span | None
) -> Path | None:
    """The file of a pack in the folder of a declaration, or else the shipped one. Reports a link that leads out (PD112)."""
    folder, name = Path(decl.source.name).parent, f"{word}.yaml"
    if _is_there(str(folder / name)) and not is_universe(decl.source.name):
        try:
            return inside(folder, name)
        except ValueError as error:
            reporter.error("PD112", f"`{name}` leaves the folder of `{decl.name.text}`", span, str(error))
            return None
    path = shipped("rules") / name
    return path if _is_there(str(path)) else None


def _report_unknown(word: str, span: Span | None, reporter: Reporter) -> None:
    close = get_close_matches(word, shipped_rules(), n=1)
    helps = [f"did you mean `{close[0]}`?"] if close else ["shipped: " + ", ".join(shipped_rules())]
    if "," in word:
        helps = [f"packs are joined by `+`: `{word.replace(',', '+')}`"]
    if span is None and _is_there(f"{word}.yaml"):
        helps = [f"did you mean the file `{word}.yaml`?"]
    label = "not shipped, and no file" if span else ""
    reporter.error("PD304", f"no pack or ruleset `{word}`", span, label, helps=helps)


@collection_paused()
def lower(ruleset: Ruleset, memo: Memo | None = None) -> Program:
    """Lower the checked model to optimized IR. With a `memo`, only passes that have changed go through the stages."""
    from powderdsl.ir.lower import lower_ruleset
    from powderdsl.ir.stages import run_passes
    from powderdsl.ir.text import structure

    program = lower_ruleset(ruleset)
    if memo is None:
        return run_passes(program)

    def optimized(pass_: PassGraph) -> PassGraph:
        key = program.slots, structure(pass_)
        run = partial(run_passes, replace(program, passes=(pass_,)))
        return memo.of(("optimized", pass_.name), key, run).passes[0]

    return replace(program, passes=tuple(map(optimized, program.passes)))


def segments_of(ruleset: Ruleset, memo: Memo | None = None) -> tuple[Segment, ...]:
    """A ruleset as segments of optimized IR, on bit planes if the planes can represent the passes. `memo` as in `lower`."""
    return persistent(
        f"{ruleset.name} on planes", lambda: ruleset.text_key, lambda: parts(lower(ruleset, memo), memo)
    )


def parts(program: Program, memo: Memo | None = None) -> tuple[Segment, ...]:
    """Split optimized IR into segments, on bit planes if the planes can represent the passes. `memo` as in `lower`."""
    from powderdsl.ir.bits import PassForm, choose_form, segments
    from powderdsl.ir.text import structure

    def form_of(whole: Program, pass_: PassGraph) -> PassForm:
        if memo is None:
            return choose_form(whole, pass_)
        return memo.of(
            ("planes", pass_.name), (whole.slots, structure(pass_)), lambda: choose_form(whole, pass_)
        )

    return segments(program, form_of)
