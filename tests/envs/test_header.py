"""`powderdsl export --env`: environments in C against those in Python."""

from __future__ import annotations

import ctypes
import importlib.util
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from powderdsl.targets.cpp.build import NoCompiler, find_compiler
from tests.cli.commands import powderdsl

DOCS = Path(__file__).parents[2] / "docs" / "export.md"
FLAGS = (
    "-std=c++17",
    "-O0",
    "-march=native",
    "-ffp-contract=off",
    "-fPIC",
    "-w",
    "-fsanitize=undefined",
    "-fno-sanitize-recover=all",
)
WORLDS, ENVIRONMENTS = 16, 5

pytestmark = pytest.mark.usefixtures("torch")


def cpp_compiler() -> tuple[str, ...]:
    try:
        return find_compiler().command
    except NoCompiler as error:
        pytest.skip(str(error))


def compiled_environment(folder: Path, task: str, *options: str) -> None:
    """Write ``env.h`` and ``env.cpp`` of a task into a folder, and compile ``env.o``."""
    compiler = cpp_compiler()
    words = [task, "--out", folder / "env.h", "--worlds", WORLDS, *options]
    powderdsl("export", "--env", *words, exits=0)
    subprocess.run([*compiler, *FLAGS, "-c", "env.cpp"], cwd=folder, check=True)


@pytest.fixture(scope="module")
def sand_pushing(tmp_path_factory):
    """A folder with the compiled environment of a task: compiling takes most of the time."""
    folder = tmp_path_factory.mktemp("environment")
    compiled_environment(folder, "sand-pushing")
    return folder


def test_the_programs_of_the_docs_run(sand_pushing):
    """With each C compiler there is."""
    blocks = re.findall(r"```c\n(.*?)```", DOCS.read_text("utf-8"), re.S)
    assert len(blocks) == 2
    assert len(blocks[0].splitlines()) <= 40
    (sand_pushing / "program.c").write_text(blocks[0].replace("STEPS = 1000", "STEPS = 100"))
    (sand_pushing / "binding.c").write_text(blocks[1])
    for compiler in [name for name in ("gcc", "clang") if shutil.which(name)]:
        strict = [compiler, "-O1", "-Wall", "-Werror", "-std=c99"]
        subprocess.run([*strict, "-c", "binding.c"], cwd=sand_pushing, check=True)
        linked = ["program.c", "env.o", "-lstdc++", "-lpthread", "-lm", "-lubsan", "-o", "program"]
        subprocess.run([*strict, *linked], cwd=sand_pushing, check=True)
        run = subprocess.run(["./program"], cwd=sand_pushing, check=True, capture_output=True, text=True)
        assert re.fullmatch(r"3200 steps, 32 episodes, return -?[0-9.]+\n", run.stdout)


@pytest.mark.parametrize(
    ("task", "observation", "actions"),
    [
        ("sand-pushing", "ids", "multidiscrete"),
        pytest.param("build-an-arch", "rgb", "full", marks=pytest.mark.slow),
        pytest.param("dig-a-channel", "compact", "discrete", marks=pytest.mark.slow),
        pytest.param("destroying", "matrix", "multidiscrete", marks=pytest.mark.slow),
    ],
)
def test_c_does_the_same_as_python(request, tmp_path, task, observation, actions):
    how, folder = {"observation": observation, "actions": actions}, tmp_path
    if (task, observation, actions) == ("sand-pushing", "ids", "multidiscrete"):
        folder = request.getfixturevalue("sand_pushing")
    else:
        compiled_environment(folder, task, *(f"--{name}={value}" for name, value in how.items()))
    linked = [*cpp_compiler(), "-shared", "env.o", "-o", "env.so", "-lpthread", "-lubsan"]
    subprocess.run(linked, cwd=folder, check=True)
    library = ctypes.CDLL(str(folder / "env.so"))
    pointer, address = ctypes.c_void_p, ctypes.c_void_p
    library.powder_new.restype, library.powder_step.restype = pointer, ctypes.c_int64
    library.powder_reset.argtypes = pointer, ctypes.c_uint64, address
    library.powder_step.argtypes, library.powder_free.argtypes = [pointer] + [address] * 5, [pointer]

    def at(array: Any) -> ctypes.c_void_p:
        return ctypes.c_void_p(array.ctypes.data)

    assert_does_the_same(library, at, task, **how)


class WasmLibrary:
    """The functions of a WebAssembly module. Arrays are copied into its memory before each call, and back."""

    def __init__(self, path: Path):
        import wasmtime

        engine = wasmtime.Engine()
        self.store, linker = wasmtime.Store(engine), wasmtime.Linker(engine)
        self.store.set_wasi(wasmtime.WasiConfig())
        linker.define_wasi()
        module = linker.instantiate(self.store, wasmtime.Module.from_file(engine, str(path)))
        self.functions, self.places = module.exports(self.store), {}
        self.functions["_initialize"](self.store)

    def __getattr__(self, name: str) -> Any:
        return lambda *values: self.call(name, values)

    def call(self, name: str, values: tuple[Any, ...]) -> Any:
        memory, arrays = (
            self.functions["memory"],
            [value for value in values if isinstance(value, np.ndarray)],
        )
        for array in arrays:
            if id(array) not in self.places:
                self.places[id(array)] = self.functions["malloc"](self.store, array.nbytes), array
            memory.write(self.store, array.tobytes(), self.places[id(array)][0])
        words = [self.places[id(value)][0] if isinstance(value, np.ndarray) else value for value in values]
        result = self.functions[name](self.store, *words)
        for array in arrays:
            at = self.places[id(array)][0]
            array[...] = np.frombuffer(memory.read(self.store, at, at + array.nbytes), array.dtype).reshape(
                array.shape
            )
        return result


def test_webassembly_does_the_same_as_python(sand_pushing):
    """Compiled by the command of the docs, or by Debian's clang++ if ziglang is not installed."""
    (words,) = re.findall(r"^(python -m ziglang.*?env\.wasm)$", DOCS.read_text("utf-8"), re.S | re.M)
    command = [sys.executable, *words.replace("\\\n", " ").split()[1:]]
    if importlib.util.find_spec("ziglang") is None:
        if not (shutil.which("clang++") and Path("/usr/include/wasm32-wasi").is_dir()):
            pytest.skip("no compiler for WebAssembly: pip install ziglang")
        command[:6] = ["clang++", "--target=wasm32-wasi"]
    subprocess.run(command, cwd=sand_pushing, check=True)
    library = WasmLibrary(sand_pushing / "env.wasm")
    assert_does_the_same(library, lambda array: array, "sand-pushing", actions="multidiscrete")


def assert_does_the_same(library: Any, at: Any, task: str, **how: Any) -> None:
    """Assert that an exported environment does what a `CompiledEnv` does; `at` makes arguments of arrays."""
    from powderdsl.envs.compiled import CompiledEnv

    env = CompiledEnv(task, ENVIRONMENTS, worlds=WORLDS, **how)
    first = env.reset(seed=3)[0].numpy()
    observed, flags = np.zeros_like(first), np.zeros((2, ENVIRONMENTS), np.bool_)
    rewards = np.zeros(ENVIRONMENTS, np.float32)
    results = at(observed), at(rewards), at(flags[0]), at(flags[1])
    handle = library.powder_new(ENVIRONMENTS)
    library.powder_reset(handle, 3, at(observed))
    assert observed.tobytes() == first.tobytes()
    draws = np.random.default_rng(0)
    for _ in range(2 * env.max_episode_steps + 9):
        numbers = np.stack([draws.integers(0, most, ENVIRONMENTS) for most in env.action_nvec], 1)
        wanted = env.step_arrays(numbers[:, 0] if env.action_form.kind == "discrete" else numbers)
        assert library.powder_step(handle, at(numbers), *results) == -1
        for name, mine, yours in zip(
            ("observations", "reward", "terminated", "truncated"),
            (observed, rewards, *flags),
            wanted[:4],
            strict=True,
        ):
            assert mine.tobytes() == yours.tobytes(), name
    before = observed.copy()
    numbers[2, 0] = env.action_nvec[0]
    assert library.powder_step(handle, at(numbers), *results) == 2 * numbers.shape[1]
    assert (observed == before).all()
    library.powder_free(handle)


def test_what_does_not_fit_is_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for words, message in [
        (["sand-pushing", "--out", "e.wasm", "--env"], "--env, writes a .h file"),
        (["life", "--out", "e.h"], "--env, writes a .h file"),
        (["--env", "sand-pushing", "--out", "e.h", "--size", "8"], "--size is for rules"),
        (["--env", "nothing-such", "--out", "e.h"], "nothing-such"),
    ]:
        assert message in powderdsl("export", *words, exits=2).stderr
        assert not [*tmp_path.iterdir()]
