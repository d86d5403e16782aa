"""Tests of native code run where there is a C++ compiler; one that refuses our code makes them fail."""

from __future__ import annotations

import pytest

from powderdsl.targets.cpp.compilers import NoCompiler, find_compiler


def skip_without_compiler(backend: str = "native") -> None:
    """Skip the test if it is about native code and this machine has no compiler that runs."""
    if backend != "native":
        return
    try:
        find_compiler()
    except NoCompiler as error:
        pytest.skip(str(error))
