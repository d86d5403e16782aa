"""Write the rules of pixel worlds in YAML; check, run and train on them.

`load` reads rules, and `compile` turns them into a `Simulator`, which creates, changes and steps a `World`.
`load_world` reads worlds and scenes, `save` stores worlds, and `gif` writes animations. `ledger` reports what rules
create, destroy and move. `CompileError` lists the mistakes in files.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from powderdsl.system.packages import importing

__version__ = "0.2.0"

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
