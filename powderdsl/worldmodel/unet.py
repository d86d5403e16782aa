"""The paper's network (Frans & Isola 2023, section 4): a U-net of three blocks, for grids of any size."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional as F

SIDES = 4
"""Rows and columns are padded to a multiple of this: two poolings halve them twice."""


class UNet(nn.Module):
    """Element ids, uint8 [B, H, W] -> logits of what each cell will hold, float32 [B, slots, H, W].

    With `channels`, the input is float32 [B, channels, H, W] instead.

    Three blocks of `width`, 2·`width` and 4·`width` features, each two 3×3 convolutions with ReLU; max-pooling down,
    transposed convolutions up, skip connections, a 1×1 head. Ids become one-hot only here, a batch at a time.
    """

    def __init__(self, slots: int, width: int = 32, channels: int | None = None):
        super().__init__()
        self.slots, self.width = slots, width
        one, two, four = width, 2 * width, 4 * width
        self.down_1, self.down_2, self.middle = (
            _block(channels or slots, one),
            _block(one, two),
            _block(two, four),
        )
        self.pool = nn.MaxPool2d(2)
        self.up_2 = nn.ConvTranspose2d(four, two, 2, stride=2)
        self.up_1 = nn.ConvTranspose2d(two, one, 2, stride=2)
        self.back_2, self.back_1 = _block(2 * two, two), _block(2 * one, one)
        self.head = nn.Conv2d(one, slots, 1)

    def forward(self, inputs: Tensor) -> Tensor:
        height, width = inputs.shape[-2:]
        cells = inputs
        if inputs.ndim == 3:
            # One-hot as [B, H, W, C] seen as [B, C, H, W] has channels last in memory, and convolutions keep that.
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
    """A network with random weights that depend on the seed alone: made on the CPU, the same for every device.

    Their spread is that of He et al. (2015): activations keep their size from layer to layer. With torch's own, which
    shrink them, the loss takes about three times as many iterations to fall as far.
    """
    network = UNet(slots, width, channels).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
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
