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
from tests.web.test_page import HERE, needed
from tests.wheels import once, succeed


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    if words := needed():
        pytest.skip(words)
    server = SiteServer(Site())
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield server.address
    server.shutdown()
    server.server_close()


@pytest.fixture(scope="module")
def seen(address: str, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What work.mjs saw."""

    def use(folder: Path) -> None:
        text = succeed(str(shutil.which("node")), HERE / "work.mjs", address, folder, cwd=folder)
        (folder / "seen.json").write_text(text, encoding="utf-8")

    folder = once(tmp_path_factory, "work", use)
    found: dict[str, Any] = json.loads((folder / "seen.json").read_text(encoding="utf-8"))
    return found


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


def test_seeds_are_those_of_the_command_line(seen: dict[str, Any]) -> None:
    most = str(2**63 - 1)
    accepted = ["99999999999", most, most, most, "1000"]
    assert seen["seeds"] == ["7 7", *(f"{seed} {seed}" for seed in accepted)]


def test_values_of_fields_are_cut(seen: dict[str, Any]) -> None:
    assert seen["field"] > 0


def test_keys(seen: dict[str, Any]) -> None:
    assert (seen["spaceRuns"], seen["spacePauses"]) == (True, True)
    assert [one for one in seen["problems"] if "status of 500" not in one] == []
