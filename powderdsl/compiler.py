"""The sequence: text → located tree → checked model → IR → passes → program. Each stage takes one value and gives one.

`load` stops at the checked model, `lower` at optimised IR; neither needs torch. `simulator.compile` goes on from there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, Any

from powderdsl.diagnostics import Reporter, Severity, Source, suggest
from powderdsl.model.check import check
from powderdsl.model.compose import compose
from powderdsl.model.declarations import PackDecl, RulesetDecl
from powderdsl.model.layout import own_slots
from powderdsl.model.packs import read_file
from powderdsl.model.palette import Palette
from powderdsl.model.types import Param, Ruleset, Value
from powderdsl.syntax.yaml_tree import MAX_CHARACTERS

if TYPE_CHECKING:
    from powderdsl.diagnostics import Diagnostic
    from powderdsl.ir.ops import Program

BACKENDS = {
    "auto": "`torch` at once, and `native` once that is compiled; work of seconds starts no compiler",
    "torch": "packed bit planes on any device; few cells on a device other than the CPU: one tensor element a cell",
    "dense": "torch, always one tensor element a cell: the readable one",
    "planes": "torch, always packed bit planes",
    "native": "generated C++ for the CPU; compiled once, then kept",
    "cuda": "generated CUDA C++ for a GPU: whole worlds on the chip, all steps of a call in one launch",
    "reference": "the slow oracle in NumPy that defines what rules mean",
}
"""All of them give the same worlds, bit for bit."""


def shipped(folder: str) -> Path:
    """The folder `rules` or `tasks` that comes with powderdsl: inside the installed package, or in the repository."""
    here = Path(__file__).resolve().parent
    inside = here / "data" / folder
    return inside if inside.is_dir() else here.parent / folder


def shipped_rules() -> list[str]:
    """Names of the packs and rulesets that come with powderdsl."""
    return sorted(path.stem for path in shipped("rules").glob("*.yaml"))


def shipped_tests() -> list[str]:
    """What of that stands by itself: rulesets, and packs that need no other and belong to no ruleset."""
    reporter = Reporter()
    found = [
        decl
        for path in sorted(shipped("rules").glob("*.yaml"))
        if (source := read_source(path, reporter)) and (decl := read_file(source, reporter))
    ]
    inside = {scalar.text for decl in found if isinstance(decl, RulesetDecl) for scalar in decl.packs}
    return [
        decl.name.text
        for decl in found
        if isinstance(decl, RulesetDecl) or not (decl.needs or decl.name.text in inside)
    ]


def load(
    *names: str | Path, params: Mapping[str, Any] | None = None, palette: Palette | None = None
) -> Ruleset:
    """Read rule files into a checked model.

    Args:
        names: shipped names (``"powderworld"``), paths of rule files, or several joined by ``+``. A name after ``-``
            is left out: ``"name-pack"``.
        params: other values for parameters, by qualified name: ``{"pack.param": 0.05}``.
        palette: ids that were recorded, such as a model's: the qualified name of the element of each id, or None.
            Elements that it does not have get its free ids, then those after its end.

    Raises:
        CompileError: with everything that is wrong in the files.
    """
    ruleset, _ = load_with_diagnostics(*names, params=params, palette=palette)
    return ruleset


def load_with_diagnostics(
    *names: str | Path, params: Mapping[str, Any] | None = None, palette: Palette | None = None
) -> tuple[Ruleset, tuple[Diagnostic, ...]]:
    """Like `load`; the second value has the warnings and notes."""
    reporter = Reporter()
    packs, ruleset = read(names, reporter)
    reporter.raise_if_errors()
    model = check(packs, ruleset, reporter, palette)
    if params:
        model = set_params(model, params, reporter)
    reporter.raise_if_errors()
    return model, tuple(d for d in reporter.diagnostics if d.severity is not Severity.ERROR)


def whole_palette(*names: str | Path) -> tuple[str | None, ...]:
    """Where a model has room for the elements of some rules: by slot, a qualified name or None.

    Packs that are left out have their places too. The ids of a ruleset's own packs, or of a list of packs, stay as they
    are; the elements of packs that are added to a ruleset follow without gaps.

    Raises:
        CompileError: with what is wrong with the files, their names and ids.
    """
    reporter = Reporter()
    packs, ruleset = read([word for name in names for word in split_names(name)[0]], reporter)
    reporter.raise_if_errors()
    composition = compose(packs, ruleset, reporter)
    reporter.raise_if_errors()
    own = own_slots(composition) if ruleset else composition.slots
    by_id = {element.id: element.qualified for element in composition.elements.values()}
    return tuple(by_id.get(number) for number in range(own)) + tuple(
        name for number, name in by_id.items() if number >= own
    )


def read(names: Sequence[str | Path], reporter: Reporter) -> tuple[list[PackDecl], RulesetDecl | None]:
    """Declarations of everything named, each pack once, in the order of first mention."""
    packs: dict[str, PackDecl] = {}
    rulesets: list[RulesetDecl] = []
    left_out: dict[str, None] = {}
    for name in names:
        plus, minus = split_names(name)
        left_out |= dict.fromkeys(minus)
        for word in plus:
            _read_one(word, packs, rulesets, reporter, from_ruleset=None)
    for word in (word for word in left_out if word not in packs):
        reporter.error(
            "PD304",
            f"`{word}` is left out, but it was not there",
            None,
            helps=list(suggest(word, packs, "packs")),
        )
    if not names:
        reporter.error(
            "PD304", "no rules were named", None, helps=["name a shipped ruleset or a file: `powderworld`"]
        )
    kept = [pack for name, pack in packs.items() if name not in left_out]
    if not rulesets:
        return kept, None
    own = {scalar.text for scalar in rulesets[-1].packs}
    gone = tuple(pack for name, pack in packs.items() if name in left_out and name in own)
    return kept, replace(rulesets[-1], left_out=gone)


def split_names(name: str | Path) -> tuple[list[str], list[str]]:
    """``a+b-c`` as names to load and names to leave out. Paths of files stay whole."""
    text = str(name)
    if (
        isinstance(name, Path)
        or (Path(text).suffix in (".yaml", ".yml") and "+" not in text)
        or _is_file(text)
    ):
        return [text], []
    plus: list[str] = []
    minus: list[str] = []
    for part in text.split("+"):
        if part.endswith((".yaml", ".yml")) or _is_file(part):
            plus.append(part)
            continue
        head, *rest = part.split("-")
        plus.append(head)
        minus.extend(rest)
    return plus, minus


def _is_file(text: str) -> bool:
    try:
        return Path(text).is_file()
    except (OSError, ValueError):
        return False


def _read_one(
    word: str,
    packs: dict[str, PackDecl],
    rulesets: list[RulesetDecl],
    reporter: Reporter,
    from_ruleset: RulesetDecl | None,
) -> None:
    if word in packs:
        return
    path = _find(word, reporter, from_ruleset)
    source = read_source(path, reporter) if path else None
    decl = read_file(source, reporter) if source else None
    if decl is None:
        return
    if isinstance(decl, PackDecl):
        if decl.name.text in packs:
            other = packs[decl.name.text]
            if other.source.name != decl.source.name:
                reporter.error(
                    "PD302",
                    f"pack `{decl.name.text}` is loaded twice",
                    decl.name.span,
                    f"also in {other.source.name}",
                    helps=["rename one of them"],
                )
            return
        packs[decl.name.text] = decl
    elif from_ruleset is not None:
        reporter.error(
            "PD304", f"`{word}` is a ruleset, not a pack", decl.name.span, helps=["a ruleset lists packs"]
        )
    else:
        rulesets.append(decl)
        for scalar in decl.packs:
            _read_one(scalar.text, packs, rulesets, reporter, decl)


def _find(word: str, reporter: Reporter, ruleset: RulesetDecl | None) -> Path | None:
    """A file by path or shipped name; packs of a ruleset are also looked for beside its file."""
    span = next((s.span for s in ruleset.packs if s.text == word), None) if ruleset else None
    looks_like_path = "/" in word or "\\" in word or word.endswith((".yaml", ".yml"))
    if looks_like_path and ruleset is not None:
        reporter.error(
            "PD304",
            f"a ruleset names packs, not paths: `{word}`",
            span,
            helps=["put the file beside the ruleset and write its name"],
        )
        return None
    candidates = [Path(word)] if looks_like_path else []
    if ruleset is not None:
        candidates.append(Path(ruleset.source.name).parent / f"{word}.yaml")
    if not looks_like_path:
        candidates += [shipped("rules") / f"{word}.yaml", Path(word)]
    for path in candidates:
        if _is_file(str(path)):
            return path
    if looks_like_path:
        reporter.error("PD101", f"no file `{word}`", None, helps=["check the path"])
        return None
    close = get_close_matches(word, shipped_rules(), n=1)
    helps = [f"did you mean `{close[0]}`?"] if close else ["shipped: " + ", ".join(shipped_rules())]
    reporter.error(
        "PD304", f"no pack or ruleset `{word}`", span, "not shipped, and no file" if span else "", helps=helps
    )
    return None


def read_source(path: Path, reporter: Reporter) -> Source | None:
    """The text of a file with its shortest name; reports what cannot be read."""
    try:
        with path.open("rb") as file:
            data = file.read(4 * MAX_CHARACTERS + 1)
        if len(data) > 4 * MAX_CHARACTERS:
            reporter.error(
                "PD102",
                f"`{path}` is larger than {4 * MAX_CHARACTERS:,} bytes",
                None,
                helps=["check that this is the file you meant"],
            )
            return None
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        reporter.error(
            "PD101", f"`{path}` is not UTF-8 text", None, notes=[f"byte {error.start} cannot be read"]
        )
        return None
    except OSError as error:
        reporter.error("PD101", f"cannot read `{path}`", None, notes=[error.strerror or "not readable"])
        return None
    try:
        name = str(path.resolve().relative_to(Path.cwd()))
    except ValueError:
        name = str(path)
    return Source(name, text)


def set_params(ruleset: Ruleset, values: Mapping[str, Any], reporter: Reporter) -> Ruleset:
    """The ruleset with other parameter values, checked against their kinds."""
    if not isinstance(values, Mapping):
        raise TypeError(f"params takes a mapping from names to values, found {type(values).__name__}")
    known = {param.name: param for param in ruleset.params}
    found: dict[str, Value] = {}
    for name, value in values.items():
        if name not in known:
            helps = suggest(name, known, "parameters") or [
                "parameters: " + (", ".join(sorted(known)) or "none")
            ]
            reporter.error("PD309", f"unknown parameter `{name}`", None, helps=list(helps))
            continue
        try:
            found[name] = param_value(known[name], value)
        except ValueError as error:
            reporter.error(
                "PD402", f"parameter `{name}`: {error}", None, notes=[f"it is a {known[name].kind}"]
            )
    return ruleset.with_params(found)


def param_value(param: Param, value: Any) -> Value:
    """A value for a parameter from text (``"5%"``, ``"yes"``) or a number. Raises ValueError."""
    if isinstance(value, str):
        text = value.strip()
        words = {"yes": 1.0, "true": 1.0, "no": 0.0, "false": 0.0}
        try:
            value = (
                words[text]
                if text in words
                else float(text[:-1]) / 100
                if text.endswith("%")
                else float(text)
            )
        except ValueError:
            raise ValueError(f"`{text}` is not a number") from None
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{value!r} is not a number") from None
    lo, hi = (0.0, 1.0) if param.kind.name in ("chance", "flag") else (param.kind.lo, param.kind.hi)
    if not lo <= number <= hi:
        raise ValueError(f"{number:g} lies outside {lo:g}..{hi:g}")
    if param.kind.name in ("int", "flag") and number != int(number):
        raise ValueError(f"{number:g} is not whole")
    return int(number) if param.kind.name in ("int", "flag") else number


def lower(ruleset: Ruleset) -> Program:
    """The checked model as optimised IR."""
    from powderdsl.ir.lower import lower_ruleset
    from powderdsl.passes import run_passes

    return run_passes(lower_ruleset(ruleset))
