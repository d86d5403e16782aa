"""The names of a composition, and other names that a hurried author might write instead."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

from powderdsl.model.builtins import KERNELS
from powderdsl.model.declarations import PackDecl, TypedDecl

MOST = 2
"""The number of names that are tried in place of one."""


@dataclass(frozen=True)
class Names:
    """Names by kind, in the order of the files. `own` are those of the mutated pack; `local` are its `let` values."""

    kinds: dict[str, str]
    own: frozenset[str]
    ranges: dict[str, tuple[int, int]]
    """Bounds of properties that are integers."""
    flags: frozenset[str]
    """Properties that are flags."""
    local: dict[str, str] = field(default_factory=dict)
    """`let` values of the pass at hand, with their text."""

    def kind(self, name: str) -> str:
        """The kind of a name without what it holds, or nothing: `property:int` is a `property`."""
        return self.kinds.get(name, "").partition(":")[0]

    def others(self, name: str) -> list[str]:
        """Names of the same kind: those of the same pack first, then others."""
        wanted = self.kinds.get(name)
        if wanted is None:
            return []
        same = [other for other, kind in self.kinds.items() if kind == wanted]
        place = same.index(name)
        ring = same[place + 1 :] + same[:place]
        if name in self.own:
            ring = [*(n for n in ring if n in self.own), *(n for n in ring if n not in self.own)]
        return [*dict.fromkeys([*ring[:1], *ring[-1:]])][:MOST]

    def with_lets(self, lets: dict[str, str]) -> Names:
        """The same names with the `let` values of a pass."""
        kinds = {**self.kinds, **dict.fromkeys(lets, "let")}
        return replace(self, kinds=kinds, own=self.own | frozenset(lets), local=lets)


def names_of(packs: Sequence[PackDecl], pack: PackDecl) -> Names:
    """The names that rules of a pack can say."""
    kinds: dict[str, str] = dict.fromkeys(KERNELS, "kernel")
    ranges: dict[str, tuple[int, int]] = {}
    flags = set()
    own: set[str] = set()
    for one in packs:
        found = {
            decl.name.text: kind
            for kind in ("tag", "set", "element", "stream", "kernel")
            for decl in getattr(one, f"{kind}s")
        }
        found |= _typed(one.properties, "property") | _typed(one.fields, "field")
        if one is pack:
            found |= _typed(one.params, "parameter")
            own |= set(found)
        kinds |= found
        for decl in one.properties:
            text = decl.type.span.text if decl.type else ""
            bounds = re.fullmatch(r"\s*(-?\d+)\s*\.\.\s*(-?\d+)\s*", text)
            if bounds:
                ranges[decl.name.text] = int(bounds[1]), int(bounds[2])
            elif text.strip() == "flag":
                flags.add(decl.name.text)
    return Names(kinds, frozenset(own), ranges, frozenset(flags))


def _typed(decls: Iterable[TypedDecl], kind: str) -> dict[str, str]:
    """Declared names with their kind and what they hold: a number never stands for a flag by mistake."""
    found = {}
    for decl in decls:
        text = (decl.type or decl.default).span.text.strip() if (decl.type or decl.default) else ""  # type: ignore[union-attr]
        held = (
            "int" if re.match(r"-?\d+\s*\.\.", text) else "chance" if "%" in text else text.partition("(")[0]
        )
        found[decl.name.text] = f"{kind}:{held}"
    return found
