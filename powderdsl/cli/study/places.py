"""Locations of mistakes in a study: values are written in one place and used in another."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from string import Template
from typing import Any

import click

from powderdsl.diagnostics import CompileError, Label, Reporter, Span
from powderdsl.experiments.studies.study import SEED, SIZE, SIZES, TEXT, Study, StudyStep, confined, maker

Values = Mapping[str, str]
"""The value of each name."""


def names_in(texts: Iterable[str]) -> set[str]:
    """The names that texts use: ``$NAME``."""
    return {name for text in texts for name in Template(text).get_identifiers()}


@dataclass(frozen=True)
class Word:
    """A word of an option of a step, with some values of the study.

    `written` has the values in place of their names; `filled` is what the command is given.
    """

    step: str
    option: str
    number: int
    text: str
    written: str
    filled: str


class Places:
    """The words of a study with all of its values, and reports of mistakes in them."""

    def __init__(self, study: Study, reporter: Reporter):
        self.study, self.reporter = study, reporter
        self.steps = {step.name: step for step in study.steps}
        self.set_by = {axis.name: axis.name for axis in study.axes}
        """The setting that gives each name its value."""
        for axis in study.axes:
            self.set_by |= {name: axis.name for values in axis.sets.values() for name in values}
        self.wrong: set[str] = set()
        """Steps with mistakes, whose consequences are not reported."""

    def known(self, names: set[str]) -> bool:
        """Whether all names have values; unknown names are reported when the file is read."""
        return names <= {*self.set_by, SEED, SIZE}

    def values(self, names: set[str]) -> Iterator[Values]:
        """All values that names can have together, at any size."""
        axes = [axis for axis in self.study.axes if axis.name in {self.set_by.get(name) for name in names}]
        seen = set()
        for size in SIZES:
            for chosen in itertools.product(*(axis.values[size] for axis in axes)):
                found = {SEED: "0", SIZE: size}
                for axis, value in zip(axes, chosen, strict=True):
                    found |= {axis.name: value, **axis.sets.get(value, {})}
                key = tuple(sorted((name, value) for name, value in found.items() if name in names))
                if key not in seen:
                    seen.add(key)
                    yield found

    def words(self, step: StudyStep, values: Values) -> dict[str, list[Word]]:
        """The words of a step's options, and of ``on`` where that is not a step."""
        texts = dict(step.options)
        if step.on is not None and not step.on_step:
            texts["on"] = (step.on,)
        return {
            option: [self._word(step, option, number, text, values) for number, text in enumerate(words)]
            for option, words in texts.items()
        }

    def _word(self, step: StudyStep, option: str, number: int, text: str, values: Values) -> Word:
        written, folder = Template(text).safe_substitute(values), self.study.folder
        filled = confined(step.means.get(option, TEXT), written, folder, folder)
        return Word(step.name, option, number, text, written, filled)

    def maker(self, step: StudyStep) -> StudyStep:
        """The step whose run is meant by a step's ``on``."""
        return maker(self.steps, step.on or "")

    def names_of(self, step: StudyStep) -> set[str]:
        """The names that a step uses, and what it works on."""
        found = names_in([step.on or "", *(word for _, words in step.options for word in words)])
        return found | (self.names_of(self.steps[step.on or ""]) if step.on_step else set())

    def place(self, *key: str) -> Span | None:
        return self.study.places.get(key)

    def report(
        self, where: Word | StudyStep, message: str, label: str = "", *, code: str = "PD806", **more: Any
    ) -> None:
        """Report a mistake of a step, or in a word: where its value is written, and where it is used."""
        if isinstance(where, StudyStep):
            self.wrong.add(where.name)
            self.reporter.error(code, message, self.place("step", where.name), label, **more)
            return
        self.wrong.add(where.step)
        span = self.place("word", where.step, where.option, str(where.number))
        names = sorted(names_in([where.text]))
        written = self._written(names[0], where) if len(names) == 1 else None
        if written is not None:
            more["secondary"] = (Label(span, f"as `{where.written}`"),)
        self.reporter.error(code, message, written or span, label, **more)

    def _written(self, name: str, word: Word) -> Span | None:
        """The place of the value of a name that makes a word what it is."""
        for axis in self.study.axes:
            for size in SIZES:
                for value in axis.values[size]:
                    found = {axis.name: value, **axis.sets.get(value, {})}
                    text = Template(word.text).safe_substitute({name: found[name]}) if name in found else None
                    if text == word.written:
                        own = name == axis.name
                        return self.place(
                            *(("value", name, value) if own else ("set", axis.name, value, name))
                        )
        return None

    @contextmanager
    def told(self, where: Word | StudyStep, *, here: bool = False) -> Iterator[list[Exception]]:
        """Report the exceptions that the block raises; the list then holds them.

        Args:
            here: a value of the study is wrong, even where that shows in another file. Otherwise mistakes of other files
                are shown there.
        """
        failed: list[Exception] = []
        try:
            yield failed
        except CompileError as error:
            failed.append(error)
            self.wrong.add(where.name if isinstance(where, StudyStep) else where.step)
            found = error.diagnostics
            if here:
                found = tuple(one for one in found if one.primary.span is None) or found[:1]
            for one in found:
                more: dict[str, Any] = {"notes": one.notes, "helps": one.helps}
                label = one.primary
                if label.span is None or here:
                    self.report(where, one.message, code=one.code, **more)
                else:
                    self.reporter.error(
                        one.code, one.message, label.span, label.text, secondary=one.secondary, **more
                    )
        except (click.ClickException, ValueError, TypeError) as error:
            failed.append(error)
            said = error.format_message() if isinstance(error, click.ClickException) else str(error)
            self.report(where, " ".join(said.split()))
