"""The best detector's network in torch (the extra `train`): a small encoder and decoder, read out at a quarter.

Only `garden train best` imports it. A robot runs the ONNX file it writes, through OpenCV (`core.perception.best`).
"""

from __future__ import annotations

import io

import torch
from torch import Tensor, nn
from torch.nn import functional

from core.perception.best import INPUT_CHANNELS, OUTPUT_CHANNELS

WIDTHS = (16, 24, 48, 64, 72)
"""Channels at 1/2, 1/4, 1/8, 1/16 and 1/32 of the input."""
HEAD_CHANNELS = 32
FRUIT_PRIOR_LOGIT = -4.0
"""Where training begins: one cell in fifty is a fruit's centre (Lin et al. 2017, focal loss, section 4.1)."""


def convolution(inputs: int, outputs: int, *, stride: int = 1, size: int = 3) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, size, stride, size // 2, bias=False), nn.BatchNorm2d(outputs), nn.ReLU(inplace=True)
    )


class Residual(nn.Module):
    """Two convolutions beside a straight path (He et al. 2016)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = convolution(channels, channels)
        self.second = nn.Sequential(nn.Conv2d(channels, channels, 3, 1, 1, bias=False), nn.BatchNorm2d(channels))

    def forward(self, x: Tensor) -> Tensor:
        return functional.relu(x + self.second(self.first(x)))


class FruitNetwork(nn.Module):
    """Planes (B, 6, H, W), H and W multiples of 32 -> maps (B, 8, H/4, W/4), as `core.perception.best` reads them."""

    def __init__(self) -> None:
        super().__init__()
        half, quarter, eighth, sixteenth, deepest = WIDTHS
        self.stem = convolution(INPUT_CHANNELS, half, stride=2)
        self.quarter = nn.Sequential(convolution(half, quarter, stride=2), Residual(quarter))
        self.eighth = nn.Sequential(convolution(quarter, eighth, stride=2), Residual(eighth), Residual(eighth))
        self.sixteenth = nn.Sequential(convolution(eighth, sixteenth, stride=2), Residual(sixteenth), Residual(sixteenth))
        self.deepest = nn.Sequential(convolution(sixteenth, deepest, stride=2), Residual(deepest))
        self.up_sixteenth = convolution(deepest + sixteenth, sixteenth, size=1)
        self.up_eighth = convolution(sixteenth + eighth, eighth, size=1)
        self.mix_eighth = convolution(eighth, eighth)
        self.up_quarter = convolution(eighth + quarter, HEAD_CHANNELS, size=1)
        self.mix_quarter = convolution(HEAD_CHANNELS, HEAD_CHANNELS)
        self.head = nn.Conv2d(HEAD_CHANNELS, OUTPUT_CHANNELS, 1)
        nn.init.constant_(self.head.bias, 0.0)
        with torch.no_grad():
            self.head.bias[0] = FRUIT_PRIOR_LOGIT

    def forward(self, x: Tensor) -> Tensor:
        quarter = self.quarter(self.stem(x))
        eighth = self.eighth(quarter)
        sixteenth = self.sixteenth(eighth)
        deepest = self.deepest(sixteenth)
        x = self.up_sixteenth(torch.cat([doubled(deepest), sixteenth], 1))
        x = self.mix_eighth(self.up_eighth(torch.cat([doubled(x), eighth], 1)))
        x = self.mix_quarter(self.up_quarter(torch.cat([doubled(x), quarter], 1)))
        return self.head(x)


def doubled(x: Tensor) -> Tensor:
    return functional.interpolate(x, scale_factor=2.0, mode="nearest")


def onnx_bytes(network: FruitNetwork) -> bytes:
    """The network as an ONNX file, normalisations folded into the convolutions. OpenCV runs it at any size."""
    network.eval()
    file = io.BytesIO()
    torch.onnx.export(
        network,
        (torch.zeros(1, INPUT_CHANNELS, 64, 96),),
        file,
        input_names=["image"],
        output_names=["maps"],
        opset_version=13,
        dynamo=False,
    )
    return file.getvalue()
