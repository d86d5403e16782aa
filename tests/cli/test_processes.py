"""The command line as processes: what it imports, terminals, and Ctrl-C."""

from __future__ import annotations

import os
import pty
import signal
import subprocess
import sys
import time
from select import select

import pytest

from tests.cli.commands import command_line, environment_with
from tests.processes import started

SLOW_IMPORTS = {"gymnasium", "stable_baselines3", "matplotlib", "tensorboard"}
"""What none of these commands needs."""


@pytest.mark.parametrize(
    ("arguments", "unwanted"),
    [
        (["--help"], {"torch", "numpy", "rich", "lark", "yaml", "PIL"}),
        (["explain", "PD301"], {"torch", "numpy", "rich", "lark", "yaml", "PIL"}),
        (["check", "--quick", "core+sand"], {"torch", "numpy", "rich", "PIL"}),
        (["check", "core+sand"], {"torch", "rich", "PIL"}),
        (["run", "core", "--steps", "2", "--size", "8x8"], {"torch", "rich", "PIL"}),
        (["trace", "core", "--at", "1,1", "--step", "1", "--size", "8x8"], {"torch", "rich", "PIL"}),
        (["show", "core"], {"torch", "numpy", "rich", "PIL"}),
        (["compile", "core", "--emit", "ir"], {"torch", "rich", "PIL"}),
        (["compile", "core", "--emit", "kernels", "--backend", "wasm"], {"torch", "rich", "PIL"}),
        (["study", "learning", "--dry-run"], {"torch", "PIL"}),
    ],
)
def test_commands_import_only_what_they_need(arguments, unwanted):
    program = (
        "import sys\nfrom powderdsl.cli import main\n"
        f"try:\n    main({arguments!r})\nexcept SystemExit as end:\n    assert not end.code, end.code\n"
        f"print(sorted({unwanted | SLOW_IMPORTS!r} & sys.modules.keys()), file=sys.stderr)"
    )
    run = subprocess.run(
        [sys.executable, "-c", program], env=environment_with(), capture_output=True, text=True, check=True
    )
    assert run.stderr.splitlines()[-1] == "[]"


def on_terminal(*arguments: str, interrupt: str = "", **environment: str) -> tuple[int, str]:
    """The exit code, and what a terminal received. Ctrl-C is sent once `interrupt` has been seen."""
    leader, follower = pty.openpty()
    received, end = b"", time.monotonic() + 240
    with (
        os.fdopen(leader, "rb", buffering=0) as terminal,
        started(
            command_line(*arguments),
            env=environment_with(TERM="xterm", **environment),
            stdin=follower,
            stdout=follower,
            stderr=follower,
            start_new_session=True,
        ) as running,
    ):
        os.close(follower)
        while True:
            assert select([terminal], [], [], end - time.monotonic())[0], received.decode()
            try:
                piece = terminal.read(65536)
            except OSError:  # Linux says so when the other end has been closed
                break
            if not piece:
                break
            received += piece
            if interrupt and interrupt.encode() in received:
                interrupt = ""
                running.send_signal(signal.SIGINT)
        return running.wait(timeout=60), received.decode()


SMALL = ("--backend", "reference", "--size", "8x8")


def test_a_live_view_is_drawn_in_place_and_can_be_interrupted():
    status, shown = on_terminal(
        "run", "life", *SMALL, "--steps", "1000000", "--watch", interrupt="step 2 ", NO_COLOR=""
    )
    assert status == 130
    assert shown.count("\x1b[?25l") == shown.count("\x1b[?25h") == 1
    assert "life  step 2 of 1000000" in shown
    assert "▀" in shown
    assert "\x1b[?25h" in shown[-40:]
    assert "Traceback" not in shown


def test_progress_is_shown_on_a_terminal_and_goes(tmp_path):
    out = tmp_path / "x.npz"
    status, shown = on_terminal("run", "life", *SMALL, "--steps", "400", "--out", str(out))
    assert status == 0
    assert "/400" in shown
    assert shown.rstrip().endswith(f"-> {out}")


def test_diagnostics_and_pages_are_colored_on_terminals_only():
    _, shown = on_terminal("check", "nonsense", NO_COLOR="")
    assert "\x1b[31;1m" in shown
    status, page = on_terminal("explain", "PD301", NO_COLOR="")
    assert status == 0
    assert "\x1b[" in page
    assert "PD301" in page
    _, plain = on_terminal("check", "nonsense", NO_COLOR="1")
    assert "\x1b" not in plain
