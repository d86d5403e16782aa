"""What the page calls in Pyodide, called here: rules of strangers give messages, and worlds keep what they are."""

from __future__ import annotations

import base64
import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import wasmtime

import powderdsl
from powderdsl.universes import universe_text
from powderdsl.web import bridge
from powderdsl.web.site import OfferedRules, shipped_entries
from powderdsl.worlds.store import load_world, world_data


@pytest.fixture
def session(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> bridge.Session:
    folder = tmp_path / "rules"
    folder.mkdir()
    made = bridge.Session(folder)
    monkeypatch.setattr(bridge, "session", lambda: made)
    return made


def call(name: str, *arguments: Any) -> Any:
    found = bridge.call(name, json.dumps(arguments))
    return found if isinstance(found, bytes) else json.loads(found)


def files(*names: str) -> dict[str, str]:
    return OfferedRules("rules", names).files()


def test_broken_rules_leave_the_last_good_ones(session: bridge.Session) -> None:
    assert call("compile", 8, 64) == {"error": "no rules without mistakes have been loaded"}
    good = files("core", "sand")
    found = call("check", good, [])["result"]
    last = session.ruleset
    assert found["ok"]
    kinds = found["words"]
    assert {name for name in kinds if kinds[name] == "element"} == {one.name for one in last.elements}
    assert (kinds["count"], kinds["below"], kinds["density"]) == ("function", "direction", "property")
    wasmtime.Module.validate(wasmtime.Engine(), call("compile", 16, 64))
    bad = good | {"sand.yaml": good["sand.yaml"].replace("density: 4", "densit: 4")}
    found = call("check", bad, [])["result"]
    assert not found["ok"]
    (problem,) = found["diagnostics"]
    assert (problem["code"], problem["primary"]["span"]["file"]) == ("PD108", "sand.yaml")
    assert problem["primary"]["span"]["start"] == {"line": 5, "column": 17}
    assert "^^^^^^" in problem["text"]
    assert str(session.folder) not in json.dumps(found)
    circle = {"a.yaml": "ruleset: a\nextends: b\n", "b.yaml": "ruleset: b\nextends: a\n"}
    assert {one["code"] for one in call("check", circle, [])["result"]["diagnostics"]} == {"PD314"}
    assert session.ruleset is last


def test_the_page_has_the_words_and_the_layout_of_the_language_server(session: bridge.Session) -> None:
    given = files("core", "sand")
    call("check", given, [])
    text = given["sand.yaml"]

    def labels(text: str) -> set[str]:
        return {item["label"] for item in call("complete", text, len(text))["result"]}

    assert {"color", "tags", "glyph"} <= labels("pack: mine\nelements:\n  gold: {id: 99, col")
    assert {"gravity"} == labels(f"{text}passes:\n  rest:\n    after: [gra") & {"gravity", "sand"}
    assert {"sand", "count", "density"} <= labels(f"{text}passes:\n  rest:\n    do:\n      - 𝒳 be")
    assert {"core", "water"} <= labels("pack: mine\nneeds: [")
    about = call("explain", text, text.index("  sand:") + 4)["result"]
    assert "**element** `sand` of pack `sand`" in about
    assert call("explain", text, 0)["result"].startswith("`pack`: ")
    assert call("explain", "# 𝒳", 2) == {"result": ""}
    assert call("format", "pack: mine\nelements:\n     gold:   {id: 99}\n") == {
        "result": "pack: mine\nelements:\n  gold: {id: 99}\n"
    }
    assert call("format", "pack: [") == {"result": "pack: ["}


def test_packs_are_left_out(session: bridge.Session) -> None:
    found = call("check", files("powderworld"), ["acid", "wind"])["result"]
    assert found["ok"]
    assert {"acid.yaml", "wind.yaml"}.isdisjoint(found["packs"])
    assert session.ruleset.packs == powderdsl.load("powderworld-acid-wind").packs
    assert not call("check", files("powderworld"), ["core"])["result"]["ok"]
    given = files("life") | {"mine.yaml": "pack: [", "other.yaml": "x" * 10_000}  # may be anything
    assert call("check", given, ["mine", "other"])["result"]["ok"]
    assert call("check", given, ["mine", "other", "life"]) == {"error": "every pack is off"}


MINE = 'pack: mine\nneeds: core\nelements:\n  mine: {density: 4, gravity: yes, color: "#E0559A"}\n'

Edit = tuple[tuple[str, ...], dict[str, str], list[str], str, list[str]]
"""Packs, files that are edited, packs that are off; then what a command is to load, and which files it needs."""

EDITS: list[Edit] = [
    (("powderworld",), {}, [], "powderworld", []),
    (("life",), {}, [], "life", []),
    (("powderworld",), {}, ["acid"], "powderworld-acid", []),
    (("powderworld",), {"mine.yaml": MINE}, ["acid"], "powderworld+mine.yaml-acid", ["mine.yaml"]),
    (
        ("powderworld", "docs/examples/salt.yaml"),
        {"sand.yaml": "# edited\n", "mine.yaml": MINE},
        [],
        "powderworld.yaml+salt.yaml+mine.yaml",
        ["powderworld.yaml", "sand.yaml", "salt.yaml", "mine.yaml"],
    ),
    (("powderworld",), {"snow.yaml": MINE}, ["snow", "acid"], "powderworld-acid", []),
    (("core", "sand"), {"sand.yaml": "# edited\n"}, [], "core+sand.yaml", ["sand.yaml"]),
]


@pytest.mark.parametrize("case", EDITS)
def test_the_command_line_reads_the_same_rules(
    session: bridge.Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, case: Edit
) -> None:
    names, edits, off, rules, saved = case
    given = files(*names)
    given |= {name: text + given.get(name, "") for name, text in edits.items()}
    found = call("check", given, off)["result"]
    assert found["ok"]
    assert edits or off or found["diagnostics"] == []
    good = session.ruleset
    assert good is not None
    call("check", given | {"core.yaml": "["}, off)  # the last good rules are saved
    found = call("command")["result"]
    assert (found["rules"], sorted(found["files"])) == (rules, sorted(saved))
    monkeypatch.chdir(tmp_path)
    data = call("save_rules")
    if len(saved) == 1:
        Path(saved[0]).write_bytes(data)
    else:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            assert sorted(archive.namelist()) == sorted(saved)
            archive.extractall()
    wanted = powderdsl.load(found["rules"])
    assert (wanted.name, wanted.palette, wanted.passes) == (good.name, good.palette, good.passes)


def test_worlds_are_saved_and_opened(session: bridge.Session, tmp_path: Path) -> None:
    call("check", files("powderworld"), [])
    ruleset = powderdsl.load("powderworld")
    sim = powderdsl.compile(ruleset)
    random = np.random.default_rng(1)
    world = sim.world(random.integers(0, 14, (1, 16, 64)).astype(np.uint8), seed=2**40 + 3)
    world = sim.step(world, 7)
    state = {name: value[0].numpy() for name, value in world.state.items()}
    data = world_data(ruleset, state.pop("element"), state, (2**40 + 3, 0, 7))
    saved = call("save", data)
    path = tmp_path / "world.npz"
    path.write_bytes(saved)
    loaded = load_world(path, sim)
    later = [sim.step(one, 5) for one in (world, loaded)]
    for name, values in later[0].state.items():
        assert (values == later[1].state[name]).all(), name
    assert call("open_world", base64.b64encode(saved).decode())["result"] == data
    assert "error" in call("open_world", base64.b64encode(b"no world").decode())


def test_worlds_of_other_ids_are_translated(session: bridge.Session, tmp_path: Path) -> None:
    """After an edit, the page's world may have other ids than the rules, also in fields that contain elements."""
    call("check", files("powderworld"), [])
    ruleset = powderdsl.load("powderworld")
    sim = powderdsl.compile(ruleset)
    number = {element.name: element.id for element in ruleset.elements}
    kinds = np.random.default_rng(1).integers(0, 14, (1, 16, 64)).astype(np.uint8)
    world = sim.replace(
        sim.world(kinds), clone=np.where(kinds == number["cloner"], number["water"], 0).astype(np.uint8)
    )
    state = {name: value[0].numpy() for name, value in world.state.items()}
    swapped = np.arange(256, dtype=np.uint8)
    swapped[[number["water"], number["sand"]]] = number["sand"], number["water"]
    data = world_data(
        ruleset, swapped[state.pop("element")], state | {"clone": swapped[state["clone"]]}, (0, 0, 0)
    )
    data["palette"] = {str(swapped[int(id)]): name for id, name in data["palette"].items()}
    path = tmp_path / "world.npz"
    path.write_bytes(call("save", data))
    loaded = load_world(path, sim)
    for name, values in world.state.items():
        assert (values == loaded.state[name]).all(), name


def test_reports(session: bridge.Session) -> None:
    call("check", files("core", "sand"), [])
    assert call("ledger")["result"].startswith("ledger of core+sand")
    (first, *_) = call("tests", "sand")["result"]
    assert (first["name"], first["passed"], first["place"]) == (
        "sand falls and slides off its pile",
        True,
        "sand.yaml:7:5",
    )
    known = {one["text"]: one["status"] for one in call("invariants")["result"]}
    assert known["wall never changes"] == "proven"
    broken = files("core", "sand")
    broken["sand.yaml"] = broken["sand.yaml"].replace("gravity: yes", "gravity: no")
    call("check", broken, [])
    (first, *_) = call("tests", "sand")["result"]
    assert not first["passed"]
    assert first["after"]


def test_traces_are_those_of_the_world(session: bridge.Session) -> None:
    call("check", files("powderworld"), [])
    ruleset = powderdsl.load("powderworld")
    ids = np.zeros((8, 8), np.uint8)
    sand = ruleset.element("sand")
    ids[2, 3] = sand.id
    data = world_data(ruleset, ids, {}, (0, 0, 0))
    found = call("trace", data, 3, 3, {})["result"]
    assert "cell 3,3 in step 1 of powderworld" in found["text"]
    element = found["data"]["slots"]["element"]
    assert (element["before"], element["after"]) == ("empty", "sand")
    assert element["writer"]["file"] == "core.yaml"
    assert "sand" in call("trace", data, 3, 3, {"water.melt": 0.5})["result"]["text"]
    assert "error" in call("trace", data, 99, 3, {})


HOSTILE = [
    ("check", [{}, []]),
    ("check", [{"../core.yaml": ""}, []]),
    ("check", [{"core.yaml": "pack: core"}, ["a-b"]]),
    ("check", [{"core.yaml": "x" * (2 << 20)}, []]),
    ("check", [{f"p{i}.yaml": "" for i in range(99)}, []]),
    ("compile", [1 << 20, 1 << 20]),
    ("save", [{"rows": 4}]),
    ("trace", [{}, 0, 0, {}]),
    ("tests", []),
    ("no such call", []),
]


@pytest.mark.usefixtures("session")
def test_what_does_not_fit_is_an_error_message() -> None:
    call("check", files("core", "sand"), [])
    for name, arguments in HOSTILE:
        assert call(name, *arguments)["error"]


@pytest.mark.slow
def test_every_ruleset_of_the_site_opens(session: bridge.Session) -> None:
    for entry in shipped_entries():
        assert call("check", entry.files(), entry.off)["result"]["ok"], entry.key


def test_a_universe_is_that_of_the_command_line(session: bridge.Session) -> None:
    found = call("universe", "7")["result"]
    assert found["files"] == {**files("core"), "universe_7.yaml": universe_text(7)}
    assert found["frame"] == 1
    assert call("check", found["files"], [])["result"]["ok"]
    assert "no universe `99999999999`" in call("universe", "99999999999")["error"]
    assert "no universe `../core`" in call("universe", "../core")["error"]
