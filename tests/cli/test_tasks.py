"""`check` and `show` of tasks."""

from __future__ import annotations

import json

import numpy as np
from PIL import Image

from tests.cli.commands import powderdsl as run


def test_tasks_are_checked_beside_rules(tmp_path):
    bad = tmp_path / "bad.yaml"
    bad.write_text(
        "# A task\ntask: bad\nrules: core\nsize: [8, 8]\nfill: emty\nagent: {may: any, actions: 0}\n"
    )
    result = run("check", "sand-pushing", str(bad), "core", exits=2)
    assert "PD604" in result.output
    assert "PD402" in result.output
    assert "sand-pushing: 3 splits, no errors" in result.output
    assert "bad.yaml: 2 errors" in result.output
    assert "core: 2 elements" in result.output


def test_a_task_is_shown_as_text_and_as_json():
    text = run("show", "path-building", "--knob", "complexity=3").output
    assert "places empty, wall; 64 actions of 3 steps" in text
    assert "lines           3  0..64" in text
    data = json.loads(run("show", "sand-pushing", "--json").output)
    assert data["agent"]["choices"] == [-1]
    assert [len(split["stands"]) for split in data["splits"]] == [1, 1, 8]


def test_a_sheet_shows_worlds_and_outlines_regions(tmp_path):
    out = tmp_path / "sheet.png"
    run("show", "sand-pushing", "--split", "handmade", "--worlds", "4", "--out", str(out))
    picture = np.asarray(Image.open(out))
    assert picture.shape[0] == picture.shape[1]
    outlined = (picture == (255, 0, 160)).all(-1).sum()
    side = (picture.shape[0] - 6) // 2 // 64  # two worlds in a row, with gaps of two pixels
    assert outlined == 4 * (2 * (20 + 9) * side - 4)
