"""The ids of elements: assigned when packs are composed, or recorded in a palette.

A palette has the qualified name of the element of each id, or None where an id is free. Worlds, datasets and
checkpoints keep one, so that they mean the same elements whatever else is loaded later.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from powderdsl.diagnostics import Label, Reporter
from powderdsl.model.declarations import ElementDecl

MAX_ELEMENTS = 256
"""Ids fit into a byte."""

Palette = Sequence[str | None]
"""By id: an element's qualified name, or None."""


@dataclass(frozen=True)
class Claim:
    """An element that wants an id. `name` is the global one; `own` says that a ruleset lists its pack."""

    name: str
    qualified: str
    pack: str
    decl: ElementDecl
    own: bool
    replaces: tuple[str, ...] = ()
    """Qualified names of the elements that it overrides, the latest first: it takes over their id."""
    is_loaded: bool = True
    """False for elements of packs that a ruleset leaves out: their ids stay reserved."""


def composed_ids(claims: Iterable[Claim]) -> dict[str, int]:
    """Ids by global name. Earlier claims are decided first, so further packs change nothing.

    An element has the id that its file gives, unless that is taken. All others have the lowest free id above those of
    the ruleset's packs, or, without a ruleset, above all ids so far.
    """
    ids: dict[str, int] = {}
    taken: dict[int, str] = {}
    highest = -1
    for claim in claims:
        number = claim.decl.id
        if number is None or number in taken:
            above = [n for n in range(highest + 1, MAX_ELEMENTS) if n not in taken]
            free = above or [n for n in range(MAX_ELEMENTS) if n not in taken]
            if not free:
                break
            number = free[0]
        ids[claim.name] = number
        taken[number] = claim.name
        if claim.own:
            highest = max(highest, number)
    return ids


def recorded_ids(claims: Iterable[Claim], palette: Palette) -> dict[str, int]:
    """Ids by global name, where a palette has them; others get its free ids, then those behind its end.

    An element that asks for a free id of the palette gets it.
    """
    known = {name: number for number, name in enumerate(palette) if name is not None}
    ids: dict[str, int] = {}
    later: list[Claim] = []
    for claim in claims:
        found = next((known[name] for name in (claim.qualified, *claim.replaces) if name in known), None)
        if found is None:
            later.append(claim)
        else:
            ids[claim.name] = found
    for claim in tuple(later):
        wanted = claim.decl.id
        vacant_there = wanted is not None and wanted < len(palette) and palette[wanted] is None
        if wanted is not None and vacant_there and wanted not in ids.values():
            ids[claim.name] = wanted
            later.remove(claim)
    taken = set(ids.values())
    vacant = [n for n in range(len(palette)) if palette[n] is None and n not in taken]
    free = [*vacant, *range(len(palette), MAX_ELEMENTS)]
    return ids | {claim.name: number for claim, number in zip(later, free, strict=False)}


def report_ids(
    claims: Sequence[Claim], ids: Mapping[str, int], reporter: Reporter, *, recorded: bool
) -> None:
    """Report elements without an id, two elements of one pack with the same id, and ids that differ from the file."""
    loaded = [claim for claim in claims if claim.is_loaded]
    lacking = [claim for claim in loaded if claim.name not in ids]
    if lacking:
        reporter.error(
            "PD508", f"{len(loaded)} elements", lacking[0].decl.name.span, f"the limit is {MAX_ELEMENTS}",
            helps=["load fewer packs"],
        )  # fmt: skip
    holders = {ids[claim.name]: claim for claim in claims if claim.name in ids}
    by_number: dict[tuple[str, int], Claim] = {}
    for claim in loaded:
        wanted, scalar = claim.decl.id, claim.decl.id_scalar
        if wanted is None or scalar is None:
            continue
        first = by_number.setdefault((claim.pack, wanted), claim)
        if first is not claim:
            used = {other.decl.id for other in loaded} | {
                number for number, holder in holders.items() if holder.is_loaded and holder is not claim
            }
            free = next((n for n in range(MAX_ELEMENTS) if n not in used), None)
            reporter.error(
                "PD303", f"elements `{first.decl.name.text}` and `{claim.decl.name.text}` have the same id {wanted}",
                scalar.span, "already taken", secondary=[Label(first.decl.name.span, "by this one")],
                helps=[] if free is None else [f"id {free} is free; an element without `id:` gets a free one"],
            )  # fmt: skip
        elif not recorded and ids.get(claim.name, wanted) != wanted:
            reporter.report(
                "PD313", f"`{claim.qualified}` has id {ids[claim.name]} here, not {wanted}",
                scalar.span, f"`{holders[wanted].qualified}` has id {wanted}",
                notes=["saved worlds, datasets and checkpoints know elements by name, not by id"],
            )  # fmt: skip
