"""Physics as data, compiled to tensor kernels, trained on.

`load` reads rules, and `compile` makes a `Simulator` of them, which makes, changes and steps a `World`. `load_world` reads
worlds and scenes, `save` stores worlds, and `gif` films them. `ledger` says what rules create, destroy and move. `CompileError` has the mistakes in files.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from powderdsl.system.packages import importing

__version__ = "0.1.0"

if TYPE_CHECKING:
    from powderdsl.analysis.ledger import ledger
    from powderdsl.compiler import load
    from powderdsl.diagnostics import CompileError
    from powderdsl.simulation.simulator import Simulator, World, compile
    from powderdsl.worlds.media import gif
    from powderdsl.worlds.store import load_world, save

__all__ = ["CompileError", "Simulator", "World", "compile", "gif", "ledger", "load", "load_world", "save"]

__getattr__, __dir__ = importing(
    "powderdsl",
    {
        "analysis.ledger": "ledger",
        "compiler": "load",
        "diagnostics": "CompileError",
        "simulation.simulator": "Simulator World compile",
        "worlds.media": "gif",
        "worlds.store": "load_world save",
    },
)
