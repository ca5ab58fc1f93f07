"""What perceptual measures share: a distance to a fixed image as one node of the AD graph, and its images."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.core.errors import InputError, place_of
from envedit.core.types import DrArray, Tensor
from envedit.losses.perceptual.backbones import Backbone
from envedit.losses.ssim import KnownGradient, check_image

MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Of the images that the networks were trained on, in [0, 1]; LPIPS says the same of images in [-1, 1]."""


class Measure:
    """A distance to a fixed image: value, and gradient by hand."""

    def __init__(self, backbone: Backbone, reference: Tensor, pooling: str, name: str):
        check(reference, f"{name}: reference")
        if dr.grad_enabled(reference):
            raise InputError(
                f"{name}: gradients of the reference are not available: swap the two, or detach it."
            )
        self.name = name
        self.shape = tuple(reference.shape)
        self._stack = backbone.stack(self.shape[0], self.shape[1], pooling)

    def __call__(self, x: Tensor) -> DrArray:
        """Return the distance of the image ``(H, W, 3)`` as a size-1 array, differentiable in ``x``.

        Raises
        ------
        InputError
            If its shape is not the reference's.
        """
        if tuple(x.shape) != self.shape:
            raise InputError(
                f"{self.name}: image {tuple(x.shape)} and reference {self.shape} differ in shape."
            )
        if not dr.grad_enabled(x):
            return self._evaluate(dr.detach(x.array), False)[0]
        return dr.custom(KnownGradient, x.array, self)

    def _evaluate(self, x: DrArray, with_gradient: bool) -> tuple[DrArray, DrArray | None]:
        """Return the distance of a flat image and, if asked for, its gradient."""
        raise NotImplementedError


def check(image: Tensor, name: str) -> None:
    """Refuse what is not an image ``(H, W, 3)``."""
    check_image(image, name)
    if image.shape[2] != 3:
        raise InputError(f"{name}: expected an image of shape (H, W, 3), got {tuple(image.shape)}.")


def single(image: Any, name: str) -> mi.TensorXf:
    """Return an image, array or tensor, in single precision, refusing what is not finite."""
    image = np.ascontiguousarray(image, np.float32)
    check(image, name)
    bad = ~np.isfinite(image).all(axis=2)
    if bad.any():
        where = f"the first at {place_of(bad)}"
        raise InputError(f"{name}: {bad.sum()} pixel(s) are not finite, {where}; repair the image first.")
    return mi.TensorXf(image)


def normalised(x: DrArray) -> DrArray:
    """Return a flat image as the networks take it."""
    F = type(x)
    return (x - by_channel(F, len(x), MEAN)) / by_channel(F, len(x), DEVIATION)


def by_channel(F: type[DrArray], length: int, values: Sequence[float]) -> DrArray:
    """Repeat three constants along an image."""
    channel = dr.arange(mi.UInt32, length) % 3
    red, green, blue = (F(value) for value in values)
    return dr.select(channel == 0, red, dr.select(channel == 1, green, blue))
