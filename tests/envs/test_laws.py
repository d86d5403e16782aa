"""Environments whose worlds draw their laws: parameters from ranges, and rulesets."""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any

import pytest

from powderdsl.diagnostics import Reporter, Source
from powderdsl.tasks.file import read_task
from tests.compilers import skip_without_compiler
from tests.envs.test_compiled import MODES, assert_alike, assert_same, both, random_actions

pytestmark = pytest.mark.usefixtures("torch")

MELTING = """
task: melting
rules: core+water+fire+lava
params: {water.melt: 1%..40%}
size: [16, 16]
fill: empty
generate:
  - disk ice at (3..12, 3..12) radius 2..4
  - disk lava at (3..12, 3..12) radius 2
agent: {may: any, actions: 7, steps_per_action: 3}
reward: {each: count(water) / 10}
splits:
  test: {params: {water.melt: 50%..90%}}
  fixed: {params: {water.melt: 5%}}
"""

PACK = """
pack: p{number}
needs: core
elements:
  pool: {{id: 2, density: {pool}, gravity: yes, color: "#3355CC", glyph: p, tags: fluid}}
  grain: {{id: 3, density: 3, gravity: yes, color: "#CC5533", glyph: g, tags: powder}}
  crust: {{id: 4, density: 5, color: "#555555", glyph: c}}
params: {{bite: {bite}%}}
passes:
  react:
    after: flow
    do:
      - crust -> empty if count({solvent}) > 0 and interact < bite
"""

MIXED = """
task: dissolving
rules: p0.yaml
rulesets: [p0.yaml, p1.yaml, p2.yaml]
size: [16, 16]
fill: empty
generate:
  - disk crust at (4..12, 4..12) radius 4
  - disk (pool, grain) at (3..12, 3..12) radius 2
agent: {may: any, actions: 6, steps_per_action: 2, free_steps: 3}
reward: {each: change(-count(crust)) / 10}
end: {success: count(crust) < 12}
expert:
  - {choose: pool, at: most(crust)}
splits:
  test: {rulesets: [p3.yaml]}
"""


@pytest.fixture(scope="module")
def mixed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A task of three rulesets, and one held out."""
    folder = tmp_path_factory.mktemp("mixed")
    for number, (pool, bite, solvent) in enumerate(
        [(2, 90, "pool"), (4, 30, "grain"), (2, 20, "grain"), (4, 60, "pool")]
    ):
        text = PACK.format(number=number, pool=pool, bite=bite, solvent=solvent)
        (folder / f"p{number}.yaml").write_text(text, encoding="utf-8")
        alone = MIXED.replace("rules: p0", f"rules: p{number}").replace(
            "rulesets: [p0.yaml, p1.yaml, p2.yaml]\n", ""
        )
        (folder / f"alone{number}.yaml").write_text(alone, encoding="utf-8")
    (folder / "mixed.yaml").write_text(MIXED, encoding="utf-8")
    return folder


def task_of(text: str) -> Any:
    return read_task(Source("test.yaml", text), Reporter())


@pytest.mark.parametrize("mode", MODES)
def test_drawn_parameters_are_the_same_in_one_call(mode: str) -> None:
    plain, compiled = both(task_of(MELTING), 9, autoreset_mode=mode, observation="laws")
    assert_alike(plain, compiled, 20, seed=4)
    drawn = compiled.episodes.params["water.melt"]
    assert len(drawn.unique()) > 4
    assert 0.01 <= float(drawn.min()) < float(drawn.max()) <= 0.4
    assert_same(
        plain.reset(options={"params": {"water.melt": 0.7}}),
        compiled.reset(options={"params": {"water.melt": 0.7}}),
        "given parameters",
    )
    draws = random.Random(1)
    for number in range(10):
        actions = random_actions(plain, draws)
        assert_same(plain.step(actions), compiled.step(actions), f"step {number}")
        if mode == "disabled" and number == 5:
            break


def test_parameters_from_outside_win_and_can_be_taken_back() -> None:
    import torch

    from powderdsl.tasks.episodes import params_of

    env, _ = both(task_of(MELTING), 4, autoreset_mode="disabled")
    env.reset(seed=3)
    drawn = env.episodes.params["water.melt"].clone()
    given = float(torch.tensor(0.7))
    env.reset(seed=3, options={"params": {"water.melt": 0.7}})
    assert params_of(env.episodes, env.params)["water.melt"].tolist() == [given] * 4
    half = torch.tensor([True, True, False, False])
    env.reset(options={"params": {}, "reset_mask": half, "worlds": [3, 4, 3, 4]})
    assert params_of(env.episodes, env.params)["water.melt"].tolist() == [*drawn[:2].tolist(), given, given]


def test_each_world_draws_by_its_number_within_the_range_of_its_split() -> None:
    import torch

    from powderdsl.tasks.episodes import compile_task
    from powderdsl.tasks.shipped import load_task

    task = task_of(MELTING)
    worlds = torch.arange(200)
    values = {}
    for split, low, high in (("train", 0.01, 0.4), ("test", 0.5, 0.9), ("fixed", 0.05, 0.05)):
        program = compile_task(task, split=split, backend="wasm")
        values[split] = program.start(worlds).params["water.melt"]
        assert (values[split] >= low - 1e-6).all()
        assert (values[split] <= high + 1e-6).all()
        assert torch.equal(program.start(worlds[7:9]).params["water.melt"], values[split][7:9])
    third = (values["train"] < 0.14).double().mean()
    assert 0.2 < float(third) < 0.5, "uniform"
    assert load_task("sand-pushing").split("train").params == ()


def test_check_says_which_splits_have_laws_of_their_own(mixed: Path, tmp_path: Path) -> None:
    from tests.cli.commands import powderdsl as run

    melting = tmp_path / "melting.yaml"
    melting.write_text(MELTING, encoding="utf-8")
    checked = run("check", str(mixed / "mixed.yaml"), str(melting)).output
    assert "dissolving: 2 splits, laws of test held out of train, no errors" in checked
    assert "melting: 3 splits, laws of test held out of train, no errors" in checked
    shown = run("show", str(mixed / "mixed.yaml")).output
    assert "3 rulesets" in shown


def test_a_parameter_that_is_set_is_not_drawn() -> None:
    task = read_task(Source("test.yaml", MELTING), Reporter(), params={"water.melt": 0.25})
    assert [split.params for split in task.splits] == [()] * 3
    assert {param.name: param.default for param in task.ruleset.params}["water.melt"] == 0.25


def alone(folder: Path, worlds: int, backend: str, **how: Any) -> list[list[Any]]:
    """Environments of one world for each of some worlds, one for each ruleset."""
    from powderdsl.envs.tensor_env import TensorEnv
    from powderdsl.tasks.episodes import compile_task

    programs = [compile_task(str(folder / f"alone{number}.yaml"), backend=backend) for number in range(3)]
    return [
        [TensorEnv(program, 1, autoreset_mode="disabled", **how) for program in programs]
        for _ in range(worlds)
    ]


@pytest.mark.parametrize(("backend", "threads"), [("wasm", 1), ("native", 1), ("native", 2)])
@pytest.mark.parametrize("mode", MODES)
def test_worlds_under_different_rules_do_what_they_do_alone(
    mixed: Path, backend: str, threads: int, mode: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    import torch

    from powderdsl.envs.mixed import environment
    from powderdsl.envs.tensor_env import world_seeds

    if backend == "native":
        skip_without_compiler()
    count, pool = 7, 40
    monkeypatch.setattr("powderdsl.envs.compiled.POOL_CELLS", 2 * count * 16 * 16)  # two episodes at once
    how: dict[str, Any] = {"autoreset_mode": mode, "backend": backend, "worlds": pool, "threads": threads}
    env = environment(mixed / "mixed.yaml", count, **how)
    players = alone(mixed, count, backend)
    base, episode = 5 + torch.arange(count), torch.zeros(count, dtype=torch.int64)
    current: list[Any] = [None] * count

    def begin(row: int) -> Any:
        world = int(world_seeds(base[row : row + 1], episode[row : row + 1], pool))
        current[row] = players[row][world % 3]
        observed, _ = current[row].reset(seed=0, options={"worlds": world})
        return observed[0]

    observed, _ = env.reset(seed=5)
    assert torch.equal(observed, torch.stack([begin(row) for row in range(count)]))
    draws, waiting, ends = random.Random(2), [False] * count, 0
    for number in range(22):
        actions = random_actions(env, draws)
        observed, *flags, info = env.step(actions)
        finals = iter(info.get("final_obs", ()))
        for row in range(count):
            if waiting[row]:
                episode[row] += 1
                waiting[row] = False
                assert torch.equal(observed[row], begin(row))
                assert [float(flag[row]) for flag in flags] == [0, 0, 0]
                continue
            expected, *rest, told = current[row].step(actions[row : row + 1])
            assert [flag[row] for flag in flags] == [flag[0] for flag in rest]
            for name in ("success", "episode_return", "episode_length"):
                assert info[name][row] == told[name][0]
            if not bool(rest[1] | rest[2]):
                assert torch.equal(observed[row], expected[0])
                continue
            ends += 1
            if mode == "same_step":
                assert torch.equal(next(finals), expected[0])
                episode[row] += 1
                assert torch.equal(observed[row], begin(row))
            else:
                assert torch.equal(observed[row], expected[0])
                waiting[row] = True
        if mode == "disabled" and any(waiting):
            mask = torch.tensor(waiting)
            observed, _ = env.reset(options={"reset_mask": mask})
            for row in mask.nonzero()[:, 0].tolist():
                episode[row] += 1
                assert torch.equal(observed[row], begin(row))
            waiting = [False] * count
        if number == 9:
            continued = environment(mixed / "mixed.yaml", count, **how)
            assert torch.equal(continued.restore(env.state()), env.observation.of(env.episodes))
            env = continued
    assert ends > count


def test_episodes_begin_in_idle_rows(mixed: Path) -> None:
    from powderdsl.envs.mixed import MixedEnv

    skip_without_compiler()
    env = MixedEnv(mixed / "mixed.yaml", 24, backend="native")
    env.reset(seed=1)
    draws, layouts = random.Random(3), []
    for _ in range(60):
        _, _, terminated, truncated, _ = env.step(random_actions(env, draws))
        if bool((terminated | truncated).any()):
            layouts.append(env._joint)
            assert env.episodes is not None
            rulesets = env.program.ruleset_of(env.episodes.seed)
            assert env._joint is not None
            assert len(env._members) > 24
            for number, (_, members) in env._groups.items():
                assert sorted(members[members >= 0]) == (rulesets == number).nonzero()[:, 0].tolist()
    assert len(layouts) > 4
    assert len({*map(id, layouts[1:])}) == 1


def test_rulesets_without_episodes_keep_their_rows(mixed: Path) -> None:
    from powderdsl.envs.mixed import MixedEnv

    skip_without_compiler()
    env = MixedEnv(mixed / "mixed.yaml", 1, backend="native")
    env.reset(seed=1)
    draws, layouts = random.Random(5), []
    for _ in range(120):
        env.step(random_actions(env, draws))
        if len(env._groups) == 3:
            layouts.append(env._joint)
    assert len(layouts) > 20
    assert len({*map(id, layouts)}) == 1


@pytest.mark.parametrize("backend", ["wasm", "native"])
def test_results_under_different_rules_stay_while_they_are_held(mixed: Path, backend: str) -> None:
    from powderdsl.envs.mixed import MixedEnv

    if backend == "native":
        skip_without_compiler()
    env = MixedEnv(mixed / "mixed.yaml", 5, backend=backend)
    first, _ = env.reset(seed=3)
    draws, held, ends = random.Random(4), [(first.numpy(), first.numpy().copy())], 0
    for number in range(24):
        observed, reward, *_, info = env.step_arrays(random_actions(env, draws).numpy())
        ends += len(info["final_obs"])
        if number % 3:
            arrays = observed[1:], reward, info["final_obs"], info["world"], info["final_info"]["world"]
            held += [(array, array.copy()) for array in arrays]
        del observed, reward, info
    assert ends > 5
    assert all((array == copy).all() for array, copy in held)


def test_rulesets_join_the_others_when_they_are_compiled(
    mixed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import torch

    from powderdsl.envs.mixed import MixedEnv
    from powderdsl.simulation.simulator import Simulator

    skip_without_compiler()
    envs = [MixedEnv(mixed / "mixed.yaml", 9, backend=backend) for backend in ("wasm", "native")]
    native, slow = Simulator.native, envs[1].program.under(1).simulator.ruleset.name
    uncompiled, draws = {slow}, random.Random(4)
    monkeypatch.setattr(
        Simulator,
        "native",
        lambda sim, width: None if sim.ruleset.name in uncompiled else native(sim, width),
    )
    for env in envs:
        env.reset(seed=2, options={"worlds": 0})  # under the first ruleset
    assert envs[1]._joint is not None
    for compiled in (False, True):
        if compiled:
            uncompiled = {*()}
        for _ in range(20):
            actions = random_actions(envs[0], draws)
            results = [env.step(actions)[:4] for env in envs]
            assert all(map(torch.equal, *results))
        assert (envs[1]._joint is not None) == compiled


def test_native_worlds_draw_parameters_under_several_rulesets(tmp_path: Path) -> None:
    import torch

    from powderdsl.envs.mixed import MixedEnv

    skip_without_compiler()
    text = MELTING.replace("may: any", "may: [ice, lava, water]").replace(
        "rules: core+water+fire+lava",
        "rules: core+water+fire+lava\nrulesets: [core+water+fire+lava, core+fire+lava+water]",
    )
    (tmp_path / "melting.yaml").write_text(text, encoding="utf-8")
    envs = [MixedEnv(tmp_path / "melting.yaml", 12, backend=backend) for backend in ("wasm", "native")]
    draws, some = random.Random(5), torch.arange(12) % 2 == 0
    for options in (
        {},
        {"params": {"water.melt": 0.3}, "reset_mask": some},
        {"params": {}, "reset_mask": some},
        {"params": {"water.melt": 0.3}},
        {"params": {}},
    ):
        for env in envs:
            env.reset(seed=None if options else 6, options=options)
        for _ in range(16):
            actions = random_actions(envs[0], draws)
            assert all(map(torch.equal, *(env.step(actions)[:4] for env in envs)))
    assert envs[1]._joint is not None


def test_faces_show_worlds_under_different_rules(mixed: Path) -> None:
    import gymnasium.utils.env_checker
    import numpy as np

    from powderdsl.envs.gym import PowderEnv, PowderVectorEnv

    env = PowderVectorEnv(mixed / "mixed.yaml", 5, backend="wasm", render_mode="rgb_array")
    env.reset(seed=1)
    assert env.render() is not None
    for _ in range(14):
        observed, reward, *_ = env.step(env.action_space.sample())
    assert observed.shape == (5, 1, 16, 16)
    assert reward.dtype == np.float32
    gymnasium.utils.env_checker.check_env(
        PowderEnv(mixed / "mixed.yaml", backend="wasm"), skip_render_check=True
    )


def test_laws_tell_rulesets_apart(mixed: Path) -> None:
    import torch

    from powderdsl.envs.mixed import environment

    env = environment(mixed / "mixed.yaml", 6, backend="wasm", observation="laws", autoreset_mode="same_step")
    observed, info = env.reset(seed=0)
    told = observed[:, 1].flatten(1)
    rulesets = info["world"] % 3
    for first in range(6):
        for second in range(6):
            assert torch.equal(told[first], told[second]) == bool(rulesets[first] == rulesets[second])
    before = told.clone()
    for _ in range(6):
        observed, _, _, truncated, info = env.step(random_actions(env, random.Random(0)))
    assert truncated.any()
    assert torch.equal(info["final_obs"][:, 1].flatten(1), before[info["_final_obs"]])
    count = len(env.program.laws)
    assert count == 5 * 4 * 4
    assert (observed[:, 1].flatten(1)[:, count:] == 0).all()


def test_rules_that_a_task_does_not_fit_are_refused(mixed: Path) -> None:
    from powderdsl.envs.mixed import environment
    from tests.cli.commands import powderdsl as run

    (mixed / "p8.yaml").write_text(
        PACK.format(number=8, pool=2, bite=5, solvent="pool").replace("crust", "shell")
    )
    (mixed / "p9.yaml").write_text(
        PACK.format(number=9, pool=2, bite=5, solvent="pool").replace("id: 3", "id: 9")
    )
    place = mixed / "wrong.yaml"
    place.write_text(MIXED.replace("p2.yaml]", "p8.yaml]"), encoding="utf-8")
    checked = run("check", str(place), exits=2).output
    assert "unknown element `crust`" in checked
    assert "note: worlds of the split have the rules " in checked
    place.write_text(MIXED.replace("p2.yaml]", "p9.yaml]"), encoding="utf-8")
    env = environment(place, 3, backend="wasm")
    with pytest.raises(ValueError, match=r"observations or actions differ under .*p9"):
        env.reset(seed=0)
    assert env.episodes is None


def test_plain_environments_refuse_several_rulesets(mixed: Path) -> None:
    from powderdsl.envs.tensor_env import TensorEnv

    with pytest.raises(ValueError, match=r"different rulesets: use powderdsl\.envs\.mixed\.environment"):
        TensorEnv(mixed / "mixed.yaml")


def test_laws_that_are_the_same_everywhere_are_refused() -> None:
    from powderdsl.envs.tensor_env import TensorEnv

    with pytest.raises(ValueError, match="the laws of sand-pushing are the same in all worlds"):
        TensorEnv("sand-pushing", observation="laws")


def test_evaluations_and_recordings_follow_the_rulesets(mixed: Path, tmp_path: Path) -> None:
    from powderdsl.datasets import Dataset, record
    from powderdsl.rl.evaluation import evaluate
    from powderdsl.tasks.shipped import load_task

    task = load_task(mixed / "mixed.yaml")
    whole = evaluate(task, splits=["train"], policies=["expert", "nothing"], episodes=6, backend="wasm")
    returns = {score.policy: score.mean for score in whole.scores}
    singles = [
        evaluate(
            load_task(mixed / f"alone{number}.yaml"),
            splits=["train"],
            policies=["expert"],
            episodes=6,
            backend="wasm",
        )
        for number in range(3)
    ]
    assert returns["expert"] > returns["nothing"]
    assert min(alone.scores[0].mean for alone in singles) <= returns["expert"]
    record(mixed / "mixed.yaml", "expert", tmp_path / "data", episodes=6, backend="wasm")
    data = Dataset.open(tmp_path / "data")
    recorded = [float(data.episode(number).reward.sum()) for number in range(6)]
    assert sum(recorded) / 6 == pytest.approx(returns["expert"], abs=1e-5)


@pytest.mark.parametrize(
    ("change", "code", "text"),
    [
        ("melt: 1%..40%", "PD807", "the ranges of `water.melt` in `test` and in `train` overlap"),
        ("melt: 1%..200%", "PD402", "the parameter `water.melt` cannot be `1%..200%`"),
        ("melt: 40%..1%", "PD402", "the parameter `water.melt` cannot be `40%..1%`"),
        ("melt: ..5%", "PD402", "the parameter `water.melt` cannot be `..5%`"),
        ("molt: 1%..4%", "PD802", "unknown parameter `water.molt`"),
    ],
)
def test_wrong_ranges_are_reported(change: str, code: str, text: str) -> None:
    from powderdsl.diagnostics import CompileError

    reporter = Reporter()
    wrong = MELTING.replace("50%..90%", "30%..90%") if code == "PD807" else MELTING
    try:
        read_task(Source("test.yaml", wrong.replace("melt: 1%..40%", change, 1)), reporter)
    except CompileError:
        assert code != "PD807"
    assert [(diagnostic.code, diagnostic.message) for diagnostic in reporter.diagnostics][:1] == [
        (code, text)
    ]


def test_wrong_rulesets_are_reported(mixed: Path) -> None:
    from powderdsl.diagnostics import CompileError
    from powderdsl.tasks.shipped import load_task_with_diagnostics

    def codes(change: str) -> list[str]:
        place = mixed / "changed.yaml"
        place.write_text(MIXED.replace("[p3.yaml]", change), encoding="utf-8")
        try:
            _, diagnostics = load_task_with_diagnostics(place)
        except CompileError as error:
            diagnostics = error.diagnostics
        return [diagnostic.code for diagnostic in diagnostics]

    assert codes("[p3.yaml]") == []
    assert codes("[p1.yaml, p3.yaml]") == ["PD807"]
    assert codes("[../p3.yaml]") == ["PD112"]
    assert codes("[nothing]") == ["PD304"]
    assert codes("[p9..1.yaml]") == ["PD110"]
    assert codes("[p0..99999999.yaml]") == ["PD508"]
    assert codes("[universe:0..4095]") == []
    assert codes("[universe:0..4094, universe:5000..5001]") == ["PD508"]


def test_the_small_network_reads_laws(mixed: Path, tmp_path: Path) -> None:
    from powderdsl.rl import preset, train
    from powderdsl.rl.evaluation import evaluate

    how = {"observation": "laws", "steps": 128, "envs": 4, "rollout": 16, "backend": "wasm", "init_expert": 6}
    run = train(preset("small", str(mixed / "mixed.yaml"), **how), tmp_path / "run")
    scores = evaluate(run, splits=["train", "test"], policies=["trained"], episodes=4).scores
    assert [score.split for score in scores] == ["train", "test"]
    again = train(preset("small", str(mixed / "mixed.yaml"), **how | {"steps": 192}), tmp_path / "run")
    assert again.latest_checkpoint().step == 192
