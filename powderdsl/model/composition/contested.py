"""Values of one element that several packs give: the order that decides, and a report of each replaced value."""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction

from powderdsl.diagnostics import Label, Reporter, Span
from powderdsl.model.composition.compose import Composition
from powderdsl.syntax.ast import Syntax
from powderdsl.syntax.yaml_tree import Scalar

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
