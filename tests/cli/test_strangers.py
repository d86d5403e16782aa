"""Packs by strangers, from the command line alone: every command that takes rules or a task takes them."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import pytest

from tests.cli.commands import ROOT, powderdsl
from tests.tiers import tiered

ELEMENT = """
pack: slime
needs: core
elements:
  slime: {id: 14, density: 3, gravity: yes, color: "#60C040", tags: fluid}
passes:
  creep: {after: flow, do: "empty -> slime if count(slime) > 3 with chance 5%"}
tests:
  - slime flows:
      given: |
        s .
        # #
      after: 20 steps
      always: not wall or below is not slime
"""
BEETLE = ROOT / "docs" / "examples" / "beetle.yaml"
FIELD = """
pack: heat
about: A field, and no element.
needs: [core, sand]
fields:
  heat: {type: 0..9, at: place}
passes:
  warm: {do: [heat += 1 where sand, heat -= 1 where empty]}
"""
AUTOMATON = """
pack: bugs
needs: core
kernels:
  wide: [ROWS]
elements:
  dot: {id: 50, color: "#8040C0"}
passes:
  grow:
    do:
      - empty -> dot if count(dot in wide) in 34..45
      - dot -> empty if count(dot in wide) not in 34..58
""".replace("ROWS", ", ".join(['"' + " ".join("1" * 11) + '"'] * 11))

TASK = """
task: pool
rules: powderworld
size: [12, 12]
fill: empty
generate:
  - square (sand, water) at (2..9, 2..9) half 1..3
  - frame wall
agent: {may: [empty, sand], bins: 2, brush: 4, actions: 2, steps_per_action: 1}
reward: {each: count(sand)}
"""
MODEL = shlex.split("--width 1 --iterations 2 --batch 2 --worlds 4 --buffer 64 --refresh 2 --backend wasm")
AGENT = shlex.split(
    "--preset small --features 2 --envs 2 --rollout 4 --batch 4 --epochs 1 --steps 8 --backend wasm"
)
PACKS = {"slime": ELEMENT, "heat": FIELD, "beetle": BEETLE.read_text("utf-8"), "bugs": AUTOMATON}


@pytest.fixture(autouse=True)
def _files(folder: Path) -> None:
    for name, text in PACKS.items():
        Path(f"{name}.yaml").write_text(text)
    Path("pool.yaml").write_text(TASK)


def run(*words: str) -> str:
    return str(powderdsl(*words, exits=0).stdout)


@pytest.mark.slow
@pytest.mark.parametrize("name", tiered(PACKS, ["beetle"]))
def test_a_pack_of_each_kind_goes_through_every_command(name: str) -> None:
    file = f"{name}.yaml"
    run("check", f"powderworld+{file}", "--quick")
    run(*f"run powderworld+{file} --size 12x12 --steps 3 --backend wasm --out w.npz".split())
    run("wm", "train", "pool.yaml", *MODEL, "--run", "less")
    run("wm", "finetune", "less", "--packs", file, "--iterations", "2", "--backend", "wasm", "--run", "more")
    run("wm", "eval", "more", "--split", "train", "--worlds", "2", "--backend", "wasm")
    held = ["--rules", f"powderworld+{file}", "--held-out", name]
    run("wm", "train", "pool.yaml", *held, *MODEL, "--run", "held")
    run("wm", "finetune", "held", "--packs", name, "--iterations", "2", "--backend", "wasm", "--run", "back")
    run("train", "pool.yaml", *AGENT, "--packs", file, "--run", "agent")
    run("evaluate", "agent", "--episodes", "2")
    run("train", "pool.yaml", *AGENT, "--slots", "16", "--observation", "compact", "--run", "roomy")
    run("evaluate", "roomy", "--packs", file, "--episodes", "2")
    run("record", "pool.yaml", "--packs", file, "--out", "data", "--episodes", "2", "--backend", "wasm")
    palettes = [
        json.loads(Path(one, "run.json").read_text())["config"]["palette"] for one in ("more", "back")
    ]
    assert palettes[0] == palettes[1]
    added = {"slime": ["slime.slime"], "heat": [], "beetle": ["beetle.beetle"], "bugs": ["bugs.dot"]}[name]
    assert palettes[0][14:] == added


@pytest.mark.slow
def test_two_packs_with_one_id_and_one_that_has_no_room(tmp_path: Path) -> None:
    Path("ooze.yaml").write_text(ELEMENT.replace("slime", "ooze"))
    shown = json.loads(run("show", "powderworld+slime.yaml+ooze.yaml", "--json"))
    ids = {one["name"]: one["id"] for one in shown["elements"]}
    assert (ids["slime"], ids["ooze"]) == (14, 15)
    run("train", "pool.yaml", *AGENT, "--slots", "15", "--run", "agent")
    result = powderdsl("evaluate", "agent", "--packs", "slime.yaml,ooze.yaml", "--episodes", "2", exits=2)
    assert "PD623" in result.stderr
    assert "--slots 16" in result.stderr


def test_a_pack_that_asks_for_even_sides_is_added_to_packs_with_odd_tests() -> None:
    Path("even.yaml").write_text(
        ELEMENT.replace("slime", "seven").replace("needs: core", "needs: core\nside_multiple: 2")
    )
    shown = run("check", "core+even.yaml", "--quick", "--notes")
    assert "this test is inactive: its world has sides that these rules do not allow" in shown


def test_values_that_ask_each_other_twice_take_no_time() -> None:
    lets = "".join(
        f"      v{n}: (v{n - 1} and above is empty) or (v{n - 1} and below is empty)\n" for n in range(1, 60)
    )
    Path("deep.yaml").write_text(
        "pack: deep\nneeds: core\nelements: {bee: {color: '#112233'}}\npasses:\n  p:\n    let:\n"
        f"      v0: row mod 2 == 0 and here is bee\n{lets}    do: bee -> empty if v59\n    then: empty -> bee if v58\n"
    )
    run("check", "core+deep.yaml", "--quick")
