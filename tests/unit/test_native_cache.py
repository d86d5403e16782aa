"""The cache of compiled code: damage, eviction, writers at the same time, writers that are killed. No C++ is compiled.

Compilers here are shell scripts that copy their source to where the library should be.
"""

from __future__ import annotations

import os
import platform
import re
import signal
import subprocess
import sys
import threading
import time
from datetime import datetime, timedelta
from pathlib import Path
from unittest.mock import Mock

import pytest
from filelock import FileLock

from powderdsl.system import cache
from powderdsl.system.writing import MARK, cache_folder, scratch_folder
from powderdsl.targets.cpp import build as cpp_build
from powderdsl.targets.cpp.build import (
    Building,
    Compiler,
    NoCompiler,
    Source,
    build,
    building,
    find_compiler,
    flags_for,
    run_compilers,
)
from powderdsl.targets.cuda import program as cuda_program
from powderdsl.targets.cuda.source import KernelSource
from powderdsl.targets.layout import Layout
from tests.cli.commands import environment_with, powderdsl
from tests.processes import alive, waited


def put(folder: Path, key: str, data: bytes, used: float | None = None) -> Path:
    """A library in the cache, used that many seconds ago."""
    library = cache.add(folder, key, data, "core+yard")
    if used is not None:
        os.utime(library, (time.time() - used,) * 2)
    return library


def names(folder: Path) -> set[str]:
    """The files in the cache, and the other contents of its folder."""
    homes = [path for path in folder.iterdir() if path.is_dir() and cache.HOME.fullmatch(path.name)]
    return {path.name for place in (folder, *homes) for path in place.iterdir() if path not in homes}


# --- what is stored


def test_a_library_is_found_with_its_name(tmp_path: Path) -> None:
    a, b = put(tmp_path, "a", b"code", used=100), put(tmp_path, "b", b"more code", used=50)
    assert [entry.path for entry in cache.entries(tmp_path)] == [b, a]
    assert cache.find(tmp_path, "a") == a
    first, second = cache.entries(tmp_path)  # a has just been used
    assert (first.path, first.name, first.size) == (a, "core+yard", 4)
    assert (second.path, second.name, second.size) == (b, "core+yard", 9)
    assert cache.find(tmp_path, "c") is None


@pytest.mark.parametrize(
    "damage",
    [
        lambda path: path.write_bytes(b"cod"),
        lambda path: path.write_bytes(b"code" + bytes(1)),
        lambda path: path.write_bytes(b"COde"),
        lambda path: path.unlink(),
        lambda path: path.rename(path.with_name(f"a-{'0' * 64}-yard")),
        lambda path: path.rename(path.with_name("a-yard")),
    ],
    ids=["short", "long", "changed", "gone", "another digest", "no digest"],
)
def test_a_damaged_library_counts_as_absent_and_is_replaced(tmp_path: Path, damage: object) -> None:
    damage(put(tmp_path, "a", b"code"))  # type: ignore[operator]
    assert cache.find(tmp_path, "a") is None
    cache.entries(tmp_path)
    library = put(tmp_path, "a", b"code")
    assert cache.find(tmp_path, "a") == library
    assert names(tmp_path) == {library.name}


def test_beyond_the_limit_the_least_recently_used_go(tmp_path: Path) -> None:
    a, _, _, d = (put(tmp_path, key, bytes(100), used=1000 - i) for i, key in enumerate("abcd"))
    cache.find(tmp_path, "a")
    cache.tidy(tmp_path, limit=200)
    assert names(tmp_path) == {a.name, d.name}
    cache.tidy(tmp_path, limit=50, keep=d)  # what was just made stays, even if it is too much
    assert names(tmp_path) == {d.name}


def test_only_leftovers_of_killed_processes_are_removed(tmp_path: Path) -> None:
    library = put(tmp_path, "a", b"code")
    (tmp_path / ".powderdsl-0123456789abcdef").mkdir()
    (tmp_path / ".powderdsl-0123456789abcdef" / "program.cpp").touch()
    (tmp_path / "a.lock").touch()
    for place in tmp_path.iterdir():
        os.utime(place, (time.time() - 2 * cache.UNUSED,) * 2)
    with scratch_folder(tmp_path) as mine, FileLock(tmp_path / "b.lock"):
        cache.tidy(tmp_path)
        assert names(tmp_path) == {library.name, mine.name, "b.lock"}


def test_a_cache_that_cannot_be_written_still_serves(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    library = put(tmp_path, "a", b"code")

    def refuse(*args: object) -> None:
        raise PermissionError

    monkeypatch.setattr(os, "utime", refuse)
    assert cache.find(tmp_path, "a") == library


def test_a_library_that_others_may_load_is_not_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    library = put(tmp_path, "a", b"code")
    monkeypatch.setattr(Path, "unlink", None)
    assert put(tmp_path, "a", b"code") == library


def test_scratch_folders_that_vanish_do_not_stop_anyone(tmp_path: Path) -> None:
    put(tmp_path, "a", b"code")
    done = threading.Event()

    def build_and_remove() -> None:
        while not done.is_set():
            with scratch_folder(tmp_path):
                pass

    others = [threading.Thread(target=build_and_remove) for _ in range(2)]
    for other in others:
        other.start()
    try:
        assert all(len(cache.entries(tmp_path)) == 1 for _ in range(200))
    finally:
        done.set()


# --- compilers


def fake(folder: Path, name: str, version: str, body: str = 'cp "${@: -1}" "$out"') -> Path:
    """A compiler: answers --version, notes down its arguments, then runs the body with the library's path in $out."""
    path = folder / name
    path.write_text(
        "#!/bin/bash\n"
        f'if [ "${{@: -1}}" = --version ]; then echo "{version}"; exit; fi\n'
        f'echo "$$ $@" >> {folder}/calls\n'
        'while [ "$1" != -o ]; do shift; done; out=$2\n'
        f"{body}\n"
    )
    path.chmod(0o755)
    return path


def calls(folder: Path) -> list[str]:
    path = folder / "calls"
    return path.read_text().splitlines() if path.exists() else []


@pytest.mark.parametrize(
    ("version", "family"),
    [
        ("g++ (Debian 12.2.0-14) 12.2.0", "gcc"),
        ("Ubuntu clang version 18.1.3", "clang"),
        ("Apple clang version 15.0.0", "clang"),
    ],
)
def test_each_compiler_gets_flags_that_it_takes(
    version: str, family: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CXX", str(fake(tmp_path, "cxx", version)))
    compiler = find_compiler()
    assert (compiler.family, compiler.version) == (family, version)
    with building(Building("-O1", tmp_path)):
        (library,) = build(Source("// source\n", "yard"))
    assert library.read_text() == "// source\n"
    (call,) = calls(tmp_path)
    flags = set(call.split())
    assert {"-O1", "-ffp-contract=off", "-fno-trapping-math"} <= flags
    assert not flags & {"-O2", "-ffast-math", "-Ofast"}


@pytest.mark.parametrize(
    ("machine", "features", "march", "wide"),
    [
        ("x86_64", "flags: sse2 avx512f", "-march=native", True),
        ("x86_64", "flags: sse2 avx2", "-march=native", False),
        ("aarch64", "Features: asimd", "-mcpu=native", False),
        ("arm64", "arm64 arm", "-mcpu=native", False),
    ],
)
def test_flags_follow_the_processor(
    machine: str, features: str, march: str, wide: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(platform, "machine", lambda: machine)
    monkeypatch.setattr(cpp_build, "processor", lambda: features)
    for family in ("gcc", "clang", "zig"):
        flags = flags_for(Compiler(("x",), family, ""), "-O2")
        assert march in flags
        assert ("-mprefer-vector-width=512" in flags) == wide
        assert ("-fno-sanitize=undefined" in flags) == (family == "zig")
        assert ("-fno-gcse" in flags) == ("-fno-tree-pre" in flags) == (family == "gcc")
        assert ("-fno-slp-vectorize" in flags) == (family != "gcc")


def test_the_variable_cxx_is_obeyed_or_complained_about(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for wanted in ("no-such-compiler", "'", "false", str(tmp_path)):
        monkeypatch.setenv("CXX", wanted)
        with pytest.raises(NoCompiler, match="CXX is"):
            find_compiler()
    wrapper = tmp_path / "with spaces"
    wrapper.mkdir()
    monkeypatch.setenv("CXX", f"'{fake(wrapper, 'cc', 'g++ 1')}' -pipe")
    assert find_compiler().command[-1] == "-pipe"


def test_without_a_compiler_all_that_were_tried_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr("powderdsl.targets.cpp.build.find_spec", lambda name: None)
    with pytest.raises(NoCompiler, match=r"tried g\+\+, c\+\+, clang\+\+, the package ziglang"):
        find_compiler()
    fake(tmp_path, "clang++", "clang version 9")
    assert find_compiler().command == ("clang++",)  # installed meanwhile


def test_another_compiler_source_or_level_is_another_library(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    libraries = set()
    for version in ("g++ 1", "g++ 2"):
        monkeypatch.setenv("CXX", str(fake(tmp_path, f"cc{version[-1]}", version)))
        for level in ("-O1", "-O2"):
            with building(Building(level, tmp_path)):
                libraries |= {
                    *build(*(Source(f"// {name}\n", name) for name in "ab")),
                    *build(Source("// a\n", "a")),
                }
    assert len(libraries) == len(calls(tmp_path)) == 8


def test_units_are_compiled_side_by_side(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.cpu_count", lambda: 2)
    both = f"echo x >> {tmp_path}/there; while [ $(wc -l < {tmp_path}/there) = 1 ]; do sleep 0.1; done"
    monkeypatch.setenv("CXX", str(fake(tmp_path, "cxx", "g++ 1", f'{both}; cp "${{@: -1}}" "$out"')))
    with building(Building("-O0", tmp_path)):
        (library,) = build(Source("// source\n", "yard", units=2))
        assert library.read_text() == "// source\n"
        found = calls(tmp_path)
        assert sorted(re.findall("-DUNIT=.", " ".join(found))) == ["-DUNIT=0", "-DUNIT=1"]
        assert " -c " not in found[2]
        monkeypatch.setattr("os.cpu_count", lambda: 1)
        build(Source("// other\n", "yard", units=2))
        assert len(calls(tmp_path)) == 4


def test_a_compiler_that_fails_is_quoted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    body = "echo program.cpp:1: bad >&2; exit 3"
    monkeypatch.setenv("CXX", str(fake(tmp_path, "cxx", "g++ 1", body)))
    with building(Building("-O0", tmp_path)), pytest.raises(NoCompiler, match=r"failed:\nprogram.cpp:1: bad"):
        build(Source("// source\n", "yard"))
    assert not [name for name in names(tmp_path) if MARK in name]


# --- processes

BUILD = """
import sys
from pathlib import Path
from powderdsl.targets.cpp.build import Building, Source, build, building
with building(Building("-O0", Path(sys.argv[1]))):
    print(build(Source("// source\\n", "yard"))[0].read_text())
"""


def start(folder: Path, compiler: Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", BUILD, str(folder)],
        env=environment_with(CXX=str(compiler)),
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )


def test_processes_that_want_the_same_compile_it_once(tmp_path: Path) -> None:
    compiler = fake(tmp_path, "cxx", "g++ 1", 'sleep 1; cp "${@: -1}" "$out"')
    running = [start(tmp_path, compiler) for _ in range(5)]
    assert {process.communicate(timeout=120)[0] for process in running} == {"// source\n\n"}
    assert len(calls(tmp_path)) == 1


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for processes in /proc")
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
def test_a_killed_builder_harms_nobody(tmp_path: Path, how: int) -> None:
    # As compilers do, this one starts another process that does the work.
    slow = fake(tmp_path, "cxx", "g++ 1", f"sleep 1000 & echo $! >> {tmp_path}/workers; wait")
    first = start(tmp_path, slow)
    assert waited(lambda: (tmp_path / "workers").exists() and (tmp_path / "workers").read_text())
    second = start(tmp_path, slow)  # waits for the first one's lock
    worker, compiler = int((tmp_path / "workers").read_text()), int(calls(tmp_path)[0].split()[0])
    assert alive(worker)
    assert alive(compiler)
    fake(tmp_path, "cxx", "g++ 1")
    first.send_signal(how)
    first.communicate(timeout=240)
    if how == signal.SIGINT:
        assert waited(lambda: not alive(worker) and not alive(compiler))
    else:  # the compiler of a killed process works to its end
        os.killpg(compiler, signal.SIGKILL)
    assert second.communicate(timeout=240)[0] == "// source\n\n"
    assert len(calls(tmp_path)) == 2


def output_of(program: str, folder: Path) -> str:
    command = [sys.executable, "-W", "ignore", "-c", program, str(folder)]
    options = {"env": environment_with(), "capture_output": True, "text": True, "timeout": 60, "check": True}
    return str(subprocess.run(command, **options).stdout)  # type: ignore[call-overload]


def test_a_process_that_exits_ends_its_compilers(tmp_path: Path) -> None:
    program = """
import sys, threading, time
from pathlib import Path
from powderdsl.targets.cpp.build import _running, run_compilers
threading.Thread(target=run_compilers, args=(Path(sys.argv[1]), ["sleep", "1000"]), daemon=True).start()
time.sleep(1)
print(*(process.pid for process in _running))
"""
    pid = int(output_of(program, tmp_path))
    assert waited(lambda: not alive(pid), 5)


def test_a_fork_that_ends_does_not_end_its_parents_compiler(tmp_path: Path) -> None:
    program = """
import os, sys, threading, time
from pathlib import Path
from powderdsl.targets.cpp.build import run_compilers
scratch = Path(sys.argv[1])
found = []
thread = threading.Thread(target=lambda: found.append(run_compilers(scratch, ["sleep", "2"])))
thread.start()
time.sleep(0.5)
pid = os.fork()
if pid == 0:
    sys.exit(0)
os.waitpid(pid, 0)
thread.join()
print(found)
"""
    assert output_of(program, tmp_path) == "[(0, '')]\n"


def test_what_cannot_be_run_says_so(tmp_path: Path) -> None:
    with pytest.raises(NoCompiler, match="nothing"):
        run_compilers(tmp_path, ["sleep", "60"], [str(tmp_path / "nothing")])


# --- powderdsl cache


def test_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    folder = cache.compiled_folder()
    assert powderdsl("cache", "path").stdout == f"{folder}\n"
    assert powderdsl("cache", "list").stdout == ""
    put(folder, "0123456789abcdef", bytes(1 << 21), used=3 * 86400)
    put(folder, "fedcba", bytes(10))
    listed = powderdsl("cache", "list")
    heading, newest, oldest = (line.split() for line in listed.stdout.splitlines())
    assert heading == ["code", "of", "size", "last", "used"]
    assert newest[:3] == ["core+yard", "0.0", "MB"]
    assert oldest[:3] == ["core+yard", "2.1", "MB"]
    assert datetime.strptime(" ".join(oldest[3:]), "%Y-%m-%d %H:%M") < datetime.now() - timedelta(days=2)
    assert "2 files, 2.1 MB" in listed.stderr
    assert "removed 2 files, 2.1 MB" in powderdsl("cache", "clear").stderr
    assert not names(folder)
    folder.chmod(0o777)
    assert "others may write" in powderdsl("cache", "list", exits=2).stderr


def test_fused_code_is_one_line_and_cleared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    folder = cache_folder("inductor")
    for name in ("ab/kernel.cpp", "fxgraph/cd/graph"):
        (folder / name).parent.mkdir(parents=True)
        (folder / name).write_bytes(bytes(1 << 20))
    os.utime(folder, (0, 0))
    put(cache.compiled_folder(), "fedcba", bytes(10))
    listed = powderdsl("cache", "list")
    assert [line.split()[:3] for line in listed.stdout.splitlines()[1:]] == [
        ["core+yard", "0.0", "MB"],
        ["torch-fused", "2.1", "MB"],
    ]
    assert "1970-01-01" in listed.stdout
    assert "removed 2 files, 2.1 MB" in powderdsl("cache", "clear").stderr
    assert not folder.exists()
    assert "no files" in powderdsl("cache", "list").stderr


def test_kernels_for_gpus_lie_there_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No GPU is needed: the compiler's version and what it compiles are made up."""
    compile_text = Mock(side_effect=lambda compiler, text, options: text.encode())
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(cuda_program, "nvrtc", Mock())
    monkeypatch.setattr(cache, "QUICK", -1)
    monkeypatch.setattr(cuda_program, "compile_text", compile_text)
    a, b = (
        KernelSource("rules", text, Layout(), group=1, threads=32, shared=0, scratch=0) for text in ("a", "b")
    )
    wanted = [(a, "sm_90"), (a, "sm_80"), (a, "sm_90"), (b, "sm_90")]
    assert [cuda_program.machine_code(*one, "13.0") for one in wanted] == [b"a", b"a", b"a", b"b"]
    assert [call.args[1] for call in compile_text.call_args_list] == ["a", "a", "b"]
    found = cache.entries(cache.compiled_folder())
    assert [entry.name for entry in found] == ["rules.cuda"] * 3
