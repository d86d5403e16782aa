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
    os.mkfifo(folder / f"pipe{suffix}")
    (folder / f"folder{suffix}").mkdir()
    (folder / f"link{suffix}").symlink_to("/dev/zero")
    with socket.socket(socket.AF_UNIX) as one:
        one.bind(str(folder / f"s{suffix}"))
    return {
        "pipe": folder / f"pipe{suffix}",
        "folder": folder / f"folder{suffix}",
        "device": folder / f"link{suffix}",
        "socket": folder / f"s{suffix}",
    }


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


@pytest.mark.parametrize("kind", ["pipe", "folder", "device", "socket"])
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
def test_every_command_refuses_what_is_not_a_regular_file(words, suffix, kind, tmp_path):
    result = command(*words, irregular(tmp_path, suffix)[kind], exits=2)
    assert re.search("it is not a regular file|is a (folder|directory)", result.output)
    assert "no file" not in result.output


def test_json_has_a_bounded_number_of_values(tmp_path):
    with pytest.raises(ValueError, match="values"):
        parse_json(b"[" + b"[]," * 1000 + b"[]]", values=1000)
    with pytest.raises(ValueError, match="deep"):
        parse_json(b"[" * 200_000 + b"]" * 200_000)
    assert parse_json(b'{"a": [1, 2]}') == {"a": [1, 2]}
    assert read_json(tmp_path) is None


@pytest.mark.parametrize(
    "name",
    [
        "/etc/passwd",
        "../x",
        "a/..",
        "..",
        "",
        " ",
        "~root/x",
        "a\0b",
        "a\nb",
        "C:x",
        "..\\x",
        "out/x",
        "out2",
        "loop",
    ],
)
def test_a_path_that_leads_elsewhere(name, tmp_path):
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "out").symlink_to(tmp_path)
    (tmp_path / "home" / "out2").symlink_to("/etc/passwd")
    (tmp_path / "home" / "loop").symlink_to("loop")
    with pytest.raises(ValueError, match=r"\w"):
        inside(tmp_path / "home", name)


def test_a_path_that_stays(tmp_path):
    (tmp_path / "in").symlink_to(tmp_path / "sub")
    for name in ("x.yaml", "a/b.yaml", "./x", "a b", "..x", "x..", "in/x", "ünï"):
        assert inside(tmp_path, name) == tmp_path / name


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


def test_a_pack_beside_a_ruleset_is_no_link_out(tmp_path):
    (tmp_path / "home").mkdir()
    (tmp_path / "secret.yaml").write_text(PACK)
    (tmp_path / "home" / "grit.yaml").symlink_to("../secret.yaml")
    (tmp_path / "home" / "r.yaml").write_text("ruleset: r\npacks: [core, grit]\n")
    assert refused_codes(powderdsl.load, tmp_path / "home" / "r.yaml") == ["PD112"]


def test_a_ruleset_reads_nothing_of_the_working_directory(folder):
    (folder / "home").mkdir()
    (folder / "secret").write_text("pack: secret\n")
    (folder / "home" / "r.yaml").write_text("ruleset: r\npacks: [core, secret]\n")
    assert refused_codes(powderdsl.load, "home/r.yaml") == ["PD304"]


# Names with a `+`


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


# Writing


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


@pytest.mark.parametrize("kind", ["pipe", "folder", "device", "socket"])
def test_nothing_but_files_is_replaced(kind, tmp_path):
    path = irregular(tmp_path, ".wasm")[kind]
    result = command("export", "core", "--out", path, exits=2)
    assert "PD613" in result.stderr
    assert "it is not a regular file" in result.output
    assert not path.is_file()


def test_a_loop_of_links_is_not_written(tmp_path):
    (tmp_path / "x.wasm").symlink_to("x.wasm")
    command("export", "core", "--out", tmp_path / "x.wasm", exits=2)
