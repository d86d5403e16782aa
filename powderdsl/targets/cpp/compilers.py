"""C++ compilers: which one is available, and its flags."""

from __future__ import annotations

import os
import platform
import re
import shlex
import shutil
import subprocess
from dataclasses import dataclass
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path

INSTALL = "install g++ or clang++, or `pip install powderdsl[native]`"
"""What to do where there is no compiler."""


MISSING = "no C++ compiler"
"""How the messages of `NoCompiler` begin where none was found."""


class NoCompilerWarning(UserWarning):
    """The backend `auto` has work that is worth compiling, and no compiler."""


class NoCompiler(Exception):
    """No C++ compiler that works was found, or it failed; the message says what was tried."""


@dataclass(frozen=True)
class Compiler:
    """A command that compiles C++, and its identity. `family` is ``gcc``, ``clang`` or ``zig``."""

    command: tuple[str, ...]
    family: str
    version: str
    """The first line of what `--version` says."""


def find_compiler() -> Compiler:
    """The compiler of `$CXX`; without that the first of g++, c++, clang++ and the `ziglang` package that works.

    Raises:
        NoCompiler: none works. If `$CXX` is set, no other compiler is tried.
    """
    return _find(os.environ.get("CXX", ""), os.environ.get("PATH", ""))


@lru_cache(maxsize=8)
def _find(cxx: str, path: str) -> Compiler:
    """As above, for these values of the environment. Only successes are cached."""
    try:
        candidates = [tuple(shlex.split(cxx))] if cxx.strip() else _usual()
    except ValueError as error:
        raise NoCompiler(f"{MISSING}: $CXX is `{cxx}`: {error}") from None
    tried = []
    for command in candidates:
        version = _version(command)
        if version:
            return Compiler(command, _family(command, version), version)
        tried.append(" ".join(command))
    if cxx.strip():
        raise NoCompiler(f"{MISSING}: $CXX is `{cxx}`, which cannot be run")
    missing = [] if len(candidates) > 3 else ["the package ziglang"]
    raise NoCompiler(f"{MISSING}: tried " + ", ".join(tried + missing))


def _usual() -> list[tuple[str, ...]]:
    found: list[tuple[str, ...]] = [("g++",), ("c++",), ("clang++",)]
    package = find_spec("ziglang")
    if package is not None and package.origin:
        # The program itself: `python -m ziglang` would start Python once more.
        found.append((str(Path(package.origin).with_name("zig")), "c++"))
    return found


def _version(command: tuple[str, ...]) -> str:
    """The first line of `--version`; empty if the command does not run."""
    if shutil.which(command[0]) is None:
        return ""
    try:
        result = subprocess.run(
            [*command, "--version"],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=30,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return ""
    return result.stdout.strip().splitlines()[0] if result.stdout.strip() else "unknown"


def _family(command: tuple[str, ...], version: str) -> str:
    if "c++" in command[1:] and any("zig" in Path(word).name for word in command):
        return "zig"
    return "clang" if "clang" in version else "gcc"


ARCHITECTURE = "POWDERDSL_ARCH"
"""The environment variable that names another processor to compile for, such as ``x86-64-v3``."""


def flags_for(compiler: Compiler, level: str, machine: str = "", features: str = "") -> tuple[str, ...]:
    """The flags for a library of generated code.

    Args:
        level: ``-O0`` to ``-O3``.
        machine, features: of the processor, as `platform.machine` and `processor` say; this one's if empty.

    Raises:
        NoCompiler: `$POWDERDSL_ARCH` is not a name.

    Floats keep their meaning at every level: no contraction (a·b + c is rounded twice on every machine) and no fast
    mathematics, so that all backends agree bit for bit.
    """
    machine, features = machine or platform.machine(), features or processor()
    on_x86 = machine in ("x86_64", "AMD64", "i686")
    name = os.environ.get(ARCHITECTURE, "native")
    if not re.fullmatch(r"[A-Za-z0-9_.+-]+", name):
        raise NoCompiler(f"no C++ compiler: ${ARCHITECTURE} is `{name}`, which names no processor")
    if compiler.family == "zig":
        name = name.replace("-", "_")
    flags = ["-std=c++17", level, f"-march={name}" if on_x86 else f"-mcpu={name}"]
    flags += ["-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math", "-fno-strict-aliasing"]
    if on_x86 and ("avx512f" in features if name == "native" else name.endswith("v4")):
        flags.append("-mprefer-vector-width=512")
    if compiler.family == "gcc":
        # On such long functions these two take most of the time and gain nothing.
        flags += ["-fno-gcse", "-fno-tree-pre"]
    else:
        flags.append("-fno-slp-vectorize")  # the code is vectorized already: a tenth faster without
    if compiler.family == "zig":
        flags.append("-fno-sanitize=undefined")  # which zig adds at -O0
    return (*flags, "-shared", "-fPIC", "-pthread", "-fvisibility=hidden", "-w")


@lru_cache(maxsize=1)
def processor() -> str:
    """What code for this processor depends on: the machine and its instruction sets."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next((line for line in lines if line.startswith(("flags", "Features"))), platform.machine())
    except OSError:
        return f"{platform.machine()} {platform.processor()}"
