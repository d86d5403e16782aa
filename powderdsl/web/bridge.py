"""The functions of a session that the page calls in Pyodide: JSON in, JSON or bytes out."""

from __future__ import annotations

import base64
import io
import json
import re
import tempfile
import zipfile
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

from powderdsl.arrays import np
from powderdsl.compiler import load, load_with_diagnostics, read
from powderdsl.diagnostics import CompileError, Reporter, Source
from powderdsl.diagnostics.diagnostic import diagnostic_data, render_text
from powderdsl.editing.layout import formatted
from powderdsl.editing.workspace import Rules, completions, explanation
from powderdsl.model.definitions import set_params
from powderdsl.model.state import qualified_slots
from powderdsl.model.types import ELEMENT, Ruleset
from powderdsl.simulation.standalone import standalone_module
from powderdsl.syntax.sources import shipped
from powderdsl.system.cache import Memo
from powderdsl.universes import PREFIX
from powderdsl.worlds.strewn import frame_element

MAX_FILES = 64
MAX_TEXT = 1 << 20
"""Maximum number of characters of all files together."""

NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_-]{0,60}\.ya?ml")
PACK = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,60}")

PROOF = 10.0
"""Seconds of counted work for proofs: a third of the time that the page waits."""


class BadRequest(ValueError):
    """Raised if the page, or a link to it, requests something that the session cannot do."""


@dataclass(frozen=True)
class Selection:
    """Rule files by name; `words`, the names passed to `load`; and `off`, the packs to leave out."""

    files: Mapping[str, str]
    words: list[str]
    off: list[str]


class Session:
    """Rule files in their own folder, and the last rules without mistakes."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.memo = Memo(versions=2, things=250)
        """Enough for one ruleset of 60 passes: a page has little memory."""
        self.ruleset: Ruleset | None = None
        self.good = Selection({}, [], [])
        """The files of these rules."""
        self.known = Rules()
        """Words for completions and explanations."""
        self._sim: Any = None

    def check(self, files: Mapping[str, str], off: list[str]) -> dict[str, Any]:
        """Load the files without the packs in `off`. If they have mistakes, the previous rules stay.

        Diagnostics have the text that `check` prints. `texts` are loaded shipped packs that are not among the files.
        """
        selection = self._write(files, off)
        names = [str(self.folder / word) for word in selection.words]
        names[-1] = "-".join([names[-1], *selection.off])
        packs: dict[str, str] = {}
        answer: dict[str, Any] = {"ok": True}
        try:
            self.known.read(names)
            packs = {Path(pack.source.name).name: pack.source.text for pack in self.known.packs}
            self.ruleset, remarks = load_with_diagnostics(*names)
            self.good, self.known.model = selection, self.ruleset
        except CompileError as error:
            answer["ok"], remarks = False, error.diagnostics
        data = [diagnostic_data(remark, utf16=True) | {"text": render_text(remark)} for remark in remarks]
        texts = {name: text for name, text in packs.items() if name not in files and NAME.fullmatch(name)}
        words = {name: meanings[0].kind for name, meanings in self.known.words.items()}
        return answer | {"diagnostics": data, "packs": list(packs), "texts": texts, "words": words}

    def complete(self, text: str, offset: int) -> list[dict[str, str]]:
        """The words that are allowed at a place of a file, as the language server offers them."""
        beside = [pack.name.text for pack in self.known.packs]
        words = completions(text, offset, self.known, beside)
        return [{"label": word.name, "kind": word.kind, "about": word.about} for word in words]

    def explain(self, text: str, offset: int) -> str:
        """The meaning of the word at a place of a file, as Markdown."""
        meaning = explanation(Source("", text), offset, self.known)
        return meaning[0] if meaning else ""

    def format(self, text: str) -> str:
        """A file in the standard layout; unchanged if it cannot be read."""
        return formatted(Source("", text), Reporter()) or text

    def _write(self, files: Mapping[str, str], off: list[str]) -> Selection:
        """Write the files, and select the names for `load`: rulesets, and packs that no ruleset lists."""
        if not 0 < len(files) <= MAX_FILES or sum(map(len, files.values())) > MAX_TEXT:
            raise BadRequest(f"1 to {MAX_FILES} files with at most {MAX_TEXT:,} characters together")
        for name in files:
            if not NAME.fullmatch(name):
                raise BadRequest(f"{name[:80]!r} is not a file name such as pack.yaml")
        if bad := next((name for name in off if not PACK.fullmatch(name)), None):
            raise BadRequest(f"{bad[:80]!r} is not the name of a pack")
        for path in sorted(self.folder.iterdir()):
            if path.name not in files:
                path.unlink()
        for name, text in files.items():
            (self.folder / name).write_text(text, encoding="utf-8", errors="replace", newline="")
        rulesets = [name for name, text in files.items() if _is_ruleset(text)]
        based = {
            base for name in rulesets for base in re.findall(r"^extends: *(\w+)", files[name], re.MULTILINE)
        }
        tops = [name for name in rulesets if Path(name).stem not in based] or rulesets
        members: set[str] = set()
        with suppress(CompileError):  # too many mistakes: reported when the rules are loaded
            packs = read([str(self.folder / name) for name in tops], Reporter())[0] if tops else []
            members = {Path(pack.source.name).name for pack in packs}
        unlisted = [name for name in files if name not in members.union(rulesets)]
        unread = {Path(name).stem for name in unlisted}.intersection(off)
        words = tops + [name for name in unlisted if Path(name).stem not in unread]
        if not words:
            raise BadRequest("every pack is off")
        used = {name: text for name, text in files.items() if Path(name).stem not in unread}
        return Selection(used, words, [name for name in off if name not in unread])

    def compile(self, rows: int, columns: int) -> bytes:
        """The WebAssembly module of a world of the last good rules."""
        return standalone_module(self._rules(), (int(rows), int(columns)), self.memo)

    def _rules(self) -> Ruleset:
        if self.ruleset is None:
            raise BadRequest("no rules without mistakes have been loaded")
        return self.ruleset

    def universe(self, seed: str) -> dict[str, Any]:
        """The rules of `powderdsl universe SEED`, in the form of the site's own rules."""
        name = f"{PREFIX}{seed}"
        ruleset, sources = load(name), [pack.source for pack in read([name], Reporter())[0]]
        files = {f"{Path(source.name).stem.replace(':', '_')}.yaml": source.text for source in sources}
        return {
            "title": ruleset.name,
            "about": f"Universe {seed}: invented elements under laws that nobody has seen.",
            "files": files,
            "off": [],
            "frame": frame_element(ruleset, ruleset.elements[0].id),
            "worlds": [],
        }

    def command(self) -> dict[str, Any]:
        """The arguments of the command line for the last good rules: `rules` for `run`, and `files` to save first.

        Files that differ from the shipped ones must be saved. If a member of a ruleset is saved, the ruleset must be
        saved too, since members are looked up in its folder.
        """
        words, off = self.good.words, self.good.off
        own = set()
        for name, text in self.good.files.items():
            path = shipped("rules") / name
            if not path.is_file() or path.read_text(encoding="utf-8") != text:
                own.add(name)
        if own.difference(words):
            own.update(name for name, text in self.good.files.items() if _is_ruleset(text))
        names = [word if word in own else Path(word).stem for word in words]
        return {
            "rules": "-".join(["+".join(names), *off]),
            "files": [name for name in self.good.files if name in own],
        }

    def save_rules(self) -> bytes:
        """The files that `command` names: a single file unmodified, several as a zip."""
        files = self.command()["files"]
        if len(files) == 1:
            return self.good.files[files[0]].encode()
        out = io.BytesIO()
        with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
            for name in files:
                archive.writestr(name, self.good.files[name])
        return out.getvalue()

    def ledger(self) -> str:
        """The ledger of created, destroyed and conserved elements, as `check --ledger` prints it."""
        from powderdsl.analysis.ledger import ledger, ledger_text

        return ledger_text(ledger(self._rules()))

    def invariants(self) -> list[dict[str, Any]]:
        """The invariants: `proven` with method and reason, `tried` on worlds, or `broken` with a small counterexample."""
        from powderdsl.testing.properties.outcomes import counterexample_lines
        from powderdsl.testing.properties.search import quick_results

        rules = self._rules()
        rows = []
        for result in quick_results(rules, PROOF):
            status, note, prop = result.status, result.reason, result.prop
            if result.counterexample is not None:
                note = "\n".join(counterexample_lines(result.counterexample, rules))
            elif status == "proven":
                note = f"{result.proof}: {note}"
            else:
                status, note = "tried", ""
            rows.append({"text": prop.text, "status": status, "note": note, "owner": prop.owner})
        return rows

    def tests(self, pack: str) -> list[dict[str, Any]]:
        """The tests of a pack: the place and worlds of each, and for failed ones the problem and the resulting world."""
        from powderdsl.testing.pack_tests.runner import run_examples

        rules = self._rules()
        own = replace(rules, tests=tuple(test for test in rules.tests if test.pack == pack))
        return [
            {
                "name": result.example.name,
                "passed": result.passed,
                "problem": result.problem,
                "step": result.step,
                "given": list(result.example.given),
                "expect": list(result.example.expect or ()),
                "after": list(result.after),
                "legend": dict(result.example.legend),
                "place": result.example.span.place.rpartition("/")[2],
            }
            for result in run_examples(own, sim=self._simulator())
        ]

    def trace(self, world: dict[str, Any], row: int, column: int, params: dict[str, float]) -> dict[str, Any]:
        """The trace of a cell in the next step of a world, as text and as data, with some values of `params` replaced."""
        from powderdsl.simulation.tracing import trace, trace_data, trace_text

        reporter, sim = Reporter(), self._simulator()
        rules = self._rules()
        defaults = {param.name: float(param.default) for param in rules.params}
        if changed := {name: value for name, value in params.items() if value != defaults.get(name)}:
            rules = set_params(rules, changed, reporter)
            reporter.raise_if_errors()
            sim = sim.of(rules)
        traced = trace(self._world(world, sim), int(row), int(column), 1)
        return {"text": trace_text(traced), "data": trace_data(traced)}

    def save(self, world: dict[str, Any]) -> bytes:
        """A world as an .npz, which `powderdsl run` continues."""
        from powderdsl.worlds.store import save

        path = self.folder.parent / "world.npz"
        save(self._world(world, self._simulator()), path)
        return path.read_bytes()

    def open_world(self, data: str) -> dict[str, Any]:
        """The first world of an .npz (base64)."""
        from powderdsl.worlds.store import first_world_data, load_world

        path = self.folder.parent / "opened.npz"
        path.write_bytes(base64.b64decode(data))
        try:
            return first_world_data(load_world(path, self._simulator()))
        finally:
            path.unlink()

    def _simulator(self) -> Any:
        """The simulator of the rules, cached because compiling takes a while."""
        from powderdsl.simulation.simulator import Simulator

        rules = self._rules()
        if self._sim is None or self._sim.ruleset is not rules:
            self._sim = Simulator(rules, "wasm", tensors=False, memo=self.memo)
        return self._sim

    def _world(self, data: dict[str, Any], sim: Any) -> Any:
        """A world from the page's JSON, with ids and fields of the rules."""
        rules = self._rules()
        ours = {element.qualified: element.id for element in rules.elements}
        shape = int(data["rows"]), int(data["columns"])
        table = bytearray(256)
        for number, name in data["palette"].items():
            if name not in ours:
                raise BadRequest(f"the rules have no element {name}")
            table[int(number)] = ours[name]
        ids = np.frombuffer(base64.b64decode(data["ids"]).translate(table), np.uint8).reshape((1, *shape))
        fields: dict[str, Any] = {}
        for own, name in qualified_slots(rules).items():
            slot, field = sim.slot_by_name.get(own), data["fields"].get(name)
            if slot and field:
                octets = base64.b64decode(field["values"])
                octets = octets.translate(table) if slot.kind == ELEMENT else octets
                components = (2,) if field["components"] == 2 else ()
                fields[slot.name] = np.frombuffer(octets, field["type"]).reshape((1, *components, *shape))
        seed, index, step = (int(number) for number in data["clock"])
        world = sim.replace(sim.world(ids, seed=seed), **fields)
        return replace(world, index=np.full_like(world.index, index), since=step)


def _is_ruleset(text: str) -> bool:
    return re.search(r"^ruleset:", text, re.MULTILINE) is not None


@cache
def session() -> Session:
    folder = Path(tempfile.mkdtemp()) / "rules"
    folder.mkdir()
    return Session(folder)


def call(name: str, arguments: str) -> str | bytes:
    """Call a method of the session with a JSON list; return the result as JSON, or bytes unmodified.

    Mistakes in the input are returned as {"error": text}, never raised.
    """
    current = session()
    try:
        method = getattr(current, name, None)
        if method is None:
            raise BadRequest(f"no call {name[:80]!r}")
        answer = {"result": method(*json.loads(arguments))}
    except (BadRequest, CompileError) as error:
        answer = {"error": str(error)}
    except (IndexError, KeyError, TypeError, ValueError) as error:
        answer = {"error": f"{type(error).__name__}: {error}"}
    if isinstance(answer.get("result"), bytes):
        return bytes(answer["result"])
    # Texts mention files by the page's names, without the folder.
    text = json.dumps(answer)
    for folder in (current.folder, current.folder.parent):
        text = text.replace(json.dumps(f"{folder}/")[1:-1], "")
    return text
