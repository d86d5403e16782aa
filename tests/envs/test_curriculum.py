"""Curricula: which worlds are played next."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.usefixtures("torch")


def test_worlds_with_high_scores_come_again() -> None:
    import torch

    from powderdsl.envs.curriculum import Prioritized

    levels = Prioritized(worlds=3)
    base, episode, drawn = (
        torch.arange(4000),
        torch.ones(4000, dtype=torch.int64),
        torch.arange(4000) + 10_000,
    )
    assert torch.equal(levels.choose(base, episode, drawn), drawn)
    levels.learn(torch.tensor([1, 2, 3, 4]), torch.tensor([0.1, 0.9, 0.5, 0.3], dtype=torch.float64))
    chosen = levels.choose(base, episode, drawn)
    again = chosen[chosen < 10_000]
    assert 0.45 < len(again) / 4000 < 0.55
    counts = [int((again == world).sum()) for world in (1, 2, 3, 4)]
    assert counts[0] == 0, "only three are kept"
    assert counts[1] > 0.8 * len(again)
    assert torch.equal(levels.choose(base[7:9], episode[7:9], drawn[7:9]), chosen[7:9])
    levels.learn(torch.tensor([2]), torch.tensor([0.0], dtype=torch.float64))
    other = Prioritized(worlds=3)
    other.restore(levels.state())
    after = other.choose(base, episode, drawn)
    assert torch.equal(after, levels.choose(base, episode, drawn))
    assert int((after == 3).sum()) > counts[2], "scores are those of the last episode"
    assert int((after == 4).sum()) > 10, "what has not been played for long comes again"


@pytest.mark.parametrize("backend", ["wasm", "native"])
def test_environments_ask_for_the_worlds_of_new_episodes(task_file: Path, backend: str) -> None:
    import torch

    from powderdsl.envs.compiled import CompiledEnv
    from tests.compilers import skip_without_compiler

    if backend == "native":
        skip_without_compiler()

    class Named:
        def choose(self, base: Any, episode: Any, drawn: Any) -> Any:
            return torch.where(episode == 0, drawn, 100 * base + episode)

    env = CompiledEnv(task_file, 3, backend=backend, curriculum=Named(), autoreset_mode="same_step")
    _, info = env.reset(seed=5)
    assert info["world"].tolist() == [5, 6, 7]
    still = torch.zeros(3, 5, dtype=torch.int64)
    played = [env.step(still)[4]["world"].tolist() for _ in range(13)]
    for row, worlds in enumerate(zip(*played, strict=True)):
        seed = 5 + row
        order = [seed, *(100 * seed + episode for episode in range(1, 14))]
        places = [order.index(world) for world in worlds]
        assert places == sorted(places)
        assert {*range(places[-1] + 1)} == {*places} | {0}
        assert places[-1] >= 2


def test_training_with_levels_resumes_as_if_it_had_not_stopped(task_file: Path, tmp_path: Path) -> None:
    import torch

    from powderdsl.rl import preset, train

    how: dict[str, Any] = {"envs": 4, "rollout": 16, "backend": "wasm", "curriculum": "prioritized"}
    whole = train(preset("small", str(task_file), steps=192, **how), tmp_path / "whole")
    train(preset("small", str(task_file), steps=64, **how), tmp_path / "parts")
    parts = train(preset("small", str(task_file), steps=192, **how), tmp_path / "parts")
    first, second = (run.checkpoint().state for run in (whole, parts))
    assert len(first["curriculum"]["worlds"]) > 8
    for name, value in first["curriculum"].items():
        assert torch.equal(value, second["curriculum"][name])
    for name, value in first["policy"].items():
        assert torch.equal(value, second["policy"][name])
