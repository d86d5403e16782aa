"""Compiles generated C++ and loads the result: one shared library per source, compiler and set of flags."""

from __future__ import annotations

import atexit
import ctypes
import hashlib
import os
import platform
import re
import shlex
import shutil
import signal
import subprocess
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryFile
from typing import NamedTuple

# Imported here, not later: a fork while another thread imports it would leave the child waiting forever.
from filelock import FileLock, Timeout

from powderdsl.system import cache
from powderdsl.system.writing import scratch_folder

INSTALL = "install g++ or clang++, or `pip install powderdsl[native]`"
"""Advice if there is no compiler."""

MISSING = "no C++ compiler"
"""The beginning of the messages of `NoCompiler` if none was found."""


class NoCompilerWarning(UserWarning):
    """Raised if the backend `auto` has work that is worth compiling, but no compiler."""


class NoCompiler(Exception):
    """Raised if no working C++ compiler was found, or it failed; the message lists the attempts."""


@dataclass(frozen=True)
class Compiler:
    """A command that compiles C++, and its identity. `family` is ``gcc``, ``clang`` or ``zig``."""

    command: tuple[str, ...]
    family: str
    version: str
    """The first line of the output of `--version`."""


def find_compiler() -> Compiler:
    """The compiler of `$CXX`; without that, the first of g++, c++, clang++ and the `ziglang` package that works.

    Raises NoCompiler if none works. If `$CXX` is set, no other compiler is tried.
    """
    cxx = os.environ.get("CXX", "").strip()
    candidates: list[tuple[str, ...]] = [("g++",), ("c++",), ("clang++",)]
    try:
        candidates = [tuple(shlex.split(cxx))] if cxx else candidates
    except ValueError as error:
        raise NoCompiler(f"{MISSING}: $CXX is `{cxx}`: {error}") from None
    package = None if cxx else find_spec("ziglang")
    if package is not None and package.origin:
        # The program itself: `python -m ziglang` would start Python once more.
        candidates.append((str(Path(package.origin).with_name("zig")), "c++"))
    for command in candidates:
        program = shutil.which(command[0])
        if program and (version := _version(command, program)):
            zig = "c++" in command[1:] and any("zig" in Path(word).name for word in command)
            return Compiler(command, "zig" if zig else "clang" if "clang" in version else "gcc", version)
    if cxx:
        raise NoCompiler(f"{MISSING}: $CXX is `{cxx}`, which cannot be run")
    tried = [*map(" ".join, candidates), *([] if package else ["the package ziglang"])]
    raise NoCompiler(f"{MISSING}: tried {', '.join(tried)}")


@lru_cache(maxsize=8)
def _version(command: tuple[str, ...], program: str) -> str:
    """The first line of `--version`; empty if the command does not run, or runs this program."""
    nothing = subprocess.DEVNULL
    try:
        output = subprocess.check_output([*command, "--version"], stdin=nothing, stderr=nothing, timeout=30)
    except (OSError, subprocess.SubprocessError):
        return ""
    return (output.decode(errors="replace").strip().splitlines() or ["unknown"])[0]


ARCHITECTURE = "POWDERDSL_ARCH"
"""The environment variable that names another processor to compile for, such as ``x86-64-v3``."""


def flags_for(compiler: Compiler, level: str) -> tuple[str, ...]:
    """The flags for a library of generated code. `level`: ``-O0`` to ``-O3``.

    Raises NoCompiler if `$POWDERDSL_ARCH` is not a name.

    Floats keep their meaning at every level: no contraction (a·b + c is rounded twice on every machine) and no fast
    mathematics, so that all backends agree bit for bit.
    """
    on_x86 = platform.machine() in ("x86_64", "AMD64", "i686")
    name = os.environ.get(ARCHITECTURE, "native")
    if not re.fullmatch(r"[A-Za-z0-9_.+-]+", name):
        raise NoCompiler(f"no C++ compiler: ${ARCHITECTURE} is `{name}`, which names no processor")
    if compiler.family == "zig":
        name = name.replace("-", "_")
    flags = ["-std=c++17", level, f"-march={name}" if on_x86 else f"-mcpu={name}"]
    flags += ["-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math", "-fno-strict-aliasing"]
    if on_x86 and ("avx512f" in processor() if name == "native" else name.endswith("v4")):
        flags.append("-mprefer-vector-width=512")
    if compiler.family == "gcc":
        # on such long functions, these two take most of the time for no benefit
        flags += ["-fno-gcse", "-fno-tree-pre"]
    else:
        flags.append("-fno-slp-vectorize")  # the code is vectorized already: a tenth faster without
    if compiler.family == "zig":
        flags.append("-fno-sanitize=undefined")  # which zig adds at -O0
    return (*flags, "-shared", "-fPIC", "-pthread", "-fvisibility=hidden", "-w")


@lru_cache(maxsize=1)
def processor() -> str:
    """The machine and its instruction sets, on which compiled code depends."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next((line for line in lines if line.startswith(("flags", "Features"))), platform.machine())
    except OSError:
        return f"{platform.machine()} {platform.processor()}"


# Libraries

TIMEOUT = 600

PATIENCE = 120.0
"""Seconds to wait for another process that compiles the same source; after that both compile."""


@dataclass(frozen=True)
class Building:
    """The optimization level (`-O0` to `-O3`) and the folder for libraries; None is the user's cache."""

    level: str = "-O2"
    folder: Path | None = None

    def place(self) -> Path:
        """The folder. Raises NoCompiler if no folder is private to the user."""
        try:
            return self.folder or cache.compiled_folder()
        except OSError as error:
            raise NoCompiler(f"no folder for compiled code: {error}") from None


FOR_USERS = Building()
_building: ContextVar[Building] = ContextVar("building", default=FOR_USERS)


@contextmanager
def building(how: Building) -> Iterator[None]:
    """Use other settings inside the block: tests of thousands of rulesets do not need -O2 or the user's cache."""
    token = _building.set(how)
    try:
        yield
    finally:
        _building.reset(token)


def current() -> Building:
    return _building.get()


@contextmanager
def turn(folder: Path, key: str) -> Iterator[None]:
    """Let one process at a time into the block, up to a time limit, so that only one compiles the same source.

    The operating system releases the lock of a process that dies. Without file locks, no process waits.
    """
    lock = FileLock(folder / f"{key}.lock")
    with suppress(OSError, NotImplementedError, Timeout):
        lock.acquire(timeout=PATIENCE)
    try:
        yield
    finally:
        lock.release()


def cache_key(source: str, compiler: Compiler, flags: tuple[str, ...]) -> str:
    """A hash of everything that a library depends on."""
    program = shutil.which(compiler.command[0]) or ""
    parts = (source, os.path.realpath(program), *compiler.command, compiler.version, *flags, processor())
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:32]


class Source(NamedTuple):
    """The text of a library, and a name for `powderdsl cache list`. Its `units` are selected by UNIT."""

    text: str
    name: str
    units: int = 1


def build(*sources: Source) -> list[Path]:
    """The paths of the libraries of sources, compiled side by side unless they are in the cache.

    Safe with other processes and threads that do the same: only one of them compiles the first source, and libraries
    are added atomically. Damaged libraries are compiled again. Raises NoCompiler if none was found, or it failed.
    """
    compiler, how = find_compiler(), current()
    flags, folder = flags_for(compiler, how.level), how.place()
    by_key = {cache_key(source.text, compiler, flags): source for source in sources}
    paths = {key: cache.find(folder, key) for key in by_key}
    if None in paths.values():
        with turn(folder, next(iter(by_key))):
            paths = {key: cache.find(folder, key) for key in by_key}
            new = [key for key, path in paths.items() if path is None]
            try:
                codes = _compile([*compiler.command, *flags], [by_key[key] for key in new], folder)
                for key, code in zip(new, codes, strict=True):
                    paths[key] = cache.add(folder, key, code, by_key[key].name)
            except OSError as error:
                raise NoCompiler(f"no room for compiled code: {error}") from None
    return [path for path in paths.values() if path is not None]


def _compile(command: list[str], sources: Sequence[Source], folder: Path) -> list[bytes]:
    """The libraries of sources, which contain the names of their files. All units are compiled side by side."""
    with scratch_folder(folder) as scratch:
        compilers, linkers, libraries = [], [], []
        for number, (text, _, units) in enumerate(sources):
            (home := scratch / f"{number}").mkdir()
            library, file = home / "library", home / "program.cpp"
            libraries.append(library)
            file.write_text(text, encoding="utf-8")
            if units == 1 or os.cpu_count() == 1:
                compilers.append([*command, "-o", str(library), str(file)])
                continue
            objects = [f"{library}-{unit}.o" for unit in range(units)]
            compilers += [
                [*command, "-c", f"-DUNIT={unit}", "-o", o, str(file)] for unit, o in enumerate(objects)
            ]
            linkers.append([*command, "-o", str(library), *objects])
        for commands in (compilers, linkers):
            status, messages = run_compilers(scratch, *commands)
            if status:
                raise NoCompiler("\n".join([f"{command[0]} failed:", *messages.splitlines()[:8]]))
        return [library.read_bytes() for library in libraries]


def run_compilers(scratch: Path, *commands: list[str]) -> tuple[int, str]:
    """Run compilers side by side; return the exit code and messages. They end if this process is interrupted or exits.

    `scratch` is a folder for temporary files. Raises NoCompiler if one cannot be started, or takes longer than TIMEOUT.
    """
    processes: list[subprocess.Popen[bytes]] = []
    with TemporaryFile() as messages:
        env, nothing = {**os.environ, "TMPDIR": str(scratch), "LC_ALL": "C"}, subprocess.DEVNULL
        try:
            for command in commands:
                # In new sessions, so that the programs that g++ starts end with it.
                process = subprocess.Popen(
                    command, stdin=nothing, stdout=nothing, stderr=messages, env=env, start_new_session=True
                )
                processes.append(process)
                _running.append(process)
            # Without a limit, waiting holds a lock, and a forked child would wait for the compilers too.
            codes = [process.wait(TIMEOUT) for process in processes]
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
    for process in [*processes]:
        if process.poll() is None:  # in a forked child, the parent's compilers count as ended
            os.killpg(process.pid, signal.SIGTERM)
            process.wait()
        if process in _running:
            _running.remove(process)


atexit.register(_end, _running)

_TYPES = {"p": ctypes.c_void_p, "i": ctypes.c_int, "l": ctypes.c_int64, "f": ctypes.c_float, "-": None}

SIGNATURES = {
    "pd_program": "p p",
    "pd_shared": "p",
    "pd_new": "p piiii",
    "pd_free": "- p",
    "pd_copy": "p p",
    "pd_run": "p pilippplippp",
    "pd_count": "- ppplplp",
    "pd_load": "- piiipl",
    "pd_store": "- piiiipl",
    "pd_put": "- piiipip",
    "pd_fill": "- piipp",
    "pd_show": "- pippl",
    "pd_take": "- ppppi",
    "pd_act": "l pp",
    "pd_finish": "i p",
    "pd_begin": "- p",
    "pd_play": "l pp",
    "pd_play_all": "- lpppppi",
    "pd_choose": "- ppp",
    "pd_observe": "- ppi",
}
"""The results and arguments of `pd_program`, in programs' libraries, and of the driver's functions, by letters of `_TYPES`."""


@lru_cache(maxsize=64)
def load_library(path: Path) -> ctypes.CDLL:
    """The library, loaded once per process, with its functions declared. Raises NoCompiler."""
    try:
        library = ctypes.CDLL(str(path))
    except OSError as error:
        raise NoCompiler(f"compiled code cannot be loaded: {error}") from None
    for name, signature in SIGNATURES.items():
        if function := getattr(library, name, None):
            result, _, arguments = signature.partition(" ")
            function.restype, function.argtypes = _TYPES[result], [_TYPES[letter] for letter in arguments]
    return library
