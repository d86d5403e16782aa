"""Generated functions of tensors through `torch.compile`, with settings that keep results exact."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

import torch
import torch._dynamo.exc
from torch._inductor.runtime.cache_dir_utils import default_cache_dir

from powderdsl.diagnostics import CompileError
from powderdsl.system.writing import cache_folder
from powderdsl.targets.job import unavailable

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


def fused(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function as one graph of fused kernels, compiled on its first call, for tensors of the same sizes.

    Raises CompileError (PD701) on that call if it cannot be compiled.
    """
    os.utime(folder := cache_folder("inductor"))  # `powderdsl cache` shows when it was last used
    if os.environ.get(FOLDER) in (None, default_cache_dir()):  # importing inductor sets the default, in /tmp
        os.environ[FOLDER] = str(folder)
    compiled = torch.compile(function, fullgraph=True, dynamic=False, options=SETTINGS)

    def run(*args: Any) -> Any:
        try:
            return compiled(*args)
        except torch._dynamo.exc.TorchDynamoException as error:
            raise not_compiled(str(error.__cause__ or error).strip()[:2000]) from error

    return run


def not_compiled(problem: str) -> CompileError:
    """The error (PD701) for a problem of a compiler."""
    remedy = "on Debian: apt install g++ python3-dev; or run on the backend `torch`, which compiles nothing"
    return unavailable("torch-fused", problem, remedy)
