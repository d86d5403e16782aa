"""The start worlds of tasks are the same on torch, on NumPy, and where neither is installed."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from typing import Any

import numpy as np
import pytest

from powderdsl.targets.array_kind import ArrayKind
from powderdsl.targets.tensor_kind import Tensors
from powderdsl.tasks.shipped import load_task, shipped_tasks
from powderdsl.tasks.tensors.generator import Made, StartWorlds
from tests.unit.test_without_numpy import BLOCK

SOME = shipped_tasks()[::5]
"""Plain Python takes a while."""

SEEDS = (0, 3, 1 << 40, 17, 18)

ALONE = f"""{BLOCK}
import hashlib
from powderdsl.arrays import np
from powderdsl.targets.array_kind import ArrayKind
from powderdsl.tasks.shipped import load_task
from powderdsl.tasks.tensors.generator import StartWorlds

for name in {SOME!r}:
    made = StartWorlds(load_task(name), "train", ArrayKind()).make(np.array([{SEEDS[1]}], np.int64))
    print(hashlib.sha256(made.ids.tobytes()).hexdigest())
"""


def values(made: Made) -> dict[str, Any]:
    found = {"ids": made.ids, **made.regions, **{f"target {name}": one for name, one in made.targets.items()}}
    return {name: np.asarray(one) for name, one in found.items()}


@pytest.mark.parametrize("name", shipped_tasks())
def test_arrays_make_the_worlds_of_tensors(torch, name):
    task = load_task(name)
    for split in task.splits:
        starts = [StartWorlds(task, split.name, kind) for kind in (ArrayKind(), Tensors())]
        for seeds in (SEEDS, SEEDS[:1]):
            found = values(starts[0].make(np.array(seeds, np.int64)))
            wanted = values(starts[1].make(torch.tensor(seeds)))
            assert found.keys() == wanted.keys()
            for key, one in wanted.items():
                assert (found[key].dtype, found[key].shape) == (one.dtype, one.shape), key
                assert (found[key] == one).all(), key


@pytest.mark.slow
def test_worlds_are_made_without_torch_and_numpy():
    ended = subprocess.run([sys.executable, "-c", ALONE], capture_output=True, text=True)
    assert ended.stderr == ""
    expected = []
    for name in SOME:
        made = StartWorlds(load_task(name), "train", ArrayKind()).make(np.array([SEEDS[1]]))
        expected.append(hashlib.sha256(made.ids.tobytes()).hexdigest())
    assert ended.stdout.split() == expected
