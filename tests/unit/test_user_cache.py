"""The cache folder is private to its user, or it is not used."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest

from powderdsl.system.writing import cache_folder, check_private


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def test_folders_are_made_private_whatever_the_mask() -> None:
    before = os.umask(0)
    try:
        folder = cache_folder("things")
    finally:
        os.umask(before)
    assert [stat.S_IMODE(place.stat().st_mode) for place in (folder, folder.parent)] == [0o700, 0o700]


@pytest.mark.parametrize("mode", [0o770, 0o707, 0o777])
@pytest.mark.parametrize("which", ["folder", "its parent"])
def test_a_folder_that_others_may_write_to_is_refused(mode: int, which: str) -> None:
    folder = cache_folder("things")
    (folder if which == "folder" else folder.parent).chmod(mode)
    with pytest.raises(PermissionError, match="others may write"):
        cache_folder("things")


def test_folders_and_links_of_somebody_else_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = cache_folder("things")
    monkeypatch.setattr(os, "getuid", lambda: folder.stat().st_uid + 1)
    with pytest.raises(PermissionError, match="another user"):
        cache_folder("things")
    (tmp_path / "link").symlink_to("/")
    monkeypatch.setattr(os, "getuid", lambda: 0)
    if folder.stat().st_uid:  # whoever owns a link may turn it elsewhere
        with pytest.raises(PermissionError, match="another user"):
            check_private(tmp_path / "link")


def test_no_home_folder_is_an_ordinary_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def homeless() -> Path:
        raise RuntimeError("no home")

    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(Path, "home", homeless)
    with pytest.raises(OSError, match="no home"):
        cache_folder("things")
