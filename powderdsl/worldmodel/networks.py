"""Networks: the paper's U-net (Frans & Isola 2023, section 4), and custom networks named ``module:Class``.

Importing a module executes its code. So a name is imported only if the user passes it on the command line or in Python.
Runs record it as text, which is never imported.
"""

from __future__ import annotations

import math
import os
import pkgutil
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from powderdsl.diagnostics import suggest
from powderdsl.experiments.runs import Checkpoint, reporting_misfits
from powderdsl.system.writing import failure
from powderdsl.tasks.laws import NUMBERS
from powderdsl.worldmodel.config import TrainConfig

SIDES = 4
"""Rows and columns are padded to a multiple of this, since two poolings halve them twice."""

NO_ELEMENT = 255
"""In inputs with actions: nothing is placed on this cell."""

CONTRACT = "it is called as NAME(channels, slots) and gives a torch.nn.Module: float32 [B, channels, H, W] -> logits [B, slots, H, W]"


# Inputs


@dataclass(frozen=True)
class ActionChannels:
    """From inputs, uint8, to channels, float32 [B, channels, H, W]: one-hot elements, and actions.

    Without `observed`, inputs are ids [B, H, W]. Otherwise, they are a state and an action, [B, observed + 3, H, W] as
    in `recordings`. Then the elements are those after the action has placed its own, followed by the other channels of
    the observation, about −1 to 1, and, with `actions`, by 1 where the action places an element, 1 where it blows, and
    its speed there in rows and columns, −1 to 1. Without `actions`, the action is hidden.
    """

    slots: int
    observed: int = 0
    actions: bool = True

    @property
    def channels(self) -> int:
        return self.slots + (self.observed - 1 + 4 * self.actions if self.observed else 0)

    @property
    def planes(self) -> tuple[int, ...]:
        """The dimensions of inputs between their number and their rows."""
        return (self.observed + 3,) if self.observed else ()

    def __call__(self, inputs: Tensor) -> Tensor:
        ids, others = inputs, list[Tensor]()
        if self.observed:
            ids, placed, speed = inputs[:, 0], inputs[:, self.observed], inputs[:, self.observed + 1 :]
            others = [inputs[:, 1 : self.observed].float() / 128 - 1]
            if self.actions:
                here = placed != NO_ELEMENT
                ids = torch.where(here, placed, ids)
                blown = (speed[:, :1] != 0).float()
                others += [here[:, None].float(), blown, (speed.float() - 2) * blown]
        elements = F.one_hot(ids.long(), self.slots).permute(0, 3, 1, 2).float().contiguous()
        return torch.cat([elements, *others], 1)


@dataclass(frozen=True)
class LawChannels:
    """From elements and laws, uint8 [B, 2, H, W], to channels: one-hot elements and their laws, −1 to 1."""

    slots: int
    planes = (2,)

    @property
    def channels(self) -> int:
        return self.slots * (1 + len(NUMBERS))

    def __call__(self, inputs: Tensor) -> Tensor:
        ids, count = inputs[:, 0].long(), self.slots * len(NUMBERS)
        table = inputs[:, 1].flatten(1)[:, : self.slots * count].unflatten(1, (self.slots, count))
        laws = table.gather(1, ids.flatten(1)[..., None].expand(-1, -1, count)).float() / 127.5 - 1
        return torch.cat([F.one_hot(ids, self.slots), laws.view(*ids.shape, count)], 3).permute(0, 3, 1, 2)


Encoder = ActionChannels | LawChannels


def without_actions(inputs: Tensor) -> Tensor:
    """Inputs without an action: uint8 [B, C + 3, H, W]."""
    blanked = inputs.clone()
    blanked[:, -3], blanked[:, -2:] = NO_ELEMENT, 0
    return blanked


class Encoded(nn.Module):
    """A network on ids that encodes its inputs for a network on channels."""

    def __init__(self, encoder: Encoder, network: nn.Module):
        super().__init__()
        self.encoder, self.network = encoder, network

    def forward(self, inputs: Tensor) -> Tensor:
        return self.network(self.encoder(inputs))


# The paper's network


class UNet(nn.Module):
    """Element ids, uint8 [B, H, W] -> logits of each cell's future element, float32 [B, slots, H, W].

    With `channels`, the input is float32 [B, channels, H, W] instead.

    Three blocks of `width`, 2·`width` and 4·`width` features, each two 3×3 convolutions with ReLU; max-pooling down,
    transposed convolutions up, skip connections, a 1×1 head. Ids become one-hot only here, a batch at a time.
    """

    def __init__(self, slots: int, width: int = 32, channels: int | None = None):
        super().__init__()
        self.slots, self.width = slots, width
        double, quadruple = 2 * width, 4 * width
        self.down_1, self.down_2 = _block(channels or slots, width), _block(width, double)
        self.middle = _block(double, quadruple)
        self.pool = nn.MaxPool2d(2)
        self.up_2 = nn.ConvTranspose2d(quadruple, double, 2, stride=2)
        self.up_1 = nn.ConvTranspose2d(double, width, 2, stride=2)
        self.back_2, self.back_1 = _block(quadruple, double), _block(double, width)
        self.head = nn.Conv2d(width, slots, 1)
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def forward(self, inputs: Tensor) -> Tensor:
        height, width = inputs.shape[-2:]
        cells = inputs
        if inputs.ndim == 3:
            # One-hot [B, H, W, C] viewed as [B, C, H, W] has channels last in memory, which convolutions preserve.
            cells = F.one_hot(inputs.long(), self.slots).to(self.head.weight.dtype).permute(0, 3, 1, 2)
        cells = F.pad(cells, (0, -width % SIDES, 0, -height % SIDES))
        cells = cells.contiguous(memory_format=torch.channels_last)
        first = self.down_1(cells)
        second = self.down_2(self.pool(first))
        third = self.middle(self.pool(second))
        second = self.back_2(torch.cat([self.up_2(third), second], 1))
        first = self.back_1(torch.cat([self.up_1(second), first], 1))
        logits: Tensor = self.head(first)
        return logits[..., :height, :width]


def _block(before: int, after: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(before, after, 3, padding=1),
        nn.ReLU(inplace=True),
        nn.Conv2d(after, after, 3, padding=1),
        nn.ReLU(inplace=True),
    )


def fresh_unet(slots: int, width: int, seed: int, channels: int | None = None) -> UNet:
    """A network with random weights that depend only on the seed; created on the CPU, so the same for every device.

    Initialized as in He et al. (2015), which keeps the scale of activations. With torch's default, which shrinks them,
    the loss takes about three times as many iterations to fall as far.
    """
    network = UNet(slots, width, channels)
    source = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for layer in network.modules():
            if isinstance(layer, nn.Conv2d):
                inputs = layer.in_channels * layer.kernel_size[0] * layer.kernel_size[1]
                gain = 1 if layer is network.head else 2  # a ReLU halves the mean square
                layer.weight.normal_(std=math.sqrt(gain / inputs), generator=source)
            elif isinstance(layer, nn.ConvTranspose2d):
                layer.weight.normal_(std=math.sqrt(1 / layer.in_channels), generator=source)
            if isinstance(layer, nn.Conv2d | nn.ConvTranspose2d) and layer.bias is not None:
                layer.bias.zero_()
    return network


# Users' own


@dataclass(frozen=True)
class CustomNetwork:
    """A custom network: its name, and the class or other callable that creates it. Created by `custom_network`.

    ``make(channels, slots)`` returns a module from float32 [B, channels, H, W] to logits [B, slots, H, W].
    """

    name: str
    make: Callable[[int, int], Any]

    def build(self, encoder: Encoder, seed: int) -> Encoded:
        """A network whose random weights depend only on the seed.

        Raises CompileError (PD625) if it is not a module or cannot be created.
        """
        with torch.random.fork_rng(devices=[]), _reporting_user_errors(self.name, "cannot be created"):
            torch.manual_seed(seed)
            network = self.make(encoder.channels, encoder.slots)
            if not isinstance(network, nn.Module):
                raise TypeError(f"it must return a torch.nn.Module, found {type(network).__name__}")
        return Encoded(encoder, network)

    def check(self, encoder: Encoder, size: tuple[int, int], seed: int) -> None:
        """Check, on two worlds of a size, the shape of a network's logits, and that it can be trained.

        Raises CompileError (PD625).
        """
        network = self.build(encoder, seed)
        inputs = torch.zeros(2, *encoder.planes, *size, dtype=torch.uint8)
        expected = [2, encoder.slots, *size]
        with torch.random.fork_rng(devices=[]), _reporting_user_errors(self.name, "cannot be trained"):
            logits: Any = network(inputs)
            shape = type(logits).__name__
            if isinstance(logits, Tensor):
                shape = f"{list(logits.shape)} of {logits.dtype}"
            if not (shape.startswith(str(expected)) and logits.is_floating_point()):
                channels = [2, encoder.channels, *size]
                raise ValueError(f"it must return logits {expected}, found {shape}, for channels {channels}")
            weights = [weight for weight in network.parameters() if weight.requires_grad]
            if logits.requires_grad and weights:
                F.cross_entropy(logits.float(), torch.zeros(2, *size, dtype=torch.int64)).backward()
            if all(weight.grad is None for weight in weights):
                why = "no parameter gets a gradient: logits must depend on some that require one"
                raise ValueError(why)


def custom_network(name: str) -> CustomNetwork:
    """Import a network by its name, ``module:Class``, from installed packages or the current folder.

    Raises:
        CompileError: PD625 if the name has another form, or the module or class does not exist.
    """
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # last, so that it does not shadow installed modules
    with _reporting_user_errors(name, "cannot be imported"):
        if name.count(":") != 1 or not all(map(str.isidentifier, name.replace(":", ".").split("."))):
            raise ValueError("write MODULE:CLASS, such as nets:Deep")
        make = pkgutil.resolve_name(name)
        if not callable(make):
            raise TypeError(f"expected a class, found {type(make).__name__}")
    return CustomNetwork(name, make)


@contextmanager
def _reporting_user_errors(name: str, what: str) -> Iterator[None]:
    """Report exceptions as PD625, with the line of the user's code that raised them."""
    try:
        yield
    except Exception as error:
        frames = traceback.extract_tb(error.__traceback__)
        ours = ("<", __file__, os.path.dirname(os.__file__))
        lines = [(frame.filename, frame.lineno) for frame in frames if not frame.filename.startswith(ours)]
        lines += [(error.filename or "", error.lineno)] if isinstance(error, SyntaxError) else []
        notes = [f"{type(error).__name__}: {' '.join(str(error).split())[:300]}".removesuffix(": ")]
        notes += [f"at {file}:{line}" for file, line in lines[-1:]]
        helps: tuple[str, ...] = (CONTRACT,)
        if isinstance(error, AttributeError):
            helps = suggest(str(error.name), [word for word in dir(error.obj) if not word.startswith("_")])
        raise failure("PD625", f"the network `{name}` {what}", notes=tuple(notes), helps=helps) from None


# Networks of runs


def encoder_of(config: TrainConfig, slots: int) -> Encoder:
    if config.recorded is None:
        return LawChannels(slots) if config.data.observation == "laws" else ActionChannels(slots)
    return ActionChannels(slots, len(config.recorded.channels), config.recorded.actions)


def network_of(config: TrainConfig, slots: int, own: nn.Module | CustomNetwork | None) -> nn.Module:
    """The given network, or the paper's, which encodes ids alone itself."""
    encoder = encoder_of(config, slots)
    if isinstance(own, CustomNetwork):
        return own.build(encoder, config.seed)
    if own is not None:
        return own
    if not encoder.planes:
        return fresh_unet(slots, config.width, config.seed)
    return Encoded(encoder, fresh_unet(slots, config.width, config.seed, encoder.channels))


def fit_weights(model: nn.Module, checkpoint: Checkpoint, *, grow: bool = False) -> None:
    """Load the weights of a checkpoint, which may contain anything, into a network.

    `grow`: the network may be larger, and weights missing in the checkpoint are unchanged. Raises CompileError (PD623)
    for weights of another network.
    """
    with reporting_misfits(checkpoint.path, "its weights belong to another network"):
        weights = dict(checkpoint.state["model"])
        model.load_state_dict(_grown(weights, model) if grow else weights)


def _grown(state: dict[str, Any], model: nn.Module) -> dict[str, Any]:
    """Weights at the start of each dimension of a network with more slots."""
    for name, fresh in model.state_dict().items():
        old = state.get(name)
        if not isinstance(old, Tensor) or old.ndim != fresh.ndim or old.shape == fresh.shape:
            continue
        if all(a <= b for a, b in zip(old.shape, fresh.shape, strict=True)):
            state[name] = fresh.clone()
            state[name][tuple(slice(size) for size in old.shape)] = old
    return state
