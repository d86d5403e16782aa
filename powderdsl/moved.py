"""Modules that have moved: their old names still import, with a DeprecationWarning."""

from __future__ import annotations

import sys
import warnings
from importlib import import_module
from importlib.machinery import ModuleSpec
from types import ModuleType

MOVED = {
    # old name below powderdsl: new one. What lies in a package has moved along.
    "bench": "experiments.bench",
    "draw": "simulation.draw",
    "envs.single": "envs.gym",
    "envs.vector": "envs.gym",
    "ledgers": "analysis",
    "ledgers.book": "analysis.ledger",
    "ledgers.sums": "analysis.ledger",
    "media": "simulation.media",
    "observe": "simulation.observe",
    "provenance": "simulation.provenance",
    "pytest_plugin": "testing.pytest_plugin",
    "reference": "model.reference",
    "rl.policy_evaluation": "rl.evaluation",
    "rl.ppo_config": "rl.config",
    "rl.ppo_training": "rl.training",
    "runs": "experiments.runs",
    "simulator": "simulation.simulator",
    "tasks.shipped_tasks": "tasks.shipped",
    "targets.dense": "targets.torch",
    "testing.cases": "testing.generators.cases",
    "testing.strategies": "testing.generators.strategies",
    "tracing": "simulation.tracing",
    "tracing.trace_data": "simulation.tracing.data",
    "tracing.trace_text": "simulation.tracing.text",
    "worlds.files": "system.writing",
}


def new_name(name: str) -> str | None:
    """What an old name of a module, ``powderdsl.…``, is now; None where it has not moved."""
    package, _, rest = name.partition(".")
    if package != "powderdsl":
        return None
    parts = rest.split(".")
    for count in range(len(parts), 0, -1):
        home = MOVED.get(".".join(parts[:count]))
        if home is not None:
            return ".".join(["powderdsl", home, *parts[count:]])
    return None


class OldNames:
    """Finds moved modules by their old names, and gives the modules themselves: there is one of each."""

    def find_spec(self, name: str, path: object = None, target: object = None) -> ModuleSpec | None:
        return None if new_name(name) is None else ModuleSpec(name, self)  # type: ignore[arg-type]

    def create_module(self, spec: ModuleSpec) -> None:
        return None

    def exec_module(self, module: ModuleType) -> None:
        old = module.__name__
        new = new_name(old)
        assert new is not None
        # Level 2 is the import statement: frames of the import system do not count.
        warnings.warn(f"{old} has moved to {new}", DeprecationWarning, stacklevel=2)
        sys.modules[old] = import_module(new)


def find_old_names() -> None:
    """Let old names be imported. First in line: below an old package the path finder would load modules again."""
    if not any(isinstance(finder, OldNames) for finder in sys.meta_path):
        sys.meta_path.insert(0, OldNames())
