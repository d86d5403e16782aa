"""The group of commands. One table has the names and summaries, so that `--help` imports nothing else."""

from __future__ import annotations

import gc
import os
import sys
import warnings
from collections.abc import Sequence
from contextlib import nullcontext
from importlib import import_module
from typing import Any, NoReturn

import click

from powderdsl.cli.exits import report_failure, version
from powderdsl.diagnostics.printable import printable_streams
from powderdsl.system.interrupts import LIFELINE, end_with_stdin, interruptible

GROUPS = {
    # title: names, as of the modules in powderdsl.cli.commands, and summaries
    "Start": {
        "new": "Create a starter pack: an element, a rule and a test.",
        "run": "Run a world: watch it, or write a picture or an animation.",
        "play": "Open a page to paint worlds and change their rules while they run.",
        "render": "Draw a world as a picture, without running it.",
    },
    "Rules": {
        "check": "Find all mistakes in rule files and tasks at once.",
        "test": "Run the tests of packs and check their invariants.",
        "prove": "Prove that two rulesets are equivalent, or that a claim always holds.",
        "trace": "Explain a cell: which rule wrote it, and what the rule read.",
        "show": "List elements, reactions, passes and parameters, or describe a task.",
        "universe": "Print the rule pack generated from a seed: invented elements and laws.",
        "fmt": "Format YAML files, keeping comments.",
        "schema": "Print the JSON Schema of all files, for editors.",
        "lsp": "Run a language server for editors.",
        "explain": "Explain a diagnostic code and how to fix it.",
        "compile": "Print the output of a compiler stage.",
        "bench": "Measure how fast rules run on each backend, batch and world size.",
        "export": "Write rules as a WebAssembly module, or a task as a C header.",
        "cache": "List or remove cached compiled code.",
    },
    "Learn": {
        "train": "Train an agent on a task, or resume an interrupted run.",
        "evaluate": "Compare an agent with a random policy and with doing nothing.",
        "watch": "Record a video of an agent at its task.",
        "curves": "Plot learning curves of runs, with confidence intervals over seeds.",
        "record": "Record episodes of a task for offline learning and world models.",
        "wm": "World models: train, test and fine-tune networks that predict worlds.",
        "study": "Train over many settings and seeds, and compare the results.",
        "ogbench": "Collect the datasets of OGBench's Powderworld.",
    },
}
COMMANDS = {name: summary for group in GROUPS.values() for name, summary in group.items()}


_usual = warnings.formatwarning


def plain_warning(message: Warning | str, category: type[Warning], *rest: Any, **options: Any) -> str:
    """The text of a warning: our own as one sentence, others with the line that raised them."""
    from powderdsl.targets.cpp.build import NoCompilerWarning

    if issubclass(category, NoCompilerWarning):
        return f"note: {message}\n"
    return _usual(message, category, *rest, **options)


class GuardedCommand(click.Command):
    """A command that turns every failure into an exit code."""

    def main(
        self, args: Sequence[str] | None = None, prog_name: str | None = None, *rest: Any, **options: Any
    ) -> NoReturn:
        """Run a command and exit with one of the codes of `exits`."""
        for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
            if getattr(sys, name) is None:  # closed (`>&-`): keep our files from getting its number
                setattr(sys, name, open(os.devnull, mode, encoding="utf-8"))  # noqa: SIM115 until the end
        # A character that the terminal cannot show becomes a `?`.
        for stream in (sys.stdout, sys.stderr):
            if hasattr(stream, "reconfigure"):
                stream.reconfigure(errors="replace")
        # Objects of commands stay alive: searching them for cycles took a tenth of the run time.
        gc.set_threshold(100_000)
        options["standalone_mode"] = False
        warnings.formatwarning = plain_warning
        if os.environ.pop(LIFELINE, None):
            end_with_stdin()
        # For completion, click writes bytes to a shell: only our own names, nothing from files.
        completes = "_POWDERDSL_COMPLETE" in os.environ
        with nullcontext() if completes else printable_streams(), interruptible():
            try:
                status = super().main(args, prog_name or self.name, *rest, **options)
            except (Exception, KeyboardInterrupt) as error:
                status = report_failure(error)
        sys.exit(status or 0)


class CommandGroup(GuardedCommand, click.Group):
    """Import commands lazily, and suggest one for an unknown name."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command:
        if cmd_name not in COMMANDS:
            from powderdsl.diagnostics import with_suggestion

            ctx.fail(with_suggestion(f"no command `{cmd_name}`", cmd_name, COMMANDS, "commands"))
        command: click.Command = import_module(f"powderdsl.cli.commands.{cmd_name}").command
        if ctx.resilient_parsing:  # called by a shell
            from powderdsl.cli.completion import add_completion

            add_completion(command)
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        for title, rows in GROUPS.items():
            with formatter.section(title):
                formatter.write_dl(list(rows.items()))


@click.group(
    cls=CommandGroup,
    name="powderdsl",
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100, "show_default": True},
)
@click.version_option(version(), prog_name="powderdsl", message="%(prog)s %(version)s")
def main() -> None:
    """Write the rules of pixel worlds in YAML; check, run and train on them.

    RULES is always a shipped ruleset or pack, a rule file, or several of them joined by `+`; `-PACK` leaves a pack out.

    \b
        powderdsl run RULES --watch
        powderdsl new NAME && powderdsl check NAME.yaml

    docs/shell.md lists environment variables and explains how to set up shell completion.
    """
