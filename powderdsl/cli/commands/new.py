"""`powderdsl new`: write a starter pack with an element, a rule and a test."""

from __future__ import annotations

import colorsys
from contextlib import suppress
from pathlib import Path
from string import Template

import click

from powderdsl.cli import options as opt
from powderdsl.cli.exits import BadInput
from powderdsl.compiler import read, shipped_rules, shipped_words
from powderdsl.diagnostics import CompileError, Reporter, Severity, Source
from powderdsl.model.check import check
from powderdsl.model.declarations import PackDecl, read_file
from powderdsl.model.schema import MAX_NAME, NAME
from powderdsl.system.random import name_number
from powderdsl.system.writing import write_text

TEMPLATE = Path(__file__).with_name("first_pack.yaml")


@click.command("new")
@click.argument("name")
@opt.path("--dir", "PATH", "The folder of the new file.", to="folder", default=".")
def command(name: str, folder: Path) -> None:
    """Write NAME.yaml, a starter pack with an element, a rule and a test. Existing files are not overwritten."""
    if not NAME.match(name) or len(name) > MAX_NAME:
        raise BadInput(
            f"`{name}` is not a name for a pack: use up to {MAX_NAME} letters, digits and `_`, a letter first"
        )
    path = folder / f"{name}.yaml"
    if path.exists() or path.is_symlink():
        raise BadInput(f"{path} exists already")
    opt.check_writable(path)
    if name in shipped_rules() or name in shipped_words():
        raise BadInput(f"`{name}` comes with powderdsl: choose another name")
    color = colorsys.hsv_to_rgb(name_number(name) / 2**32, 0.55, 0.85)
    digits = "".join(f"{round(part * 255):02X}" for part in color)
    text = Template(TEMPLATE.read_text(encoding="utf-8")).substitute(name=name, color=f"#{digits}")
    # The name may be taken by the language or by the required pack.
    reporter = Reporter()
    packs, _ = read(["core"], reporter)
    new = read_file(Source(f"{name}.yaml", text), reporter)
    if isinstance(new, PackDecl):
        with suppress(CompileError):
            check([*packs, new], None, reporter)
    for diagnostic in reporter.diagnostics:
        if diagnostic.severity is Severity.ERROR:
            raise BadInput(f"`{name}` cannot name a pack: {diagnostic.message}")
    write_text(path, text)
    click.echo(f"wrote {path}: powderdsl run {path} --watch")
