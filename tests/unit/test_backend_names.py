"""Names of backends: each is what runs, or is refused."""

from __future__ import annotations

import pytest
import torch

import powderdsl
from powderdsl.diagnostics import CompileError
from powderdsl.simulation.programs import make_program, starting_backend
from powderdsl.targets.tensor_kind import Tensors


@pytest.mark.parametrize("backend", ["wasm", "native"])
def test_what_runs_on_the_cpu_is_refused_elsewhere(backend: str) -> None:
    with pytest.raises(CompileError, match=f"the {backend} backend is not available") as found:
        make_program(powderdsl.load("life"), backend, Tensors(torch.device("meta")))
    assert "on the backend `torch` or `auto` on `meta`" in str(found.value)
    assert make_program(powderdsl.load("life"), "auto", Tensors(torch.device("meta"))).name == "torch"


def test_without_a_compiler_native_names_what_needs_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CXX", "no-such")
    with pytest.raises(CompileError, match="run on the backend `wasm`, or install"):
        powderdsl.compile("life", backend="native")


def test_the_first_backend_needs_no_compiler() -> None:
    assert [starting_backend(name) for name in ("cpu", "cpu:0", "cuda", "cuda:1", "mps")] == [
        *("wasm", "wasm"),
        *("torch", "torch", "torch"),
    ]
