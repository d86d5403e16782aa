"""Saved worlds, as .npz or JSON. A palette of qualified names lets them load into rulesets with other ids."""

from __future__ import annotations

import base64
import json
import os
import re
from collections.abc import Mapping
from math import prod
from pathlib import Path
from typing import Any

from powderdsl.arrays import np
from powderdsl.diagnostics import CompileError
from powderdsl.model.state import qualified_slots, slot_name
from powderdsl.model.types import ELEMENT, Ruleset
from powderdsl.simulation.simulator import LAST_STEP, Simulator, World
from powderdsl.system.archives import Archive, BadArchive, open_archive, write_archive
from powderdsl.system.reading import parse_json
from powderdsl.system.writing import failure, replacing
from powderdsl.worlds.ascii import load_ascii
from powderdsl.worlds.image import read_image
from powderdsl.worlds.raster import MAX_CELLS, Size
from powderdsl.worlds.scene import Start, draw_start, find_scene

FORMAT = 1
SLOT, IDS = "slot_", "slot_element"
CLOCK = ("seed", "index", "step")
MAX_ABOUT = 1 << 20
"""Bytes of the header `about` of a file."""
MORE = 1 << 24
"""Bytes of arrays allowed in excess of twice the size of the worlds, for fields of packs that are not loaded."""


def save(world: World, path: str | Path) -> None:
    """Write worlds with their state, seeds, indices and steps as .npz, atomically.

    Raises:
        CompileError: PD613 if the file cannot be written, PD607 if there are more than MAX_CELLS cells.
        TypeError: `world` is not a World.
    """
    if not isinstance(world, World):
        raise TypeError(f"save takes a World, found {type(world).__name__}")
    target = Path(path)
    if target.suffix.lower() != ".npz":
        helps = "see powderdsl.gif for animations"
        raise ValueError(f"a saved world's name ends in .npz, found {target.name!r}; {helps}")
    check_saved(target, world.shape)
    ruleset = world.sim.ruleset
    about = {
        "format": FORMAT,
        "ruleset": ruleset.name,
        "palette": {str(element.id): element.qualified for element in ruleset.elements},
        "fields": {name: word for name, word in qualified_slots(ruleset).items() if name in world.state},
    }
    to_numpy = world.sim.kind.to_numpy
    arrays = {f"{SLOT}{name}": to_numpy(value) for name, value in world.state.items()}
    clock = {name: to_numpy(getattr(world, name)) for name in CLOCK}
    with replacing(target, follow=True) as temporary, temporary.open("wb") as file:
        write_archive(file, {"about": json.dumps(about), **arrays, **clock})
        file.flush()
        os.fsync(file.fileno())


def load_world(
    path: str | Path,
    sim: Simulator,
    *,
    size: Size | None = None,
    batch: int | None = None,
    seed: int | None = None,
) -> World:
    """Load saved worlds (.npz), or create worlds from a scene, a drawing (.txt) or a picture (.png).

    The simulator's ruleset may assign other ids to the elements of a saved world.

    Args:
        path: a file, ``FILE.yaml#NAME`` for one of several scenes, or a shipped scene's name such as ``"garden"``.
        size: (rows, columns) instead of the scene's.
        batch: number of copies of a drawn world; 1 by default.
        seed: seed of new worlds; 0 by default.

    Raises:
        CompileError: PD602 if the file is not a world; PD603 or PD604 if the ruleset lacks one of its elements or fields;
            PD607 if it has more than MAX_CELLS cells; what `find_scene` and `draw_start` raise.
        TypeError: `sim` is not a simulator.
        ValueError: `size`, `batch` or `seed` is given for a saved world, or `size` for a picture.
    """
    if not isinstance(sim, Simulator):
        raise TypeError(f"load_world takes a Simulator, from powderdsl.compile; found {type(sim).__name__}")
    source = Path(path)
    if source.suffix.lower() != ".npz":
        drawn = drawn_world(str(path), sim.ruleset, size)
        ids = np.repeat(drawn.ids[None], batch or 1, axis=0)
        return fresh_world(sim, Start(ids, drawn.fields), seed or 0)
    if (size, batch, seed) != (None, None, None):
        raise ValueError("a saved world has its own size, batch and seed")
    try:
        with open_archive(source) as archive:
            return _load(archive, sim, source)
    except FileNotFoundError:
        raise _unreadable(source, "does not exist") from None
    except OSError as error:
        raise _unreadable(source, f"cannot be read: {error.strerror or error}") from None
    except (BadArchive, AttributeError, LookupError, TypeError, ValueError) as error:
        raise _unreadable(source, f"is not a saved world: {' '.join(str(error).split())[:200]}") from None


KINDS = "worlds are .npz, .png, .txt and .yaml files, FILE.yaml#NAME, or a shipped scene's name"


def drawn_world(name: str, ruleset: Ruleset, size: Size | None) -> Start:
    """A picture, an ASCII drawing or a scene; only scenes set fields and can have another `size`."""
    suffix = Path(name).suffix.lower()
    if suffix in (".png", ".txt"):
        kind, read = ("a picture", read_image) if suffix == ".png" else ("a drawing", load_ascii)
        if size is not None:
            raise ValueError(f"size cannot be used with this world: {kind} has its own")
        return Start(read(name, ruleset.elements), {})
    if suffix not in (".yaml", ".yml"):
        if Path(name).is_file():
            raise failure("PD602", f"unknown kind of world file: {name}", helps=(KINDS,))
        if re.search(r"\.[A-Za-z0-9]{1,5}\Z", name):
            raise failure("PD601", f"no world {name}", helps=(KINDS,))
    return draw_start(find_scene(name), ruleset, size=size)


def fresh_world(sim: Simulator, start: Start, seed: int) -> World:
    """New worlds of ids [B, H, W] with the fields that a scene sets."""
    world = sim.world(start.ids, seed=seed)
    for name, field in start.fields.items():
        values: dict[str, Any] = {name: field.values}
        world = sim.paint(world, where=field.where, **values)
    return world


def _load(archive: Archive, sim: Simulator, source: Path) -> World:
    """Worlds from an archive. Raises BadArchive, and LookupError, TypeError or ValueError for malformed values."""
    palette, qualified, saved_in = _about(archive)
    shape = _shape(archive, sim, source)
    clock = {name: _clock(archive, name) for name in CLOCK}
    since = int(clock["step"].max())
    clock["step"] = clock["step"] - since
    seed, index, start = map(sim.kind.from_numpy, clock.values())
    ids = archive.read(IDS)
    fields: dict[str, Any] = {}
    for key in archive.headers:
        name = key.removeprefix(SLOT)
        if key in ("about", IDS, *CLOCK):
            continue
        own_name = slot_name(sim.ruleset, qualified[name]) if name in qualified else name
        slot = sim.slot_by_name.get(own_name)
        if slot is None:
            if sim.ruleset.property(own_name) is None and archive.read(key).any():
                field = qualified.get(name, name)
                problem = f"the field `{field}` of {saved_in} is not in {sim.ruleset.name}"
                raise _mismatch(source, problem, "load the pack that has it")
            continue
        if archive.headers[key].shape != (shape if slot.planes != 2 else (shape[0], 2, *shape[1:])):
            raise BadArchive(f"`{key}` does not fit its elements")
        value = archive.read(key)
        fields[slot.name] = _translate(palette, value, sim, source) if slot.kind == ELEMENT else value
    world = sim.replace(sim.world(_translate(palette, ids, sim, source)), **fields)
    return World(sim, world.state, seed, index, start, since)


def _about(archive: Archive) -> tuple[dict[int, str], dict[str, str], str]:
    """The palette, the qualified name of each field, and the name of the ruleset."""
    header = archive.headers.get("about")
    if header is None or header.shape != () or header.dtype != "str" or header.size > MAX_ABOUT:
        raise BadArchive("it does not say what it is")
    about = parse_json(archive.text("about").encode())
    if not isinstance(about, dict) or about.get("format") != FORMAT:
        raise BadArchive(f"its format is not {FORMAT}")
    palette = {int(number): str(name) for number, name in about["palette"].items()}
    fields = {str(name): str(word) for name, word in about["fields"].items()}
    return palette, fields, str(about.get("ruleset"))[:100]


def _shape(archive: Archive, sim: Simulator, path: Path) -> tuple[int, ...]:
    """[worlds, rows, columns]. Raises BadArchive if the arrays are larger than such worlds can be."""
    header = archive.headers.get(IDS)
    if header is None or header.dtype != "uint8" or len(header.shape) != 3 or 0 in header.shape:
        raise BadArchive("it has no elements [worlds, rows, columns]")
    cells = prod(header.shape)
    check_saved(path, header.shape)
    cell_size = sum(max(1, slot.planes) * np.dtype(slot.dtype).itemsize for slot in sim.slots)
    size = sum(header.size for header in archive.headers.values())
    if size > MORE + 2 * cells * cell_size:
        raise BadArchive(f"it has {size:,} bytes of arrays for {cells:,} cells")
    return header.shape


def check_saved(path: Path, shape: tuple[int, ...]) -> None:
    """Raise CompileError (PD607) if worlds of shape [worlds, rows, columns] have too many cells for a file."""
    if prod(shape) > MAX_CELLS:
        size = "×".join(f"{side:,}" for side in shape)
        helps = (f"the worlds of a file have at most {MAX_CELLS:,} cells together",)
        raise failure("PD607", f"{path}: {size} cells", helps=helps)


def _clock(archive: Archive, name: str) -> Any:
    header = archive.headers.get(name)
    batch = archive.headers[IDS].shape[:1]
    if header is None or header.dtype[:1] not in "iu" or header.shape != batch:
        raise BadArchive(f"its arrays do not fit together (`{name}`)")
    values = archive.read(name)
    if (values < 0).any() or (values > LAST_STEP).any():
        raise BadArchive(f"`{name}` does not lie in 0..{LAST_STEP:,}")
    return values.astype(np.int64)


def _translate(palette: dict[int, str], ids: Any, sim: Simulator, path: Path) -> Any:
    """The file's ids as ids of the simulator's ruleset, uint8. Raises CompileError for missing elements (PD603)."""
    if ids.dtype != np.uint8:
        raise BadArchive(f"elements are bytes, found {ids.dtype}")
    ours = {element.qualified: element.id for element in sim.ruleset.elements}
    table = bytearray(256)
    data = ids.tobytes()
    for number in sorted(set(data)):
        name = palette.get(number)
        if name is None:
            raise BadArchive(f"it has the id {number}, which is not in its palette")
        if name not in ours:
            fix = f"load the pack `{name.split('.')[0]}` too"
            raise _mismatch(path, f"the element `{name}` is not in {sim.ruleset.name}", fix)
        table[number] = ours[name]
    return np.frombuffer(data.translate(table), np.uint8).reshape(ids.shape)


def _unreadable(path: Path, problem: str) -> CompileError:
    return failure("PD602", f"`{path}` {problem}")


def _mismatch(path: Path, problem: str, fix: str) -> CompileError:
    return failure("PD603", f"`{path}` does not fit: {problem}", helps=(fix,))


# Worlds as JSON, for the page (`web/page/worlds.js`)


def world_data(
    ruleset: Ruleset, ids: Any, fields: Mapping[str, Any], clock: tuple[int, int, int]
) -> dict[str, Any]:
    """A world as JSON: ids [H, W], whole fields [H, W] or [2, H, W] by qualified name, seed, index and step."""
    qualified, written = qualified_slots(ruleset), {}
    for name, values in fields.items():
        about = {"type": str(values.dtype), "components": 2 if values.ndim == 3 else 1}
        written[qualified.get(name, name)] = {**about, "values": _text(values.tobytes())}
    return {
        "rows": int(ids.shape[0]),
        "columns": int(ids.shape[1]),
        "palette": {str(element.id): element.qualified for element in ruleset.elements},
        "ids": _text(ids.astype("uint8").tobytes()),
        "fields": written,
        "clock": [str(number) for number in clock],
    }


def first_world_data(world: World) -> dict[str, Any]:
    """The first of some worlds of a simulator as JSON."""
    state = {name: world.sim.kind.to_numpy(values)[0] for name, values in world.state.items()}
    clock = int(world.seed[0]), int(world.index[0]), int(world.step[0])
    return world_data(world.sim.ruleset, state.pop("element"), state, clock)


def _text(data: bytes) -> str:
    return base64.b64encode(data).decode()
