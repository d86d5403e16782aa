"""Results that checks after each key, as in editors, use again while a pack's file and its words' meaning stay."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from powderdsl.model.expressions.operators import SetOf

if TYPE_CHECKING:
    from powderdsl.diagnostics import Source, Span
    from powderdsl.model.composition.compose import Composition
    from powderdsl.model.expressions.typer import Typer

T = TypeVar("T")

MAX_WORK = 60_000
"""Maximum number of parts of expressions in all rules, which takes a second or two."""

Effects = tuple[tuple[object, str, int], ...]
"""What checks change besides their results: attributes with sets and dicts (0), and counters with their maximum."""


class _Version(NamedTuple):
    source: Source
    words: tuple[str, ...]
    meanings: list[object]
    """What the words mean."""
    results: dict[Span, tuple[Any, object, list[Any]]]
    """By place: a result, what it depends on besides its text and the words, and what was changed."""


class Reuse:
    """Results by file. Results of checks that report something are not stored, so that these checks report again."""

    def __init__(self) -> None:
        self._versions: dict[str, list[_Version]] = {}  # of each file the last three, newest first

    def begin(self, symbols: Composition) -> None:
        """Find the results of files that are as before, and whose words mean what they did."""
        meanings, setting = _meanings(symbols), _setting(symbols)
        sources = [pack.source for pack in symbols.packs.values()]
        for source in sources + [ruleset.source for ruleset in symbols.ruleset.lineage]:
            versions = self._versions.get(source.name, [])
            same = [version for version in versions if version.source == source]
            words = same[0].words if same else tuple({*re.findall(r"\w+", source.text)})
            now = [setting, *map(meanings.get, words)]
            empty = _Version(source, words, now, {})
            current = next((version for version in same if version.meanings == now), empty)
            others = [version for version in versions if version is not current]
            self._versions[source.name] = [current, *others[:2]]

    def of(self, place: Span, inputs: object, typer: Typer, make: Callable[[], T], *more: Any) -> T:
        """The result for the pass, the test or the invariant at a place: an earlier one, or that of `make`.

        `inputs`: what it depends on besides its text and the words of its file. `more`: effects.
        """
        if place.source.name not in self._versions:
            return make()
        effects: Effects = ((typer, "used", 0), (typer, "undeclared", 0), (typer, "work", MAX_WORK), *more)
        version = self._versions[place.source.name][0]
        before = [getattr(owner, name) for owner, name, _ in effects]
        result, earlier, changes = version.results.get(place, (None, self, []))
        if earlier == inputs and all(
            value + change <= most
            for value, change, (*_, most) in zip(before, changes, effects, strict=True)
            if most
        ):
            _apply(effects, before, changes)
            return result
        for owner, name, most in effects:
            if not most:
                setattr(owner, name, type(getattr(owner, name))())
        reports = typer.reporter.reports
        try:
            made = make()
        finally:
            after = [getattr(owner, name) for owner, name, _ in effects]
            changes = [
                new - old if most else new
                for old, new, (*_, most) in zip(before, after, effects, strict=True)
            ]
            _apply(effects, before, changes)
        # A backslash in a file may spell words that are not in its text.
        if typer.reporter.reports == reports and "\\" not in version.source.text:
            version.results[place] = made, inputs, changes
        return made


def _apply(effects: Effects, values: list[Any], changes: list[Any]) -> None:
    """Set attributes to their values before a check, with its changes. What was in a dict stays."""
    for (owner, name, most), value, change in zip(effects, values, changes, strict=True):
        if not most:
            value |= change | value if isinstance(value, dict) else change
        setattr(owner, name, value + change if most else value)


def _setting(symbols: Composition) -> object:
    """The results that concern all files: the packs, what they need, and who lists them or leaves them out."""
    needs = [(name, pack.side_multiple, symbols.names.needs[name]) for name, pack in symbols.packs.items()]
    members = [tuple(ruleset.members) for ruleset in symbols.ruleset.lineage]
    return needs, members, symbols.left_out, symbols.first_id


def _meanings(symbols: Composition) -> dict[str, list[object]]:
    """For each word, all names that it may be short for, with what the checker of lines knows of them."""
    names, ids, order = symbols.names, symbols.names_by_id, symbols.order
    meanings: dict[str, list[object]] = defaultdict(list, any=[ids, order])
    for qualified, name in names.known.items():
        constant, prop = symbols.constants.get(name), symbols.properties.get(name)
        members = [(ids[i], order[i]) for i in constant.ids] if isinstance(constant, SetOf) else ()
        others = prop and prop.kind, symbols.fields.get(name), symbols.streams.get(name)
        for word in {qualified.rpartition(".")[2], name.rpartition(".")[2]}:
            meanings[word].append((qualified, name, names.pack(name), constant, members, others))
    for qualified in symbols.param_decls:
        param = symbols.params.get(qualified)
        meanings[qualified.rpartition(".")[2]].append((qualified, param and param.kind))
    return meanings
