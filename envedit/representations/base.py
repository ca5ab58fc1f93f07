"""The interface through which loop, solver and export see a representation, whichever it is."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.core.types import Params

if TYPE_CHECKING:
    from envedit.representations.layers.separation import Separation
    from envedit.representations.siren.fit import Fitted

EPSILON = 0.01
"""Added to radiance inside a logarithm (paper, below Eq. 3)."""


def not_negative(radiance: mi.TensorXf) -> mi.TensorXf:
    """Clip below at zero, but keep the slope: with the clip's, a black texel would stay black for good."""
    return dr.replace_grad(dr.maximum(radiance, 0), radiance)


class Representation(Protocol):
    """The part of a map that is edited, as parameters.

    ``lr`` is the learning rate that suits them. With ``models_edit`` they describe the edit and not the map:
    they start at "no change", are searched for before they are optimised, and apply to the original at any
    resolution. ``fitted`` says how well the map was fitted, ``separation`` are its lights and background;
    None where it is not fitted, or they are not separated.
    """

    @property
    def lr(self) -> float: ...  # noqa: D102

    @property
    def models_edit(self) -> bool: ...  # noqa: D102

    @property
    def fitted(self) -> Fitted | None: ...  # noqa: D102

    @property
    def separation(self) -> Separation | None: ...  # noqa: D102

    def decode(self, params: Params) -> mi.TensorXf:
        """Return (H, W, 3) linear radiance, finite and not negative, differentiable in the parameters."""


class Encoder(Representation, Protocol):
    """A representation that is made before it is known of which map."""

    def encode(self, image: np.ndarray, seed: int = 0) -> Params:
        """Return the parameters that reproduce an image (H, W, 3) as well as the representation can.

        InputError if the image is not radiance, or holds what :meth:`.Representation.decode` could not give
        back.
        """
