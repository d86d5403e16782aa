"""Users' own networks: built and checked from the command line, and never imported because a file names them."""

from __future__ import annotations

import json
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from powderdsl.diagnostics import CompileError
from powderdsl.experiments.runs import read_metrics
from powderdsl.worldmodel import TrainConfig, custom_network, load_trained, train
from powderdsl.worldmodel.networks import ActionChannels, CustomNetwork
from tests.cli.commands import powderdsl as run
from tests.refusals import refusal, refused_codes
from tests.states import logged, same
from tests.tiers import tiered
from tests.worldmodel.test_training import HERE, tiny, weights

QUICK = ("--batch", 4, "--buffer", 32, "--refresh", 2, "--worlds", 8, "--backend", "torch")

NETS = """
import torch
from pathlib import Path
from torch import nn

if Path("watched").exists():
    Path("imported").touch()

class Wide(nn.Module):
    def __init__(self, channels, slots):
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv2d(channels, 8, 3, padding=1), nn.ReLU(), nn.BatchNorm2d(8), nn.Dropout(0.2), nn.Conv2d(8, slots, 1)
        )

    def forward(self, cells):
        assert cells.dtype == torch.float32 and cells.is_contiguous()
        return self.layers(cells)

def made(channels, slots):
    return Wide(channels, slots)

class Flat(Wide):
    def forward(self, cells):
        return self.layers(cells).argmax(1)

class Words(Wide):
    def forward(self, cells):
        return "sand"

class Still(nn.Module):
    def __init__(self, channels, slots):
        super().__init__()
        self.unused = nn.Parameter(torch.zeros(3))

    def forward(self, cells):
        return cells

class Broken(Wide):
    def forward(self, cells):
        raise RuntimeError("no such layer")

class Other(nn.Module):
    def __init__(self, width):
        super().__init__()

class NoModule:
    def __init__(self, channels, slots):
        pass

number = 3
"""


@pytest.fixture(autouse=True)
def _folder(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    torch.set_num_threads(1)
    Path(folder, "nets.py").write_text(NETS, encoding="utf-8")
    Path(folder, "faulty.py").write_text("import nowhere\n", encoding="utf-8")
    monkeypatch.setattr(sys, "path", [*sys.path])
    sys.modules.pop("nets", None)
    yield
    for name in ("nets", "faulty"):
        sys.modules.pop(name, None)


def was_imported(*words: object) -> tuple[int, str, bool]:
    """The exit code and output of a command, and whether it imported `nets`."""
    sys.modules.pop("nets", None)
    Path("watched").touch()
    Path("imported").unlink(missing_ok=True)
    result = run(*words)
    return result.exit_code, result.output, "nets" in sys.modules or Path("imported").exists()


@pytest.mark.parametrize("name", tiered(["nets:Wide", "nets:made"], ["nets:made"]))
def test_a_network_of_ones_own_is_trained_and_tested(name: str, dunes: str) -> None:
    words = ("wm", "train", dunes, "--run", "run", *QUICK, "--iterations", 3, "--network", name)
    run(*words, exits=0)
    config = json.loads(Path("run/run.json").read_text())["config"]
    assert config["network"] == name
    how = ("--network", name, "--split", "two", "--backend", "torch")
    run("wm", "eval", "run", "--worlds", 1, *how, exits=0)
    run("wm", "show", "run", "--out", "strips.png", *how, exits=0)
    run(*words, exits=0)


@pytest.mark.parametrize("name", [None, "nets:Wide"])
def test_a_run_in_parts_is_a_run_at_once(name: str | None, dunes: str) -> None:
    """Also with layers that draw random numbers, and with those that keep statistics. Validation changes no weight."""
    config, network = tiny(dunes), custom_network(name) if name else None
    how = {"machine": HERE, "network": network, "validate_every": 8}
    plain = train(config, "plain", machine=HERE, network=network)
    whole = train(config, "whole", **how)
    found = {line["step"]: line for line in read_metrics(whole.path)}
    assert [step for step, line in found.items() if "loss/validation" in line] == [8, 16, 24, 30]
    assert [step for step, line in found.items() if "loss/train" in line] == [10, 20, 30]
    assert found[30]["loss/validation"] < found[8]["loss/validation"]
    for score in ("accuracy", "changed_accuracy", "change_f1", "ece", "change_ece"):
        assert 0 <= found[30][f"validation/{score}"] <= 1

    def stop(done: int, *_: float | None) -> None:
        if done in (7, 14):
            signal.raise_signal(signal.SIGINT)
        if done == 19:
            raise RuntimeError("stopped")

    for error, seconds in ((KeyboardInterrupt, 600), (KeyboardInterrupt, 600), (RuntimeError, 0)):
        with pytest.raises(error):
            train(config, "parts", save_seconds=seconds, tell=stop, **how)
    torch.rand(100)  # what else the process draws makes no difference
    for _ in range(2):  # then it is done
        parts = train(config, "parts", **how)
        assert same(weights(parts), weights(whole))
    assert same(weights(plain), weights(whole))
    assert logged(parts) == logged(whole)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("nowhere:Net", "ModuleNotFoundError: No module named 'nowhere'"),
        ("faulty:Net", "faulty.py:1"),
        ("nets:Widee", "did you mean `Wide`?"),
        ("nets:number", "expected a class, found int"),
        ("../nets:Wide", "write MODULE:CLASS"),
        ("nets:Other", "TypeError"),
        ("nets:NoModule", "must return a torch.nn.Module, found NoModule"),
        ("nets:Flat", "must return logits [2, 10, 14, 18], found [2, 14, 18] of torch.int64"),
        ("nets:Words", "must return logits [2, 10, 14, 18], found str"),
        ("nets:Still", "no parameter gets a gradient"),
        ("nets:Broken", "RuntimeError: no such layer"),
    ],
)
def test_networks_that_cannot_be_trained_are_refused(name: str, said: str) -> None:
    encoder = ActionChannels(10)
    (found,) = refusal(lambda: custom_network(name).check(encoder, (14, 18), 0))
    assert found.code == "PD625"
    assert said in " ".join([found.message, *found.notes, *found.helps])


def test_they_are_refused_before_a_run_begins(dunes: str) -> None:
    result = run("wm", "train", dunes, "--run", "run", *QUICK, "--network", "nets:Broken", exits=2)
    line = NETS[: NETS.index("no such layer")].count("\n") + 1
    assert f"nets.py:{line}" in result.output
    assert not Path("run").exists()


# What files name is never imported


def test_a_run_that_names_a_network_needs_it_on_the_command_line(dunes: str) -> None:
    words = ("wm", "train", dunes, "--run", "run", *QUICK, "--iterations", 1)
    run(*words, "--network", "nets:Wide", exits=0)
    for others in (
        ("eval", "run"),
        ("show", "run", "--out", "strips.png"),
        ("finetune", "run", "--packs", "stone", "--run", "tuned"),
    ):
        code, output, imported = was_imported("wm", *others, "--backend", "torch")
        assert (code, imported) == (2, False), output
        assert "PD623" in output
        assert "the custom network `nets:Wide`" in output
        code, output, imported = was_imported("wm", *others, "--backend", "torch", "--network", "nets:made")
        assert code == 2, output
        assert "it was trained with `nets:Wide`, not with `nets:made`" in output
    code, output, imported = was_imported(*words)
    assert (code, imported) == (2, False), output
    assert '`network` is "nets:Wide" there, not set here' in output
    before = torch.random.get_rng_state()
    config = TrainConfig.of(load_trained("run", network=custom_network("nets:Wide")).run.config)
    assert torch.equal(torch.random.get_rng_state(), before)
    # What a run's file says decides nothing either.
    assert refused_codes(train, config, "other", machine=HERE) == ["PD623"]
    assert not Path("other").exists()


def test_a_run_of_the_u_net_has_no_name_and_hostile_names_are_text(dunes: str) -> None:
    words = ("wm", "train", dunes, "--run", "run", *QUICK, "--width", 2, "--iterations", 1)
    run(*words, exits=0)
    assert "network" not in json.loads(Path("run/run.json").read_text())["config"]
    result = run("wm", "eval", "run", "--network", "nets:Wide", "--backend", "torch", exits=2)
    assert "it was trained with the paper's U-net, not with `nets:Wide`" in result.output
    assert "--width is for the U-net" in run(*words, "--network", "nets:Wide").output
    about = json.loads(Path("run/run.json").read_text())
    for name in ("nets:Wide", 3, ["nets:Wide"], "nets", "os:system('x')", "a" * 5000 + ":b"):
        about["config"]["network"] = name
        Path("run/run.json").write_text(json.dumps(about))
        for command in (("wm", "eval", "run", "--backend", "torch"), words):
            code, output, imported = was_imported(*command)
            assert (code, imported) == (2, False), (name, output)
            assert "Traceback" not in output


def test_names_of_networks() -> None:
    for wrong in ("nets", "nets:", ":Wide", "a:b:c", "a b:c", "a:b()", "../a:b", ""):
        with pytest.raises(CompileError) as error:
            custom_network(wrong)
        assert "write MODULE:CLASS" in error.value.diagnostics[0].notes[0]


def test_what_is_installed_comes_before_the_current_folder() -> None:
    Path("torch.py").write_text("raise SystemExit\n", encoding="utf-8")
    found = custom_network("torch.nn:Conv2d")
    assert found == CustomNetwork("torch.nn:Conv2d", torch.nn.Conv2d)
