"""The playground as files: the page, rules as WebAssembly modules, start worlds, and the compiler for Pyodide."""

from __future__ import annotations

import base64
import hashlib
import io
import json
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache, cached_property
from importlib import metadata
from pathlib import Path
from typing import Any

from powderdsl.compiler import load, read, shipped, shipped_tests, split_names
from powderdsl.diagnostics import Reporter
from powderdsl.model.fingerprint import fingerprint
from powderdsl.model.state import fits
from powderdsl.model.types import Ruleset
from powderdsl.simulation.standalone import standalone_module
from powderdsl.system.memo import Memo
from powderdsl.system.user_cache import cache_folder
from powderdsl.system.writing import replacing
from powderdsl.web.offered_worlds import offered_worlds
from powderdsl.worlds.raster import Size
from powderdsl.worlds.strewn import frame_element

HERE = Path(__file__).parent
PAGE = HERE / "page"
PARTS = HERE / "parts"
"""What `make web` fetches from npm: Pyodide and CodeMirror, with their licenses. Git ignores the folder."""

MODULES = HERE / "modules"
"""Modules of all shipped rules: `make wheel` compiles them, so that the first world of an installed page needs no wait."""

SIZES = (64, 128, 256, 512)
LIBRARIES = ("click", "lark", "pyyaml")
"""Python packages that the compiler needs in Pyodide."""


@dataclass(frozen=True)
class Entry:
    """Rules that the page offers. `names` is what `load` takes."""

    key: str
    names: tuple[str, ...]
    params: Mapping[str, Any] = field(default_factory=dict)

    @cached_property
    def ruleset(self) -> Ruleset:
        return load(*self.names, params=self.params)

    def files(self) -> dict[str, str]:
        """The rule files by name, rulesets first; packs are found beside the ruleset that lists them."""
        words = [word for name in self.names for word in split_names(name)[0]]
        packs, ruleset = read(words, Reporter())
        sources = [pack.source for pack in packs]
        if ruleset is not None:
            sources = [one.source for whole in (ruleset, *ruleset.beside) for one in whole.lineage] + sources
        return {Path(source.name).name: source.text for source in sources}

    def left_out(self) -> list[str]:
        """Packs that a `-` in the names leaves out."""
        return [word for name in self.names for word in split_names(name)[1]]


def entries() -> list[Entry]:
    """The shipped rules that stand by themselves, then the example packs on top of a ruleset."""
    found = [Entry(name, (name,)) for name in shipped_tests()]
    found.sort(key=lambda one: -len(one.ruleset.elements))
    largest = found[0]
    examples = [
        Entry(path.stem, (*largest.names, str(path))) for path in sorted(examples_folder().glob("*.yaml"))
    ]
    return found + examples


def examples_folder() -> Path:
    """The example packs: inside the installed package, or in the repository."""
    inside = shipped("examples")
    return inside if HERE.parent / "data" in inside.parents else HERE.parents[1] / "docs" / "examples"


class Site:
    """All files of the page, made when they are asked for.

    `first`: rules that the page opens with, and `world`, their start world, if the user named one.
    """

    def __init__(self, first: Entry | None = None, world: dict[str, Any] | None = None):
        self.first, self.world = first, world

    @cached_property
    def entries(self) -> dict[str, Entry]:
        known = entries()
        if self.first is not None:
            known = [self.first] + [one for one in known if one.key != self.first.key]
        return {one.key: one for one in known}

    @cached_property
    def files(self) -> dict[str, Callable[[], bytes]]:
        """What makes each file, by its path in the site."""
        found: dict[str, Callable[[], bytes]] = {}
        for folder, below in ((PAGE, ""), (PARTS, "parts/")):
            for path in sorted(folder.rglob("*")):
                if path.is_file():
                    found[below + path.relative_to(folder).as_posix()] = path.read_bytes
        found["index.html"] = index_page
        found["catalog.json"] = self._catalog
        found["python.zip"] = python_archive
        for key, entry in self.entries.items():
            found[f"rules/{key}.json"] = _json(self._rules, entry)
            for size in self.sizes(entry):
                found[f"rules/{key}-{size[0]}x{size[1]}.wasm"] = _code(entry, size)
        return found

    def sizes(self, entry: Entry) -> list[Size]:
        """The sizes of worlds for which the site has a module, the user's world first."""
        sizes: list[Size] = [(side, side) for side in SIZES]
        if entry is self.first and self.world is not None:
            sizes.insert(0, (self.world["rows"], self.world["columns"]))
        return [size for size in dict.fromkeys(sizes) if fits(entry.ruleset, size)]

    def start(self) -> str:
        """The module that the page loads first."""
        entry = next(iter(self.entries.values()))
        rows, columns = self.sizes(entry)[0]
        return f"rules/{entry.key}-{rows}x{columns}.wasm"

    def read(self, path: str) -> bytes | None:
        """A file, or None if the site has no such file."""
        make = self.files.get(path or "index.html")
        return None if make is None else make()

    def write(self, folder: Path) -> int:
        """Write all files, and return how many there are. Raises CompileError (PD613) where that fails."""
        for name, make in self.files.items():
            target = folder / name
            target.parent.mkdir(parents=True, exist_ok=True)
            with replacing(target) as temporary:
                temporary.write_bytes(make())
        return len(self.files)

    def _catalog(self) -> bytes:
        listed = [
            {"key": key, "about": _about(entry), "sizes": self.sizes(entry)}
            for key, entry in self.entries.items()
        ]
        return _dump({"format": 1, "rules": listed})

    def _rules(self, entry: Entry) -> dict[str, Any]:
        ruleset = entry.ruleset
        ground = ruleset.elements[0].id
        worlds, shown = offered_worlds(ruleset, entry.names)
        if entry is self.first and self.world is not None:
            worlds, shown = [self.world, *worlds], self.world["name"]
        return {
            "key": entry.key,
            "title": ruleset.name,
            "about": _about(entry),
            "files": entry.files(),
            "off": entry.left_out(),
            "frame": frame_element(ruleset, ground),
            "worlds": worlds,
            "shown": shown,
        }


def index_page() -> bytes:
    """The page itself, whose content security policy allows its own import map by hash."""
    text = (PAGE / "index.html").read_text(encoding="utf-8")
    inline = text.partition('<script type="importmap">')[2].partition("</script>")[0]
    digest = base64.b64encode(hashlib.sha256(inline.encode()).digest()).decode()
    return text.replace("IMPORTMAP", digest).encode()


def _about(entry: Entry) -> str:
    """The sentence of the last file that is named: a ruleset, or a pack on top of one."""
    words = [word for name in entry.names for word in split_names(name)[0]]
    packs, ruleset = read(words[-1:], Reporter())
    return packs[-1].about if ruleset is None else ruleset.about


def _dump(value: Any) -> bytes:
    return json.dumps(value, ensure_ascii=False, separators=(",", ":")).encode()


def _json(make: Callable[[Entry], Any], entry: Entry) -> Callable[[], bytes]:
    return lambda: _dump(make(entry))


def _code(entry: Entry, size: Size) -> Callable[[], bytes]:
    return lambda: cached_module(entry.ruleset, size)


def cached_module(ruleset: Ruleset, size: Size) -> bytes:
    """The module of a world: that of the installation or of the user's cache, if the same code has made it."""
    name = _file_name(ruleset, size)
    if (made := MODULES / name).is_file():
        return made.read_bytes()
    try:
        path = cache_folder("play") / name
        if path.is_file():
            return path.read_bytes()
    except OSError:
        return standalone_module(ruleset, size)
    code = standalone_module(ruleset, size)
    with replacing(path) as temporary:
        temporary.write_bytes(code)
    return code


def write_modules() -> None:
    """Compile all shipped rules into the folder MODULES, and remove what other code has made."""
    for path in MODULES.glob("*.wasm"):
        path.unlink()
    MODULES.mkdir(exist_ok=True)
    memo = Memo()
    for entry in entries():
        for size in ((side, side) for side in SIZES):
            if fits(entry.ruleset, size):
                (MODULES / _file_name(entry.ruleset, size)).write_bytes(
                    standalone_module(entry.ruleset, size, memo)
                )


def _file_name(ruleset: Ruleset, size: Size) -> str:
    """A name that only the same code gives to the same rules."""
    key = f"{code_version()} {fingerprint(ruleset)} {ruleset.name} {size}"
    return f"{hashlib.sha256(key.encode()).hexdigest()[:32]}.wasm"


@cache
def code_version() -> str:
    """A number that changes with any module of powderdsl."""
    found = hashlib.sha256()
    for path in sorted(HERE.parent.rglob("*.py")):
        found.update(path.read_bytes())
    return found.hexdigest()[:16]


ABSENT = (
    "envs",
    "datasets",
    "rl",
    "worldmodel",
    "experiments",
    "targets/cuda",
    "web/page",
    "web/parts",
    "web/modules",
)
"""Parts of powderdsl that need torch, and the page itself: Pyodide does without them."""


@cache
def python_archive() -> bytes:
    """A zip of powderdsl and the packages that it needs, to be unpacked in Pyodide."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in sorted(HERE.parent.rglob("*")):
            name = path.relative_to(HERE.parent).as_posix()
            if path.is_file() and "__pycache__" not in path.parts and not name.startswith(ABSENT):
                _add(archive, f"powderdsl/{name}", path.read_bytes())
        for folder in ("rules", "tasks"):
            for path in sorted(shipped(folder).rglob("*.yaml")):
                name = f"powderdsl/data/{folder}/{path.relative_to(shipped(folder)).as_posix()}"
                if name not in archive.namelist():
                    _add(archive, name, path.read_bytes())
        for library in LIBRARIES:
            for file in metadata.files(library) or ():
                if not (".." in file.parts or "__pycache__" in file.parts or file.suffix in (".so", ".pyd")):
                    _add(archive, str(file), Path(str(file.locate())).read_bytes())
    return out.getvalue()


def _add(archive: zipfile.ZipFile, name: str, data: bytes) -> None:
    """A file with a fixed date: the same files make the same archive."""
    entry = zipfile.ZipInfo(name, (2000, 1, 1, 0, 0, 0))
    entry.compress_type = zipfile.ZIP_DEFLATED
    archive.writestr(entry, data)
