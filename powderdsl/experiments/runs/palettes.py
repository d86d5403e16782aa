"""The palette of a run: the qualified name of the element of each of its network's slots, or None for a free slot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from powderdsl.experiments.runs.folder import RunFolder, does_not_fit, no_run

MAX_SLOTS = 256


def recorded_palette(run: RunFolder) -> tuple[str | None, ...]:
    """The palette of a run. Raises CompileError (PD620) if it is damaged."""
    palette = run.config.get("palette")
    if not isinstance(palette, list) or not 1 <= len(palette) <= MAX_SLOTS:
        raise no_run(run.path, "it has no palette that a network can have")
    return tuple(None if name is None else str(name) for name in palette)


def check_palette(
    folder: Path, palette: Sequence[str | None], elements: Mapping[int, str], *helps: str
) -> None:
    """Compare the slots of a run's network with the elements of some rules, qualified names by id.

    Raises:
        CompileError: PD623, with every element that has no slot, or whose slot is another's. `helps` are for the first.
    """
    why, lacking = [], 0
    for number, name in elements.items():
        if number >= len(palette):
            lacking += 1
            why.append(f"there is no free slot for `{name}`: the network has {len(palette)}")
        elif palette[number] not in (None, name):
            why.append(f"id {number} is `{palette[number]}` there, `{name}` here")
    if why:
        more = f"train with `--slots {len(palette) + lacking}` to leave room for packs that come later"
        raise does_not_fit(folder, *why, helps=(more, *helps) if lacking else ())
