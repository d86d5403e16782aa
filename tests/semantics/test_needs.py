"""Packs that others need are loaded with them."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

import powderdsl
from powderdsl.compiler import load_with_diagnostics
from powderdsl.diagnostics import CompileError
from powderdsl.system.settings import fingerprint
from tests.cli.commands import powderdsl as run

SEED = 'pack: seed\nneeds: [core, loam]\nelements:\n  seed: {id: 40, color: "#112233"}\n'
LOAM = 'pack: loam\nneeds: sand\nelements:\n  loam: {id: 41, color: "#332211"}\n'


@pytest.fixture(autouse=True)
def packs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "packs"
    folder.mkdir()
    monkeypatch.chdir(tmp_path)
    (folder / "seed.yaml").write_text(SEED)
    (folder / "loam.yaml").write_text(LOAM)
    return folder


def test_needs_come_from_the_folder_of_the_pack_or_are_shipped() -> None:
    alone = powderdsl.load("packs/seed.yaml")
    assert set(alone.packs) == {"core", "sand", "loam", "seed"}
    named = powderdsl.load("core+sand+packs/loam.yaml+packs/seed.yaml")
    assert fingerprint(alone) == fingerprint(named)
    assert "core+sand+loam+seed: 5 elements" in run("check", "packs/seed.yaml").stdout


def test_a_pack_that_stands_in_for_another_is_enough() -> None:
    assert "core" not in powderdsl.load("core2+packs/seed.yaml").packs


def test_what_is_left_out_is_not_loaded_again() -> None:
    with pytest.raises(CompileError, match="PD305") as caught:
        powderdsl.load("powderworld-sand+packs/seed.yaml")
    assert "also leave out the packs that need it: `-loam`" in str(caught.value)


def test_a_pack_that_nobody_has_is_missing(packs: Path) -> None:
    (packs / "loam.yaml").write_text("pack: another\nneeds: core\n")
    with pytest.raises(CompileError, match="PD305") as caught:
        powderdsl.load("packs/seed.yaml")
    assert "put `loam.yaml` into the folder of `packs/seed.yaml`" in str(caught.value)


def test_links_do_not_lead_out_of_the_folder(packs: Path, tmp_path: Path) -> None:
    (packs / "loam.yaml").rename(tmp_path / "loam.yaml")
    os.symlink(tmp_path / "loam.yaml", packs / "loam.yaml")
    with pytest.raises(CompileError, match="PD112"):
        powderdsl.load("packs/seed.yaml")


def test_a_file_here_is_suggested_for_an_unknown_name(packs: Path, tmp_path: Path) -> None:
    (packs / "seed.yaml").rename(tmp_path / "seed.yaml")
    assert "did you mean the file `seed.yaml`?" in run("check", "core+seed", exits=2).stdout


@pytest.mark.parametrize(
    ("rule", "warned"),
    [
        ("loam -> empty if count(water) > 0", ["water"]),
        ("loam -> empty if count(water?) > 0", []),
        ("loam -> seed if fire", ["seed", "fire"]),
        ("loam -> wall if sand and above.momentum > 0", []),  # of packs that a pack needs needs
        ("loam -> empty if above.velocity?.row > 1", []),
    ],
)
def test_a_name_of_a_pack_that_is_not_needed_is_a_warning(packs: Path, rule: str, warned: list[str]) -> None:
    (packs / "loam.yaml").write_text(f"{LOAM}passes:\n  crumble:\n    do: {rule}\n")
    _, remarks = load_with_diagnostics("powderworld+packs/seed.yaml+packs/loam.yaml")
    warnings = [remark for remark in remarks if remark.code == "PD319"]
    assert [warning.primary.span.text for warning in warnings] == warned
    assert all("add `" in warning.helps[0] and "?`" in warning.helps[0] for warning in warnings)


def test_packs_joined_by_commas_and_names_of_shipped_packs_have_a_fix() -> None:
    assert "packs are joined by `+`: `core+sand`" in run("check", "core,sand", exits=2).stdout
    Path("oil.yaml").write_text(LOAM + "passes:\n  burn:\n    do: loam -> empty if count(fire) > 0\n")
    told = run("check", "oil.yaml", exits=2).stdout
    assert "the pack `fire` defines it: add it to `needs`, or write `fire?`" in told
