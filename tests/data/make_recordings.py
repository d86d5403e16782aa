"""Make the small recordings beside this file from a folder of full ones.

    python tests/data/make_recordings.py FOLDER [SECOND]

The second folder holds recordings of the engine's second generation; their copies lie in `second/`.

A full recording holds steps of the published Powderworld engine, one state after every pass. This script
keeps the few steps of each file that show everything: steps are taken one at a time, each time the one that
adds the most events not seen so far, until every event of the file is seen. An event is a pass putting one
element in the place of another somewhere, or raising or lowering the gravity, momentum or clone (of the second
generation: gravity, density and what elements keep for themselves) of a cell of an element, or changing its velocity. Array names and types stay as they are, so that tests read small
and full recordings alike; `population.npz`, counts of elements only, is copied whole.

The output depends on nothing but the input. Files are zip archives packed with LZMA, which finds the
repetition from pass to pass that deflate's short window misses; `numpy.load` reads them like any other.
"""

from __future__ import annotations

import argparse
import os
import zipfile
from pathlib import Path

import numpy as np

Recording = dict[str, np.ndarray]

HERE = Path(__file__).parent
NAMES = ("designed_tests", "mixtures", "pairings", "pcg")
SECOND = ("creatures_32x32", "creatures_32x48", "defect_sand_dust", "designed", "mixtures", "shapes")
NUMBERS = ("gravity", "momentum", "clone", "density", "custom1", "custom2", "custom3")
# Arrays whose axis of recorded steps is not the first.
STEP_AXIS = {"elements": None, "passes": None, "step": 0, "random": 1, "world": 0, "defect": 1}


def step_axis(name: str) -> int | None:
    """The axis of `name` that counts recorded steps; None when it has none."""
    return STEP_AXIS[name] if name in STEP_AXIS else int(name.startswith("after_"))


def events_of(recording: Recording, step: int) -> set[tuple[object, ...]]:
    """What happens in one recorded step, as a set of hashable events."""
    numbers = [name for name in NUMBERS if f"before_{name}" in recording]
    fields = ("ids", *numbers, "velocity")
    state = {name: recording[f"before_{name}"][step] for name in fields}
    events: set[tuple[object, ...]] = set()
    for index, pass_name in enumerate(recording["passes"].tolist()):
        after = {name: recording[f"after_{name}"][index, step] for name in fields}
        changed = state["ids"] != after["ids"]
        pairs = np.stack([state["ids"][changed], after["ids"][changed]], axis=1)
        events |= {(pass_name, *pair) for pair in np.unique(pairs, axis=0).tolist()}
        if "defect" in recording:
            wrong = recording["defect"][index, step]
            events |= {(pass_name, "defect", element) for element in np.unique(after["ids"][wrong]).tolist()}
        for name in numbers:
            rise = np.sign(after[name].astype(float) - state[name])
            found = np.stack([after["ids"][rise != 0], rise[rise != 0]], axis=1)
            events |= {(pass_name, name, *pair) for pair in np.unique(found, axis=0).tolist()}
        moved = np.abs(after["velocity"] - state["velocity"]).max(axis=0) > 1e-3
        events |= {(pass_name, "velocity", element) for element in np.unique(after["ids"][moved]).tolist()}
        state = after
    return events


def choose(recording: Recording) -> list[int]:
    """The recorded steps to keep, in their own order."""
    unseen = [events_of(recording, step) for step in range(len(recording["step"]))]
    chosen: list[int] = []
    while any(unseen):
        best = max(range(len(unseen)), key=lambda step: len(unseen[step]))  # the first of equals
        chosen.append(best)
        gained = unseen[best]
        unseen = [events - gained for events in unseen]
    return sorted(chosen)


def keep(recording: Recording, steps: list[int]) -> Recording:
    """The recording with only these steps."""
    axes = {name: step_axis(name) for name in recording}
    return {
        name: array if axes[name] is None else np.ascontiguousarray(np.take(array, steps, axis=axes[name]))
        for name, array in recording.items()
    }


def write(path: Path, recording: Recording) -> None:
    """Write an .npz packed with LZMA, whole or not at all, byte for byte the same each time."""
    partial = path.with_name(path.name + ".part")
    with zipfile.ZipFile(partial, "w", zipfile.ZIP_LZMA) as archive:
        for name, array in recording.items():
            entry = zipfile.ZipInfo(f"{name}.npy")  # dated 1980: no clock in the file
            entry.compress_type = zipfile.ZIP_LZMA
            with archive.open(entry, "w") as file:
                np.lib.format.write_array(file, array, allow_pickle=False)
    os.replace(partial, path)


def copy(folder: Path, names: tuple[str, ...], to: Path) -> None:
    """Write the small copies of some recordings."""
    for name in names:
        with np.load(folder / f"{name}.npz", allow_pickle=False) as archive:
            recording = {key: archive[key] for key in archive.files}
        steps = choose(recording)
        write(to / f"{name}.npz", keep(recording, steps))
        size = (to / f"{name}.npz").stat().st_size
        print(f"{name}: {len(steps)} of {len(recording['step'])} steps, {size} bytes")


def main() -> None:
    """Read the recordings' folder from the command line and write the small copies beside this file."""
    parser = argparse.ArgumentParser(description="make the small recordings that the tests read")
    parser.add_argument("folder", type=Path, help="folder of the full recordings")
    parser.add_argument("second", type=Path, nargs="?", help="folder of those of the second generation")
    given = parser.parse_args()
    copy(given.folder, NAMES, HERE)
    if given.second is not None:
        (HERE / "second").mkdir(exist_ok=True)
        copy(given.second, SECOND, HERE / "second")
    folder = given.folder
    partial = HERE / "population.npz.part"
    partial.write_bytes((folder / "population.npz").read_bytes())
    os.replace(partial, HERE / "population.npz")


if __name__ == "__main__":
    main()
