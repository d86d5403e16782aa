"""Files from strangers are read within bounds, and paths that they name stay in their folders."""

from __future__ import annotations

import os
import re
import socket
from pathlib import Path

import pytest

import powderdsl
from powderdsl.compiler import split_names
from powderdsl.system.reading import check_links, inside, parse_json, read_bytes, read_json
from powderdsl.system.writing import replacing
from tests.cli.commands import PACK
from tests.cli.commands import powderdsl as command
from tests.refusals import refused_codes


def irregular(folder: Path, suffix: str) -> dict[str, Path]:
    """Things that are not files, by what they are."""
    places = {kind: folder / f"{kind}{suffix}" for kind in ("pipe", "folder", "device", "socket")}
    os.mkfifo(places["pipe"])
    places["folder"].mkdir()
    places["device"].symlink_to("/dev/zero")
    with socket.socket(socket.AF_UNIX) as one:
        one.bind(str(places["socket"]))
    return places


def test_only_regular_files_are_read(tmp_path):
    for path in irregular(tmp_path, "").values():
        with pytest.raises(OSError, match="not a regular file"):
            read_bytes(path, 100)
    with pytest.raises(OSError, match="NUL"):
        read_bytes("a\0b", 100)


def test_no_more_than_the_limit_is_read(tmp_path):
    (tmp_path / "x").write_bytes(b"x" * 100)
    assert len(read_bytes(tmp_path / "x", 100)) == 100
    with pytest.raises(OSError, match="more than 99 bytes"):
        read_bytes(tmp_path / "x", 99)
    with pytest.raises(OSError, match="more than 10 bytes"):
        read_bytes("/proc/self/status", 10)  # says that it has 0


@pytest.mark.parametrize(
    ("words", "suffix"),
    [
        (("check",), ".yaml"),
        (("show",), ".yaml"),
        (("train",), ".yaml"),
        (("study",), ".yaml"),
        (("run", "core", "--world"), ".yaml"),
        (("run", "core", "--world"), ".txt"),
        (("run", "core", "--world"), ".png"),
        (("fuzz", "--replay"), ".yaml"),
        (("test", "core", "--replay"), ".yaml"),
    ],
)
def test_every_command_refuses_what_is_not_a_regular_file(words, suffix, tmp_path):
    for path in irregular(tmp_path, suffix).values():
        result = command(*words, path, exits=2)
        assert re.search("it is not a regular file|is a (folder|directory)", result.output)
        assert "no file" not in result.output


def test_json_has_a_bounded_number_of_values(tmp_path):
    with pytest.raises(ValueError, match="values"):
        parse_json(b"[" + b"[]," * 1000 + b"[]]", values=1000)
    with pytest.raises(ValueError, match="deep"):
        parse_json(b"[" * 200_000 + b"]" * 200_000)
    assert parse_json(b'{"a": [1, 2]}') == {"a": [1, 2]}
    assert read_json(tmp_path) is None


def test_paths_stay_in_their_folder(tmp_path):
    home = tmp_path / "home"
    home.mkdir()
    for name, target in {"out": tmp_path, "out2": "/etc/passwd", "loop": "loop", "in": home / "sub"}.items():
        (home / name).symlink_to(target)
    outside = ("/etc/passwd", "../x", "a/..", "..", "~root/x", "C:x", "..\\x", "out/x", "out2", "loop")
    for name in (*outside, "", " ", "a\0b", "a\nb"):
        with pytest.raises(ValueError, match=r"\w"):
            inside(home, name)
    for name in ("x.yaml", "a/b.yaml", "./x", "a b", "..x", "x..", "in/x", "ünï"):
        assert inside(home, name) == home / name


def test_links_that_lead_out_of_a_folder(tmp_path):
    home = tmp_path / "home"
    (home / "deep").mkdir(parents=True)
    (home / "deep" / "here").symlink_to("../deep")
    check_links(home)
    (home / "deep" / "there").symlink_to(tmp_path)
    with pytest.raises(OSError, match="leads out"):
        check_links(home)
    # The folder itself may be a link: the user named it.
    (tmp_path / "alias").symlink_to(home / "deep" / "here")
    (home / "deep" / "there").unlink()
    check_links(tmp_path / "alias")


def test_a_ruleset_reads_packs_of_its_own_folder_alone(folder):
    (folder / "home").mkdir()
    (folder / "secret").write_text(PACK)
    (folder / "home" / "grit.yaml").symlink_to("../secret")
    for name, code in (("grit", "PD112"), ("secret", "PD304")):
        (folder / "home" / "r.yaml").write_text(f"ruleset: r\npacks: [core, {name}]\n")
        assert refused_codes(powderdsl.load, "home/r.yaml") == [code]


def test_files_with_a_plus_in_their_path_can_be_named(folder):
    (folder / "a+b-c").mkdir()
    path = "a+b-c/g+r.yaml"
    (folder / path).write_text(PACK)
    assert split_names(f"core+{path}") == (["core", path], [])
    assert split_names(f"{path}+core+{path}") == ([path, "core", path], [])
    assert split_names(f"core+{path}-sand") == (["core", path], ["sand"])
    assert split_names("powderworld-gas+x.yaml-sand-acid") == (
        ["powderworld", "x.yaml"],
        ["gas", "sand", "acid"],
    )
    assert powderdsl.load(f"core+{path}").packs == ("core", "grit")
    command("check", f"core+{folder / path}", exits=0)


def test_a_link_stays_a_link_and_its_target_is_written(tmp_path):
    (tmp_path / "far").mkdir()
    (tmp_path / "far" / "x.txt").write_text("old")
    (tmp_path / "x.txt").symlink_to("far/x.txt")
    with replacing(tmp_path / "x.txt", follow=True) as temporary:
        temporary.write_text("new")
    assert (tmp_path / "x.txt").is_symlink()
    assert (tmp_path / "far" / "x.txt").read_text() == "new"
    (tmp_path / "y.wasm").symlink_to("far/new.wasm")  # which is not there yet
    command("export", "core", "--out", tmp_path / "y.wasm", exits=0)
    assert (tmp_path / "far" / "new.wasm").read_bytes()
    assert (tmp_path / "y.wasm").is_symlink()


def test_nothing_but_files_is_replaced(tmp_path):
    for path in irregular(tmp_path, ".wasm").values():
        result = command("export", "core", "--out", path, exits=2)
        assert "PD613" in result.stderr
        assert "it is not a regular file" in result.output
        assert not path.is_file()
    (tmp_path / "x.wasm").symlink_to("x.wasm")
    command("export", "core", "--out", tmp_path / "x.wasm", exits=2)
