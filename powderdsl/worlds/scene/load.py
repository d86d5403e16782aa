"""Scenes by file or name -> start worlds of a ruleset."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from powderdsl.diagnostics import Reporter, suggest
from powderdsl.model.types import Element
from powderdsl.syntax.sources import read_source
from powderdsl.system.writing import failure
from powderdsl.worlds.raster import MAX_CELLS, Paint, Size, paint
from powderdsl.worlds.scene.read import SIZE_RULE, Scene, read_scenes


class HasElements(Protocol):
    """A ruleset, as far as scenes need one."""

    @property
    def elements(self) -> Sequence[Element]: ...


def load_scene(
    path_or_name: str | Path, ruleset: HasElements, *, size: Size | None = None
) -> NDArray[np.uint8]:
    """The ids uint8 [H, W] of a scene: a file, ``FILE#NAME`` for one of several, or a shipped scene's name.

    Fields that the scene sets are left out: `load_start` has them.

    With another `size` shapes stay where they are, a frame and open ends follow the edge. Raises CompileError
    with everything that is wrong.
    """
    return draw_scene(find_scene(path_or_name), ruleset, size=size)


def load_scenes(
    path: str | Path, ruleset: HasElements, *, size: Size | None = None
) -> dict[str, NDArray[np.uint8]]:
    """Every scene of a file by name, uint8 [H, W] each, in the order of the file. Raises CompileError."""
    reporter = Reporter()
    drawn = {scene.name: _draw(scene, ruleset, size, reporter) for scene in _read_file(Path(path))}
    reporter.raise_if_errors()
    return {name: ids for name, ids in drawn.items() if ids is not None}


def find_scene(path_or_name: str | Path) -> Scene:
    """A scene from a file, or a shipped one by name. Raises CompileError (PD601 for an unknown name)."""
    text = str(path_or_name)
    file, _, name = text.rpartition("#") if "#" in text else (text, "", "")
    if file.lower().endswith((".yaml", ".yml")) or _is_file(file):
        scenes = {scene.name: scene for scene in _read_file(Path(file))}
        if not name and len(scenes) == 1:
            return next(iter(scenes.values()))
        if name in scenes:
            return scenes[name]
        message = f"no scene `{name}` in {file}" if name else f"{file} has {len(scenes)} scenes"
        which = f"say which: {file}#{next(iter(scenes), 'NAME')}"
        raise failure("PD601", message, helps=suggest(name, scenes) if name else (which,))
    shipped = {scene.name: scene for scene in shipped_scenes()}
    if text in shipped:
        return shipped[text]
    helps = suggest(text, shipped) or ("shipped: " + ", ".join(shipped),)
    raise failure("PD601", f"unknown scene `{text[:80]}`", helps=helps)


def _is_file(text: str) -> bool:
    try:
        return Path(text).is_file()
    except OSError:  # a name longer than the system allows is not a file either
        return False


def shipped_scenes() -> tuple[Scene, ...]:
    """The scenes that come with the package, files in alphabetical order."""
    package = Path(__file__).resolve().parents[2]
    installed = package / "data" / "tasks" / "scenes"
    directory = installed if installed.is_dir() else package.parent / "tasks" / "scenes"
    return tuple(scene for path in sorted(directory.glob("*.yaml")) for scene in _read_file(path))


def _read_file(path: Path) -> tuple[Scene, ...]:
    reporter = Reporter()
    source = read_source(path, reporter)
    scenes = read_scenes(source, reporter) if source else ()
    reporter.raise_if_errors()
    return scenes


def element_ids(ruleset: HasElements) -> dict[str, int]:
    """Ids by plain and qualified name."""
    ids = {element.qualified: element.id for element in ruleset.elements}
    return ids | {element.name: element.id for element in ruleset.elements}


def draw_scene(scene: Scene, ruleset: HasElements, *, size: Size | None = None) -> NDArray[np.uint8]:
    """The ids uint8 [H, W] of a scene. Raises CompileError: PD604 unknown elements, PD607 a bad `size`."""
    reporter = Reporter()
    ids = _draw(scene, ruleset, size, reporter)
    reporter.raise_if_errors()
    assert ids is not None
    return ids


def _draw(
    scene: Scene, ruleset: HasElements, size: Size | None, reporter: Reporter
) -> NDArray[np.uint8] | None:
    height, width = size or scene.size
    if not (height >= 1 and width >= 1 and height * width <= MAX_CELLS):
        raise failure("PD607", f"a world of {height}×{width} cells", helps=(SIZE_RULE,))
    ids = element_ids(ruleset)
    paints = [one for one in scene.paints if isinstance(one, Paint)]
    used = [(scene.fill, scene.fill_span), *((one.element, one.element_span) for one in paints)]
    unknown = [(name, span) for name, span in used if name not in ids]
    for name, span in unknown:
        reporter.error(
            "PD604",
            f"unknown element `{name}`",
            span,
            "not an element of this ruleset",
            helps=suggest(name, {element.name for element in ruleset.elements}, "its elements"),
        )
    return None if unknown else paint((height, width), ids[scene.fill], paints, ids)
