"""Values of one element that several packs give: which one holds is defined, and who loses it is told."""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction

from powderdsl.diagnostics import Label, Reporter
from powderdsl.model.composition.compose import Composition, needed_first
from powderdsl.model.composition.names import needs_of
from powderdsl.syntax.ast import Syntax
from powderdsl.syntax.yaml_tree import Scalar

Given = tuple[str, str, str, Scalar, Syntax]
"""A pack, a property or field, an element (global names; one that is absent as written), the key, the value."""


def given_values(composition: Composition) -> Iterator[Given]:
    """Every value of a single element, in rising precedence.

    First come the elements' own, then those under `also`: each pack after those that it needs, in load order
    otherwise. Those beside the property or field come last.
    """

    def name_of(pack: str, key: Scalar) -> str:
        return composition.names.of(pack, key.text.removesuffix("?"))

    for element, named in composition.element_decls.items():
        for key, syntax in named.decl.values:
            yield named.pack, name_of(named.pack, key), element, key, syntax
    for decl in needed_first(composition.packs):
        pack = decl.name.text
        for also in decl.also:
            word = also.element.text.removesuffix("?")
            for key, syntax in also.values:
                yield pack, name_of(pack, key), composition.element(word, pack) or word, key, syntax
    for table in (composition.properties, composition.fields):
        for name, typed in table.items():
            for key, syntax in typed.decl.values:
                word = key.text.removesuffix("?")
                yield typed.pack, name, composition.element(word, typed.pack) or word, key, syntax


def report_contested(composition: Composition, reporter: Reporter) -> None:
    """Report values that another one takes the place of: a note where a pack means to, a warning where none can."""
    needs = needs_of(composition.packs)
    known: dict[tuple[str, str], Given] = {}
    for value in given_values(composition):
        pack, name, element, key, syntax = value
        if element not in composition.elements or not (
            name in composition.properties or name in composition.fields
        ):
            continue
        other = known.get((name, element))
        known[name, element] = value
        if other is None or _meaning(other[4]) == _meaning(syntax):
            continue
        if other[0] in needs[pack]:
            reporter.report(
                "PD317", f"`{pack}` replaces the `{name}` of `{element}`", key.span, "this value holds",
                secondary=[Label(other[3].span, f"the value that `{other[0]}` gives")],
            )  # fmt: skip
        else:
            reporter.report(
                "PD316", f"packs `{other[0]}` and `{pack}` give `{element}` different values of `{name}`",
                key.span, "this one holds", secondary=[Label(other[3].span, "this one is lost")],
                helps=[f"say `needs: {other[0]}` in `{pack}` if it means to replace the value", "or remove one of them"],
            )  # fmt: skip


def _meaning(value: Syntax) -> object:
    """Numbers by what they come to, anything else by its words."""
    text = " ".join(value.span.text.split())
    try:
        return Fraction(text[:-1]) / 100 if text.endswith("%") else Fraction(text)
    except (ValueError, ZeroDivisionError):
        return text
