"""The rows below the horizon, which follow the sky above them.

On PureSky maps they are a blurred mirror of the sky; on others they are photographed ground. Either way they
are the original's, times a smooth factor, the change of the sky above:

    E_low = E0_low * R^f * (H / H_0)^(1 - f) * a^(1 - e),      f = s e,
    log R = (1 - b) log(S(m) / S_0(m)) + b log(K S(m) / K S_0(m))

S and S_0 are the sky after the edit and before, without cores of lights, and with some of its luminance in
every channel (:data:`.VEIL`), as a ratio to a black channel says nothing. m is the mirrored direction, K a
Gaussian on the sphere that widens with the angle below the horizon. b goes from 0 at the horizon to 1 at
:data:`BLEND_DEGREES`, so that there is no edge. Cores are left out, as they are far too bright for a ratio;
the reflection of a core goes with its glow (:meth:`Below.reveal`).

f is 1 for a mirror. For ground, e falls off with the angle below the horizon (:data:`FADE_DEGREES`), and s
is how far the ground continues the sky's pattern in the original (:meth:`Below._continued`). Farther down,
ground follows its irradiance H (``ground_light.py``), or keeps its brightness where that would need an
implausible albedo. a is an unknown of the edit, 1 where the picture does not determine it: light from the
side, or another ground. At the horizon it has no effect, as texels there are interpolated with the sky's: it
would make up for what is wrong with the sky.
"""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.core import latlong
from envedit.core.arrays import settled, tensor, vectors
from envedit.core.color import LUMINANCE
from envedit.representations.layers.gain import VEIL
from envedit.representations.layers.ground_light import GroundLight, with_luminance

Horizon = Literal["mirror", "keep", "free"]

MIRROR_MOST_DETAIL = 0.0125
"""Most detail below the horizon of a mirror: median of |log luminance less its mean over a square of
:data:`DETAIL_DEGREES`|. Above it is photographed ground. Measured: 0.001 to 0.007 on 13 PureSky maps, 0.03 to
0.14 on four maps with ground, 128 to 1024 texels wide (``test_public_maps_are_told_apart``)."""
DETAIL_DEGREES = 7.0
"""Side of that square. In maps narrower than 128 texels, where it would have fewer than three texels, the
limit is as much higher as they are narrower. Not measured beside other values."""
MIRROR_LEAST_RANGE = 1 / 512
"""Least range of log luminance around the horizon of a mirror; below it, nothing shows that it is one.
Derived: no display shows less (:data:`.unseen.UNSEEN`)."""
BLUR_DEGREES = 1.0
"""Standard deviation of K at the horizon. Not measured beside other values."""
BLUR_WIDENING = 0.3
"""Degrees that are added to it for each degree below the horizon. Not measured beside other values."""
BLUR_MOST_DEGREES = 3.0, 6.0, 10.0, 15.0, 20.0
"""Candidates for the largest standard deviation of K: the one is taken under which the original mirrors its
own sky best. Measured: the lower halves of 13 PureSky maps turned by 60 degrees, their upper halves given,
come 15.9 dB nearer to the truth, and 14.2 dB with 10 degrees for all."""
BLEND_DEGREES = 5.0
"""Degrees below the horizon over which the blur sets in. Not measured beside other values."""
FADE_DEGREES = 10.0
"""Degrees below the horizon at which ground follows the mirrored sky by 1/e. Not measured beside other
values."""
LEAST_GONE = 1e-3
"""Least share of a texel's light that is taken for a glow's: keeps a quotient finite. Not measured."""
GRID_COLUMNS = 96
"""Columns of the grid on which K is applied. Not measured beside other values."""
CHOICE_COLUMNS = 48
"""Columns of the grid on which the widths of K are compared. Not measured beside other values."""


class Averaged(NamedTuple):
    """A sky (rows, W, 3) with some of its luminance in every channel, and its average over K."""

    sky: mi.TensorXf
    soft: mi.TensorXf


def sky_rows(total: int) -> int:
    """Return how many rows of a map look up, the horizon's own included."""
    return (total + 1) // 2


def treatment(horizon: str, rows: str | tuple[int, int], envmap: np.ndarray) -> Any:
    """Return what the rows below the horizon of a map do (:data:`Horizon`), from keys of ``[input]``."""
    if rows != "all":
        return "free"
    return kind_of(envmap) if horizon == "auto" else horizon


def kind_of(envmap: np.ndarray) -> str:
    """Detect what a map (H, W, 3) shows below the horizon: a "mirror" of the sky, or ground to "keep"."""
    low = envmap[sky_rows(len(envmap)) :].astype(np.float64) @ LUMINANCE
    if not low.size or not low.max() > 0:
        return "keep"
    logs = np.log(np.maximum(low, 1e-6 * low.max()))
    # Neither the horizon, where the sky's own detail is near, nor the nadir, where columns meet.
    logs = logs[len(logs) // 8 : max(3 * len(logs) // 4, len(logs) // 8 + 1)]
    width = envmap.shape[1]
    half = max(1, round(DETAIL_DEGREES / 360 * width / 2 - 0.5))
    padded = np.pad(logs, ((half, half), (0, 0)), mode="edge")
    padded = np.pad(padded, ((0, 0), (half, half)), mode="wrap")
    mean = np.lib.stride_tricks.sliding_window_view(padded, (2 * half + 1,) * 2).mean(axis=(2, 3))
    detail = np.median(np.abs(logs - mean))
    smooth = detail <= MIRROR_MOST_DETAIL * max(1.0, 128 / width)
    varies = np.ptp(logs, axis=1).max() > MIRROR_LEAST_RANGE
    return "mirror" if smooth and varies else "keep"


class Below:
    """The rows below the horizon of one map.

    ``radiance`` (rows, W, 3) are the original's rows below the horizon, ``sky`` (sky_rows, W, 3) its rows
    above, without cores of lights, and ``above`` these with cores: ground is lit by them, or keeps its
    brightness without. ``kind`` is "mirror" or "keep".

    Of each row, (rows,), ``mirrored`` is the row of the sky that it mirrors, ``fade`` its f, and
    ``own_ground`` how far it has the ground's own factor a, 1 - e. ``widest`` is the greatest standard
    deviation of K, degrees. ``light`` is what falls on ground that it lights; None of a mirror, and of ground
    that keeps its brightness.
    """

    def __init__(self, radiance: np.ndarray, sky: np.ndarray, kind: str, above: np.ndarray | None = None):
        up, width, _ = sky.shape
        low = len(radiance)
        total = up + low
        self.kind = kind
        self.shape = radiance.shape[:2]
        self.image = radiance
        self.radiance = vectors(mi.Color3f, radiance)
        self._faint = float(max(1e-6 * sky.mean(), 1e-30))

        # ---- How far each row follows the mirrored sky, sharp and blurred
        angle = np.degrees(np.pi * np.arange(up, total) / max(total - 1, 1)) - 90
        near = np.exp(-angle / FADE_DEGREES)
        self.fade = np.ones(low) if kind == "mirror" else near * self._continued(radiance, sky, near)
        self._blend = np.clip(angle / BLEND_DEGREES, 0, 1)
        self._sharp = tensor(((1 - self._blend) * self.fade)[:, None])
        self._soft = tensor((self._blend * self.fade)[:, None])

        # ---- The mirrored sky: its texels, and its average over K
        self.mirrored = np.arange(low)[::-1]
        texel = self.mirrored[:, None] * (3 * width) + np.arange(3 * width)
        self._mirrored = dr.opaque(mi.UInt32(texel.ravel().astype(np.uint32)))
        self._blur = _Blur((up, width), total, GRID_COLUMNS)
        self._up = tensor(self._blur.down[self.mirrored])
        self._back = tensor(np.kron(self._blur.across.T, np.eye(3)))
        self.widest = BLUR_MOST_DEGREES[2] if kind == "keep" else self._best_width(radiance, sky, total)
        self._blur.widen(self.widest)
        self._before = self.averaged(tensor(sky))
        self._behind = None

        # ---- Ground that follows its irradiance
        self.light: GroundLight | None = None
        if kind == "keep" and above is not None:
            light = GroundLight(above, radiance)
            self.light = light if light.plausible else None
        self.own_ground = np.zeros(low) if self.light is None else 1 - near
        self._lit = tensor(self.lit[:, None])
        self._own_ground = tensor(self.own_ground[:, None])
        self._around = tensor(np.tile(np.eye(3), width))

    @property
    def said(self) -> str:
        """What the rows do, in words."""
        if self.kind == "mirror":
            return "follow the sky as its mirror"
        if self.light is None:
            return "are ground and keep their brightness: no albedo explains it by the light from above"
        return f"are ground and follow the light that falls on it (albedo {self.light.albedo:.2g})"

    @property
    def lit(self) -> np.ndarray:
        """How far each row follows the light that falls on it, (rows,)."""
        return np.zeros_like(self.fade) if self.light is None else 1 - self.fade

    def _varying(self, image):
        """Return how the log luminance of each row of (rows, W, 3) varies around the horizon, (rows, W)."""
        logs = np.log(image.astype(np.float64) @ LUMINANCE + self._faint)
        return logs - logs.mean(axis=1, keepdims=True)

    def _continued(self, radiance, sky, fade):
        """Return the share, 0 to 1, with which the mirrored sky's pattern, faded, explains the ground's.

        By least squares. Walls go on below the horizon; open ground has nothing of the glow above it.
        """
        original = self._varying(radiance)
        mirrored = self._varying(sky[: len(radiance)][::-1]) * fade[:, None]
        square = np.square(mirrored).sum()
        return np.clip((mirrored * original).sum() / square, 0, 1) if square > 0 else 0.0

    def _best_width(self, radiance, sky, total):
        """Choose the widest K by how well K S_0 explains the variation of each row around the horizon."""
        blur = _Blur(sky.shape[:2], total, CHOICE_COLUMNS)
        omega = latlong.solid_angles(total, sky.shape[1])[sky.shape[0] :]
        original = self._varying(radiance)
        errors = []
        for widest in BLUR_MOST_DEGREES:
            blur.widen(widest)
            soft = blur(tensor(sky)).numpy().reshape(*blur.grid, 3)
            soft = np.einsum("ri,ijx,cj->rcx", blur.down[self.mirrored], soft, blur.across, optimize=True)
            errors.append(omega @ np.square(self._varying(soft) - original).mean(axis=1))
        return BLUR_MOST_DEGREES[int(np.argmin(errors))]

    def reveal(self, log_change: np.ndarray, gone: np.ndarray, near: np.ndarray) -> None:
        """Set what else changes where a texel's light was all a glow's and is gone.

        The change grows from nothing at the horizon, which follows the sky's own, to all of it at
        :data:`BLEND_DEGREES`. The mirror image of a core goes with its glow, all of it and at any elevation.

        ``log_change`` (rows, W, 3) is of :meth:`.BehindGlow.log_change`, beside what follows from the sky;
        ``gone`` and ``near`` (rows, W, 1) are the share of the light that is gone where every glow is, and
        :func:`.near_core`.
        """
        share = 1 - near + near / np.maximum(gone, LEAST_GONE)
        visible = 1 - (1 - self._blend[:, None, None]) * (1 - near)
        self._behind = tensor(log_change * share * visible)

    def averaged(self, sky: mi.TensorXf) -> Averaged:
        """Return what :meth:`log_factor` compares of a sky (sky_rows, W, 3) without cores."""
        sky = _veiled(sky)
        return Averaged(sky, self._blur(sky))

    def log_lit(
        self, sky: mi.TensorXf, core: mi.TensorXf, ground: mi.TensorXf | None = None
    ) -> mi.TensorXf | float:
        """Return the log factor (rows, 3 W) of ground that the light from above falls on; 0 of other rows.

        ``sky`` is as for :meth:`log_factor`, ``core`` the cores' radiance in the whole map. ``ground`` (1, 3)
        is the logarithm of a factor beyond that, for light that does not come from above.
        """
        if self.light is None:
            return 0.0
        change = dr.matmul(self._lit, dr.matmul(self.light.log_change(sky, core), self._around))
        if ground is None:
            return change
        return change + dr.matmul(self._own_ground, dr.matmul(ground, self._around))

    def log_factor(
        self,
        sky: mi.TensorXf | Averaged,
        gone: mi.Float | None = None,
        log_ground: mi.TensorXf | float = 0.0,
        before: mi.TensorXf | Averaged | None = None,
    ) -> mi.TensorXf:
        """Return the log factor (rows, W, 3) of the rows under a sky (sky_rows, W, 3) without cores.

        ``before`` is the sky that it is compared with, the original by default, ``log_ground`` what else is
        to be added (:meth:`log_lit`). With what is to be revealed, ``gone`` (sky_rows * W) is the share of a
        texel's light above the horizon that was a glow's and is gone.
        """
        before = self._before if before is None else before
        old, new = (image if isinstance(image, Averaged) else self.averaged(image) for image in (before, sky))
        soft = dr.log((new.soft + self._faint) / (old.soft + self._faint))
        soft = dr.matmul(dr.matmul(self._up, soft), self._back)
        sharp = dr.log((new.sky.array + self._faint) / (old.sky.array + self._faint))
        sharp = mi.TensorXf(dr.gather(mi.Float, sharp, self._mirrored), soft.shape)
        factor = settled(
            dr.reshape(sharp * self._sharp + soft * self._soft + log_ground, (*self.shape, 3)), 0
        )
        if self._behind is None or gone is None:
            return factor
        gone = dr.gather(mi.Float, gone, self._mirrored // 3)
        return factor + mi.TensorXf(gone, factor.shape) * self._behind


class _Blur:
    """K of a sky (rows, W), in a map of ``total`` rows, on a grid of at most so many ``columns``."""

    def __init__(self, shape, total, columns):
        up, width = shape
        columns = min(columns, width)
        rows = max(1, columns // 4)
        self.grid = rows, columns

        # ---- From the sky to the grid: means by solid angle
        self.down = _tents(2 * np.arange(up) / max(total - 1, 1) * rows - 0.5, rows)
        self.across = _tents((np.arange(width) + 0.5) / width * columns - 0.5, columns, periodic=True)
        weight = self.down * latlong.solid_angles(total, width)[:up, None]
        share = weight.sum(axis=0)[:, None] * self.across.sum(axis=0)
        self._down = tensor(weight.T)
        self._across = tensor(np.kron(self.across, np.eye(3)))
        self._share = tensor(1 / np.maximum(np.repeat(share, 3, axis=1), 1e-30))

        # ---- Every row of the grid, shifted by every number of columns
        column = (np.arange(columns)[:, None] + np.arange(columns)) % columns  # distance, column
        node = np.arange(rows)[:, None, None, None] * columns + column[..., None]
        self._shifted = dr.opaque(mi.UInt32((3 * node + np.arange(3)).ravel().astype(np.uint32)))

    def widen(self, widest: float) -> None:
        """Make K for a greatest standard deviation, degrees; each of its rows sums to 1."""
        rows, columns = self.grid
        theta = (np.arange(rows) + 0.5) / rows * np.pi / 2
        # The same around the horizon: angles between nodes of two rows, by how many columns they are apart.
        d = latlong.on_sphere(theta[:, None], 2 * np.pi * np.arange(columns) / columns)
        angle = np.degrees(np.arccos(np.clip(np.einsum("ik,jck->ijc", d[:, 0], d), -1, 1)))
        width = np.minimum(BLUR_DEGREES + BLUR_WIDENING * (90 - np.degrees(theta)), widest)
        kernel = np.exp(-0.5 * (angle / width[:, None, None]) ** 2) * np.sin(theta)[:, None]
        kernel = (kernel / kernel.sum(axis=(1, 2), keepdims=True)).astype(np.float32)
        self._kernel, self._adjoint = (
            tensor(matrix.reshape(rows, rows * columns)) for matrix in (kernel, kernel.transpose(1, 0, 2))
        )

    def __call__(self, sky: mi.TensorXf) -> mi.TensorXf:
        """Average a sky over K, at the nodes of the grid: (rows, 3 columns)."""
        flat = dr.reshape(sky, (sky.shape[0], 3 * sky.shape[1]))
        coarse = dr.matmul(dr.matmul(self._down, flat), self._across) * self._share
        return dr.custom(_Around, coarse, self._kernel, self._adjoint, self._shifted)


class _Around(dr.CustomOp):
    """K on its grid, a matrix of rows and of distances along them; it is even in these.

    Every row is laid out once for each distance, and one product sums over rows and distances in a fixed
    order.
    """

    def eval(self, coarse, kernel, adjoint, shifted):
        self._adjoint = adjoint
        self._shifted = shifted
        return self._product(coarse, kernel)

    def _product(self, coarse, kernel):
        laid_out = dr.gather(mi.Float, coarse.array, self._shifted)
        return dr.matmul(kernel, mi.TensorXf(laid_out, (kernel.shape[1], coarse.shape[1])))

    def backward(self):
        self.set_grad_in("coarse", self._product(self.grad_out(), self._adjoint))

    def name(self):
        return "average over K"


def _veiled(sky):
    """Mix some of its luminance into every channel of a sky (rows, W, 3).

    By a matrix: ``dr.unravel`` of an array that is used afterwards too loses
    the derivative of that use (drjit 1.5.0).
    """
    mixed = dr.matmul(dr.reshape(sky, (-1, 3)), tensor(with_luminance(VEIL)))
    return dr.reshape(mixed, sky.shape)


def _tents(place, count, periodic=False):
    """Return linear weights (n, count) of a grid's nodes at places in units of their distance."""
    if periodic:
        apart = np.abs(place[:, None] - np.arange(count)) % count
        return np.maximum(1 - np.minimum(apart, count - apart), 0)
    return np.maximum(1 - np.abs(np.clip(place, 0, count - 1)[:, None] - np.arange(count)), 0)
