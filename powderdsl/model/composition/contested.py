"""Values that several packs give one element, and optional names that look like misspelled ones."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from fractions import Fraction

from powderdsl.diagnostics import Label, Reporter, Span
from powderdsl.model.composition.compose import Composition
from powderdsl.model.declarations import PackDecl, RulesetDecl, TestDecl
from powderdsl.syntax.ast import Syntax
from powderdsl.syntax.yaml_tree import Mapping as MappingNode
from powderdsl.syntax.yaml_tree import Node, Scalar

Given = tuple[str, str, str, Scalar, Syntax]
"""A pack, a property or field, an element (global names; one that is absent as written), the key, the value."""


def given_values(composition: Composition) -> Iterator[Given]:
    """Every value of a single element, in rising precedence.

    First come those that stand with the elements, as `Composition.entries` has them, then those beside the property or
    field.
    """
    for pack, element, entry in composition.entries():
        for key, syntax in entry.values:
            yield pack, composition.names.of(pack, key.word), element, key, syntax
    for table in (composition.properties, composition.fields):
        for name, typed in table.items():
            for key, syntax in typed.decl.values:
                yield typed.pack, name, composition.element(key.word, typed.pack) or key.word, key, syntax


def report_contested(composition: Composition, reporter: Reporter) -> None:
    """Report values that are replaced by others."""
    known: dict[tuple[str, str], Given] = {}
    for value in given_values(composition):
        pack, name, element, key, syntax = value
        if element in composition.elements and (name in composition.properties or name in composition.fields):
            other = known.get((name, element))
            known[name, element] = value
            if other is not None and _meaning(other[4]) != _meaning(syntax):
                report_replaced(
                    name, element, (other[0], other[3].span), (pack, key.span), composition, reporter
                )


def report_replaced(
    what: str,
    element: str,
    lost: tuple[str, Span],
    held: tuple[str, Span],
    composition: Composition,
    reporter: Reporter,
) -> None:
    """Report that a pack replaces what another one gives an element: a note if it needs that pack, else a warning.

    What a ruleset gives replaces that of its packs without a word; a pack that is added to it may replace it.
    """
    (before, old), (after, new) = lost, held
    needs = composition.names.needs
    if after not in needs:  # a ruleset knows what its packs say
        return
    if before not in needs or before in needs[after]:
        reporter.report(
            "PD317", f"`{after}` replaces the `{what}` of `{element}`", new, "this value is used",
            secondary=[Label(old, f"the one that `{before}` gives")],
        )  # fmt: skip
        return
    reporter.report(
        "PD316", f"packs `{before}` and `{after}` give `{element}` a different `{what}`", new, "this value is used",
        secondary=[Label(old, "this one is lost")],
        helps=[f"say `needs: {before}` in `{after}` if it means to replace it", "or remove one of them"],
    )  # fmt: skip


def _meaning(value: Syntax) -> object:
    """Numbers by what they come to, anything else by its words."""
    text = " ".join(value.span.text.split())
    try:
        return Fraction(text[:-1]) / 100 if text.endswith("%") else Fraction(text)
    except (ValueError, ZeroDivisionError):
        return text


SECTIONS = ("tags", "properties", "fields", "streams", "kernels", "sets", "elements", "passes")
"""Sections of a pack whose keys are names that other packs may ask for."""

MAX_PLACES = 4
"""Places of one name that are shown besides the first."""

_OPTIONAL = re.compile(r"[A-Za-z_][A-Za-z0-9_]*\?")


def report_misspelled(
    packs: Sequence[PackDecl],
    ruleset: RulesetDecl | None,
    elsewhere: Callable[[], Mapping[str, str]],
    reporter: Reporter,
) -> None:
    """Warn of optional names that no pack defines and that are a slip away from one that some pack defines.

    Args:
        elsewhere: words that packs define which are not loaded, and these packs. Asked only if it matters.
    """
    left_out = ruleset.left_out if ruleset else ()
    known = {word for pack in (*packs, *left_out) for word in defined_words(pack)}
    asked: dict[str, dict[Span, None]] = {}
    for decl in (*packs, *((ruleset,) if ruleset else ())):
        for word, span in _optional_names(decl):
            if word not in known:
                asked.setdefault(word, {})[span] = None
    others = elsewhere() if asked else {}
    for word, places in asked.items():
        meant = None if word in others else _meant(word, [*sorted(known), *others])
        if meant is None:
            continue
        pack = others.get(meant) if meant not in known else None
        first, *more = places
        reporter.report(
            "PD315", f"no loaded or shipped pack defines `{word}`", first,
            "with the `?`, it is always absent",
            secondary=[Label(span, "and here") for span in more[:MAX_PLACES]],
            helps=[f"did you mean `{meant}?`" + (f", which `{pack}` defines" if pack else "")],
        )  # fmt: skip


def defined_words(pack: PackDecl) -> Iterator[str]:
    """The names that other packs may use, and the names under `let` and `scratch`."""
    yield from (one.name.text for one in (*pack.definitions, *pack.params, *pack.passes))
    for one in pack.passes:
        yield from (item.name.text for item in one.scratch)
        yield from (name.text for block in one.walk() for name, _ in block.lets)


def words_of_tree(tree: Node | None) -> Iterator[str]:
    """The names that a pack's file defines, from its structure alone."""
    if isinstance(tree, MappingNode):
        for key, section in tree.entries:
            if key.text in SECTIONS and isinstance(section, MappingNode):
                yield from (name.text for name, _ in section.entries)
            elif key.text in SECTIONS and not isinstance(section, Scalar | MappingNode):
                yield from (item.text for item in section.items if isinstance(item, Scalar))


def _optional_names(value: object) -> Iterator[tuple[str, Span]]:
    """Every word with a `?` in declarations, and where it stands."""
    match value:
        case Scalar():
            if _OPTIONAL.fullmatch(value.text):
                yield value.text[:-1], value.span
        case Syntax():
            if value.kind == "optional_name":
                yield value.text.removesuffix("?"), value.span
            for child in value.children:
                yield from _optional_names(child)
        case TestDecl():  # in its worlds a `?` stands for anything
            keys = [key for key, _ in (*value.fields, *value.expect_fields)]
            yield from _optional_names((value.legend, value.always, value.often, tuple(keys)))
        case tuple():
            for item in value:
                yield from _optional_names(item)
        case RulesetDecl():
            yield from _optional_names((value.matrix, value.invariants))
        case _ if dataclasses.is_dataclass(value) and not isinstance(value, type):
            for item in dataclasses.fields(value):
                yield from _optional_names(getattr(value, item.name))


def _meant(word: str, known: Iterable[str]) -> str | None:
    """The name that a word was probably meant for: the first of the closest ones."""
    near = {name: slips for name in known if (slips := _slips(word, name)) is not None}
    return min(near, key=lambda name: near[name], default=None)


def _slips(word: str, name: str) -> int | None:
    """How many slips make a word of a name; None if they are more than its length makes likely.

    A letter that is left out, added, wrong, or exchanged with the next one is a slip. Other words may differ by one
    letter too, as `food` and `mood`, `ash` and `dash`. So short words, and the first letter, must be right.
    """
    most = 2 if len(name) >= 8 else 1
    if min(len(word), len(name)) < 3 or abs(len(word) - len(name)) > most:
        return None
    wrong = 1 if len(name) >= 5 and word[0] == name[0] else most + 1
    rows = [list(range(len(name) + 1))]
    for i, a in enumerate(word, 1):
        row = [i]
        for j, b in enumerate(name, 1):
            best = min(rows[-1][j] + 1, row[-1] + 1, rows[-1][j - 1] + (wrong if a != b else 0))
            if i > 1 and j > 1 and a == name[j - 2] and b == word[i - 2]:
                best = min(best, rows[-2][j - 2] + 1)
            row.append(best)
        rows.append(row)
    found = rows[-1][-1]
    if min(len(word), len(name)) == 3 and len(word) != len(name):
        return None  # `ash` and `dash`
    return found if 0 < found <= most else None
