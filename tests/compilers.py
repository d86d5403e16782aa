"""Tests of native code run where there is a C++ compiler; one that refuses our code makes them fail."""

from __future__ import annotations

import pytest

from powderdsl.targets.cpp.build import NoCompiler, find_compiler


def skip_without_compiler(backend: str = "native") -> None:
    """Skip the test if it compiles C++ and this machine has no compiler that runs."""
    if backend not in ("native", "cuda-emulated"):
        return
    try:
        find_compiler()
    except NoCompiler as error:
        pytest.skip(str(error))
