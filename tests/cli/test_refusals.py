"""Bad input to any command: it ends with 2, says why, and nothing is written."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest

from powderdsl.cli import exits
from tests.cli.commands import PACK, powderdsl

FILES = {
    "grit.yaml": PACK,
    "drawing.txt": "# . G #\n# G . #\n# # # #\n",
    "ragged.txt": "..\n.\n",
    **dict.fromkeys(("broken.txt", "broken.npz", "broken.dat"), "??"),
    "empty.yaml": "",
    "case.yaml": "property: rock never changes\n",
    "world.yaml": "world: [9 9]\nproperty: x\n",
}
BAD_OPTIONS = (
    *("--steps many", "--size 0x4", "--batch 0", "--seed -1", f"--seed {2**64}", "--threads 0", "--scale 0"),
    *("--fps 0", "--every 0", "--backend abacus", "--set no-equals-sign", "--out x.jpg", "--nonsense"),
)
USAGE = (
    *(f"run core {option}" for option in BAD_OPTIONS),
    *("", "check", "run", "compile core", "compile core --emit poetry", "render core --world garden"),
    *("render core --world garden --out x.gif", "explain PD301 PD302"),
)
UNUSABLE = (
    *("''", "9", "'a b'", "a-b", "../a", "salt.yaml", "x" * 41, "é"),
    *("if", "count", "above", "powder", "core", "sand", "wood", "interact", "vanish", "powderworld"),
)
"""Names that a pack cannot have."""
WORLD = "run core+grit.yaml --backend reference --out x.png --world"
TRACE = "trace core+grit.yaml --backend reference --world drawing.txt"
RECORD = "record sand-pushing --out d --episodes 1"
REFUSED = (
    *((line, "Usage: powderdsl") for line in USAGE),
    ("chek core", "did you mean `check`?"),
    ("run core sand", "core+sand"),
    ("run core garden --out x.png", "--world garden"),
    ("train sand-pushing none", "powderdsl train --help"),
    (f"{WORLD} gardn", "error[PD601"),
    (f"{WORLD} none.png", "error[PD101"),
    (f"{WORLD} none.npz", "error[PD602"),
    (f"{WORLD} grit.yaml", "error[PD10"),
    (f"{WORLD} broken.npz", "error[PD602"),
    (f"{WORLD} broken.txt", "error[PD610"),
    (f"{WORLD} ragged.txt", "error[PD611"),
    (f"{WORLD} broken.dat", "error[PD602"),
    (f"{WORLD} garden", "error[PD604"),
    (f"{WORLD} ''", "error[PD601"),
    ("run core --size 100000x100000", "error[PD"),
    ("run core --batch 1000000", "error[PD"),
    ("run core+grit.yaml --set grit.vanish=200%", "error[PD"),
    ("run core+grit.yaml --set grit.vanish=often", "error[PD"),
    ("run core+grit.yaml --set grit.vanish=٢٠%", "error[PD402]"),
    ("run core+grit.yaml --steps ٣", "not a valid integer"),
    ("bench life --seconds ٣", "not a number above 0"),
    ("run core --out none/x.png", "error[PD"),
    ("run core --device cuda:99", "error[PD"),
    ("run life --size 600 --steps 0 --scale 64 --out x.png", "choose a smaller --scale"),
    ("run core --world saved.npz", "error[PD603"),
    ("run core+grit.yaml --world saved.npz --size 4x4", "size cannot be used with this world"),
    ("run core+grit.yaml --world saved.npz --batch 2", "--batch cannot be used with this world"),
    ("run core+grit.yaml --world saved.npz --seed 0", "--seed cannot be used with this world"),
    ("run core+grit.yaml --world drawing.txt --size 4x4 --watch", "size cannot be used with this world"),
    ("render core --world drawing.txt --out x.png", "error[PD"),
    ("render core+grit.yaml --world drawing.txt --out none/x.png", "error[PD"),
    ("bench no-such-rules", "PD304"),
    ("bench life --backend fast", "fast"),
    ("bench life --size 4096x4096 --batch 1000", "PD607"),
    ("bench life --only snow", "no element `snow`"),
    ("bench life --only a,,b", "NAME,NAME"),
    ("bench life --workload storm", "storm"),
    ("bench life --seconds nan", "seconds"),
    ("bench life --device abacus", "PD701"),
    ("bench life --set life.nonsense=3", "PD309"),
    ("bench life --beside missing.py", "missing.py"),
    ("train", "TASK"),
    ("train sand-pulling", "error[PD801"),
    ("train sand-pulling", "sand-pushing"),
    ("train gone.yaml", "error[PD101"),
    ("train destroying --knob lnies=3 --knob disks=65", "\n2 errors\n"),
    ("train sand-pushing --split tset", "no split"),
    ("train keep-ice --knob complexity=3", "no knob `complexity`"),
    ("train sand-pushing --network paper --observation rgb", "rgb"),
    ("train --resume nowhere", "nowhere"),
    ("train sand-pushing --resume nowhere", "--resume cannot be used with TASK"),
    ("train --resume nowhere --seed 2", "only steps"),
    ("evaluate nowhere", "PD620"),
    ("evaluate sand-pushing --policies trained", "random, nothing"),
    ("evaluate nowhere --knob lines=2", "a run has its own"),
    ("watch sand-pushing --policy trained", "no trained policy"),
    ("watch sand-pushing --out x.png", ".gif or .mp4"),
    ("watch sand-pushing --scale 32 --worlds 64 --out no/x.gif", "PD613"),
    ("record", "error: missing TASK, --out, --episodes\n"),
    ("record sand-pushing --episodes 1", "missing --out\n"),
    ("record --verify gone", "PD630"),
    ("record small --verify gone", "--verify cannot be used with TASK"),
    ("record --knob disks", "write NAME=N"),
    (f"{RECORD} --policy runs/clever", "PD620"),
    ("record --observation matrix", "matrix"),
    (f"{RECORD} --split tst", "did you mean `test`"),
    ("record destroying --out d --episodes 1 --policy nothing", "may neither `blow`"),
    ("show sand-pushing --split tset", "did you mean `test`"),
    ("show sand-pushing --knob lines", "NAME=N"),
    ("show sand-pushing --knob lines=99", "lines"),
    ("show sand-pushing --out sheet.gif", ".png"),
    ("show sand-pushing --out no/such/folder/sheet.png", "PD613"),
    ("show powderworld --out sheet.png", "--out"),
    (f"{TRACE} --at 9,1 --step 1", "no cell 9,1: the world has 3 rows and 4 columns"),
    (f"{TRACE} --at here --step 1", "write ROW,COLUMN"),
    (f"{TRACE} --at 1,1 --step 0", "0 is not in the range"),
    (f"{TRACE} --at 1,1 --step 1 --of momentun", "did you mean `momentum`?"),
    (f"{TRACE} --at 1,1 --step 1 --of density", "follows from the element"),
    (f"{TRACE} --at 1,1 --step 1 --number 7", "no world 7"),
    (f"{TRACE} --step 1", "--at"),
    ("compile life --emit kernels --backend reference", "error: "),
    ("compile life --emit kernels --backend native --pass life", "error: "),
    *(
        (f"compile powderworld --emit {stage} --pass mlt", "no pass `mlt`; did you mean `melt`?")
        for stage in ("tree", "model", "ir", "kernels")
    ),
    *(
        (f"test life {option}", "--mutate")
        for option in ("--write", "--packs life", "--mutants 3", "--jobs 1")
    ),
    ("test life --mutate --jobs 1 --packs nowhere", "life"),
    *((f"test life --replay {name}.yaml", "PD602") for name in ("empty", "case", "world")),
    ("test --replay case.yaml", "--replay"),
    ("test life --picture rock.gif", "--picture"),
    ("study start-stats", "did you mean `start-states`?"),
    ("ogbench eazy --out d", "did you mean `easy`"),
    ("record --to-minari me/small-v1", "missing --out"),
    (
        "record --out d --to-minari me/a-v0 --from-minari me/a-v0",
        "--to-minari cannot be used with --from-minari",
    ),
    ("record small --out d --to-minari me/a-v0", "--to-minari cannot be used with TASK"),
    *((f"new {name}", "error: ") for name in UNUSABLE),
    ("new salt --dir nowhere", "PD613"),
)


@pytest.mark.parametrize(("line", "words"), REFUSED)
def test_bad_input_ends_with_2_says_why_and_writes_nothing(folder: Path, line: str, words: str) -> None:
    for name, text in FILES.items():
        Path(name).write_text(text)
    if "saved" in line:
        powderdsl(*f"{WORLD} drawing.txt --steps 0 --out saved.npz".split(), exits=0)
    before = sorted(folder.rglob("*"))
    result = powderdsl(*shlex.split(line), exits=exits.BAD_INPUT)
    assert words in result.stderr
    assert "PD901" not in result.stderr
    assert result.stdout == ""
    assert sorted(folder.rglob("*")) == before
