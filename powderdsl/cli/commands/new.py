"""`powderdsl new`: a first pack to change: an element with a free id, a rule and a test."""

from __future__ import annotations

import colorsys
from contextlib import suppress
from pathlib import Path
from string import Template

import click

from powderdsl.cli import options as opt
from powderdsl.cli.exits import BadInput
from powderdsl.compiler import read, shipped, shipped_rules
from powderdsl.diagnostics import CompileError, Reporter, Severity, Source
from powderdsl.model.check import check
from powderdsl.model.declarations import ElementDecl, PackDecl
from powderdsl.model.packs import read_file
from powderdsl.model.schema import MAX_NAME, NAME
from powderdsl.syntax.sources import read_source
from powderdsl.system.writing import write_text

TEMPLATE = Path(__file__).with_name("first_pack.yaml")


@click.command("new")
@click.argument("name")
@opt.path("--dir", "PATH", "The folder of the new file.", to="folder", default=".")
def command(name: str, folder: Path) -> None:
    """Write NAME.yaml, a first pack: an element, a rule and a test.

    The element gets an id that no shipped pack and no pack in the folder uses. Existing files stay.
    """
    if not NAME.match(name) or len(name) > MAX_NAME:
        raise BadInput(
            f"`{name}` cannot name a pack: up to {MAX_NAME} letters, digits and `_`, a letter first"
        )
    path = folder / f"{name}.yaml"
    if path.exists() or path.is_symlink():
        raise BadInput(f"{path} exists already")
    opt.check_writable(path)
    taken = _elements(shipped("rules"))
    if name in shipped_rules() or name in {element.name.text for element in taken}:
        raise BadInput(f"`{name}` comes with powderdsl: choose another name")
    taken += _elements(folder)
    free = set(range(256)) - {element.id for element in taken}
    if not free:
        raise BadInput("all 256 element ids are taken")
    number = min(free)
    color = _color(number, {element.color for element in taken})
    text = Template(TEMPLATE.read_text(encoding="utf-8")).substitute(name=name, id=number, color=color)
    for problem in _problems(name, text):
        raise BadInput(f"`{name}` cannot name a pack: {problem}")
    write_text(path, text)
    click.echo(f"wrote {path}: powderdsl run core+{path} --watch")


def _elements(folder: Path) -> list[ElementDecl]:
    """The elements of all packs in a folder; files that cannot be read have none."""
    elements: list[ElementDecl] = []
    for path in sorted(folder.glob("*.yaml")):
        reporter = Reporter()
        source = read_source(path, reporter)
        decl = read_file(source, reporter) if source else None
        if isinstance(decl, PackDecl):
            elements.extend(decl.elements)
    return elements


def _color(number: int, taken: set[str]) -> str:
    """A color that no other element has: the hue turns by the golden angle from id to id."""
    while True:
        parts = colorsys.hsv_to_rgb(number * 0.381966 % 1, 0.55, 0.85)
        color = "#" + "".join(f"{round(part * 255):02X}" for part in parts)
        if color not in taken:
            return color
        number += 1


def _problems(name: str, text: str) -> list[str]:
    """Errors in the new pack: its name means something in the language or in the pack that it needs."""
    reporter = Reporter()
    packs, _ = read(["core"], reporter)
    new = read_file(Source(f"{name}.yaml", text), reporter)
    if isinstance(new, PackDecl):
        with suppress(CompileError):
            check([*packs, new], None, reporter)
    return [
        diagnostic.message for diagnostic in reporter.diagnostics if diagnostic.severity is Severity.ERROR
    ]
