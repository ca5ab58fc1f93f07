"""Feature stacks of VGG16 and AlexNet as torchvision has them, on `convolution`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.core.arrays import tensor
from envedit.core.types import DrArray, FilePath, Shape
from envedit.losses.perceptual import convolution, weights

# ---- The stacks, as torchvision has them -------------------------------------------------------------------


@dataclass(frozen=True)
class Conv:
    """A convolution and its ReLU."""

    name: str
    inputs: int
    outputs: int
    kernel: int
    stride: int = 1
    padding: int = 0
    tap: bool = False

    def parts(self) -> dict[str, tuple[int, ...]]:
        """Name the tensors of the layer, with their shapes in torchvision's layout (O, I, kh, kw)."""
        weight = self.outputs, self.inputs, self.kernel, self.kernel
        return {f"{self.name}.weight": weight, f"{self.name}.bias": (self.outputs,)}


@dataclass(frozen=True)
class Pool:
    """Max pooling of every second pixel."""

    kernel: int


def _vgg16():
    layers: list[Conv | Pool] = []
    index, channels = 0, 3
    for block, (width, count) in enumerate([(64, 2), (128, 2), (256, 3), (512, 3), (512, 3)]):
        if block:
            layers.append(Pool(2))
            index += 1
        for i in range(count):
            layers.append(Conv(f"features.{index}", channels, width, 3, padding=1, tap=i == count - 1))
            channels = width
            index = index + 2
    return layers


def _alexnet():
    sizes = [(0, 3, 64, 11, 4, 2), (3, 64, 192, 5, 1, 2), (6, 192, 384, 3, 1, 1)]
    sizes += [(8, 384, 256, 3, 1, 1), (10, 256, 256, 3, 1, 1)]
    convs = [Conv(f"features.{i}", a, b, k, s, p, tap=True) for i, a, b, k, s, p in sizes]
    return [convs[0], Pool(3), convs[1], Pool(3), *convs[2:]]


KINDS = {
    "vgg": ("VGG16", _vgg16(), 16, "vgg16", "vgg16-397923af.pth"),
    "alex": ("AlexNet", _alexnet(), 31, "alexnet", "alexnet-owt-7be5be79.pth"),
}
"""Name as LPIPS has it -> title, layers, least pixels along each side of an image, which leave one after the
last layer, torchvision's name, torchvision's file."""


class Backbone:
    """The weights of a feature stack.

    ``kind`` is one of :data:`KINDS`; ``tensors`` are torchvision's state dict, as far as it is named
    ``features.*``: float32 arrays.
    """

    def __init__(self, kind: str, tensors: dict[str, np.ndarray]):
        _, self.layers, self.least_size, _, _ = KINDS[kind]
        self.channels = [layer.outputs for layer in self.layers if isinstance(layer, Conv) and layer.tap]
        self.weights: list[Any] = [
            _as_matrix(layer, tensors) if isinstance(layer, Conv) else None for layer in self.layers
        ]

    @classmethod
    def load(cls, kind: str, file: FilePath) -> Backbone:
        """Read the weights from an ``npz`` file that holds torchvision's state dict.

        Further tensors, such as those of the classifier, are ignored; errors as of :func:`.weights.read`.
        """
        words, layers, _, model, original = KINDS[kind]
        shapes: dict[str, tuple[int, ...]] = {}
        for layer in layers:
            shapes |= layer.parts() if isinstance(layer, Conv) else {}
        source = f"torchvision.models.{model}, https://download.pytorch.org/models/{original}"
        return cls(kind, weights.read(file, shapes, words, source))


def _as_matrix(layer, tensors):
    """Weights (O, taps * I), channels together as in an image, and bias (O,), in memory."""
    kernels = tensors[f"{layer.name}.weight"]
    matrix = kernels.transpose(0, 2, 3, 1).reshape(len(kernels), -1)
    return tensor(matrix), dr.opaque(mi.Float(tensors[f"{layer.name}.bias"]))


# ---- A network laid out for one size of image --------------------------------------------------------------


class Stack:
    """A feature stack for images of one size.

    ``pooling`` is "max", of images with ``least_size`` pixels or more along each side, or "hanning" for the
    L2 pooling of DISTS in place of every max pooling. Gradients are pulled back through the network of DISTS:
    VGG16 with "hanning".
    """

    def __init__(self, backbone: Backbone, height: int, width: int, pooling: str = "max"):
        self._steps: list[Any] = []
        self._tapped: list[tuple[int, int, int]] = []
        size: Shape = (height, width, 3)
        step: Any
        for layer, parameters in zip(backbone.layers, backbone.weights, strict=True):
            if isinstance(layer, Conv):
                matrix, bias = parameters
                step = convolution.Convolution(matrix, bias, size, layer.kernel, layer.stride, layer.padding)
            elif pooling == "hanning":
                step = convolution.HanningPool(size)
            else:
                step = convolution.MaxPool(layer.kernel, size)
            size = step.after
            self._steps.append(step)
            if isinstance(layer, Conv) and layer.tap:
                self._tapped.append((len(self._steps), size[0] * size[1], size[2]))

    def forward(self, x: DrArray) -> list:
        """Return the image and the output of every layer: what :meth:`taps` and :meth:`backward` need.

        ``x`` has H * W * 3 numbers, normalised as the network requires; it is not differentiated.
        """
        tape = [x]
        for step in self._steps:
            tape.append(step.forward(tape[-1]))
        return tape

    def taps(self, tape: list) -> list:
        """Pick the tapped features: a list of (N * C numbers, N, C), N pixels of C channels."""
        return [(tape[i], pixels, channels) for i, pixels, channels in self._tapped]

    def backward(self, tape: list, gradients: list) -> DrArray:
        """Pull gradients, N * C numbers for each tap, back to the image: H * W * 3 numbers.

        ``tape`` is what :meth:`forward` returned.
        """
        at = {i: gradient for (i, _, _), gradient in zip(self._tapped, gradients, strict=True)}
        gradient: DrArray = None
        for i in range(len(self._steps), 0, -1):
            if i in at:
                gradient = at[i] if gradient is None else gradient + at[i]
            if gradient is not None:
                gradient = self._steps[i - 1].backward(tape[i - 1], tape[i], gradient)
        return gradient
