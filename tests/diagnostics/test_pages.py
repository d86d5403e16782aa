"""Every diagnostic code has a page, every page's examples do what the page says, and every code is raised.

A page has a wrong example and, mostly, the fixed one:

* ``yaml wrong`` and ``yaml right`` are rule files; ``# with: core`` at the top names packs to load with them.
* ``yaml wrong scene`` is a drawn world, ``text wrong world`` one in ASCII, ``yaml wrong task`` a task, ``yaml wrong study`` a
  study; all use the rules of the paper.
* ``text`` is the message itself, for what no file can show; `SITUATIONS` brings it about.

The text under the caret stands in the example, in a comment ``# ^ text`` below it.
"""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import powderdsl
from powderdsl.compiler import load_with_diagnostics
from powderdsl.datasets.manifest import read_manifest
from powderdsl.diagnostics import CODES, CompileError, Diagnostic, Reporter, Severity, Source
from powderdsl.diagnostics.codes import page
from powderdsl.diagnostics.diagnostic import render_text
from powderdsl.experiments.runs import find_run, lock_folder, misfit, open_run
from powderdsl.experiments.studies.run import StudyRun, check_cluster, collected, read_folders
from powderdsl.experiments.studies.study import TEXT, load_study, read_study
from powderdsl.rl import preset
from powderdsl.simulation.standalone import standalone_module
from powderdsl.system.writing import replacing
from powderdsl.tasks.shipped import load_task, load_task_with_diagnostics
from powderdsl.testing.properties.search import quick_results, refuted
from powderdsl.worldmodel import training
from powderdsl.worldmodel.config import DataConfig, Machine, TrainConfig
from powderdsl.worldmodel.networks import custom_network
from powderdsl.worlds.image import read_image
from powderdsl.worlds.scene import draw_start, find_scene
from tests.drawings import read_ascii
from tests.refusals import refusal
from tests.semantics.test_mixed import spread

ROOT = Path(__file__).resolve().parents[2]
PAGES = ROOT / "powderdsl" / "diagnostics" / "pages"
GOLDEN = Path(__file__).with_name("golden")
WITHOUT_COMMENT = {"PD610": "!", "PD611": "..ss."}
"""The text under the caret where the example has no room for a comment."""


@dataclass(frozen=True)
class Example:
    """A fenced block of a page: what follows the fence (``yaml wrong``), and its text."""

    info: str
    text: str

    @property
    def caret(self) -> str | None:
        """The text that the page promises under the caret."""
        found = re.search(r"^.*# .*\^ (.*)$", self.text, re.MULTILINE)
        return found[1] if found else None

    @property
    def packs(self) -> list[str]:
        found = re.match(r"# with: (\S+)\n", self.text)
        return [found[1]] if found else []


def examples(code: str) -> list[Example]:
    return [
        Example(*found)
        for found in re.findall(r"^```(.+)\n((?:.*\n)*?)```$", page(CODES[code]), re.MULTILINE)
    ]


def example(code: str, word: str) -> Example | None:
    """The wrong or the right example of a page; the bare message for ``message``."""
    for one in examples(code):
        if word in one.info.split() or (word == "message" and one.info == "text"):
            return one
    return None


WRONG = {code: one for code in CODES if (one := example(code, "wrong"))}
RIGHT = {code: one for code in CODES if (one := example(code, "right"))}
MESSAGES = {code: one for code in CODES if (one := example(code, "message"))}


@cache
def paper_rules():  # type: ignore[no-untyped-def]
    return powderdsl.load("powderworld")


def diagnostics_of(one: Example) -> tuple[Diagnostic, ...]:
    """What loading an example says, errors or not. It is loaded as `page.yaml` of the working directory."""
    path = Path("page.yaml")
    path.write_text(one.text, encoding="utf-8")
    try:
        if "scene" in one.info.split():
            draw_start(find_scene(path), paper_rules())
            return ()
        if "task" in one.info.split():
            return load_task_with_diagnostics(path)[1]
        if "study" in one.info.split():
            load_study(
                "page.yaml",
                {("train",): dict.fromkeys(("on", "run", "seed", "steps"), TEXT), ("evaluate",): {}},
            )
            return ()
        if "world" in one.info.split():
            read_ascii(one.text, paper_rules().elements, name="page.txt")
            return ()
        ruleset, remarks = load_with_diagnostics(*one.packs, path)
        return (
            *remarks,
            *refuted(ruleset, quick_results(ruleset)),
        )  # what `powderdsl check` says
    except CompileError as error:
        return error.diagnostics


pytestmark = pytest.mark.usefixtures("folder")


# The lock: codes, pages, examples, and the places that raise them


def test_every_code_has_a_page_and_every_page_a_code() -> None:
    assert {path.stem for path in PAGES.glob("*")} == set(CODES)


@pytest.mark.parametrize("code", CODES)
def test_a_page_starts_with_its_code_and_shows_what_is_wrong(code: str) -> None:
    text = page(CODES[code])
    assert text.startswith(f"# {code}: {CODES[code].slug}\n\n")
    assert (code in WRONG) != (code in MESSAGES)
    assert (code in RIGHT) == (code in WRONG)
    assert all(len(line) <= 120 or line.startswith(" ") for line in text.splitlines()), (
        "too wide for a terminal"
    )


def test_every_code_is_raised_somewhere_and_every_raised_code_is_in_the_table() -> None:
    """Codes stand in string literals of the package, besides the table's."""
    files = {*(ROOT / "powderdsl").rglob("*.py")} - {ROOT / "powderdsl" / "diagnostics" / "codes.py"}
    texts = [path.read_text(encoding="utf-8") for path in files]
    assert {code for text in texts for code in re.findall(r'"(PD\d+)"', text)} == set(CODES)


def test_slugs_are_words_and_differ() -> None:
    slugs = [row.slug for row in CODES.values()]
    assert len(set(slugs)) == len(slugs)
    assert all(re.fullmatch(r"[a-z]+(-[a-z]+)*", slug) for slug in slugs)


# The examples


@pytest.mark.golden
@pytest.mark.parametrize("code", WRONG)
def test_a_wrong_example_gives_its_message_and_no_other(
    code: str, golden: Callable[[Path, str], None]
) -> None:
    told = diagnostics_of(WRONG[code])
    own = [one for one in told if one.code == code]
    golden(GOLDEN / f"{code}.txt", "\n\n".join(map(render_text, own)).replace(str(ROOT), "REPOSITORY") + "\n")
    # Other notes are no mistakes of the example.
    severe = CODES[code].severity is not Severity.NOTE
    found = [one for one in told if one.severity is not Severity.NOTE or (one.code == code and not severe)]
    assert [one.code for one in found] == [code]
    caret = WITHOUT_COMMENT.get(code) or WRONG[code].caret
    assert caret is not None or code in {"PD505", "PD507"}
    if caret is not None:
        assert found[0].primary.span.text.split("\n")[0] == caret


@pytest.mark.parametrize("code", RIGHT)
def test_a_right_example_has_no_errors_or_warnings(code: str) -> None:
    found = [render_text(one) for one in diagnostics_of(RIGHT[code]) if one.severity is not Severity.NOTE]
    assert found == []


# Messages that no file can show


def save_a_world_of_more_elements() -> None:
    full, less = powderdsl.load("powderworld"), powderdsl.load("powderworld-gas")
    element = full.element("gas")
    simulator = powderdsl.compile(full, backend="reference")
    powderdsl.save(simulator.world([[[element.id]]]), "yard.npz")
    powderdsl.load_world("yard.npz", powderdsl.compile(less, backend="reference"))


def read_a_soft_picture() -> None:
    pixels = np.full((4, 4, 3), (0xF3, 0xC2, 0x3A), dtype=np.uint8)
    pixels[0, 3] = pixels[1:, 0] = pixels[3] = pixels[2, 1:] = (0xF3, 0xC2, 0x3B)
    pixels[1, 1] = (0xF3, 0xC2, 0x3B)
    Image.fromarray(pixels).save("yard.png")
    read_image("yard.png", paper_rules().elements)


def write_a_film_without_the_package() -> None:
    from powderdsl.worlds.media import write_mp4

    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "imageio_ffmpeg", None)
        write_mp4("yard.mp4", [np.zeros((2, 2, 3), dtype=np.uint8)])


def read_a_large_file() -> None:
    Path("rules").mkdir()
    Path("rules/everything.yaml").write_bytes(b" " * (4 * (1 << 20) + 1))
    powderdsl.load("rules/everything.yaml")


def read_text_as_a_picture() -> None:
    Path("yard.png").write_text("no picture", encoding="utf-8")
    read_image("yard.png", paper_rules().elements)


def write_into_no_folder() -> None:
    with replacing(Path("out/yard.gif")):
        pass


def record_with_another_seed() -> None:
    from powderdsl.datasets import record

    for seed in (0, 1):
        record("herd-gas", "nothing", "recorded", episodes=1, seed=seed, max_episode_steps=1, backend="torch")


def open_a_run_of_another_seed() -> None:
    open_run("runs/dunes", "ppo", {"seed": 1})
    open_run("runs/dunes", "ppo", {"seed": 2})


def train_in_one_folder_twice() -> None:
    run = open_run("runs/dunes", "ppo", {})
    with lock_folder(run.path), lock_folder(run.path):
        pass


def use_a_run_that_does_not_fit() -> None:
    raise misfit(Path("runs/dunes"), "id 3 is `core.wall` there, nothing here")


def learn_too_fast() -> None:
    data = DataConfig("sand-pushing", states=4, steps=1, pairs=1, capacity=4, refresh=1)
    config = TrainConfig(data, width=1, iterations=50, batch=1, learning_rate=0.5)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training._Trainer, "step", lambda self, *pairs: math.inf if self.done == 35 else 1.0)
        training.train(config, "runs/dunes", machine=Machine(backend="reference"))


def collect_different_results() -> None:
    known = {("train",): {"on": TEXT, "run": TEXT, "steps": TEXT}}
    text = "study: s\nseeds: 1\nvary: {steps: [100]}\nsteps: {t: {command: train, on: x, steps: $steps}}\n"
    source = Source("study.yaml", text + "measures: {reward: {of: t, value: mean}}\n")
    study = read_study(source, Reporter(), known)
    for name, reward in (("one", 2.5), ("two", 3.0)):
        StudyRun(study, Path(name), "small").prepare()
        done = Path(name) / "done"
        done.mkdir()
        (done / "steps=100,seed=0.json").write_text(f'{{"t": {{"mean": {reward}}}}}', encoding="utf-8")
    collected(read_folders([Path("one"), Path("two")], known), next(study.points("small")))


SITUATIONS: dict[str, Callable[[], object]] = {
    "PD101": lambda: powderdsl.load("rules/snd.yaml"),
    "PD102": read_a_large_file,
    "PD601": lambda: find_scene("gardn"),
    "PD602": read_text_as_a_picture,
    "PD603": save_a_world_of_more_elements,
    "PD609": read_a_soft_picture,
    "PD612": write_a_film_without_the_package,
    "PD613": write_into_no_folder,
    "PD620": lambda: find_run("runs/dunes"),
    "PD621": open_a_run_of_another_seed,
    "PD622": train_in_one_folder_twice,
    "PD623": use_a_run_that_does_not_fit,
    "PD624": learn_too_fast,
    "PD625": lambda: custom_network("nets:Deep"),
    "PD626": lambda: check_cluster("127.0.0.1:1"),
    "PD627": collect_different_results,
    "PD630": lambda: read_manifest(Path("recorded")),
    "PD631": record_with_another_seed,
    "PD640": lambda: preset("paper", "sand-pushing", batch=1),
    "PD801": lambda: load_task("sand-pulling"),
    "PD702": lambda: standalone_module(spread("heavy"), (64, 64)),
    "PD701": lambda: powderdsl.compile(paper_rules(), backend="reference", device="cuda:99"),
}
"""How to bring about each message that a page shows."""

SYSTEM_WORDS = re.compile(r"^  = note: .*", re.MULTILINE)
"""Notes quote other programs, whose words change."""


def test_every_message_has_a_situation() -> None:
    assert set(MESSAGES) == {*SITUATIONS, "PD901"}


@pytest.mark.parametrize("code", SITUATIONS)
def test_a_page_shows_the_message_as_it_is(code: str) -> None:
    (found,) = refusal(SITUATIONS[code])
    shown = SYSTEM_WORDS.sub("", MESSAGES[code].text)
    assert SYSTEM_WORDS.sub("", render_text(found) + "\n") == shown
    assert ("= note" in MESSAGES[code].text) == bool(found.notes)


def test_an_internal_error_reads_as_its_page_says(capsys: pytest.CaptureFixture[str]) -> None:
    from powderdsl.cli.exits import report_failure

    report_failure(IndexError("list index out of range"))
    shown = SYSTEM_WORDS.sub("", MESSAGES["PD901"].text)
    assert SYSTEM_WORDS.sub("", capsys.readouterr().err) == shown


# The tests themselves


def test_golden_files_are_those_of_codes() -> None:
    with suppress(FileNotFoundError):
        assert {path.stem for path in GOLDEN.iterdir() if not path.name.startswith(".")} == set(WRONG)
