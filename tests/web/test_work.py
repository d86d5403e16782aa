"""Work in the playground is kept, and can be undone: in headless Chromium, on the site of this repository."""

from __future__ import annotations

import json
import shutil
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from powderdsl.web.site import Site, SiteServer
from tests.tiers import tiered
from tests.web.test_page import HERE, needed
from tests.wheels import succeed


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    if words := needed():
        pytest.skip(words)
    server = SiteServer(Site())
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield server.address
    server.shutdown()
    server.server_close()


def script(name: str, address: str, folder: Path, *words: str) -> dict[str, Any]:
    """What a script saw."""
    text = succeed(str(shutil.which("node")), HERE / name, address, *words, cwd=folder)
    found: dict[str, Any] = json.loads(text)
    assert [one for one in found["problems"] if "status of 500" not in one] == []
    return found


@pytest.fixture(scope="module")
def seen(address: str, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    return script("undo.mjs", address, tmp_path_factory.mktemp("undo"))


def test_sizes_seeds_worlds_and_rules_can_be_undone(seen: dict[str, Any]) -> None:
    assert seen["sand"] == [seen["sand"][0]] * 3
    assert seen["sand"][0] > 10
    assert seen["framed"]
    assert seen["undone"] == [True, True]
    assert seen["undoneMenus"] == [
        "life glider-gun 128x128 7",
        "powderworld random 128x128 7",
        "powderworld random 128x128 0",
        "powderworld empty 128x128 0",
        "powderworld empty 64x64 0",
        "powderworld empty 128x128 0",
        "powderworld empty 64x64 0",
    ]
    assert seen["redone"]


def test_rules_that_were_chosen_last_run(seen: dict[str, Any]) -> None:
    assert seen["raced"] == ["life", "life", "life", "life.yaml"]
    assert seen["failed"] == "powderworld"
    assert "powderworld (edited)" in seen["edited"][0]
    assert seen["edited"][1]


def test_packs_that_are_off_and_parameters_can_be_undone(seen: dict[str, Any]) -> None:
    on, off = [[], True], [["wind"], False]
    assert seen["off"] == [off, on, off, on]
    first, changed, *rest = seen["parameter"]
    assert changed == pytest.approx([0.25, 0.25])
    assert rest == [first, changed]


def test_seeds_are_those_of_the_command_line(seen: dict[str, Any]) -> None:
    most = str(2**63 - 1)
    accepted = ["99999999999", most, most, most, "1000"]
    assert seen["seeds"] == ["7 7", *(f"{seed} {seed}" for seed in accepted)]


def test_values_of_fields_are_cut(seen: dict[str, Any]) -> None:
    assert seen["field"] == 10


def test_keys(seen: dict[str, Any]) -> None:
    assert (seen["spaceRuns"], seen["spacePauses"]) == (True, True)


def test_work_is_kept(address: str, tmp_path: Path) -> None:
    found = script("work.mjs", address, tmp_path, str(tmp_path))
    assert (found["module"], found["reloaded"]) == (True, True)
    assert "is back" in found["back"]
    assert found["link"][1] == "life"
    assert "Your earlier work is under Recent." in found["link"][0]
    assert (found["wentBack"], found["changed"]) == (True, True)
    assert (found["fromList"], found["undoneLink"]) == (True, "life")
    assert "powderworld, sand.yaml" in found["recent"]
    assert "is back" in found["newTab"]


def test_files_links_and_tests(address: str, tmp_path: Path) -> None:
    found = script("files.mjs", address, tmp_path, str(tmp_path))
    assert found["replaced"] == ["red.yaml is replaced. Undo", True, False]
    assert found["mine"] == ["mine.yaml", *(f"mine{number}.yaml" for number in range(2, 11))]
    assert found["renamed"] == [["dust.yaml", "dust2.yaml"], "pack: dust2"]
    assert found["deleted"] == ["dust2.yaml is deleted. Undo", "dust.yaml", "dust2.yaml"]
    assert found["taken"] == "There is a red.yaml already."
    assert found["typed"] == ["ashes.yaml", "ashes"]
    assert found["figures"] == [[name, 4, 4, 3] for name in ("given", "expected", "got, step 20")]
    assert found["lab"] == ["core.yaml", "sand.yaml", "water.yaml", "lab.yaml"]
    assert found["added"] == [*found["lab"], "zzz.yaml"]
    assert found["left"]
    exact, rounded, refused = found["links"]
    assert "Fields are rounded" not in exact
    assert "Fields are rounded" in rounded
    assert "30,000 at most" in refused
    assert (found["sameLink"], found["sameFile"]) == (True, True)
    assert found["hash"] < 30_000
    assert "my.npz" in found["message"]
    assert "/tmp" not in found["message"]


def test_the_editor_completes_explains_and_formats(address: str, tmp_path: Path) -> None:
    found = script("words.mjs", address, tmp_path)
    keys, packs, values = found["offered"].values()
    assert "color" in "\n".join(keys)
    assert "water" in "\n".join(packs)
    assert values
    assert found["about"][0].startswith("element sand of pack sand")
    assert found["about"][1] == "element"
    assert (found["behind"], found["undone"]) == ("glyph", True)


@pytest.mark.parametrize("seed", tiered(range(1, 11), [1]))
def test_random_actions_lose_nothing(address: str, tmp_path: Path, seed: int) -> None:
    found = script("actions.mjs", address, tmp_path, "500", str(seed))
    assert (found["actions"], found["reloads"], found["lost"]) == (500, 5, [])
    assert max(found["heap"]) <= 2 * found["heap"][0] + 8
