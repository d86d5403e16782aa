"""Compiles generated C++ and loads the result: one shared library per source, compiler and set of flags."""

from __future__ import annotations

import atexit
import ctypes
import hashlib
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryFile

from powderdsl.system.interrupts import held_back
from powderdsl.system.user_cache import cache_folder
from powderdsl.system.writing import scratch_folder
from powderdsl.targets import cache
from powderdsl.targets.cpp.compilers import Compiler, NoCompiler, find_compiler, flags_for, processor

TIMEOUT = 600


@dataclass(frozen=True)
class Building:
    """The optimization level (`-O0` to `-O3`) and the folder for libraries; None is the user's cache."""

    level: str = "-O2"
    folder: Path | None = None

    def place(self) -> Path:
        """The folder. Raises NoCompiler if no folder is private to the user."""
        try:
            return self.folder or cache_folder("native")
        except OSError as error:
            raise NoCompiler(f"no folder for compiled code: {error}") from None


FOR_USERS = Building()
_building: ContextVar[Building] = ContextVar("building", default=FOR_USERS)


@contextmanager
def building(how: Building) -> Iterator[None]:
    """Use other settings inside the block: tests of thousands of rulesets need neither -O2 nor the user's cache."""
    token = _building.set(how)
    try:
        yield
    finally:
        _building.reset(token)


def current() -> Building:
    """The settings in effect."""
    return _building.get()


def cache_key(source: str, compiler: Compiler, flags: tuple[str, ...]) -> str:
    """A hash of everything on which a library depends."""
    program = shutil.which(compiler.command[0]) or ""
    parts = (source, os.path.realpath(program), *compiler.command, compiler.version, *flags, processor())
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:32]


def build(source: str, ruleset: str = "", units: int = 1) -> Path:
    """The path of the library for a source, compiled unless it is in the cache.

    Safe with other processes and threads doing the same: one of them compiles, and the library is added atomically. A
    damaged library is compiled again.

    Args:
        ruleset: a name for `powderdsl cache list`. units: the parts of the source that are compiled side by side, if this
            machine can: each where UNIT is its number.

    Raises:
        NoCompiler: none was found, or it failed.
    """
    compiler, how = find_compiler(), current()
    flags, folder = flags_for(compiler, how.level), how.place()
    key = cache_key(source, compiler, flags)
    found = cache.find(folder, key)
    if found is not None:
        return found
    with cache.turn(folder, key):
        try:
            return cache.find(folder, key) or _compile(source, units, ruleset, compiler, flags, folder, key)
        except OSError as error:
            raise NoCompiler(f"no room for compiled code: {error}") from None


def _compile(
    source: str, units: int, ruleset: str, compiler: Compiler, flags: tuple[str, ...], folder: Path, key: str
) -> Path:
    with scratch_folder(folder) as scratch:
        text, library = scratch / "program.cpp", scratch / "library"
        text.write_text(source, encoding="utf-8")
        command = [*compiler.command, *flags]
        if units == 1 or os.cpu_count() == 1:
            _call([[*command, "-o", str(library), str(text)]], scratch)
        else:
            objects = [str(scratch / f"{unit}.o") for unit in range(units)]
            _call(
                [
                    [*command, "-c", f"-DUNIT={unit}", "-o", name, str(text)]
                    for unit, name in enumerate(objects)
                ],
                scratch,
            )
            _call([[*command, "-o", str(library), *objects]], scratch)
        code = library.read_bytes()
    return cache.add(folder, key, code, ruleset)


def _call(commands: list[list[str]], scratch: Path) -> None:
    """Run compilers side by side. Raises NoCompiler if one fails."""
    status, said = run_compilers(scratch, *commands)
    if status:
        raise NoCompiler("\n".join([f"{commands[0][0]} failed:", *said.splitlines()[:8]]))


def run_compilers(scratch: Path, *commands: list[str]) -> tuple[int, str]:
    """Exit code and messages of compilers that run side by side. They end if this process is interrupted or exits.

    Args:
        scratch: a folder for their temporary files.

    Raises:
        NoCompiler: one cannot be started, or they take longer than TIMEOUT.
    """
    environment = {**os.environ, "TMPDIR": str(scratch), "LC_ALL": "C"}
    processes: list[subprocess.Popen[bytes]] = []
    with TemporaryFile() as messages:
        try:
            for command in commands:
                with held_back():  # a process that starts while a signal raises would be unknown to us
                    # A session of its own: g++ starts other programs, which are ended with it.
                    process = subprocess.Popen(
                        command,
                        stdin=subprocess.DEVNULL,
                        stdout=subprocess.DEVNULL,
                        stderr=messages,
                        env=environment,
                        start_new_session=True,
                    )
                    processes.append(process)
                    _running.append(process)
            end = time.monotonic() + TIMEOUT
            codes = [process.wait(max(0.0, end - time.monotonic())) for process in processes]
        except OSError as error:
            raise NoCompiler(f"{commands[0][0]} could not be run: {error}") from None
        except subprocess.TimeoutExpired:
            raise NoCompiler(f"{commands[0][0]} took longer than {TIMEOUT} s") from None
        finally:
            _end(processes)
        messages.seek(0)
        return next(filter(None, codes), 0), messages.read().decode(errors="replace")


_running: list[subprocess.Popen[bytes]] = []
"""Compilers of all threads."""


def _end(processes: Iterable[subprocess.Popen[bytes]]) -> None:
    for process in processes:
        if process.poll() is None:  # in a fork, the parent's compilers count as ended
            os.killpg(process.pid, signal.SIGTERM)
            process.wait()
        if process in _running:
            _running.remove(process)


@atexit.register
def _end_all() -> None:
    _end([*_running])


def open_library(source: str, ruleset: str = "", units: int = 1) -> tuple[Path, ctypes.CDLL]:
    """The library of a source, built if necessary: see `build`. Raises NoCompiler."""
    path = build(source, ruleset, units)
    try:
        return path, load_library(path)
    except OSError:  # another process has just removed it, or it cannot be loaded at all
        path = build(source, ruleset, units)
    try:
        return path, load_library(path)
    except OSError as error:
        raise NoCompiler(f"compiled code cannot be loaded: {error}") from None


@lru_cache(maxsize=64)
def load_library(path: Path) -> ctypes.CDLL:
    """The library, loaded once per process, with its functions declared."""
    library = ctypes.CDLL(str(path))
    pointer, integer, long = ctypes.c_void_p, ctypes.c_int, ctypes.c_int64
    signatures = {
        "pd_new": (pointer, [integer, integer, integer]),
        "pd_free": (None, [pointer]),
        "pd_copy": (pointer, [pointer]),
        "pd_load": (None, [pointer, integer, integer, integer, pointer]),
        "pd_store": (None, [pointer, integer, integer, integer, integer, pointer, long]),
        "pd_load_real": (None, [pointer, integer, pointer, long]),
        "pd_put": (None, [pointer, integer, integer, integer, integer, pointer, pointer]),
        "pd_put_real": (None, [pointer, integer, integer, pointer, pointer]),
        "pd_fill": (None, [pointer, integer, integer, pointer, pointer]),
        "pd_fill_real": (None, [pointer, integer, pointer, pointer]),
        "pd_store_real": (None, [pointer, integer, pointer, long]),
        "pd_rgb": (None, [pointer, integer, integer, pointer, pointer, long]),
        "pd_tint": (None, [pointer, integer, integer, pointer, pointer, long]),
        "pd_ramp": (None, [pointer, *[integer] * 8, pointer, pointer, pointer, long]),
        "pd_channels": (None, [pointer, integer, pointer, pointer, pointer, long]),
        "pd_planes": (None, [pointer, integer, pointer, pointer, long]),
        "pd_count": (
            None,
            [pointer, integer, pointer, integer, pointer, integer, integer, pointer, pointer],
        ),
        "pd_codes": (None, [pointer, integer, ctypes.c_float, pointer, long]),
        "pd_run": (pointer, [pointer, integer, long, integer, *[pointer] * 3, long, *[pointer] * 3]),
    }
    for name, (result, arguments) in signatures.items():
        function = getattr(library, name)
        function.restype, function.argtypes = result, arguments
    return library
