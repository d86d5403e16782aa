"""`python -m docs.page_table`: seconds from an edited rule file to running code, in Pyodide under Node.js."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from tempfile import TemporaryDirectory

from tests.web.packages import PACKAGES, write_packages
from tests.wheels import build_wheel, succeed

HERE = Path(__file__).parent
WEB = HERE.parent / "tests" / "web"


def main() -> None:
    """Print a table for docs/performance.md. Each row is the best of five; only the first one happens once."""
    node = shutil.which("node")
    assert node is not None, "Node.js is missing"
    busy = os.getloadavg()[0]
    with TemporaryDirectory() as name:
        folder = Path(name)
        wheel = build_wheel(folder)
        write_packages(folder / "packages.zip", PACKAGES)
        command = (node, WEB / "pyodide.mjs", folder, HERE / "page_edits.py", wheel, folder / "packages.zip")
        succeed(*command, cwd=folder)
        found: dict[str, dict[str, float]] = json.loads((folder / "seconds.json").read_text())
    phases = list(found["from scratch"])
    print(f"load of the machine before: {busy:.1f}\n")
    print("| seconds | " + " | ".join(phases) + " |")
    print("|---|" + "---:|" * len(phases))
    for row, seconds in found.items():
        print(
            f"| {row} | "
            + " | ".join(f"{seconds[one]:.2f}" if one in seconds else "" for one in phases)
            + " |"
        )


if __name__ == "__main__":
    main()
