"""Who may import whom: the tables that `test_architecture` holds the code against."""

from __future__ import annotations

from dataclasses import dataclass

_MODEL = ("bounded_files", "diagnostics", "syntax", "model")
_COMPILER = (*_MODEL, "reference", "ir", "passes", "backends", "compiler")
_PROGRAMS = ("programs", "native_start", "auto_program")
_STEPS = ("observe", "state_checks", "simulator", "provenance")
_SCREEN = (*_COMPILER, *_PROGRAMS, "draw", *_STEPS, "tracing", "worlds", "media", "terminal")
_TESTING = (*_SCREEN, "ledgers", "pack_test_fields", "pack_test_chances", "pack_tests", "testing")
_AFTER = ("bench", "tasks", "envs", "runs", "datasets", "rl", "worldmodel", "studies", "web", "cli")
_EVERYTHING = (*_TESTING, "properties", "mutation", "pytest_plugin", *_AFTER)

LAYERS: dict[str, tuple[str, ...]] = {
    # module or pattern: what it may import besides its own package. The longest row that fits counts.
    "user_cache": (),
    "scratch": (),
    "interrupts": (),
    "bounded_files": (),
    "diagnostics": (),
    "syntax": ("bounded_files", "diagnostics", "user_cache"),
    "model": ("diagnostics", "syntax"),
    "ledgers": _MODEL,  # decides from the model alone: no world is run
    "reference": _MODEL,  # never ir: an oracle that shares the lowering cannot see a bug in it
    "ir": ("diagnostics",),
    "ir.lower*": _MODEL,  # the one door from the model into the IR
    "passes": ("diagnostics", "ir"),  # never the model: by now all that is needed is in the IR
    "backends": ("bounded_files", "diagnostics", "ir", "user_cache", "scratch", "interrupts"),
    "compiler": _COMPILER[:-1],
    "native_start": _COMPILER,
    "auto_program": _COMPILER,
    "programs": (*_COMPILER, "native_start", "auto_program"),
    "draw": _MODEL,
    "observe": (*_COMPILER, "draw"),
    "state_checks": _MODEL,
    "simulator": (*_COMPILER, "programs", "observe", "state_checks"),
    "provenance": (*_MODEL, "simulator"),
    "tracing": (*_MODEL, "reference", "provenance", "simulator"),  # explains by what the oracle does
    "worlds": (*_MODEL, "scratch", "draw"),
    "worlds.store": (*_MODEL, "simulator"),  # saved worlds are values of the simulator
    "media": (*_SCREEN[: _SCREEN.index("media")], "interrupts"),
    "terminal": _SCREEN[: _SCREEN.index("terminal")],
    "pack_test_fields": _SCREEN,
    "pack_test_chances": _SCREEN,
    "pack_tests": (*_SCREEN, "pack_test_fields", "pack_test_chances"),
    "testing": (*_SCREEN, "ledgers", "pack_tests", "scratch", "interrupts"),
    "properties": (*_TESTING, "user_cache"),
    "mutation": (*_TESTING, "properties"),
    "pytest_plugin": (*_TESTING, "properties"),
    "bench": _SCREEN,
    "tasks": (*_COMPILER, "simulator", "worlds"),
    "envs": (*_SCREEN, "tasks"),
    "runs": ("bounded_files", "diagnostics", "worlds", "scratch"),
    "datasets": (*_SCREEN, "tasks", "envs", "runs"),
    "rl": (*_SCREEN, "tasks", "envs", "runs"),
    "worldmodel": (*_SCREEN, "tasks", "runs", "interrupts"),
    "studies": (
        *_MODEL,
        "compiler",
        "worlds",
        "runs",
        "bench",
        "interrupts",
    ),  # calls commands, in processes of their own
    "web": _SCREEN,
    "cli": (*_EVERYTHING[:-1], "user_cache", "scratch", "interrupts"),
    "__init__": _EVERYTHING,  # the public names, imported when they are asked for
    "__main__": ("cli",),
}


@dataclass(frozen=True)
class Home:
    """Where a third party may be imported, and where that may happen while the module itself is imported."""

    anywhere: tuple[str, ...]
    at_import: tuple[str, ...]


_TEXT = ("syntax", "worlds.scene")
_TORCH = (
    "*.torch_*",
    *_PROGRAMS,
    *_STEPS,
    "testing",
    "mutation",
    "tasks.episodes",
    "envs",
    "datasets",
    "runs",
    "worldmodel",
    "rl",
)
THIRD_PARTIES: dict[str, Home] = {
    "yaml": Home(_TEXT, _TEXT),
    "lark": Home(_TEXT, _TEXT),
    "torch": Home(
        (*_TORCH, "worlds.store", "draw", "media", "terminal", "pack_tests", "bench", "web", "cli"), _TORCH
    ),
    "gymnasium": Home(("envs", "rl"), ("envs", "rl")),
    "stable_baselines3": Home(("envs", "rl"), ("envs", "rl")),
    "click": Home(("cli",), ("cli",)),
    "matplotlib": Home(("bench", "studies", "cli"), ()),
}
