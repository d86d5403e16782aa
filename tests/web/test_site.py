"""The site as files, and the server that shows it on loopback."""

from __future__ import annotations

import ast
import base64
import gzip
import hashlib
import http.client
import json
import re
import threading
import zipfile
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from powderdsl.simulation.standalone import standalone_module
from powderdsl.web import site as site_module
from powderdsl.web.bridge import NAME
from powderdsl.web.site import PAGE, OfferedRules, Site, SiteServer
from tests.cli.commands import powderdsl as command


@pytest.fixture(scope="module")
def site() -> Site:
    return Site(OfferedRules("life", ("life",)))


@pytest.fixture
def server(site: Site) -> Iterator[SiteServer]:
    made = SiteServer(site)
    threading.Thread(target=made.serve_forever, daemon=True).start()
    yield made
    made.shutdown()
    made.server_close()


def ask(server: SiteServer, path: str, method: str = "GET", **headers: str) -> tuple[int, bytes, Any]:
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=30)
    connection.request(method, path, headers=headers)
    answer = connection.getresponse()
    found = answer.status, answer.read(), answer.headers
    connection.close()
    return found


def test_files_have_their_types(server: SiteServer) -> None:
    for path, kind in (
        ("/", "text/html; charset=utf-8"),
        ("/app.js", "text/javascript; charset=utf-8"),
        ("/catalog.json", "application/json"),
        ("/rules/life-64x64.wasm", "application/wasm"),
    ):
        status, data, headers = ask(server, path)
        assert (status, headers["Content-Type"], headers["X-Content-Type-Options"]) == (200, kind, "nosniff")
        assert data
    assert data == standalone_module(OfferedRules("life", ("life",)).ruleset, (64, 64))


def test_files_are_sent_compressed_and_once(server: SiteServer) -> None:
    for path in ("/app.js", "/catalog.json", "/rules/life-64x64.wasm"):
        _, plain, headers = ask(server, path)
        assert headers["Content-Encoding"] is None
        _, packed, headers = ask(server, path, **{"Accept-Encoding": "gzip, br"})
        assert (headers["Content-Encoding"], headers["Vary"]) == ("gzip", "Accept-Encoding")
        assert gzip.decompress(packed) == plain
        assert len(packed) < len(plain)
        status, data, again = ask(server, path, **{"If-None-Match": f'W/{headers["ETag"]}, "x"'})
        assert (status, data, again["ETag"]) == (304, b"", headers["ETag"])
        assert ask(server, path, **{"If-None-Match": '"x"'})[0] == 200
    assert ask(server, "/rules/life.png", **{"Accept-Encoding": "gzip"})[2]["Content-Encoding"] is None
    for path in ("/sw.js", "/landing.html"):  # of exported sites
        assert ask(server, path)[0] == 404


def test_only_files_of_the_site_are_served_and_only_to_itself(server: SiteServer) -> None:
    for path in ("/../site.py", "/%2e%2e/site.py", "/..%2fsite.py", "//etc/passwd"):
        assert ask(server, path)[0] == 404
    for path in ("/page/app.js", "/rules/", "/rules/x.json"):
        assert ask(server, path)[0] == 404
    assert ask(server, "/app.js", Host="evil.example")[0] == 403
    assert ask(server, "/app.js", Origin="http://evil.example")[0] == 403
    assert ask(server, "/app.js", Origin=f"http://127.0.0.1:{server.server_port}")[0] == 200
    for method in ("POST", "PUT", "DELETE", "OPTIONS"):
        assert ask(server, "/app.js", method)[0] == 501


def test_the_page_allows_its_own_code_alone(site: Site) -> None:
    text = site.read("index.html").decode()
    (policy,) = re.findall(r'http-equiv="Content-Security-Policy"\s+content="([^"]*)"', text)
    rules = dict(part.strip().split(" ", 1) for part in policy.split(";"))
    assert rules["default-src"] == "'none'"
    assert rules["script-src"] == "'self' 'wasm-unsafe-eval'"
    assert re.findall(r"<script[^>]*>", text) == ['<script type="module" src="app.js">']
    assert rules["connect-src"] == "'self'"
    assert not re.search(r"\s(on\w+|style)\s*=", text)
    inserted = r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\(|new Function"
    for path in PAGE.glob("*.js"):
        assert not re.search(inserted, path.read_text(encoding="utf-8")), path


def test_a_folder_for_any_web_server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(site_module, "SIZES", (64,))
    monkeypatch.setattr(site_module, "shipped_entries", lambda: [OfferedRules("life", ("life",))])
    monkeypatch.setattr(site_module, "code_version", lambda: "of a test")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    folder = tmp_path / "site"
    count = Site(offline=True).write(folder)
    written = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    assert len(written) == count
    assert {"index.html", "app.js", "catalog.json", "python.zip"} <= written
    assert {"rules/life.json", "rules/life-64x64.wasm"} <= written
    listed = json.loads((folder / "catalog.json").read_text())
    assert listed["rules"][0]["key"] == "life"
    assert listed["rules"][0]["sizes"] == [[64, 64]]
    packed = {name for name in written if name.endswith(".gz")}
    assert {"index.html.gz", "app.js.gz", "rules/life-64x64.wasm.gz"} <= packed
    assert gzip.decompress((folder / "app.js.gz").read_bytes()) == (folder / "app.js").read_bytes()
    assert 'href="play.html?rules=life"' in (folder / "index.html").read_text()
    with Image.open(folder / "rules" / "life.png") as picture:
        sheet = json.loads((folder / "rules" / "life.json").read_text())
        world = next(one for one in sheet["worlds"] if one["name"] == sheet["shown"])
        assert picture.size == (64, 64)
        assert picture.tobytes() == base64.b64decode(world["ids"])
        assert picture.convert("RGB").getpixel((0, 0)) == (0x14, 0x21, 0x3D)


def test_the_service_worker_has_the_hashes_of_what_a_visit_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    def worker() -> tuple[str, dict[str, str]]:
        site = Site(OfferedRules("life", ("life",)), offline=True)
        text = (site.read("sw.js") or b"").decode()
        (version,), (files,) = (
            re.findall(r'powderdsl-\$\{"(\w+)"\}', text),
            re.findall(r"FILES = (\{.*\});", text),
        )
        return version, json.loads(files)

    version, files = worker()
    assert {
        "index.html",
        "play.html",
        "app.js",
        "python.zip",
        "rules/life.json",
        "rules/life-64x64.wasm",
    } <= set(files)
    assert not [name for name in files if name == "sw.js" or "licenses" in name or "128x128" in name]
    assert files["app.js"] == hashlib.sha256((PAGE / "app.js").read_bytes()).hexdigest()[:16]
    assert worker() == (version, files)
    monkeypatch.setattr(site_module, "index_page", lambda: b"another")
    assert worker()[0] != version


def test_the_archive_for_pyodide_is_the_compiler() -> None:
    with zipfile.ZipFile(BytesIO(site_module.python_archive())) as archive:
        names = set(archive.namelist())
    assert {"powderdsl/web/bridge.py", "powderdsl/data/rules/sand.yaml"} <= names
    assert {"lark/__init__.py", "yaml/__init__.py"} <= names
    absent = ("powderdsl/rl", "powderdsl/cli", "powderdsl/tasks", "click")
    assert not [name for name in names if name.endswith((".so", ".pyc", ".hpp")) or name.startswith(absent)]
    assert site_module.python_archive() == site_module.python_archive.__wrapped__()


def test_the_archive_has_what_the_bridge_imports() -> None:
    root = PAGE.parents[1]

    def imported(path: Path) -> set[Path]:
        """The files of modules that one imports anywhere, but for those that only `Workspace.check` and schemas need."""
        names = set()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module:
                names |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
        places = [root.parent.joinpath(*name.split(".")) for name in names if name.startswith("powderdsl")]
        files = {place.with_suffix(".py") for place in places} | {place / "__init__.py" for place in places}
        unused = ("tasks", "experiments") if path.parent.name == "editing" else ()
        return {file for file in files if file.is_file() and file.relative_to(root).parts[0] not in unused}

    waiting, needed = [PAGE.parent / "bridge.py"], set[Path]()
    while waiting:
        path = waiting.pop()
        if path not in needed and "cuda" not in path.parts:
            needed.add(path)
            waiting += imported(path)
    with zipfile.ZipFile(BytesIO(site_module.python_archive())) as archive:
        names = set(archive.namelist())
    assert len(needed) > 100
    assert {path.relative_to(root.parent).as_posix() for path in needed} <= names


def test_the_licenses_of_all_parts_are_there(site: Site) -> None:
    text = (site.read("licenses.txt") or b"").decode()
    for owner in ("The powderdsl authors", "Erez Shinan", "Kirill Simonov"):
        assert owner in text
    assert text.count("\n" + "-" * 80 + "\n") == 2 + len(list(site_module.PARTS.glob("licenses/*.txt")))
    if site_module.PARTS.is_dir():
        listed = (site_module.PARTS / "licenses" / "README.txt").read_text().splitlines()
        for name in (line.split()[0].removeprefix("@").replace("/", "-") for line in listed):
            assert (site_module.PARTS / "licenses" / f"{name}.txt").stat().st_size > 500, name


def test_without_its_parts_the_command_says_what_to_do(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(site_module, "PARTS", tmp_path / "none")
    done = command("play", "--no-open", exits=2)
    assert "make web" in done.stderr
    assert "Traceback" not in done.stderr


def test_universes_are_files_that_the_page_can_edit() -> None:
    files = OfferedRules("core-universe-7", ("universe:7",)).files()
    assert list(files) == ["core.yaml", "universe_7.yaml"]
    assert all(NAME.fullmatch(name) for name in files)
