"""Networks other than the paper's, named by the user: ``module:Class``.

Importing a module executes its code. So a name is imported only where the user gives it, on the command line or in
Python. Runs record it as text, which nothing imports.
"""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import reduce
from importlib import import_module
from typing import Any, Protocol

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from powderdsl.diagnostics import CompileError, suggest
from powderdsl.system.writing import failure

CONTRACT = "it is called as NAME(channels, slots) and gives a torch.nn.Module: float32 [B, channels, H, W] -> logits [B, slots, H, W]"


class Encoder(Protocol):
    """What a world model is given, uint8 -> float32 [B, channels, H, W]."""

    @property
    def channels(self) -> int:
        """How many there are."""

    def __call__(self, inputs: Tensor) -> Tensor:
        """The channels of some inputs."""


def is_network_name(text: Any) -> bool:
    """Whether a text has the form ``package.module:Class``. Nothing is imported."""
    if not isinstance(text, str) or text.count(":") != 1 or len(text) > 200:
        return False
    return all(part.isidentifier() for part in text.replace(":", ".").split("."))


@dataclass(frozen=True)
class CustomNetwork:
    """A user's network: its name, and what makes it, a class or another callable. Made by `custom_network`.

    ``make(channels, slots)`` gives a module from float32 [B, channels, H, W] to logits [B, slots, H, W].
    """

    name: str
    make: Callable[[int, int], Any]

    def build(self, encoder: Encoder, slots: int, seed: int) -> Encoded:
        """A network whose random weights depend on the seed alone.

        Raises:
            CompileError: PD625 if it is not a module, or making it fails.
        """
        with torch.random.fork_rng(devices=[]), self._told("cannot be made"):
            torch.manual_seed(seed)
            network = self.make(encoder.channels, slots)
        if not isinstance(network, nn.Module):
            found = type(network).__name__
            raise _invalid(self.name, f"must give a torch.nn.Module, found {found}", helps=(CONTRACT,))
        return Encoded(encoder, network)

    def check(self, encoder: Encoder, slots: int, inputs: Tensor, seed: int) -> None:
        """Try a network on some inputs: the shape of its logits, and whether it can learn.

        Raises:
            CompileError: PD625.
        """
        network = self.build(encoder, slots, seed).to(inputs.device)
        with torch.random.fork_rng(devices=[]), self._told("fails on a batch"):
            logits = network(inputs)
        given = f"for channels [{len(inputs)}, {encoder.channels}, {inputs.shape[-2]}, {inputs.shape[-1]}]"
        expected = [len(inputs), slots, *inputs.shape[-2:]]
        if not isinstance(logits, Tensor):
            found = type(logits).__name__
            raise _invalid(self.name, f"must give logits {expected}, found {found}", given, helps=(CONTRACT,))
        if list(logits.shape) != expected or not logits.is_floating_point():
            found = f"{list(logits.shape)} of {logits.dtype}"
            raise _invalid(self.name, f"must give logits {expected}, found {found}", given, helps=(CONTRACT,))
        weights = [one for one in network.parameters() if one.requires_grad]
        if logits.requires_grad and weights:
            with self._told("has no gradient"):
                truth = torch.zeros(len(inputs), *inputs.shape[-2:], dtype=torch.int64, device=inputs.device)
                F.cross_entropy(logits.float(), truth).backward()
        if all(one.grad is None for one in weights):
            helps = ("its logits must depend on parameters that require a gradient",)
            raise _invalid(self.name, "cannot be trained: no gradient reaches a parameter", helps=helps)

    @contextmanager
    def _told(self, what: str) -> Iterator[None]:
        """Report exceptions of the user's code, with the line that raised them."""
        try:
            yield
        except Exception as error:
            raise _invalid(self.name, what, *_words(error), helps=(CONTRACT,)) from None


class Encoded(nn.Module):
    """A network on channels, as one on ids: encodes its inputs first."""

    def __init__(self, encoder: Encoder, network: nn.Module):
        super().__init__()
        self.encoder, self.network = encoder, network

    def forward(self, inputs: Tensor) -> Tensor:
        logits: Tensor = self.network(self.encoder(inputs))
        return logits


@dataclass(frozen=True)
class OneHot:
    """Ids uint8 [B, H, W] -> float32 [B, slots, H, W]: 1 in the channel of the element, 0 in the others."""

    slots: int

    @property
    def channels(self) -> int:
        return self.slots

    def __call__(self, inputs: Tensor) -> Tensor:
        return F.one_hot(inputs.long(), self.slots).permute(0, 3, 1, 2).float().contiguous()

    def example(self, count: int, size: tuple[int, int]) -> Tensor:
        """Some inputs: uint8 [count, H, W]."""
        cells = torch.arange(count * size[0] * size[1]) % self.slots
        return cells.to(torch.uint8).view(count, *size)


NO_ELEMENT = 255
"""In inputs with actions: nothing is placed on this cell."""


@dataclass(frozen=True)
class ActionChannels:
    """A state and an action, uint8 [B, observed + 3, H, W] as `recordings` has them -> float32 [B, channels, H, W].

    The channels: the elements, one-hot, after the action has placed its own; the other channels of the observation,
    about −1 to 1; and, with `actions`, 1 where the action places an element, 1 where it blows, and its speed there in
    rows and columns, −1 to 1. Without, nothing of the action is seen.
    """

    slots: int
    observed: int
    actions: bool = True

    @property
    def channels(self) -> int:
        return self.slots + self.observed - 1 + (4 if self.actions else 0)

    def __call__(self, inputs: Tensor) -> Tensor:
        ids, placed, speed = inputs[:, 0], inputs[:, self.observed], inputs[:, self.observed + 1 :]
        found = [inputs[:, 1 : self.observed].float() / 128 - 1]
        if self.actions:
            here = placed != NO_ELEMENT
            ids = torch.where(here, placed, ids)
            blown = (speed[:, :1] != 0).float()
            found += [here[:, None].float(), blown, (speed.float() - 2) * blown]
        return torch.cat([OneHot(self.slots)(ids), *found], 1)

    def example(self, count: int, size: tuple[int, int]) -> Tensor:
        """Some inputs."""
        ids = OneHot(self.slots).example(count, size)[:, None]
        return torch.cat([ids, torch.zeros(count, self.observed + 2, *size, dtype=torch.uint8)], 1)


def without_actions(inputs: Tensor) -> Tensor:
    """Inputs in which nothing was done: uint8 [B, C + 3, H, W]."""
    found = inputs.clone()
    found[:, -3], found[:, -2:] = NO_ELEMENT, 0
    return found


def custom_network(name: str) -> CustomNetwork:
    """Import a network by its name, ``module:Class``, from installed packages or the current folder.

    Raises:
        CompileError: PD625 if the name has another form, or there is no such module or class in it.
    """
    if not is_network_name(name):
        raise _invalid(name, "is not a name of a network", helps=("write MODULE:CLASS, such as nets:Deep",))
    module_name, _, path = name.partition(":")
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # behind all others: nothing that is installed is replaced
    helps: tuple[str, ...] = ()
    try:
        module = import_module(module_name)
    except ModuleNotFoundError as error:
        if error.name and f"{module_name}.".startswith(f"{error.name}."):
            helps = ("run the command in the module's folder",)
            raise _invalid(name, "cannot be imported", _words(error)[0], helps=helps) from None
        raise _invalid(name, "cannot be imported", *_words(error)) from None
    except Exception as error:
        raise _invalid(name, "cannot be imported", *_words(error)) from None
    try:
        make = reduce(getattr, path.split("."), module)
    except AttributeError:
        known = [one for one, value in vars(module).items() if callable(value) and not one.startswith("_")]
        helps = suggest(path, known, f"`{module_name}` has")
        raise _invalid(name, f"does not exist: `{module_name}` has no `{path}`", helps=helps) from None
    if not callable(make):
        raise _invalid(name, f"is not a class but {type(make).__name__}", helps=(CONTRACT,))
    return CustomNetwork(name, make)


def _words(error: Exception) -> tuple[str, str]:
    """What an exception says, and the line of the code that raised it."""
    said = f"{type(error).__name__}: {' '.join(str(error).split())[:300]}".removesuffix(": ")
    if isinstance(error, SyntaxError):
        return said, f"at {error.filename}:{error.lineno}"
    frames = [one for one in traceback.extract_tb(error.__traceback__) if not one.filename.startswith("<")]
    return said, f"at {frames[-1].filename}:{frames[-1].lineno}"


def _invalid(name: str, what: str, *notes: str, helps: tuple[str, ...] = ()) -> CompileError:
    """PD625: a network that cannot be used."""
    return failure("PD625", f"the network `{name}` {what}", notes=notes, helps=helps)
