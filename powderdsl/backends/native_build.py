"""Compile generated C++ and keep the results: one shared library for each source, compiler and set of flags."""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from powderdsl.user_cache import cache_folder

FLAGS = (
    "-std=c++17", "-O2", "-march=native", "-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math",
    "-fno-strict-aliasing", "-fno-gcse", "-fno-tree-pre", "-shared", "-fPIC", "-pthread", "-fvisibility=hidden", "-w",
)  # fmt: skip
"""No contraction: a·b + c is rounded twice on every machine, so that all backends agree bit for bit."""

TIMEOUT = 600


@dataclass(frozen=True)
class Building:
    """How much the compiler optimises (`-O0` to `-O3`), and the folder for libraries: None is the user's cache."""

    level: str = "-O2"
    folder: Path | None = None

    def flags(self) -> tuple[str, ...]:
        """FLAGS at this level."""
        return tuple(self.level if flag == "-O2" else flag for flag in FLAGS)


FOR_USERS = Building()
_building: ContextVar[Building] = ContextVar("building", default=FOR_USERS)


@contextmanager
def building(how: Building) -> Iterator[None]:
    """Build so inside the block: a test of thousands of rulesets wants neither -O2 nor the user's cache."""
    token = _building.set(how)
    try:
        yield
    finally:
        _building.reset(token)


class NoCompiler(Exception):
    """No C++ compiler that works was found; the message says what was tried."""


@dataclass(frozen=True)
class Compiler:
    """A command that compiles C++, and what identifies it."""

    command: tuple[str, ...]
    version: str


@lru_cache(maxsize=1)
def find_compiler() -> Compiler:
    """`$CXX`, c++, g++, clang++, or the one in the `ziglang` wheel. Raises NoCompiler."""
    candidates: list[tuple[str, ...]] = []
    if os.environ.get("CXX"):
        candidates.append(tuple(os.environ["CXX"].split()))
    candidates += [(name,) for name in ("g++", "c++", "clang++")]
    candidates.append((sys.executable, "-m", "ziglang", "c++"))
    tried = []
    for command in candidates:
        if shutil.which(command[0]) is None:
            tried.append(command[0])
            continue
        try:
            result = subprocess.run(
                [*command, "--version"], capture_output=True, text=True, timeout=30, check=True
            )
        except (OSError, subprocess.SubprocessError):
            tried.append(" ".join(command))
            continue
        return Compiler(command, result.stdout.splitlines()[0] if result.stdout else "")
    raise NoCompiler("no C++ compiler found; tried " + ", ".join(tried))


@lru_cache(maxsize=1)
def processor() -> str:
    """What `-march=native` hangs on: the machine and its instruction sets."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next((line for line in lines if line.startswith(("flags", "Features"))), platform.machine())
    except OSError:
        return f"{platform.machine()} {platform.processor()}"


def cache_key(source: str, compiler: Compiler, flags: tuple[str, ...] = FLAGS) -> str:
    """A hash of everything that the library depends on."""
    parts = (source, *compiler.command, compiler.version, *flags, processor())
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:32]


def build(source: str, how: Building | None = None) -> Path:
    """The path of the library for a source, compiled unless it lies in the cache; `how` is else what `building` says.

    Safe with other processes doing the same: the library appears under its name whole, or not at all.

    Raises:
        NoCompiler: none was found, or it failed.
    """
    compiler = find_compiler()
    how = how or _building.get()
    flags = how.flags()
    try:
        folder = how.folder or cache_folder("native")
    except OSError as error:
        raise NoCompiler(f"no cache folder: {error}") from None
    target = folder / f"{cache_key(source, compiler, flags)}.so"
    if target.is_file():
        os.utime(target)
        return target
    with tempfile.TemporaryDirectory(dir=folder, prefix=".build-") as scratch:
        unit, library = Path(scratch) / "program.cpp", Path(scratch) / "program.so"
        unit.write_text(source, encoding="utf-8")
        command = [*compiler.command, *flags, "-o", str(library), str(unit)]
        if (
            "-march=native" in command
            and platform.machine() in ("x86_64", "AMD64")
            and "avx512f" in processor()
        ):
            command.insert(-3, "-mprefer-vector-width=512")
        try:
            result = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT)
        except (OSError, subprocess.SubprocessError) as error:
            raise NoCompiler(f"{compiler.command[0]} could not be run: {error}") from None
        if result.returncode:
            detail = "\n".join(result.stderr.splitlines()[:8])
            raise NoCompiler(f"{compiler.command[0]} failed:\n{detail}")
        os.replace(library, target)
    return target


@lru_cache(maxsize=64)
def load_library(path: Path) -> ctypes.CDLL:
    """The library, loaded once a process, its functions declared."""
    library = ctypes.CDLL(str(path))
    pointer, integer, long = ctypes.c_void_p, ctypes.c_int, ctypes.c_int64
    signatures = {
        "pd_new": (pointer, [integer, integer, integer]),
        "pd_free": (None, [pointer]),
        "pd_copy": (pointer, [pointer]),
        "pd_load": (None, [pointer, integer, integer, integer, pointer]),
        "pd_store": (None, [pointer, integer, integer, integer, integer, pointer, long]),
        "pd_load_real": (None, [pointer, integer, pointer, long]),
        "pd_store_real": (None, [pointer, integer, pointer, long]),
        "pd_rgb": (None, [pointer, integer, integer, pointer, pointer, long]),
        "pd_channels": (None, [pointer, integer, pointer, pointer, pointer, long]),
        "pd_planes": (None, [pointer, integer, pointer, pointer, long]),
        "pd_run": (None, [pointer, long, integer, pointer, pointer, pointer, pointer, pointer]),
    }
    for name, (result, arguments) in signatures.items():
        function = getattr(library, name)
        function.restype, function.argtypes = result, arguments
    if hasattr(library, "pd_profile"):  # only where it was built with clocks
        library.pd_profile.restype, library.pd_profile.argtypes = None, [pointer]
    return library


@dataclass(frozen=True)
class CachedLibrary:
    """One compiled library in the cache: bytes, and when it was used last (seconds since the epoch)."""

    name: str
    size: int
    used: float

    @property
    def age(self) -> float:
        return time.time() - self.used


def cached_libraries() -> list[CachedLibrary]:
    """What lies in the cache, the last used first."""
    found = [
        CachedLibrary(p.stem, p.stat().st_size, p.stat().st_mtime)
        for p in cache_folder("native").glob("*.so")
    ]
    return sorted(found, key=lambda entry: -entry.used)


def clear_cache() -> int:
    """Remove all compiled libraries and what killed builds left behind; returns how many libraries went."""
    folder = cache_folder("native")
    libraries = list(folder.glob("*.so"))
    for path in libraries:
        path.unlink(missing_ok=True)
    for scratch in folder.glob(".build-*"):
        shutil.rmtree(scratch, ignore_errors=True)
    return len(libraries)
