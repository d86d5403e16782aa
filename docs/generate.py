"""Tables and pictures of README.md and docs/*.md that follow from the package.

`python docs/generate.py` writes the tables, `--check` names the pages that are stale. `--pictures` draws the pictures.

A table stands between `<!-- generated: NAME -->` and `<!-- end -->`; what is between them is rewritten. A picture
stands below the command that draws it: `<!-- powderdsl run … --out docs/images/NAME -->`.
"""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from types import UnionType

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # runs from a checkout that is not installed

from powderdsl.cli.dispatch import GROUPS
from powderdsl.compiler import MAX_BASES, shipped_rules
from powderdsl.editing.json_schema import schema
from powderdsl.experiments.studies import study as _study_file  # noqa: F401  # declares the records of studies
from powderdsl.ir.stages import PIPELINE
from powderdsl.model.builtins import (
    KIND_WORDS,
    MAX_MAGNITUDE,
    MAX_OFFSET,
    MAX_RADIUS,
)
from powderdsl.model.composition.names import MAX_PASSES
from powderdsl.model.declarations import COLOR
from powderdsl.model.elaborate import MAX_RULES, MAX_SUBSTEPS
from powderdsl.model.examples import MAX_SIDE
from powderdsl.model.expressions.typer import MAX_ROUNDS, MAX_SET_DEPTH
from powderdsl.model.operations import FUNCTIONS
from powderdsl.model.schema import MAX_NAME, RECORDS, Key, Record, keys_of
from powderdsl.syntax import parse, yaml_tree
from powderdsl.tasks import file as _task_file  # noqa: F401  # declares the records of tasks
from powderdsl.worlds.scene.statements import SETTING, STATEMENTS

DOCS = Path(__file__).resolve().parent
SCHEMA = DOCS / "powderdsl.schema.json"
PAGES = (DOCS.parent / "README.md", *sorted(DOCS.rglob("*.md")))
DRAWN = re.compile(r"^<!-- powderdsl (.*) --out (docs/images/\S+) -->$", re.MULTILINE)
MARKED = re.compile(r"(<!-- generated: ([\w ]+) -->\n).*?(<!-- end -->)", re.DOTALL)

SHAPES = {
    "text": "text",
    "word": "word",
    "words": "words",
    "number": "integer",
    "flag": "`yes` or `no`",
    **dict.fromkeys(("mapping", "record", "section", "pairs"), "mapping"),
    "list": "list",
    "lines": "expressions",
    "line": "expression",
    "block": "block",
    "invariants": "list",
    "any": "see below",
}
"""Shapes of `schema.Key`, as readers see them."""


BELOW_PACKS = ("element", "field", "param", "pass", "property", "stream")
"""Entries of packs that all have the key `about`, which the table of packs explains."""


def table(head: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> str:
    """A Markdown table; `|` inside cells is escaped."""
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    lines += ["| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows]
    return "\n".join(lines) + "\n"


def keys(context: str) -> str:
    """The keys of one kind of mapping in a rule file, with their values and defaults."""
    record = RECORDS[context]
    rows = [
        (f"`{name}`" + (" *" if key.required else ""), value_of(key, record), key.about)
        for name, key in keys_of(record).items()
        if name != "about" or context not in BELOW_PACKS
    ]
    if record.OTHERS:
        rows.append((f"*{record.OTHERS}'s name*", "expression", "its value"))
    return table(("key", "value", "meaning"), rows)


def value_of(key: Key, record: type[Record]) -> str:
    """The shape, the bounds and the default of a key's value."""
    if key.choices:
        *first, last = (f"`{choice}`" for choice in key.choices)
        shape = f"{', '.join(first)} or {last}" if first else last
    elif key.form is COLOR:
        shape = '`"#RRGGBB"`'
    elif key.form:
        shape = key.form.noun.removeprefix("a ")
    elif key.shape == "number" and key.bounds[1]:
        shape = f"{key.bounds[0]}..{key.bounds[1]:,}"
    elif key.shape == "any" and not isinstance(key.type, UnionType):
        shape = "mapping or list"
    else:
        shape = SHAPES[key.shape]
    default = getattr(record, key.field, None)
    if key.required or default in (None, "", ()):
        return shape
    return f"{shape}, default `{'no' if default is False else default}`"


def functions() -> str:
    return table(("function", "value"), [(f"`{f.usage}`", f.about) for f in FUNCTIONS.values()])


def kinds() -> str:
    rows = [("`LOW..HIGH`", "an integer between two bounds, both included")]
    rows += [(f"`{word}`", about) for word, about in KIND_WORDS.items()]
    return table(("kind", "values"), rows)


def limits() -> str:
    rows = [
        ("characters in a file", yaml_tree.MAX_CHARACTERS),
        ("values in a file", yaml_tree.MAX_NODES),
        ("nesting in YAML", yaml_tree.MAX_DEPTH),
        ("characters in a rule", parse.MAX_LENGTH),
        ("nesting in a rule", parse.MAX_DEPTH),
        ("characters in a name", MAX_NAME),
        ("elements", 256),
        ("distance of a neighbor", MAX_OFFSET),
        ("radius of a kernel", MAX_RADIUS),
        ("magnitude of a number", MAX_MAGNITUDE),
        ("modulus of `mod`", 64),
        ("rounds of `repeat` or a loop variable", 64),
        ("rounds of a loop over several variables", MAX_ROUNDS),
        ("nesting of sets", MAX_SET_DEPTH),
        ("nesting of `extends`", MAX_BASES),
        ("passes", MAX_PASSES),
        ("substeps of a pass", MAX_SUBSTEPS),
        ("rules, after unrolling loops", MAX_RULES),
        ("rows or columns of a test", MAX_SIDE),
    ]
    return table(("quantity", "maximum"), [(what, f"{most:,}") for what, most in rows])


def shipped(rulesets: bool = False) -> str:
    """The packs, or the rulesets, that come with powderdsl."""
    from powderdsl.compiler import read
    from powderdsl.diagnostics import Reporter

    rows = []
    for name in shipped_rules():
        packs, ruleset = read([name], Reporter())
        if ruleset and rulesets:
            rows.append((f"`{name}`", ruleset.about))
        elif not ruleset and not rulesets:
            pack = packs[-1]  # its needs come first
            rows.append((f"`{name}`", ", ".join(e.name.text for e in pack.elements), pack.about))
    head = ("ruleset",) if rulesets else ("pack", "elements")
    return table((*head, "description"), rows)


def scene_statements() -> str:
    """How each statement of a scene is written."""
    return "```text\n" + "".join(f"{line}\n" for line in (*STATEMENTS.values(), SETTING)) + "```\n"


def tasks(families: bool = False) -> str:
    """The tasks that come with powderdsl, in families or not, and their goals."""
    from powderdsl.tasks.shipped import load_task, shipped_tasks

    loaded = sorted(((name, load_task(name)) for name in shipped_tasks()), key=lambda named: named[1].family)
    rows = [
        (f"`{name}`", task.about, *((task.family,) if families else ()))
        for name, task in loaded
        if bool(task.family) == families
    ]
    return table(("task", "goal", *(["family"] if families else [])), rows)


def stages() -> str:
    return table(("stage", "what it does"), [(f"`{stage.name}`", stage.about) for stage in PIPELINE])


def planner() -> str:
    from powderdsl.schedule.stages import PLANNERS

    stages = {stage.name: stage for planner in PLANNERS.values() for stage in reversed(planner)}
    names = dict.fromkeys(stage.name for planner in PLANNERS.values() for stage in planner)
    rows = (
        (f"`{name}`", stages[name].about.partition(";")[0]) for name in names
    )  # reasons for the order left out
    return table(("stage", "what it decides"), rows)


def commands() -> str:
    rows = [
        ("" if number else f"**{title}**", f"`powderdsl {name}`", about)
        for title, group in GROUPS.items()
        for number, (name, about) in enumerate(group.items())
    ]
    return table(("", "command", "what it does"), rows)


def mutation_testing() -> str:
    """What `docs/mutation_table.py` has counted: the packs with survivors, all others together, and the sum."""
    from powderdsl.testing.mutation.judging import COUNTED, noticed_share

    path = DOCS / "mutation.json"
    measured = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    packs = {name: counts for entry in measured.values() for name, counts in entry["packs"].items()}
    complete = {name for name, counts in packs.items() if not counts["survived"]}

    def sum_of(names: Iterable[str]) -> dict[str, int]:
        return {key: sum(packs[name][key] for name in names) for key in COUNTED}

    rows = [(f"`{name}`", counts) for name, counts in packs.items() if name not in complete]
    rows += [(f"{len(complete)} others", sum_of(complete)), ("**all**", sum_of(packs))]
    shown = [key for key in COUNTED if key not in ("killed", "generated")]
    return table(
        ("pack", *shown, "noticed"),
        ((name, *(str(n[key]) for key in shown), f"{100 * noticed_share(n):.1f} %") for name, n in rows),
    )


TABLES: dict[str, Callable[[], str]] = {
    "mutation testing": mutation_testing,
    "functions": functions,
    "kinds": kinds,
    "limits": limits,
    "shipped packs": shipped,
    "shipped rulesets": partial(shipped, rulesets=True),
    "scene statements": scene_statements,
    "tasks": tasks,
    "task families": partial(tasks, families=True),
    "stages": stages,
    "planner": planner,
    "commands": commands,
    **{f"keys {context}": partial(keys, context) for context, kind in RECORDS.items() if keys_of(kind)},
}
"""What can stand between markers, by name."""


def generated(markdown: str) -> str:
    """A page with all its tables rewritten. Raises KeyError for a table that does not exist."""
    return MARKED.sub(lambda found: found[1] + TABLES[found[2]]() + found[3], markdown)


def fresh_text(path: Path) -> str:
    """A page with all its tables rewritten, or the JSON Schema."""
    return json.dumps(schema(), indent=1) + "\n" if path == SCHEMA else generated(path.read_text("utf-8"))


def stale_pages() -> list[Path]:
    """Files that are not what the package says."""
    return [path for path in (*PAGES, SCHEMA) if fresh_text(path) != path.read_text("utf-8")]


def pictures() -> dict[str, list[str]]:
    """The arguments of the command that draws each picture, by the picture's path in the repository."""
    found = (match for page in PAGES for match in DRAWN.findall(page.read_text("utf-8")))
    return {path: shlex.split(command) for command, path in found}


def draw_pictures() -> None:
    for path, arguments in pictures().items():
        print(path)
        command = [sys.executable, "-m", "powderdsl", *arguments, "--out", path]
        subprocess.run(command, cwd=DOCS.parent, check=True)


def main(arguments: list[str]) -> int:
    """Write the stale pages, or name them and return 1 under `--check`; under `--pictures`, draw the pictures."""
    if "--pictures" in arguments:
        draw_pictures()
        return 0
    stale = stale_pages()
    for page in stale:
        print(f"{'stale' if '--check' in arguments else 'written'}: {page.relative_to(DOCS.parent)}")
        if "--check" not in arguments:
            page.write_text(fresh_text(page), "utf-8")
    return 1 if stale and "--check" in arguments else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
