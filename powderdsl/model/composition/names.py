"""Which definition a word means: one namespace over all packs, in which packs that do not know each other may clash."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from powderdsl.diagnostics import Label, Reporter
from powderdsl.model.builtins import RESERVED
from powderdsl.model.declarations import PackDecl
from powderdsl.syntax.parse import reserved_words
from powderdsl.syntax.yaml_tree import Scalar

PASS = "pass"
"""The kind of names that live apart: a pass and an element may share a word."""


@dataclass(frozen=True)
class Names:
    """Every global name of a composition.

    The first pack that defines a word keeps it as its global name. A pack that neither needs that one nor is needed by
    it may define the same word: its definition is known as ``pack.word``. So adding a pack renames nothing.
    """

    owners: Mapping[str, tuple[str, str]]
    """The pack that defines each global name, and the word under which it does; passes left out."""
    meanings: Mapping[tuple[str, str], str]
    """By pack and word: the global name that the word means there, where that is not the word itself."""
    pass_meanings: Mapping[tuple[str, str], str]
    """The same for names of passes."""
    defined: Mapping[tuple[str, str], str]
    """By pack and word: the global name of what the pack defines, elements that it overrides among them."""
    passes_defined: Mapping[tuple[str, str], str]
    """The same for names of passes."""
    needs: Mapping[str, frozenset[str]]
    """A pack, and all packs that it needs, directly or not."""

    def of(self, pack: str, word: str) -> str:
        """The global name that a word, plain or qualified, means in a pack. Unknown words stay as they are."""
        return _meant(self.meanings, self.defined, pack, word)

    def of_pass(self, pack: str, word: str) -> str:
        """The same for the name of a pass."""
        return _meant(self.pass_meanings, self.passes_defined, pack, word)

    def qualified(self, pack: str, word: str) -> str | None:
        """The global name of what a pack defines under a word."""
        return self.defined.get((pack, word))

    def knows(self, pack: str, name: str) -> bool:
        """Whether a pack can be expected to know a global name: its own, or one of a pack that it needs."""
        owner = self.owners.get(name)
        return owner is None or owner[0] in self.needs.get(pack, frozenset((pack,)))


def _meant(
    meanings: Mapping[tuple[str, str], str], defined: Mapping[tuple[str, str], str], pack: str, word: str
) -> str:
    owner, point, own = word.partition(".")
    return (defined.get((owner, own)) if point else meanings.get((pack, word))) or word


def a(noun: str) -> str:
    """The noun with its article."""
    return f"{'an' if noun[0] in 'aeiou' else 'a'} {noun}"


def needs_of(packs: Sequence[PackDecl]) -> dict[str, frozenset[str]]:
    """For each pack, itself and all packs that it needs, directly or not."""
    direct = {decl.name.text: [need.text for need in decl.needs] for decl in packs}
    closed: dict[str, frozenset[str]] = {}
    for pack in direct:
        found: dict[str, None] = {}
        waiting = [pack]
        while waiting:
            name = waiting.pop()
            if name not in found:
                found[name] = None
                waiting.extend(direct.get(name, ()))
        closed[pack] = frozenset(found)
    return closed


@dataclass(frozen=True)
class _Definition:
    kind: str
    scalar: Scalar
    pack: str
    name: str
    """The global one."""


class NameBook:
    """Collects the definitions of packs, in load order, and reports those that clash.

    `rename` has other global names, by qualified name.
    """

    def __init__(
        self, packs: Sequence[PackDecl], rename: Sequence[tuple[Scalar, Scalar]], reporter: Reporter
    ):
        self.reporter = reporter
        self.packs = [pack.name.text for pack in packs]
        self.needs = needs_of(packs)
        self.reserved = RESERVED | reserved_words() | {"elements"}
        self.rename = {old.text: new for old, new in rename}
        self.renamed: set[str] = set()
        """The qualified names of `rename` that were met."""
        self._words: dict[tuple[bool, str], list[_Definition]] = {}
        """By the word in its own file."""
        self._known: dict[tuple[bool, str], _Definition] = {}
        """By global name."""
        self._overridden: dict[tuple[str, str], str] = {}
        """By pack and word: the global name of the element that the pack overrides."""

    def check_word(self, scalar: Scalar, kind: str) -> bool:
        """Whether a word may name something; reports one that belongs to the language."""
        if scalar.text not in self.reserved:
            return True
        self.reporter.error(
            "PD311",
            f"`{scalar.text}` is a word of the language",
            scalar.span,
            f"cannot name {a(kind)}",
            helps=[f"write `{scalar.text}_`, or choose another name"],
        )
        return False

    def define(self, scalar: Scalar, kind: str, pack: str) -> str | None:
        """The global name of a definition, or None after reporting that it clashes with one the pack knows."""
        if kind != PASS and not self.check_word(scalar, kind):
            return None
        is_pass, word = kind == PASS, scalar.text
        written = self._words.setdefault((is_pass, word), [])
        for other in written:
            if self._related(pack, other.pack):
                self._twice(scalar, kind, pack, other)
                return None
        name, new = word, self.rename.get(f"{pack}.{word}")
        if new is not None:
            self.renamed.add(f"{pack}.{word}")
            if not self.check_word(new, kind):
                return None
            name = new.text
        elif (is_pass, word) in self._known:
            name = f"{pack}.{word}"
            self._qualified(scalar, kind, pack, name, self._known[is_pass, word])
        if (is_pass, name) in self._known:
            self._twice(new or scalar, kind, pack, self._known[is_pass, name])
            return None
        found = _Definition(kind, scalar, pack, name)
        written.append(found)
        self._known[is_pass, name] = found
        return name

    def find(self, word: str, pack: str, kind: str) -> str | None:
        """The global name of what packs before this one define under a word; what the pack knows comes first."""
        written = [one for one in self._words.get((kind == PASS, word), ()) if one.kind == kind]
        near = [one for one in written if one.pack in self.needs[pack]]
        return (near or written)[0].name if written else None

    def override(self, word: str, pack: str) -> str | None:
        """The global name of the element that a pack overrides, which is also known by the pack's name from now on."""
        name = self.find(word, pack, "element")
        if name is not None:
            self._overridden[pack, word] = name
        return name

    def finish(self) -> Names:
        """What every word means in every pack."""
        meanings: dict[bool, dict[tuple[str, str], str]] = {False: {}, True: {}}
        for (is_pass, word), written in self._words.items():
            if all(one.name == word for one in written):
                continue
            for pack in self.packs:
                own = [one.name for one in written if one.pack == pack]
                near = own or [one.name for one in written if one.pack in self.needs[pack]]
                if near:
                    meanings[is_pass][pack, word] = near[0]
        defined: dict[bool, dict[tuple[str, str], str]] = {False: {}, True: {}}
        for (is_pass, name), one in self._known.items():
            defined[is_pass][one.pack, one.scalar.text] = name
        owners = {name: owner for owner, name in defined[False].items()}
        return Names(
            owners=owners,
            meanings=meanings[False],
            pass_meanings=meanings[True],
            defined={**defined[False], **self._overridden},
            passes_defined=defined[True],
            needs=self.needs,
        )

    def _related(self, pack: str, other: str) -> bool:
        return other in self.needs[pack] or pack in self.needs[other]

    def _twice(self, scalar: Scalar, kind: str, pack: str, other: _Definition) -> None:
        fix = "rename one of them" + (
            "; to replace an element say `override: yes`" if kind == "element" else ""
        )
        self.reporter.error(
            "PD302",
            f"{kind + ' ' if kind == PASS else ''}`{scalar.text}` is defined twice",
            scalar.span,
            f"{a(kind)} of {pack}",
            secondary=[Label(other.scalar.span, f"{a(other.kind)} of {other.pack}")],
            helps=[fix],
        )

    def _qualified(self, scalar: Scalar, kind: str, pack: str, name: str, first: _Definition) -> None:
        self.reporter.report(
            "PD312",
            f"the {kind} `{scalar.text}` of `{pack}` is known as `{name}` here",
            scalar.span,
            f"`{first.pack}` defines `{scalar.text}` too",
            secondary=[Label(first.scalar.span, f"{a(first.kind)} of {first.pack}")],
            notes=[f"in the rules of `{pack}`, `{scalar.text}` still means its own"],
        )
