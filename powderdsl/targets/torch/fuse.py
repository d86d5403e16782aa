"""Generated functions of tensors, traced and compiled by inductor, with settings that keep results exact."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from copy import copy
from typing import Any

import torch
import torch._dynamo.exc
from torch import Tensor
from torch._guards import TracingContext, tracing
from torch._inductor.compile_fx import compile_fx
from torch._inductor.runtime.cache_dir_utils import default_cache_dir
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.fx.experimental.proxy_tensor import make_fx
from torch.fx.experimental.symbolic_shapes import ShapeEnv
from torch.utils._pytree import TreeSpec, tree_flatten, tree_unflatten

from powderdsl.diagnostics import CompileError
from powderdsl.system.cache import collection_paused
from powderdsl.system.writing import cache_folder
from powderdsl.targets.job import unavailable
from powderdsl.targets.torch.library import Portable

FOLDER = "TORCHINDUCTOR_CACHE_DIR"

SETTINGS: dict[str, Any] = {
    # Planes are read many times. Beyond these numbers they are stored; inductor's own make code that grows with the square.
    "realize_reads_threshold": 3,
    "realize_opcount_threshold": 8,
    "realize_cpu_opcount_threshold": 8,
    # Every operation is rounded for itself: no product is fused with a sum, and quotients are those of IEEE 754.
    "cpp.enable_floating_point_contract_flag": "off",
    "emulate_precision_casts": True,
    "eager_numerics.division_rounding": True,
    "eager_numerics.disable_ftz": True,
}


KEPT = ("everywhere", "nowhere", "valid")
"""The tensors of a library, which are inputs of the compiled functions."""


def fused(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function of a library and tensors as one graph of fused kernels, compiled on its first call, for tensors of these sizes.

    Raises CompileError (PD701) on that call if it cannot be compiled.
    """
    os.utime(folder := cache_folder("inductor"))  # `powderdsl cache` shows when it was last used
    if os.environ.get(FOLDER) in (None, default_cache_dir()):  # importing inductor sets the default, in /tmp
        os.environ[FOLDER] = str(folder)
    compiled: dict[Any, tuple[Callable[..., Any], TreeSpec]] = {}

    def run(k: Portable, *args: Any) -> Any:
        tensors, form = tree_flatten(([getattr(k, name) for name in KEPT], args))
        strides = tuple([tensor.stride() for tensor in tensors])  # kernels are made for these
        if strides not in compiled:
            compiled[strides] = _compiled(function, k, tensors, form)
        kernels, results = compiled[strides]
        return tree_unflatten(kernels(*tensors), results)

    return run


@collection_paused()
def _compiled(
    function: Callable[..., Any], k: Portable, tensors: Sequence[Tensor], form: TreeSpec
) -> tuple[Callable[..., Any], TreeSpec]:
    """The compiled function on plain lists of tensors, and the form of its results.

    `torch.compile` would interpret the bytecode: tracing the operations themselves takes a third of the time.
    """
    results: list[TreeSpec] = []

    def traced(*inputs: Tensor) -> list[Tensor]:
        kept, args = tree_unflatten(inputs, form)
        library = copy(k)
        vars(library).update(zip(KEPT, kept, strict=True))
        outputs, spec = tree_flatten(function(library, *args))
        results.append(spec)
        return outputs

    graph = make_fx(traced, tracing_mode="fake")(*tensors)
    try:
        with tracing(TracingContext(FakeTensorMode(shape_env=ShapeEnv()))):  # inductor's cache asks for it
            kernels: Any = compile_fx(graph, [*tensors], config_patches=SETTINGS, ignore_shape_env=True)
    except torch._dynamo.exc.TorchDynamoException as error:
        raise not_compiled(str(error.__cause__ or error).strip()[:2000]) from error
    return kernels, results[0]


def not_compiled(problem: str) -> CompileError:
    """The error (PD701) for a problem of a compiler."""
    remedy = "on Debian: apt install g++ python3-dev; or run on the backend `torch`, which compiles nothing"
    return unavailable("torch-fused", problem, remedy)
