"""Who may import whom: the tables that `test_architecture` holds the code against."""

from __future__ import annotations

from dataclasses import dataclass

_FRONT = ("arrays", "diagnostics", "system", "syntax", "model")
_COMPILER = (*_FRONT, "universes", "analysis", "ir", "ir.stages", "ir.lower", "schedule", "compiler")
_TARGETS = ("targets", "targets.torch", "targets.cpp", "targets.wasm", "targets.cuda")
_BACK = (*_COMPILER, "model.reference", *_TARGETS)
_STEPS = (
    "simulation.draw",
    "simulation.state_checks",
    "simulation.native",
    "simulation.programs",
    "simulation.observe",
    "simulation.simulator",
)
_SIMULATION = (*_STEPS, "simulation.tracing")
_WORLDS = ("worlds", "worlds.media", "worlds.store")
_SCREEN = (*_BACK, *_SIMULATION, *_WORLDS)
_TESTING = (
    "testing.generators",
    "testing.pack_tests",
    "testing.properties",
)
_LEARNING = (
    "experiments.runs",
    "tasks",
    "tasks.tensors",
    "tasks.laws",
    "tasks.episodes",
    "tasks.compiled",
    "tasks.mixed",
    "tasks.players",
    "envs",
    "datasets",
    "rl",
    "worldmodel",
    "ogbench",
)

LAYERS: dict[str, tuple[str, ...]] = {
    # A row is a package with all that lies in it, or a module; the longest row that fits a module is its own. It may
    # import from its own row and from the rows named beside it, all of them further up.
    "arrays": (),
    "diagnostics": (),
    "system": ("arrays", "diagnostics"),
    "syntax": ("diagnostics", "system"),
    "universes": ("diagnostics", "system", "syntax"),  # text from a seed, right by construction
    "model": ("diagnostics", "system", "syntax"),
    "model.reference": _FRONT,  # never ir: an oracle that shares the lowering cannot see a bug in it
    "analysis": _FRONT,  # decides from the model alone: no world is run
    "ir": ("diagnostics",),
    "ir.stages": ("diagnostics", "ir"),  # never the model: by now all that is needed is in the IR
    "ir.lower": (*_FRONT, "analysis", "ir"),  # the one door from the model into the IR
    "analysis.costs": ("ir",),  # of passes, as they will run
    "schedule": ("diagnostics", "ir"),
    "targets": ("arrays", "diagnostics", "system", "ir", "schedule"),  # what targets share; never the model
    "targets.torch": ("diagnostics", "system", "ir", "schedule", "targets"),
    "targets.cpp": ("diagnostics", "system", "ir", "schedule", "targets", "targets.torch"),
    "targets.wasm": ("diagnostics", "system", "ir", "schedule", "targets"),
    "targets.cuda": ("diagnostics", "system", "ir", "schedule", "targets", "targets.torch", "targets.cpp"),
    "compiler": _COMPILER[:-1],
    "prover.solver": (),  # knows nothing but clauses
    "prover": (*_COMPILER, "prover.solver"),  # decides from the IR that backends run
    "simulation": (),
    "simulation.draw": (*_FRONT, "targets"),
    "simulation.state_checks": (*_FRONT, "targets"),
    "simulation.native": _BACK,
    "simulation.programs": (*_BACK, "simulation.native"),
    "simulation.observe": (*_BACK, "simulation.draw"),
    "simulation.simulator": (
        *_BACK,
        "simulation.draw",
        "simulation.state_checks",
        "simulation.programs",
        "simulation.observe",
    ),
    "simulation.standalone": _BACK,
    "simulation.tracing": (
        *_FRONT,
        "model.reference",
        "targets",
        "simulation.simulator",
    ),  # explains by what the oracle does
    "worlds.media": ("arrays", "system", "simulation.draw", "simulation.simulator"),
    "worlds": (*_FRONT, "analysis", "simulation.draw"),
    "worlds.store": (*_FRONT, "worlds", "simulation.simulator"),  # saved worlds are values of the simulator
    "testing.generators": _SCREEN,
    "testing": ("system", "testing.generators"),  # the public names
    "testing.pack_tests": (*_SCREEN, "testing.generators"),
    "testing.properties": (*_SCREEN, "prover", *_TESTING[:-1]),
    "testing.mutation": (*_SCREEN, "prover", *_TESTING),
    "testing.lawful": _SCREEN,
    "testing.pytest_plugin": (*_SCREEN, *_TESTING),
    "experiments": (),
    "experiments.bench": _SCREEN,
    "experiments.runs": ("diagnostics", "system"),
    "tasks": (*_FRONT, "compiler", "worlds"),
    "tasks.tensors": (*_BACK, "simulation.simulator", "worlds", "tasks"),
    "tasks.laws": (*_BACK, "simulation.simulator", "tasks"),
    "tasks.episodes": (*_BACK, "simulation.simulator", "tasks", "tasks.tensors", "tasks.laws"),
    "tasks.mixed": (*_BACK, "simulation.simulator", "tasks", "tasks.episodes"),
    "tasks.compiled": (*_BACK, "simulation.simulator", "tasks", "tasks.tensors"),
    "tasks.players": (*_BACK, "worlds", "tasks", "tasks.tensors", "tasks.episodes", "tasks.mixed"),
    "envs": (*_SCREEN, *_LEARNING[1:7]),
    "datasets": (*_SCREEN, *_LEARNING[:9]),
    "rl": (*_SCREEN, *_LEARNING[:10]),
    "worldmodel": (*_SCREEN, *_LEARNING[:10]),
    "ogbench": (*_SCREEN, *_LEARNING[:7], "envs"),
    # Calls commands, in processes of their own.
    "experiments.studies": (*_FRONT, "compiler", "experiments.runs"),
    "editing": (*_COMPILER, "worlds", "tasks", "experiments.studies"),
    "web": (*_BACK, "simulation.standalone", *_WORLDS, "tasks", "tasks.tensors", "editing"),
    "web.bridge": (*_SCREEN, "simulation.standalone", *_TESTING, "editing"),
    "cli": (
        *_SCREEN,
        "editing",
        "analysis.costs",
        "simulation.standalone",
        "web",
        *_TESTING,
        "testing.lawful",
        "testing.mutation",
        *_LEARNING,
        "experiments.bench",
        "experiments.studies",
    ),
    "__init__": _SCREEN,  # the public names, imported when they are asked for
    "__main__": ("cli",),
}


@dataclass(frozen=True)
class Home:
    """Where a third party may be imported, and where that may happen while the module itself is imported."""

    anywhere: tuple[str, ...]
    at_import: tuple[str, ...]


_TEXT = ("syntax",)
_TORCH = (
    "targets.tensor_kind",
    "targets.torch.program",
    "targets.torch.packed",
    "targets.torch.library",
    "targets.torch.fuse",
    "targets.cpp.program",
    "targets.cuda.program",
    "targets.cpp.counts",
    "simulation.native",
    "simulation.observe",
    "testing.mutation",
    "tasks.tensors",
    "tasks.laws",
    "tasks.episodes",
    "tasks.mixed",
    "tasks.players",
    "envs",
    "datasets",
    "experiments.runs",
    "worldmodel",
    "rl",
    "ogbench.episodes",
    "ogbench.env",
    "ogbench.collect",
)
THIRD_PARTIES: dict[str, Home] = {
    "yaml": Home((*_TEXT, "testing.properties.outcomes"), (*_TEXT, "testing.properties.outcomes")),
    "lark": Home(_TEXT, _TEXT),
    "torch": Home(
        (
            *_TORCH,
            "system.random",
            "targets.job",
            "simulation.programs",
            "simulation.draw",
            "worlds.media",
            "experiments.bench",
            "cli",
        ),
        _TORCH,
    ),
    "gymnasium": Home(("envs", "rl", "datasets.minari", "ogbench"), ("envs", "rl", "ogbench")),
    "minari": Home(("datasets.minari",), ()),
    "h5py": Home(("datasets.minari",), ()),
    "stable_baselines3": Home(("envs", "rl"), ("envs", "rl")),
    "wasmtime": Home(("targets.wasm.wasmtime_host",), ("targets.wasm.wasmtime_host",)),
    "js": Home(("targets.wasm.host",), ()),
    "pyodide": Home(("targets.wasm.host",), ()),
    "click": Home(("cli",), ("cli",)),
    "pygls": Home(("cli.commands.lsp",), ()),
    "lsprotocol": Home(("cli.commands.lsp",), ()),
    "matplotlib": Home(("experiments.studies", "cli"), ()),
    "ray": Home(("experiments.studies.run",), ()),
}
