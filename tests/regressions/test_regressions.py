"""Cases that a backend once got wrong, as `python -m tests.fuzz` saved them: all backends run them forever."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from powderdsl.targets.cpp.build import Building
from tests.compilers import skip_without_compiler
from tests.fuzz import COMPARED, COMPILED
from tests.fuzz.cases import read_case
from tests.fuzz.differential import check_case

FOLDER = Path(__file__).parent
FILES = sorted(FOLDER.glob("*.yaml"))


def cases() -> list:
    found = []
    for path in FILES:
        for backend in COMPARED:
            marks = [pytest.mark.slow] if backend in COMPILED else []
            found.append(pytest.param(path, backend, id=f"{path.stem}-{backend}", marks=marks))
    return found


@pytest.mark.parametrize(("path", "backend"), cases())
def test_backends_agree(path: Path, backend: str, tmp_path: Path) -> None:
    skip_without_compiler(backend)
    found = check_case(replace(read_case(path), backend=backend), Building("-O0", tmp_path))
    assert found is None, f"{found}\npython -m tests.fuzz --replay {path.relative_to(FOLDER.parents[1])}"


def test_there_are_some() -> None:
    assert FILES
