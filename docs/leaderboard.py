"""Keeps the results of studies with what repeats them: the rules' hashes, the seeds and the command.

    python docs/leaderboard.py add studies/unseen-laws-small     # writes docs/results/unseen-laws.json
    python docs/leaderboard.py replay --sample 3                 # runs three combinations of all files again

`replay` draws combinations by `--seed`, runs them anew and compares every measure. It ends with exit code 1 if a task or its
rules have changed since, or if a measure differs by more than `--tolerance`: processors round differently, which training
amplifies, so only the same kind of processor gives the same digits.
"""

from __future__ import annotations

import argparse
import json
import random
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from typing import Any

from powderdsl.cli.commands.study import commands
from powderdsl.compiler import load
from powderdsl.experiments.studies.study import Study, load_study
from powderdsl.system.settings import fingerprint
from powderdsl.tasks.shipped import load_task

RESULTS = Path(__file__).with_name("results")


def hash_of(task: str) -> str:
    """Sixteen hexadecimal digits of a task, and of the first and the last rules of each split.

    The others are left out to save minutes: a change of the generator changes these, too.
    """
    model = load_task(task)
    rules = {rules: None for split in model.splits for rules in (*split.rulesets[:1], *split.rulesets[-1:])}
    digits = [fingerprint(model), *(fingerprint(load(*names)) for names in rules)]
    return sha256("".join(digits).encode()).hexdigest()[:16]


def command_of(entry: Mapping[str, Any], point: Mapping[str, Any]) -> list[str]:
    """The words of the command that runs one combination."""
    only = [word for name, value in point["values"].items() for word in ("--only", f"{name}={value}")]
    seed = ["--only", f"seed={point['seed']}", "--seeds", str(point["seed"] + 1)]
    return ["powderdsl", "study", entry["study"], "--size", entry["size"], *only, *seed]


def tasks_of(study: Study, size: str) -> list[str]:
    """The tasks that a study's first step works on."""
    on = study.steps[0].on
    return sorted({point.filled(on) for point in study.points(size, 1)}) if on is not None else []


def add(folder: Path, results: Path = RESULTS, study: str | None = None) -> Path:
    """Write the results of a study's folder, and return the file. `study`: its file, if it is not a shipped one."""
    data = json.loads((folder / "results.json").read_text())
    name = study or data["study"]
    points = [
        {name: point[name] for name in ("values", "seed", "measures")}
        for point in data["points"]
        if point["problem"] is None
    ]
    entry = {
        "study": name,
        "size": data["size"],
        "command": f"powderdsl study {name} --size {data['size']}",
        "versions": {name: version(name) for name in ("powderdsl", "torch", "stable-baselines3")},
        "rules": {task: hash_of(task) for task in tasks_of(load_study(name, commands()), data["size"])},
    }
    results.mkdir(exist_ok=True)
    path = results / f"{data['study']}.json"
    *head, end = json.dumps(entry, indent=1).splitlines()
    rows = ",\n".join(f"  {json.dumps(point)}" for point in points)  # one line each
    path.write_text("\n".join(head) + f',\n "points": [\n{rows}\n ]\n{end}\n')
    return path


def differences(entry: Mapping[str, Any], point: Mapping[str, Any]) -> dict[str, float]:
    """By how much each measure of a combination is larger now, in a new run."""
    with tempfile.TemporaryDirectory() as folder:
        words = [*command_of(entry, point), "--jobs", "1", "--out", folder]
        subprocess.run([sys.executable, "-m", *words], check=True, stdout=subprocess.DEVNULL)
        data = json.loads((Path(folder) / "results.json").read_text())
    measures = next(new["measures"] for new in data["points"] if new["seed"] == point["seed"])
    return {name: measures[name] - value for name, value in point["measures"].items()}


def replay(paths: Sequence[Path], sample: int, seed: int, tolerance: float) -> bool:
    """Run a sample of combinations again and print what differs; true if nothing does."""
    entries = [json.loads(path.read_text()) for path in paths]
    same = True
    for entry in entries:
        for task, digits in entry["rules"].items():
            if hash_of(task) != digits:
                print(f"{entry['study']}: the task {task} or its rules have changed since")
                same = False
    choices = [(entry, point) for entry in entries for point in entry["points"]]
    for entry, point in random.Random(seed).sample(choices, min(sample, len(choices))):
        changes = differences(entry, point)
        largest = max(map(abs, changes.values()))
        print(
            shlex.join(command_of(entry, point)), f"largest difference {largest:.6g}", sep="\n  ", flush=True
        )
        same &= largest <= tolerance
    return same


def main() -> None:
    """Add or replay, as the command line says."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    actions = parser.add_subparsers(dest="action", required=True)
    actions.add_parser("add").add_argument("folders", type=Path, nargs="+")
    again = actions.add_parser("replay")
    again.add_argument("files", type=Path, nargs="*", default=sorted(RESULTS.glob("*.json")))
    again.add_argument("--sample", type=int, default=2)
    again.add_argument("--seed", type=int, default=0)
    again.add_argument("--tolerance", type=float, default=1e-6)
    options = parser.parse_args()
    if options.action == "add":
        for folder in options.folders:
            print(add(folder))
    elif not replay(options.files, options.sample, options.seed, options.tolerance):
        sys.exit(1)


if __name__ == "__main__":
    main()
