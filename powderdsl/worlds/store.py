"""Saved worlds: one .npz with a palette of qualified names, so that they load into rulesets with other ids."""

from __future__ import annotations

import json
import os
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from powderdsl.diagnostics import CompileError, Reporter
from powderdsl.model.types import ELEMENT
from powderdsl.simulator import Simulator, World
from powderdsl.worlds.files import replacing

FORMAT = 1
MAX_BYTES = 1 << 32
"""Uncompressed size of all arrays of a file, at most."""


def save(world: World, path: str | Path) -> None:
    """Write worlds with everything their future hangs on. The file appears whole or not at all.

    Raises:
        CompileError: PD613 if the place cannot be written, PD602 if the disk is full.
    """
    target = Path(path)
    ruleset = world.sim.ruleset
    about = {
        "format": FORMAT,
        "ruleset": ruleset.name,
        "palette": {str(element.id): element.qualified for element in ruleset.elements},
    }
    arrays = {f"slot_{name}": value.cpu().numpy() for name, value in world.state.items()}
    clock = {name: getattr(world, name).cpu().numpy() for name in ("seed", "index", "step")}
    with replacing(target, follow=True) as temporary:
        try:
            with temporary.open("wb") as file:
                np.savez_compressed(file, about=np.array(json.dumps(about)), **arrays, **clock)  # type: ignore[arg-type]
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise _bad(target, f"cannot be written: {error.strerror}") from None


def load_world(path: str | Path, sim: Simulator) -> World:
    """Worlds from a file, for a simulator whose ruleset may number its elements differently.

    Raises:
        CompileError: PD602 if the file is no saved world; PD603 if the ruleset lacks one of its elements or fields.
    """
    import torch

    source = Path(path)
    data = _read(source)
    try:
        about = json.loads(str(data.pop("about")))
        if not isinstance(about, dict) or about.get("format") != FORMAT:
            raise _bad(source, f"was saved in another format than {FORMAT}")
        palette = {int(number): str(name) for number, name in about["palette"].items()}
        clock = {
            name: torch.from_numpy(data.pop(name).astype(np.int64)).to(sim.device)
            for name in ("seed", "index", "step")
        }
        ids = data.pop("slot_element")
    except (KeyError, ValueError, TypeError, AttributeError) as error:
        raise _bad(source, f"is no saved world: {type(error).__name__} {error}") from None
    if (
        ids.dtype != np.uint8
        or ids.ndim != 3
        or 0 in ids.shape
        or any(value.shape != (len(ids),) for value in clock.values())
    ):
        raise _bad(source, "is no saved world: its arrays do not fit together")
    numbers = _numbers(palette, ids, sim, source)
    fields: dict[str, Any] = {}
    for key, value in data.items():
        name = key.removeprefix("slot_")
        slot = next((s for s in sim.slots if s.name == name), None)
        if slot is None:
            if value.any() and sim.ruleset.property(name) is None:
                raise _mismatch(
                    source,
                    f"the field `{name}` of {about['ruleset']} is not in {sim.ruleset.name}",
                    "load the pack that has it",
                )
            continue
        if slot.kind == ELEMENT:
            value = _numbers(palette, value, sim, source)[value]
        fields[name] = value
    try:
        world = sim.replace(sim.world(numbers[ids]), **fields)
        return World(sim, world.state, **clock)
    except (ValueError, TypeError) as error:
        raise _bad(source, str(error)) from None


def _read(path: Path) -> dict[str, Any]:
    """The arrays of a file, after looking at how much they claim to hold. No pickles."""
    try:
        with zipfile.ZipFile(path) as archive:
            if sum(entry.file_size for entry in archive.infolist()) > MAX_BYTES:
                raise _bad(path, "holds more than 4 GiB")
        with np.load(path, allow_pickle=False) as data:
            return {name: data[name] for name in data.files}
    except FileNotFoundError:
        raise _bad(path, "does not exist") from None
    except (
        OSError,
        ValueError,
        EOFError,
        zipfile.BadZipFile,
        KeyError,
        NotImplementedError,
        MemoryError,
        RuntimeError,
    ) as error:
        raise _bad(path, f"cannot be read: {error}") from None
    except CompileError:
        raise
    except Exception as error:  # a damaged archive raises whatever its codec likes
        raise _bad(path, f"is damaged: {error}") from None


def _numbers(palette: dict[int, str], ids: Any, sim: Simulator, path: Path) -> Any:
    """Our id for each of the file's, uint8 [256]; reports elements that we do not have."""
    ours = {element.qualified: element.id for element in sim.ruleset.elements}
    table = np.zeros(256, np.uint8)
    for number in np.unique(ids).tolist():
        name = palette.get(number)
        if name is None:
            raise _bad(path, f"has the id {number}, which is not in its palette")
        if name not in ours:
            raise _mismatch(
                path,
                f"the element `{name}` is not in {sim.ruleset.name}",
                f"load the pack `{name.split('.')[0]}` too",
            )
        table[number] = ours[name]
    return table


def _bad(path: Path, problem: str) -> CompileError:
    reporter = Reporter()
    reporter.error("PD602", f"`{path}` {problem}", None)
    return CompileError(reporter.diagnostics)


def _mismatch(path: Path, problem: str, cure: str) -> CompileError:
    reporter = Reporter()
    reporter.error("PD603", f"`{path}` does not fit: {problem}", None, helps=[cure])
    return CompileError(reporter.diagnostics)
