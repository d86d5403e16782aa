"""Physics as data, compiled to tensor kernels, trained on.

`load` reads rules, and `compile` makes a `Simulator` of them, which makes, changes and steps a `World`. `save` and
`load_world` store worlds. `ledger` says what rules create, destroy and move. `CompileError` has the mistakes in files.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from powderdsl.analysis.ledger import ledger
    from powderdsl.compiler import load
    from powderdsl.diagnostics import CompileError
    from powderdsl.simulation.simulator import Simulator, World, compile
    from powderdsl.worlds.store import load_world, save

_HOMES = {
    "load": "powderdsl.compiler",
    "compile": "powderdsl.simulation.simulator",
    "CompileError": "powderdsl.diagnostics",
    "ledger": "powderdsl.analysis.ledger",
    "Simulator": "powderdsl.simulation.simulator",
    "World": "powderdsl.simulation.simulator",
    "save": "powderdsl.worlds.store",
    "load_world": "powderdsl.worlds.store",
}

__all__ = ["CompileError", "Simulator", "World", "compile", "ledger", "load", "load_world", "save"]


def __getattr__(name: str) -> Any:
    """Import a public name on first use, so that torch is only imported when it is needed."""
    if name not in _HOMES:
        raise AttributeError(f"module 'powderdsl' has no attribute {name!r}")
    from importlib import import_module

    value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value
    return value
