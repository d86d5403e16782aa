"""`powderdsl export --env`: environments in C against those in Python."""

from __future__ import annotations

import ctypes
import re
import shutil
import subprocess
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
    from powderdsl.envs.compiled import CompiledEnv

    how, folder = {"observation": observation, "actions": actions}, tmp_path
    if (task, observation, actions) == ("sand-pushing", "ids", "multidiscrete"):
        folder = request.getfixturevalue("sand_pushing")
    else:
        compiled_environment(folder, task, *(f"--{name}={value}" for name, value in how.items()))
    linked = [*cpp_compiler(), "-shared", "env.o", "-o", "env.so", "-lpthread", "-lubsan"]
    subprocess.run(linked, cwd=folder, check=True)
    library = ctypes.CDLL(str(folder / "env.so"))
    library.powder_new.restype, library.powder_step.restype = ctypes.c_void_p, ctypes.c_int64

    def at(array: Any) -> ctypes.c_void_p:
        return ctypes.c_void_p(array.ctypes.data)

    env = CompiledEnv(task, ENVIRONMENTS, worlds=WORLDS, **how)
    first = env.reset(seed=3)[0].numpy()
    observed, flags = np.zeros_like(first), np.zeros((2, ENVIRONMENTS), np.bool_)
    rewards = np.zeros(ENVIRONMENTS, np.float32)
    results = at(observed), at(rewards), at(flags[0]), at(flags[1])
    handle = ctypes.c_void_p(library.powder_new(ENVIRONMENTS))
    library.powder_reset(handle, ctypes.c_uint64(3), at(observed))
    assert observed.tobytes() == first.tobytes()
    draws = np.random.default_rng(0)
    for _ in range(2 * env.max_episode_steps + 9):
        numbers = np.stack([draws.integers(0, most, ENVIRONMENTS) for most in env.action_nvec], 1)
        wanted = env.step_arrays(numbers[:, 0] if actions == "discrete" else numbers)
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
