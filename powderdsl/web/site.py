"""The playground as files: the page, rules as WebAssembly modules, start worlds, and the compiler for Pyodide.

The server listens on loopback and answers only GET requests for files of the site, from pages of this server.
"""

from __future__ import annotations

import base64
import gzip
import hashlib
import html
import io
import json
import re
import shutil
import zipfile
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache, cached_property, partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import metadata
from pathlib import Path
from random import Random
from typing import Any
from urllib.parse import unquote, urlsplit

from powderdsl.analysis.changes import unchanging_ids
from powderdsl.arrays import np
from powderdsl.compiler import load, read, shipped_tests, shipped_variants, split_names
from powderdsl.diagnostics import CompileError, Reporter
from powderdsl.editing.json_schema import MADE as MADE_SCHEMA
from powderdsl.editing.json_schema import schema
from powderdsl.model.state import fits
from powderdsl.model.types import Ruleset
from powderdsl.simulation.standalone import standalone_module
from powderdsl.syntax.sources import shipped
from powderdsl.system.cache import Memo, code_hash, persistent
from powderdsl.system.writing import replacing
from powderdsl.tasks.shipped import load_task, shipped_tasks
from powderdsl.universes import MAX_SEED, is_universe
from powderdsl.web.playable import start_world, task_data
from powderdsl.worlds.raster import Size, mask
from powderdsl.worlds.scene import draw_start, shipped_scenes
from powderdsl.worlds.store import world_data
from powderdsl.worlds.strewn import frame_element, random_shape, strew

HERE = Path(__file__).parent
PAGE = HERE / "page"
PARTS = HERE / "parts"
"""Pyodide and CodeMirror, with their licenses, which `make web` fetches from npm. Git ignores the folder."""

MADE = HERE / "made"
"""Files about shipped rules, which `make wheel` compiles, so that the page of an installed wheel opens without delay."""

ADDRESS = "127.0.0.1"
TYPES = {
    "css": "text/css; charset=utf-8",
    "html": "text/html; charset=utf-8",
    "js": "text/javascript; charset=utf-8",
    "json": "application/json",
    "mjs": "text/javascript; charset=utf-8",
    "png": "image/png",
    "svg": "image/svg+xml",
    "wasm": "application/wasm",
    "zip": "application/zip",
}

SIZES = (64, 128, 256, 512)
PACKED = frozenset({"css", "html", "js", "json", "mjs", "svg", "txt", "wasm"})
"""Kinds of files that are sent compressed."""

LIBRARIES = ("lark", "pyyaml")
"""Python packages that the compiler needs in Pyodide."""


@dataclass(frozen=True)
class OfferedRules:
    """Rules that the page offers. `names` are the arguments of `load`; `world` is the user's start world, offered first."""

    key: str
    names: tuple[str, ...]
    params: Mapping[str, Any] = field(default_factory=dict)
    world: dict[str, Any] | None = None

    @cached_property
    def ruleset(self) -> Ruleset:
        return load(*self.names, params=self.params)

    @property
    def words(self) -> list[str]:
        """The rulesets and packs in the names."""
        return [word for name in self.names for word in split_names(name)[0]]

    @property
    def off(self) -> list[str]:
        """Packs that a `-` in the names leaves out."""
        return [word for name in self.names for word in split_names(name)[1]]

    @property
    def about(self) -> str:
        """The sentence of the last named file: a ruleset, or a pack added to one."""
        packs, ruleset = read(self.words[-1:], Reporter())
        return packs[-1].about if ruleset is None else ruleset.about

    def files(self) -> dict[str, str]:
        """The rule files by name, rulesets first."""
        packs, ruleset = read(self.words, Reporter())
        sources = [pack.source for pack in packs]
        if ruleset is not None:
            rulesets = [base for top in (ruleset, *ruleset.beside) for base in top.lineage]
            sources = [*(base.source for base in rulesets), *sources]
        names = [Path(source.name).name for source in sources]
        names = [f"{name.replace(':', '_')}.yaml" if is_universe(name) else name for name in names]
        return {name: source.text for name, source in zip(names, sources, strict=True)}

    @property
    def is_shipped(self) -> bool:
        """True if these are the unmodified shipped rules of that name."""
        return self.names == (self.key,) and not self.params and self.world is None


def shipped_entries() -> list[OfferedRules]:
    """The shipped rules that load alone, except variants, followed by each example pack added to the first rules.

    Rules that most tasks use come first, then rules with the most elements.
    """
    tasks = "\n".join(path.read_text(encoding="utf-8") for path in sorted(shipped("tasks").glob("*.yaml")))
    used = Counter(re.findall(r"^rules: *(\S+)", tasks, re.MULTILINE))
    variants = shipped_variants()
    entries = [OfferedRules(name, (name,)) for name in shipped_tests() if name not in variants]
    entries.sort(key=lambda entry: (-used[entry.key], -len(entry.ruleset.elements)))
    examples = sorted(examples_folder().glob("*.yaml"))
    return entries + [_example(path.stem, entries[0].key) for path in examples]


def _example(stem: str, rules: str) -> OfferedRules:
    return OfferedRules(stem, (rules, str(examples_folder() / f"{stem}.yaml")))


def examples_folder() -> Path:
    """The example packs: inside the installed package, or in the repository."""
    inside = shipped("examples")
    return inside if HERE.parent / "data" in inside.parents else HERE.parents[1] / "docs" / "examples"


Make = Callable[[], bytes]


def shipped_files() -> dict[str, Make]:
    """The makers of files about shipped rules: the catalog, start worlds of tasks, sheets and modules."""
    rows = _shipped_rows()
    makers: dict[str, Make] = {"tasks.json": partial(cached, "tasks.json", lambda: _dump(task_worlds()))}
    for name in json.loads((PAGE / "scores.json").read_text(encoding="utf-8")):
        path = f"tasks/{name}.json"
        makers[path] = partial(cached, path, partial(lambda name: _dump(task_data(name)), name))
    memo = Memo()
    for row in rows:
        key = row["key"]
        entry = _example(key, rows[0]["key"]) if row["example"] else OfferedRules(key, (key,))
        for path, make in _files_of(entry, [tuple(size) for size in row["sizes"]], memo).items():
            makers[path] = partial(cached, path, make)
    return makers


def _shipped_rows() -> list[dict[str, Any]]:
    return json.loads(cached("shipped.json", lambda: _dump([_row(entry) for entry in shipped_entries()])))


def _row(entry: OfferedRules) -> dict[str, Any]:
    """A row of the catalog: `sizes` are the sizes of modules, first that of the user's world."""
    own = [] if entry.world is None else [(entry.world["rows"], entry.world["columns"])]
    sizes = dict.fromkeys([*own, *((side, side) for side in SIZES)])
    return {
        "key": entry.key,
        "about": entry.about,
        "sizes": [size for size in sizes if fits(entry.ruleset, size)],
        "example": len(entry.names) > 1,
    }


def _files_of(entry: OfferedRules, sizes: list[Size], memo: Memo) -> dict[str, Make]:
    """The files about some rules: a sheet, a picture, and a module for each size."""
    makers: dict[str, Make] = {f"rules/{entry.key}.json": lambda: _dump(_sheet(entry))}
    makers[f"rules/{entry.key}.png"] = lambda: _picture(_sheet(entry), entry.ruleset)
    for size in sizes:
        module = partial(lambda size: standalone_module(entry.ruleset, size, memo), size)
        makers[f"rules/{entry.key}-{size[0]}x{size[1]}.wasm"] = module
    return makers


def _sheet(entry: OfferedRules) -> dict[str, Any]:
    ruleset = entry.ruleset
    worlds, shown = offered_worlds(ruleset, entry.names)
    if entry.world is not None:
        worlds, shown = [entry.world, *worlds], entry.world["name"]
    return {
        "key": entry.key,
        "title": ruleset.name,
        "about": entry.about,
        "files": entry.files(),
        "off": entry.off,
        "frame": frame_element(ruleset, ruleset.elements[0].id),
        "worlds": worlds,
        "shown": shown,
    }


def _picture(sheet: Mapping[str, Any], ruleset: Ruleset) -> bytes:
    """A PNG of the world that shows the rules best."""
    from PIL import Image

    world = next(world for world in sheet["worlds"] if world["name"] == sheet["shown"])
    rows, columns, ids = world["rows"], world["columns"], base64.b64decode(world["ids"])
    colors = {element.id: element.color for element in ruleset.elements}
    image = Image.frombytes("P", (columns, rows), ids)
    image.putpalette(bytes.fromhex("".join(colors.get(id, "#000000")[1:] for id in range(256))))
    image.save(file := io.BytesIO(), "PNG", optimize=True)
    return file.getvalue()


class Site:
    """All files of the page, created on request. `first`: the rules that the page opens with.

    `offline`: for another host, where a service worker stores the files.
    """

    def __init__(self, first: OfferedRules | None = None, *, offline: bool = False):
        self.first, self.offline = first, offline

    @cached_property
    def rows(self) -> list[dict[str, Any]]:
        """The rows of the catalog; the page opens the first one."""
        rows = _shipped_rows()
        if self.first is None:
            return rows
        same = [row for row in rows if row["key"] == self.first.key]
        own = same[0] if same and self.first.is_shipped else _row(self.first)
        return [own, *(row for row in rows if row not in same)]

    @cached_property
    def files(self) -> dict[str, Make]:
        """The makers of files, by path in the site."""
        makers: dict[str, Make] = {}
        for folder, prefix in ((PAGE, ""), (PARTS, "parts/")):
            for path in sorted(folder.rglob("*")):
                if path.is_file():
                    makers[prefix + path.relative_to(folder).as_posix()] = path.read_bytes
        makers["index.html"], makers["python.zip"] = index_page, python_archive
        makers["licenses.txt"] = licenses
        makers["language.txt"] = (examples_folder().parent / "short.md").read_bytes
        worker, landing = makers.pop("sw.js"), makers.pop("landing.html")
        makers |= shipped_files()
        if self.first is not None and not (self.first.is_shipped and self.start in makers):
            own = _files_of(self.first, self.rows[0]["sizes"], Memo())
            makers |= {path: cache(make) for path, make in own.items()}
        catalog = {"format": 1, "rules": self.rows, "offline": self.offline}
        makers["catalog.json"] = lambda: _dump(catalog)
        if self.offline:
            makers["play.html"], makers["index.html"] = index_page, lambda: self._landing(landing().decode())
            makers["sw.js"] = lambda: self._worker(worker().decode())
        return makers

    def _landing(self, text: str) -> bytes:
        """The first page of an exported site, with a card for each of the rules."""
        cards = [
            f'<a class="card" href="play.html?rules={row["key"]}"><img src="rules/{row["key"]}.png" alt="" loading="lazy">'
            f"<strong>{row['key']}</strong><small>{html.escape(row['about'])}</small></a>"
            for row in self.rows
        ]
        return text.replace("<!-- cards -->", "\n".join(cards)).encode()

    def _worker(self, text: str) -> bytes:
        """The service worker. It stores the files of a visit, and those about other rules once they are opened."""
        first = {self.start, f"rules/{self.rows[0]['key']}.json"}
        lazy = re.compile(r"rules/|tasks/|parts/licenses/|licenses\.txt|sw\.js")
        kept = [name for name in self.files if name in first or not lazy.match(name)]
        hashes = {name: hashlib.sha256(self.files[name]()).hexdigest()[:16] for name in kept}
        version = hashlib.sha256(_dump([text, hashes, code_version()])).hexdigest()[:16]
        return text.replace('"VERSION"', f'"{version}"').replace('"FILES"', _dump(hashes).decode()).encode()

    @property
    def start(self) -> str:
        """The module that the page loads first."""
        (rows, columns), key = self.rows[0]["sizes"][0], self.rows[0]["key"]
        return f"rules/{key}-{rows}x{columns}.wasm"

    def read(self, path: str) -> bytes | None:
        """A file, or None if the site has no such file."""
        make = self.files.get(path or "index.html")
        return None if make is None else make()

    def write(self, folder: Path) -> int:
        """Write all files, with compressed ones next to them, and return their number. Raises CompileError (PD613) on
        failure."""
        count = 0
        for name, make in self.files.items():
            data = make()
            packed = pack(name, data)
            for path, content in [(name, data)] + [(f"{name}.gz", packed)] * (packed is not data):
                _write(folder / path, content)
                count += 1
        return count


class SiteServer(ThreadingHTTPServer):
    """Serves one site, with a thread for each request, since some files take long to create."""

    daemon_threads = True

    def __init__(self, site: Site, port: int = 0):
        super().__init__((ADDRESS, port), _Handler)
        self.site = site

    @property
    def address(self) -> str:
        return f"http://{ADDRESS}:{self.server_port}/"


class _Handler(BaseHTTPRequestHandler):
    server: SiteServer
    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        own = {f"{name}:{self.server.server_port}" for name in (ADDRESS, "localhost")}
        origin = self.headers.get("Origin")
        # A page of another site can neither name this server (Host) nor read it from its own origin (Origin).
        is_ours = not origin or origin in {f"http://{host}" for host in own}
        if self.headers.get("Host") not in own or not is_ours:
            self._answer(HTTPStatus.FORBIDDEN, b"this server answers its own page only", "txt")
            return
        path = unquote(urlsplit(self.path).path).lstrip("/") or "index.html"
        try:
            data = self.server.site.read(path)
        except CompileError as error:
            self._answer(HTTPStatus.INTERNAL_SERVER_ERROR, str(error).encode(), "txt")
            return
        if data is None:
            self._answer(HTTPStatus.NOT_FOUND, b"no such file", "txt")
            return
        tag = f'"{hashlib.sha256(data).hexdigest()[:24]}"'
        headers = {"ETag": tag, "Vary": "Accept-Encoding"}
        if tag in self.headers.get("If-None-Match", ""):
            self._answer(HTTPStatus.NOT_MODIFIED, b"", "txt", headers)
            return
        if "gzip" in self.headers.get("Accept-Encoding", ""):
            packed = persistent(f"gzip {path}", tag, partial(pack, path, data))
            headers |= {"Content-Encoding": "gzip"} if packed != data else {}
            data = packed
        self._answer(HTTPStatus.OK, data, path.rpartition(".")[2], headers)

    def _answer(
        self, status: HTTPStatus, data: bytes, suffix: str, headers: Mapping[str, str] | None = None
    ) -> None:
        self.send_response(status)
        self.send_header("Content-Type", TYPES.get(suffix, "text/plain; charset=utf-8"))
        if status != HTTPStatus.NOT_MODIFIED:
            self.send_header("Content-Length", str(len(data)))
        for name, value in (headers or {}).items():
            self.send_header(name, value)
        self.send_header("Cache-Control", "no-cache")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.end_headers()
        try:
            self.wfile.write(data)
        except (BrokenPipeError, ConnectionResetError):
            self.close_connection = True

    def log_message(self, *_: object) -> None:
        pass


def _write(path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary:
        temporary.write_bytes(data)


def pack(name: str, data: bytes) -> bytes:
    """A file compressed by gzip, or unmodified if that saves nothing."""
    packed = gzip.compress(data, mtime=0) if name.rpartition(".")[2] in PACKED else data
    return packed if len(packed) < len(data) else data


def index_page() -> bytes:
    """The page itself."""
    return (PAGE / "index.html").read_bytes().replace(b"UNIVERSES", str(MAX_SEED).encode())


def _dump(value: Any) -> bytes:
    return json.dumps(value, ensure_ascii=False, separators=(",", ":")).encode()


def cached(name: str, make: Make) -> bytes:
    """A file about shipped rules: from the installation, or created once for a version of the code."""
    version, path = MADE / "version.txt", MADE / name
    if version.is_file() and version.read_text(encoding="utf-8") == code_version() and path.is_file():
        return path.read_bytes()
    return persistent(name, code_version(), make)


def write_made() -> None:
    """Make all files about shipped rules, in the folder MADE."""
    shutil.rmtree(MADE, ignore_errors=True)
    for name, make in (shipped_files() | {"shipped.json": lambda: _dump(_shipped_rows())}).items():
        _write(MADE / name, make())
    _write(MADE / "version.txt", code_version().encode())


@cache
def code_version() -> str:
    """A hash of the code of powderdsl, and of its rules, tasks and examples."""
    digest = hashlib.sha256(code_hash().encode())
    folders = shipped("rules"), shipped("tasks"), examples_folder()
    texts = [path for folder in folders for path in sorted(folder.rglob("*.yaml"))]
    for path in sorted(texts):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def licenses() -> bytes:
    """The licenses of powderdsl, of the packages that it needs in Pyodide, and of the parts from npm."""
    sections = []
    for library in ("powderdsl", *LIBRARIES):
        about = metadata.distribution(library)
        files = [file for file in about.files or () if "licenses" in file.parts]
        texts = [Path(str(file.locate())).read_text(encoding="utf-8") for file in files]
        sections.append("\n\n".join([f"{about.name} {about.version}", *texts]))
    for path in sorted((PARTS / "licenses").glob("*.txt")):
        sections.append(f"{path.stem}\n\n{path.read_text(encoding='utf-8')}")
    return f"\n\n{'-' * 80}\n\n".join(sections).encode()


ABSENT = (
    "cli",
    "data/tasks",
    "datasets",
    "envs",
    "experiments",
    "ogbench",
    "rl",
    "targets/cuda",
    "tasks",
    "testing/mutation",
    "web/made",
    "web/page",
    "web/parts",
    "web/playable.py",
    "web/site.py",
    "worldmodel",
)
"""Parts of powderdsl that `web/bridge.py` does not import: the command line, modules that require torch, and the page
itself."""


@cache
def python_archive() -> bytes:
    """A zip of powderdsl and the packages that it needs, for Pyodide."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in sorted(HERE.parent.rglob("*")):
            name = path.relative_to(HERE.parent).as_posix()
            native = path.suffix in (".h", ".hpp", ".cu") or "__pycache__" in path.parts
            if path.is_file() and not native and not name.startswith(ABSENT):
                _add(archive, f"powderdsl/{name}", path.read_bytes())
        for path in sorted(shipped("rules").rglob("*.yaml")):
            name = f"powderdsl/data/rules/{path.relative_to(shipped('rules')).as_posix()}"
            if name not in archive.namelist():
                _add(archive, name, path.read_bytes())
        _add(archive, f"powderdsl/data/{MADE_SCHEMA.name}", json.dumps(schema()).encode())
        for library in LIBRARIES:
            for file in metadata.files(library) or ():
                if not (".." in file.parts or "__pycache__" in file.parts or file.suffix in (".so", ".pyd")):
                    _add(archive, str(file), Path(str(file.locate())).read_bytes())
    return out.getvalue()


def _add(archive: zipfile.ZipFile, name: str, data: bytes) -> None:
    """Add a file with a fixed date, so that equal files make equal archives."""
    entry = zipfile.ZipInfo(name, (2000, 1, 1, 0, 0, 0))
    entry.compress_type = zipfile.ZIP_DEFLATED
    archive.writestr(entry, data)


# The start worlds that the page offers with rules

SIDE = 64
"""Rows and columns of worlds without a given size."""

OWN_SHAPES = 12
"""Shapes of an added pack's own elements."""


def offered_worlds(ruleset: Ruleset, names: Sequence[str]) -> tuple[list[dict[str, Any]], str]:
    """The worlds that the page offers with some rules, and the name of the world that shows them best.

    A world has `name`, `about` and the keys of `world_data`. `names` are the arguments of `load`: an added pack gets
    a world with its elements.
    """
    worlds = []
    for scene in shipped_scenes():
        with suppress(CompileError):  # the rules lack its elements
            start = draw_start(scene, ruleset)
            fields = {name: field.values for name, field in start.fields.items()}
            worlds.append(_named(scene.name, scene.about or "", ruleset, start.ids, fields))
    shown = worlds[-1]["name"] if worlds else "shapes"
    shapes = strew(ruleset, (SIDE, SIDE), 1, 0)[0]
    worlds.append(_named("shapes", "Random shapes of all elements.", ruleset, shapes))
    if not unchanging_ids(ruleset):
        noise = Random(0).choices([element.id for element in ruleset.elements], k=SIDE * SIDE)
        ids = np.array(noise, np.uint8).reshape(SIDE, SIDE)
        worlds.append(_named("noise", "Every cell at random.", ruleset, ids))
    if len(names) > 1:
        worlds.append(_pack_world(ruleset))
        shown = worlds[-1]["name"]
    return worlds, shown


def _named(name: str, about: str, ruleset: Ruleset, ids: Any, fields: Any = None) -> dict[str, Any]:
    return {"name": name, "about": about} | world_data(ruleset, ids, fields or {}, (0, 0, 0))


def task_worlds() -> dict[str, list[dict[str, Any]]]:
    """The first world of each shipped task's first split, by the rules of the tasks."""
    worlds: dict[str, list[dict[str, Any]]] = {}
    for name in shipped_tasks():
        task = load_task(name)
        _, world = start_world(task, task.splits[0].name, 0)
        named = {"name": f"task {name}", "about": task.about} | world
        worlds.setdefault("+".join(task.rules), []).append(named)
    return worlds


def _pack_world(ruleset: Ruleset) -> dict[str, Any]:
    """Shapes of all elements, and more shapes of the pack that was added last."""
    pack = ruleset.packs[-1]
    own = [element.id for element in ruleset.elements if element.pack == pack]
    ids = strew(ruleset, (SIDE, SIDE), 1, 1)[0].copy()  # without NumPy, views cannot be written to
    edge = ids.copy()
    random = Random(2)
    for number in range(OWN_SHAPES if own else 0):
        ids[mask(random_shape(random, (SIDE, SIDE), SIDE // 10), (SIDE, SIDE))] = own[number % len(own)]
    ids[[0, -1]], ids[:, [0, -1]] = edge[[0, -1]], edge[:, [0, -1]]
    return _named(pack, f"Random shapes, and more of {pack}.", ruleset, ids)
