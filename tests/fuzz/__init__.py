"""Fuzzing: targets compared on random rules, damaged rule files, failing cases made small."""

from __future__ import annotations

from powderdsl.compiler import BACKENDS

EMULATED = "cuda-emulated"
"""The name of the CUDA target where its kernels run on the CPU."""

TARGETS = tuple(name for name in BACKENDS if name not in ("auto", "cuda", "reference", "torch-fused"))
"""What runs on every machine: `auto` runs one of these, and the reference is what they are compared with."""

PORTABLE = "torch-portable"
"""The functions of `torch` with the library for other devices and for compilation, on the CPU."""

COMPARED = (*TARGETS, EMULATED)
"""Every target but CUDA on a GPU."""

COMPILED = ("native", EMULATED)
"""What needs a C++ compiler, and seconds a ruleset."""

STARTS_AT_ONCE = tuple(name for name in TARGETS if name not in COMPILED)
