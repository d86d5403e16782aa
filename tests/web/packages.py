"""The packages that powderdsl needs in Pyodide, from this environment, so that tests need no network."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Set
from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement

PACKAGES = frozenset({"click", "lark", "pyyaml", "rich"})


def needed_in_pyodide(requirements: list[str] | None) -> Iterator[str]:
    """The names of packages that a package needs there."""
    for requirement in map(Requirement, requirements or ()):
        marker = requirement.marker
        if marker is None or marker.evaluate({"sys_platform": "emscripten", "extra": ""}):
            yield requirement.name.lower()


def write_packages(path: Path, names: Set[str]) -> None:
    """An archive of installed packages and those that they need, without their compiled parts."""
    found: set[str] = set()
    with zipfile.ZipFile(path, "w") as archive:
        while names - found:
            name = min(names - found)
            found.add(name)
            for file in metadata.files(name) or ():
                if not (".." in file.parts or "__pycache__" in file.parts or file.suffix == ".so"):
                    archive.write(file.locate(), str(file))
            names |= set(needed_in_pyodide(metadata.requires(name)))
