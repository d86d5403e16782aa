"""Pages of the documentation site that follow from the package: a hook of MkDocs, see mkdocs.yml.

* the home page, the changelog and the page for contributors are files of the repository's root;
* the encyclopedia has a page for each element and each task;
* the references of commands, diagnostics and the Python API come from `--help`, `explain` and docstrings.

Everything about rules and tasks comes from powderdsl's own commands. What they print and draw is cached in `.site/`.
"""

from __future__ import annotations

import html
import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from hashlib import sha256
from pathlib import Path, PurePosixPath
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # runs from a checkout that is not installed

from powderdsl.cli.dispatch import GROUPS
from powderdsl.compiler import shipped_tests, shipped_variants
from powderdsl.tasks.shipped import load_task, shipped_tasks

ROOT = Path(__file__).resolve().parents[1]
CACHE = ROOT / ".site"
BOOSTS = {
    "guides/recipes.md": 2,
    "editors.md": 2,
    "tutorials/": 1.5,
    "language/": 1.5,
    "diagnostics.md": 0.3,
    "elements/": 0.3,
    "tasks/": 0.3,
}
"""How much more, or less, the search makes of pages than of others; it leaves out decisions."""
SHIM = "assets/javascripts/iframe-worker.js"
COPIED = {"index.md": "README.md", "changelog.md": "CHANGELOG.md", "contributing.md": "CONTRIBUTING.md"}
LINK = re.compile(r"(\]\()([^)\s#:]+)(#[^)\s]*)?(\))")
FENCED = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)
COMMENT = re.compile(r"^<!--.*?-->\n?", re.MULTILINE | re.DOTALL)

API = {
    "Rules and worlds": (
        "load",
        "compile",
        "Simulator",
        "World",
        "load_world",
        "save",
        "gif",
        "ledger",
        "CompileError",
    ),
    "Environments": (
        "envs.tensor_env.TensorEnv",
        "envs.gym.PowderEnv",
        "envs.gym.PowderVectorEnv",
        "envs.sb3.PowderVecEnv",
    ),
}


# --- commands, cached


def command(*words: str, out: str = "") -> bytes:
    """What `powderdsl WORDS` prints, or the bytes of the file that it writes with `--out`, whose ending is `out`."""
    CACHE.mkdir(exist_ok=True)
    key = sha256("\0".join([state_of_rules(), *words, out]).encode()).hexdigest()[:24]
    stored = CACHE / f"{key}{out or '.txt'}"
    if not stored.exists() or words[-1] == "--help":
        written = CACHE / f"{key}.part{out}"
        options = ["--out", str(written)] if out else []
        environment = {**os.environ, "COLUMNS": "100", "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
        run = subprocess.run(
            [sys.executable, "-m", "powderdsl", *words, *options],
            cwd=ROOT,
            env=environment,
            capture_output=True,
        )
        if run.returncode not in (0, 1):
            raise RuntimeError(f"powderdsl {' '.join(words)}: {run.stderr.decode()}")
        if not out:
            written.write_bytes(run.stdout)
        written.replace(stored)
    return stored.read_bytes()


@cache
def state_of_rules() -> str:
    """A hash of all rules and tasks that come with powderdsl."""
    files = [path for name in ("rules", "tasks") for path in sorted((ROOT / name).rglob("*.yaml"))]
    return sha256(b"".join(path.read_bytes() for path in files)).hexdigest()


def json_of(*words: str) -> Any:
    return json.loads(command(*words, "--json"))


# --- Markdown


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "".join(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in line)} |\n" for line in lines)


def code(text: str) -> str:
    return f"`{text}`"


def source_link(where: str) -> str:
    """A link from `rules/water.yaml:13` to that line in the repository."""
    path, line = re.sub(r"^.*?(?=rules/)", "", where).rsplit(":", 1)
    return f"[{path}:{line}](../../../{path}#L{line})"


# --- elements


def rulesets() -> list[str]:
    """The rulesets that the encyclopedia describes."""
    return [name for name in shipped_tests() if name not in shipped_variants()]


def element_pages(pictures: bool) -> Iterator[tuple[str, str | bytes]]:
    index = ["# Elements\n\nAll elements of the shipped rulesets, generated from the rules.\n"]
    for ruleset in rulesets():
        shown = json_of("show", ruleset)
        facts = json_of("check", ruleset, "--ledger", "--quick")["ledger"][ruleset]
        rows = []
        for element in shown["elements"]:
            page = f"{ruleset}/{element['name']}.md"
            rows.append(
                [f"{swatch(element)}[{element['name']}]({page})", code(element["pack"]), element["about"]]
            )
            picture = f"{element['name']}.gif" if pictures else ""
            yield f"elements/{page}", element_page(element, shown, facts, picture)
            if pictures:
                yield f"elements/{ruleset}/{picture}", element_film(element["name"], ruleset, facts)
        index.append(f"## {ruleset}\n\n{shown['about']}\n\n{table(['element', 'pack', 'about'], rows)}")
    yield "elements/index.md", "\n".join(index)


def swatch(element: Mapping[str, Any]) -> str:
    return f'<span class="swatch" style="background:{html.escape(element["color"])}"></span>'


def element_page(element: Mapping[str, Any], shown: Any, facts: Any, picture: str) -> str:
    """A page about one element of a ruleset. `shown` and `facts` are of `show` and of `check --ledger`."""
    name = element["name"]
    known = next(entry for entry in facts["elements"] if entry["name"] == name)
    parts = [
        f"# {name}\n\n{swatch(element)}An element of `{shown['name']}`, from the pack `{element['pack']}`. {element['about']}"
    ]
    if picture:
        parts.append(f"![{name} in a small world]({picture})")
    properties = [[code(key), str(value)] for key, value in element["properties"].items()]
    tags = ", ".join(map(code, element["tags"])) or "none"
    parts.append(
        f"## Properties\n\n{table(['property', 'value'], properties)}\nTags: {tags}. Defined in {source_link(element['where'])}."
    )
    for title, key in (("What becomes it", "made_from"), ("What it becomes", "becomes")):
        rows = [
            [
                other_link(other),
                "<br>".join(
                    f"{code(facts['rules'][i]['rule'])}, {source_link(facts['rules'][i]['where'])}"
                    for i in lines
                ),
            ]
            for other, lines in known[key].items()
        ]
        parts.append(f"## {title}\n\n" + (table(["element", "rule"], rows) if rows else "Nothing."))
    rules = " ".join(
        facts["rules"][i]["rule"]
        for key in ("made_from", "becomes")
        for lines in known[key].values()
        for i in lines
    )
    chances = [
        [code(param["name"]), f"{param['value']:.4g}", param["about"]]
        for param in shown["params"]
        if re.search(rf"\b{param['name'].rpartition('.')[2]}\b", rules)
    ]
    if chances:
        parts.append(f"Parameters of these rules:\n\n{table(['parameter', 'value', 'about'], chances)}")
    moves = [
        f"- {code(facts['rules'][i]['rule'])}, {source_link(facts['rules'][i]['where'])}"
        for i in known["moved_by"]
    ]
    parts.append("## What moves it\n\n" + ("\n".join(moves) or "Nothing: it stays in place."))
    parts.append(
        f"## Conservation\n\nIts number: {known['number']}.\n\n"
        + "\n".join(f"- {line}" for line in laws(name, facts))
    )
    return "\n\n".join(parts) + "\n"


def other_link(name: str) -> str:
    return f"[{name}]({name}.md)"


def laws(name: str, facts: Any) -> Iterator[str]:
    """Sums of cells with the element that are constant, or change in one direction only."""
    for key, verdict in (
        ("constant_sums", "is constant"),
        ("never_falls", "never falls"),
        ("never_rises", "never rises"),
    ):
        for elements in facts[key]:
            if name in elements:
                words = (
                    " + ".join(elements)
                    if len(elements) < len(facts["elements"])
                    else "the number of all cells"
                )
                yield f"{words} {verdict}"


def element_film(name: str, ruleset: str, facts: Any) -> bytes:
    """A GIF of the element above a floor, with the elements that it reacts with beside it."""
    known = next(entry for entry in facts["elements"] if entry["name"] == name)
    names = [entry["name"] for entry in facts["elements"]]
    if "wall" not in names:
        return command(
            "run", ruleset, "--size", "36x54", "--steps", "120", "--every", "2", "--scale", "6", out=".gif"
        )
    needed = [other for i in range(len(facts["rules"])) for other in partners(facts["rules"][i], name)]
    others = [
        other
        for other in dict.fromkeys([*needed, *known["made_from"], *known["becomes"]])
        if other not in ("empty", "wall", name)
    ]
    columns = [4, 14, 36, 46]
    draw = [
        f"box {other} rows 24:32 columns {at}:{at + 6}" for other, at in zip(others, columns, strict=False)
    ]
    scene = {
        "scene": "film",
        "size": [36, 54],
        "fill": "empty",
        "draw": [
            "frame wall",
            "box wall rows 32:36",
            *draw,
            f"disk {name} at (14, 27) radius 5",
            f"box {name} rows 28:32 columns 10:44",
        ],
    }
    CACHE.mkdir(exist_ok=True)
    path = CACHE / f"{ruleset}-{name}.yaml"
    path.write_text(json.dumps(scene))  # JSON is YAML
    return command(
        "run",
        ruleset,
        "--world",
        str(path.relative_to(ROOT)),
        "--steps",
        "160",
        "--every",
        "2",
        "--scale",
        "6",
        out=".gif",
    )


def partners(rule: Mapping[str, Any], name: str) -> list[str]:
    """Elements without which a rule that changes the element cannot fire."""
    if not any(name in pair for pair in rule["changes"]):
        return []
    return [elements[0] for elements in rule["needs"] if len(elements) == 1]


# --- tasks


def task_pages(pictures: bool) -> Iterator[tuple[str, str | bytes]]:
    rows = []
    for name in shipped_tasks():
        task = load_task(name)
        shown = json_of("show", name)
        rows.append([f"[{name}]({name}.md)", task.family, task.about])
        parts = [
            f"# {name}\n\n{task.about} Rules: `{shown['rules']}`; [the task's file](../../tasks/{name}.yaml)."
        ]
        expert = bool(task.expert)
        if pictures:
            policy = "expert" if expert else "random"
            yield (
                f"tasks/{name}.gif",
                command("watch", name, "--policy", policy, "--worlds", "2", "--scale", "4", out=".gif"),
            )
            actor = "The expert" if expert else "Random actions"
            parts.append(f"![{actor} in two worlds]({name}.gif)\n\n{actor} in two held-out worlds.")
        splits = [[code(split["name"]), split["about"]] for split in shown["splits"]]
        parts.append(f"## Splits\n\n{table(['split', 'worlds'], splits)}")
        if pictures:
            parts.append(f"## Difficulty\n\n{difficulty(name, expert)}")
        if shown["knobs"]:
            knobs = [
                [code(knob["name"]), str(knob["value"]), "{}..{}".format(*knob["range"]), knob["about"]]
                for knob in shown["knobs"]
            ]
            parts.append(f"## Knobs\n\n{table(['knob', 'default', 'range', 'meaning'], knobs)}")
        yield f"tasks/{name}.md", "\n\n".join(parts) + "\n"
    head = "# Shipped tasks\n\nAll tasks that come with powderdsl. [Tasks](../tasks.md) explains how to write one.\n\n"
    yield "tasks/index.md", head + table(["task", "family", "goal"], rows)


def difficulty(name: str, expert: bool) -> str:
    """Returns of policies that need no training, on each split."""
    policies = ["expert"] * expert + ["random", "nothing"]
    # Universes are compiled one by one, which WebAssembly does in less time.
    varied = any(split.rulesets for split in load_task(name).splits)
    episodes = "16" if varied else "64"
    options = [
        "--episodes",
        episodes,
        "--policies",
        ",".join(policies),
        *(["--backend", "wasm"] if varied else []),
    ]
    splits = json_of("evaluate", name, *options)["splits"]
    rows = []
    for split, results in splits.items():
        cells = []
        for policy in policies:
            result = results[policy]
            success = "" if result["success"] is None else f", {share(result['success']):.0%} succeed"
            cells.append(f"{result['mean']:.3g} ± {result['interval'] or 0:.2g}{success}")
        rows.append([code(split), *cells])
    return f"Mean return over {episodes} episodes, with 95 % intervals over worlds.\n\n{table(['split', *policies], rows)}"


def share(success: Any) -> float:
    return float(success["mean"] if isinstance(success, Mapping) else success)


# --- references


def reference_pages() -> Iterator[tuple[str, str]]:
    commands = [
        "# Commands\n\nThe help of each command. [Command line](shell.md) explains what all commands share.\n"
    ]
    for group, names in GROUPS.items():
        commands.append(f"## {group}\n")
        for name, summary in names.items():
            commands.append(
                f"### powderdsl {name}\n\n{summary}\n\n```text\n{command(name, '--help').decode().strip()}\n```\n"
            )
    yield "commands.md", "\n".join(commands)

    codes = [
        "# Diagnostics\n\nAll mistakes that powderdsl reports, as `powderdsl explain CODE` prints them.\n"
    ]
    for path in sorted((ROOT / "powderdsl/diagnostics/pages").glob("PD*.md")):
        text = path.read_text(encoding="utf-8")
        codes.append(re.sub(r"^(```\w*) (?:wrong|right).*$", r"\1", "#" + text, flags=re.MULTILINE))
    yield "diagnostics.md", "\n".join(codes)

    parts = [
        "# Python API\n\nThe public classes and functions. [Python, a tour](python.md) shows them at work.\n"
    ]
    for title, names in API.items():
        parts += [f"## {title}\n", *(f"::: powderdsl.{name}\n" for name in names)]
    yield "api.md", "\n".join(parts)


# --- hooks


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages."""
    pictures = str(config.extra["pictures"]).lower() not in ("0", "false", "no")
    copied = ((page, (ROOT / name).read_text(encoding="utf-8")) for page, name in COPIED.items())
    play = [("play/index.html", "`powderdsl play --export site/play` replaces this page.")]
    for pages in (copied, play, reference_pages(), element_pages(pictures), task_pages(pictures)):
        for path, content in pages:
            files.append(File.generated(config, path, content=content))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Leave out comments, and lead links to files outside of docs/ to the repository."""
    page_path = page.file.src_uri
    boosts = [boost for start, boost in BOOSTS.items() if page_path.startswith(start)]
    page.meta["search"] = {"exclude": page_path.startswith("decisions/0"), "boost": max(boosts, default=1)}
    folder = PurePosixPath("docs", page_path).parent if page_path not in COPIED else PurePosixPath(".")

    copied = {name: page for page, name in COPIED.items()}

    def link(match: re.Match[str]) -> str:
        target = os.path.normpath(folder / match[2]).replace(os.sep, "/")
        inside = copied.get(target) or (target.removeprefix("docs/") if target.startswith("docs/") else "")
        file = files.get_file_from_path(inside) if inside else None
        if file and file.inclusion.is_included():
            leads = os.path.relpath(inside, PurePosixPath(page_path).parent).replace(os.sep, "/")
        else:
            kind = "tree" if (ROOT / target).is_dir() else "blob"
            if not (ROOT / target).exists():
                return match[0]  # dead: MkDocs warns
            leads = f"{config.extra['repository']}/{kind}/main/{target}"
        return f"{match[1]}{leads}{match[3] or ''}{match[4]}"

    pieces = []
    end = 0
    for block in [*FENCED.finditer(markdown), None]:
        text = markdown[end : block.start() if block else len(markdown)]
        pieces.append(LINK.sub(link, COMMENT.sub("", text)))
        if block:
            pieces.append(block[0])
            end = block.end()
    return "".join(pieces)


def on_post_page(output: str, page: Page, config: MkDocsConfig) -> str:
    """Name the dialog of the search, and load the shim by which the search works in files from the site itself."""
    leads = os.path.relpath(SHIM, PurePosixPath(page.file.dest_uri).parent).replace(os.sep, "/")
    named = output.replace(
        'component="search" role="dialog"', 'component="search" role="dialog" aria-label="Search"'
    )
    return named.replace("https://unpkg.com/iframe-worker/shim", leads)


def on_post_build(config: MkDocsConfig) -> None:
    """Copy that shim; without what `make web` fetches, the search works where the site is served."""
    fetched = ROOT / "tests/web/node_modules/iframe-worker/shim/index.js"
    Path(config.site_dir, SHIM).write_bytes(fetched.read_bytes() if fetched.exists() else b"")
