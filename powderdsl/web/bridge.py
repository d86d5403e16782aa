"""What the page calls in Pyodide: functions of one session, JSON in, JSON or bytes out."""

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
from powderdsl.compiler import load_with_diagnostics, read, shipped
from powderdsl.diagnostics import CompileError, Reporter
from powderdsl.diagnostics.diagnostic import diagnostic_data, render_text
from powderdsl.model import declarations
from powderdsl.model.builtins import RESERVED
from powderdsl.model.definitions import set_params
from powderdsl.model.operations import FUNCTIONS
from powderdsl.model.schema import RECORDS, keys_of
from powderdsl.model.state import qualified_slots, slot_name
from powderdsl.model.types import Ruleset
from powderdsl.simulation.standalone import standalone_module
from powderdsl.syntax.parse import reserved_words
from powderdsl.system.memo import Memo

MAX_FILES = 64
MAX_TEXT = 1 << 20
"""Characters of all files together."""

NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_-]{0,60}\.ya?ml")
PACK = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,60}")


class BadRequest(ValueError):
    """The page, or a link that it was given, asks for something that the session cannot do."""


@dataclass(frozen=True)
class Named:
    """Rule files by name, those of them that the rules are named by, and packs that are left out."""

    files: Mapping[str, str]
    words: list[str]
    off: list[str]


class Session:
    """Rule files in a folder of their own, and the last rules that had no mistakes."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.memo = Memo(versions=2, things=250)
        """Of one ruleset with some 60 passes: a page has less memory than a machine."""
        self.ruleset: Ruleset | None = None
        self.good = Named({}, [], [])
        """What was read for these rules."""
        self._made: Any = None

    def check(self, files: Mapping[str, str], off: list[str]) -> dict[str, Any]:
        """Load the files without the packs in `off`. Rules with mistakes leave the ones before in place.

        Diagnostics have the text that `check` prints.
        """
        named = self._write(files, off)
        names = [str(self.folder / word) for word in named.words]
        names[-1] = "-".join([names[-1], *named.off])
        packs: list[str] = []
        answer: dict[str, Any] = {"ok": True}
        try:
            packs = [Path(pack.source.name).name for pack in read(names, Reporter())[0]]
            self.ruleset, remarks = load_with_diagnostics(*names)
            self.good, answer["words"] = named, _words(self.ruleset)
        except CompileError as error:
            answer["ok"], remarks = False, error.diagnostics
        data = [diagnostic_data(remark, utf16=True) | {"text": render_text(remark)} for remark in remarks]
        return answer | {"diagnostics": data, "packs": packs}

    def _write(self, files: Mapping[str, str], off: list[str]) -> Named:
        """Write the files, and name them as `load` takes them: rulesets, and packs beside them."""
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
        known: set[str] = set()
        with suppress(CompileError):  # too many mistakes: reported when the rules are loaded
            packs = read([str(self.folder / name) for name in tops], Reporter())[0] if tops else []
            known = {Path(pack.source.name).name for pack in packs}
        beside = [name for name in files if name not in known.union(rulesets)]
        unread = {Path(name).stem for name in beside}.intersection(off)
        words = tops + [name for name in beside if Path(name).stem not in unread]
        if not words:
            raise BadRequest("every pack is off")
        taken = {name: text for name, text in files.items() if Path(name).stem not in unread}
        return Named(taken, words, [name for name in off if name not in unread])

    def compile(self, rows: int, columns: int) -> bytes:
        """The last good rules as a module of a world."""
        return standalone_module(self._rules(), (int(rows), int(columns)), self.memo)

    def _rules(self) -> Ruleset:
        if self.ruleset is None:
            raise BadRequest("no rules without mistakes have been loaded")
        return self.ruleset

    def command(self) -> dict[str, Any]:
        """What the command line needs for the last good rules: `rules` as `run` takes them, and `files` to save.

        Files that are not shipped as they are have to be saved; with a member of a ruleset, which is looked for beside
        it, the ruleset too.
        """
        words, off = self.good.words, self.good.off
        own = {name for name, text in self.good.files.items() if not _is_shipped(name, text)}
        if own.difference(words):
            own.update(name for name, text in self.good.files.items() if _is_ruleset(text))
        named = [word if word in own else Path(word).stem for word in words]
        return {
            "rules": "-".join(["+".join(named), *off]),
            "files": [name for name in self.good.files if name in own],
        }

    def save_rules(self) -> bytes:
        """The files that `command` names: one as it is, several in a zip."""
        files = self.command()["files"]
        if len(files) == 1:
            return self.good.files[files[0]].encode()
        out = io.BytesIO()
        with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
            for name in files:
                archive.writestr(name, self.good.files[name])
        return out.getvalue()

    def ledger(self) -> str:
        """What rules create, destroy and conserve, as `check --ledger` prints it."""
        from powderdsl.analysis.account import ledger_text
        from powderdsl.analysis.ledger import ledger

        return ledger_text(ledger(self._rules()))

    def invariants(self) -> list[dict[str, Any]]:
        """Each invariant: `proven` and why, `tried` on worlds, or `broken` with a small world that breaks it."""
        from powderdsl.analysis.ledger import ledger
        from powderdsl.testing.properties.outcomes import counterexample_lines
        from powderdsl.testing.properties.refute import quick_results

        rules = self._rules()
        rows = []
        for one in quick_results(rules, ledger(rules)):
            status, note = one.status, one.reason
            if one.counterexample is not None:
                note = "\n".join(counterexample_lines(one.counterexample, rules))
            elif status != "proven":
                status, note = "tried", ""
            rows.append({"text": one.prop.text, "status": status, "note": note, "owner": one.prop.owner})
        return rows

    def tests(self, pack: str) -> list[dict[str, Any]]:
        """Each test of a pack: its place, and what failed, with the world then."""
        from powderdsl.testing.pack_tests.runner import run_examples

        rules = self._rules()
        own = replace(rules, tests=tuple(one for one in rules.tests if one.pack == pack))
        return [
            {
                "name": one.example.name,
                "passed": one.passed,
                "problem": one.problem,
                "step": one.step,
                "after": list(one.after),
                "legend": dict(one.example.legend),
                "place": one.example.span.place.rpartition("/")[2],
            }
            for one in run_examples(own, sim=self._simulator())
        ]

    def trace(self, world: dict[str, Any], row: int, column: int, params: dict[str, float]) -> str:
        """Why a cell holds what it holds one step after a world, with other values for some parameters."""
        from powderdsl.simulation.simulator import Simulator
        from powderdsl.simulation.tracing import trace, trace_text

        reporter, sim = Reporter(), self._simulator()
        rules = self._rules()
        usual = {one.name: float(one.default) for one in rules.params}
        if changed := {name: value for name, value in params.items() if value != usual.get(name)}:
            rules = set_params(rules, changed, reporter)
            reporter.raise_if_errors()
            sim = Simulator(rules, "wasm", tensors=False, memo=self.memo)
        return trace_text(trace(self._world(world, sim), int(row), int(column), 1)).replace(
            f"{self.folder}/", ""
        )

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
        """One for each rules: compiling takes a while."""
        from powderdsl.simulation.simulator import Simulator

        rules = self._rules()
        if self._made is None or self._made.ruleset is not rules:
            self._made = Simulator(rules, "wasm", tensors=False, memo=self.memo)
        return self._made

    def _world(self, data: dict[str, Any], sim: Any) -> Any:
        """A world as the page writes it, whose ids and fields are those of the rules."""
        rules = self._rules()
        ours = {element.qualified: element.id for element in rules.elements}
        shape = int(data["rows"]), int(data["columns"])
        table = bytearray(256)
        for number, name in data["palette"].items():
            if name not in ours:
                raise BadRequest(f"the rules have no element {name}")
            table[int(number)] = ours[name]
        ids = np.frombuffer(base64.b64decode(data["ids"]).translate(bytes(table)), np.uint8).reshape(
            (1, *shape)
        )
        fields: dict[str, Any] = {}
        known = qualified_slots(rules).values()
        for name, given in data["fields"].items():
            if name in known:
                values = np.frombuffer(base64.b64decode(given["values"]), np.dtype(given["type"]))
                whole = (1, 2, *shape) if given["components"] == 2 else (1, *shape)
                fields[slot_name(rules, name)] = values.reshape(whole)
        seed, index, step = (int(number) for number in data["clock"])
        world = sim.replace(sim.world(ids, seed=seed), **fields)
        return replace(world, index=np.full_like(world.index, index), start=np.full_like(world.start, step))


def _is_ruleset(text: str) -> bool:
    return re.search(r"^ruleset:", text, re.MULTILINE) is not None


def _is_shipped(name: str, text: str) -> bool:
    path = shipped("rules") / name
    return path.is_file() and path.read_text(encoding="utf-8") == text


def _words(ruleset: Ruleset) -> dict[str, list[str]]:
    """What the editor completes, by kind."""
    rule_records = [kind for kind in RECORDS.values() if kind.__module__ == declarations.__name__]
    return {
        "element": [one.name for one in ruleset.elements],
        "field": [*(one.name for one in ruleset.fields), *(one.name for one in ruleset.properties)],
        "parameter": [one.name.rpartition(".")[2] for one in ruleset.params],
        "function": sorted(FUNCTIONS),
        "keyword": sorted({*reserved_words(), *RESERVED}),
        "key": sorted({key for kind in rule_records for key in keys_of(kind)}),
    }


@cache
def session() -> Session:
    """The session of this process."""
    folder = Path(tempfile.mkdtemp()) / "rules"
    folder.mkdir()
    return Session(folder)


def call(name: str, arguments: str) -> str | bytes:
    """Call a method of the session with a JSON list; the result as JSON, or bytes as they are.

    What is wrong with the input comes back as {"error": text}, never as an exception.
    """
    current = session()
    try:
        method = getattr(current, name, None)
        if method is None:
            raise BadRequest(f"no call {name[:80]!r}")
        found = {"result": method(*json.loads(arguments))}
    except (BadRequest, CompileError) as error:
        found = {"error": str(error)}
    except (IndexError, KeyError, TypeError, ValueError) as error:
        found = {"error": f"{type(error).__name__}: {error}"}
    if isinstance(found.get("result"), bytes):
        return bytes(found["result"])
    # Files have the names that the page gave them, wherever a text mentions them.
    return json.dumps(found).replace(json.dumps(f"{current.folder}/")[1:-1], "")
