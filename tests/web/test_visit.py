"""Visits of an exported site in headless Chromium: what they fetch, and what visitors see."""

from __future__ import annotations

import json
import re
import shutil
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any

import pytest

from powderdsl.universes import universe_text
from powderdsl.web import site as site_module
from powderdsl.web.site import OfferedRules, Site
from tests.web.test_page import HERE, needed
from tests.wheels import succeed

pytestmark = pytest.mark.slow

MOST = 8_000_000
"""Bytes of a first visit, all that the compiler needs included."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A site with two rulesets."""
    if words := needed():
        pytest.skip(words)
    made = tmp_path_factory.mktemp("exported")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(site_module, "SIZES", (64,))
        entries = [OfferedRules(name, (name,)) for name in ("powderworld", "life")]
        patch.setattr(site_module, "shipped_entries", lambda: entries)
        patch.setattr(site_module, "code_version", lambda: "of a test")
        patch.setenv("XDG_CACHE_HOME", str(made))
        Site(offline=True).write(made / "site")
    return made / "site"


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        pass


def saw(script: str, folder: Path) -> dict[str, Any]:
    """What a script saw of the site."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(folder)))
    Thread(target=server.serve_forever, daemon=True).start()
    address = f"http://127.0.0.1:{server.server_port}/"
    try:
        return json.loads(succeed(str(shutil.which("node")), HERE / script, address, folder, cwd=folder))
    finally:
        server.shutdown()
        server.server_close()


@pytest.fixture(scope="module")
def seen(folder: Path) -> dict[str, Any]:
    return saw("views.mjs", folder)


@pytest.fixture(scope="module")
def felt(folder: Path) -> dict[str, Any]:
    if not (HERE / "node_modules" / "axe-core").is_dir():
        pytest.skip("axe-core is missing: `make web` fetches it")
    return saw("access.mjs", folder)


def test_a_second_visit_needs_no_network(folder: Path) -> None:
    found = json.loads(succeed(str(shutil.which("node")), HERE / "visit.mjs", folder, cwd=folder))
    assert found["first"]["bytes"] <= MOST
    # The browser itself asks whether there is a new service worker.
    assert set(found["second"]["paths"]) <= {"/sw.js"}
    assert found["offline"]["ready"] > 0
    # The memory of the started compiler is kept.
    assert [found[visit]["isKept"] for visit in ("first", "second", "offline")] == [False, True, True]
    # A new version replaces the old one at the next visit, and only its files are kept.
    assert found["replaced"] == {"texts": ["old", "new"], "caches": 1}
    assert found["problems"] == []


def test_the_landing_page_opens_rules(seen: dict[str, Any]) -> None:
    assert (seen["cards"], seen["opened"]) == (["powderworld", "life"], "life")


def test_an_embedded_world_has_a_button_and_a_link(seen: dict[str, Any]) -> None:
    found = seen["embedded"]
    assert (found["shown"], found["editor"]) == (["Pause", "Open in the playground"], False)
    assert found["link"] == "play.html?rules=life"


def test_the_gpu_draws_the_same_pixels(seen: dict[str, Any]) -> None:
    assert seen["pixels"].pop("colors") > 100
    assert seen["pixels"] == {"tinted": 0, "plain": 0, "ramped": 0, "without": False}


def test_one_key_records(seen: dict[str, Any], folder: Path) -> None:
    assert "record a video" in seen["keys"]
    assert seen["closed"]
    assert seen["recording"] == [True, "Recording. Press M to end and save it."]
    assert (folder / "film.webm").read_bytes()[:4] == b"\x1aE\xdf\xa3"


def test_the_chart_outlives_edits_and_has_a_legend(seen: dict[str, Any]) -> None:
    assert seen["chart"]["earlier"]
    assert "sand" in seen["chart"]["legend"]


def test_a_change_is_explained_in_a_sentence_that_leads_to_the_rule(seen: dict[str, Any]) -> None:
    why = r"The cell \(25, 20\) changed from empty to sand that came from \(2[234], \d+\) in step 3, by (.+) core.yaml:\d+"
    found = re.fullmatch(why, seen["why"])
    assert found, seen["why"]
    assert seen["near"] == 2
    assert seen["rule"][0] == "core.yaml"
    assert found[1].split()[0] in seen["rule"][1]


def test_parameters_and_fields_are_described(seen: dict[str, Any]) -> None:
    assert "element < dies" in seen["parameters"]
    assert {"empty", "lava", "cloner"} <= set(seen["choices"])
    assert "clone lava" in seen["set"]


def test_a_remix_names_what_it_came_from(seen: dict[str, Any]) -> None:
    assert "It is a remix, of 2 works, one after the other." in seen["origin"][0]
    assert seen["origin"][1] == 3
    assert seen["framed"] == [False, 3]


def test_nothing_fails(seen: dict[str, Any]) -> None:
    assert seen["problems"] == []


def test_axe_finds_nothing(felt: dict[str, Any]) -> None:
    assert felt["violations"] == []
    assert felt["problems"] == []


def test_phones_have_the_world_the_palette_and_large_buttons(felt: dict[str, Any]) -> None:
    assert {where: names for where, names in felt["small"].items() if names} == {}
    assert len(felt["small"]) == 21
    assert {where: names for where, names in felt["reach"].items() if names} == {}
    assert felt["wide"] == []


def test_two_fingers_zoom_and_do_not_paint(felt: dict[str, Any]) -> None:
    assert felt["fingers"] == {"painted": True, "undone": True, "factor": 2, "middle": 0, "paints": True}


def test_worlds_can_be_dark_and_still(felt: dict[str, Any]) -> None:
    assert felt["dark"]["ground"] < 100 <= felt["dark"]["least"]
    assert felt["still"] == [False, 0]


@pytest.fixture(scope="module")
def first(folder: Path) -> dict[str, Any]:
    return saw("first.mjs", folder)


def test_a_first_visit_shows_three_steps(first: dict[str, Any]) -> None:
    assert [words.split("\n")[0] for words in first["steps"]] == [
        "1. Paint",
        "2. Change this line",
        "3. Share",
    ]
    assert "ice -> water" in first["steps"][1]
    assert (first["focused"], first["ended"]) == (True, True)
    assert first["later"] == [False, False, True]
    assert (first["sheet"], first["escaped"]) == (False, [True, "yes"])
    assert first["docs"] == "# The rule language in brief"


def test_the_editor_opens_on_a_rule_and_elements_lead_to_theirs(first: dict[str, Any]) -> None:
    assert first["rule"][0] == "water.yaml"
    assert "ice -> water" in first["rule"][1]
    assert first["mentions"][0].startswith("water.yaml:8 ice: {")
    assert any(words.startswith("fire.yaml:") for words in first["mentions"])
    assert (first["mentioned"][0], "water -> ice" in first["mentioned"][1]) == ("water.yaml", True)


def test_a_form_writes_the_pack_of_a_new_element(first: dict[str, Any]) -> None:
    assert first["taken"] == "There is a sand already."
    shown, text, element, mistakes = first["written"]
    assert (shown, element, mistakes) == ("goo.yaml", "goo.goo", 0)
    assert "- goo -> empty if count(sand) > 0 with chance 20%\n" in text
    assert "- sand -> water if count(goo) > 0 with chance 20%\n" in text


def test_a_universe_opens_by_its_seed(first: dict[str, Any]) -> None:
    found = first["universe"]
    assert (found["key"], found["hash"], found["menu"]) == ("universe_7", "#universe=7", "universe_7")
    assert found["text"] == universe_text(7)
    assert (first["back"], "world of the link" in first["linked"]) == ("universe_7", True)
    assert "universe" in first["refused"]
    assert first["problems"] == []


def test_tasks_are_played_and_replayed(folder: Path) -> None:
    found = saw("tasks.mjs", folder)
    assert "ice-bridge" in found["list"]
    assert "24 of 24 actions left. A click acts on 4×4 cells; 3 steps follow." in found["begun"]
    assert "random\t0.047\nnothing\t0\n" in found["begun"]
    assert (found["you"], found["hash"]) == ("0.013", "#task=ice-bridge&world=0&actions=490449040014")
    assert (found["reloaded"], found["replayed"]) == (True, True)
    assert found["said"] == "These were 3 actions of a link: they returned 0.013."
    assert "0 of 24 actions left. Not done." in found["over"]
    assert (found["ended"], found["problems"]) == (None, [])
