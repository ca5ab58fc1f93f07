"""Numbers that judge an image: PSNR, SSIM and MSE on a stated tonemap, and what they do not see.

Images are numpy arrays ``(H, W, 3)`` of linear radiance unless said otherwise; sums run in double precision.
Every function raises InputError for images that are not finite, and returns a finite number or None.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from envedit.core.color import luminance
from envedit.core.color import tonemap as apply_tonemap
from envedit.core.errors import InputError, texels_are
from envedit.core.types import ArrayLike, Views

if TYPE_CHECKING:
    from envedit.losses.perceptual import distances

PSNR_CAP = 200.0
"""PSNR of identical images, and the most that is ever reported, in dB: JSON has no infinity."""

SATURATED = 0.5
"""Share of the samples that differ, of which a display shows nothing, above which PSNR is no score: with a
half it is 3 dB too high, with 0.9 in the median 14 dB (``docs/decisions/defaults.md``)."""
OFF_DECIBELS, OFF_STOPS = 30.0, 0.5
"""PSNR and `log_rmse` beyond which renderings differ by more than noise: caustics leave 30 dB and more."""
DISPLAY_STEP = 1 / 255
"""Step of the display values of a picture of 8 bits; what is within a half of black or white is shown so."""
RELATIVE_EPS = 0.01
"""Share of the median radiance that is added before the logarithm of `log_rmse`."""

LOG_EPS = 0.01
"""Radiance added before a logarithm, so that black has one; small beside any daylight sky."""


def checked(image: ArrayLike, name: str) -> np.ndarray:
    """Return an image (H, W, 3) in float64; InputError, which names it, if it is not finite."""
    image = np.asarray(image, np.float64)
    bad = ~np.isfinite(image).all(axis=2)
    if bad.any():
        raise InputError(f"{name}: {texels_are(bad, 'not finite')}; repair the image first.")
    return image


def _pair(a, b):
    return checked(a, "first image"), checked(b, "second image")


# ---- Two images: how far apart -----------------------------------------------------------------------------


def mse(a: np.ndarray, b: np.ndarray) -> float:
    """Compute the mean squared error over texels and channels."""
    a, b = _pair(a, b)
    return float(np.mean(np.square(a - b)))


def psnr(a: np.ndarray, b: np.ndarray, data_range: float = 1.0) -> float:
    """Compute the peak signal-to-noise ratio ``10 log10(data_range^2 / MSE)`` in dB, at most `PSNR_CAP`."""
    error = mse(a, b)
    if error == 0:
        return PSNR_CAP
    return min(PSNR_CAP, 20 * math.log10(data_range) - 10 * math.log10(error))


def ssim(a: np.ndarray, b: np.ndarray) -> float:
    """Compute the mean structural similarity of ``envedit.losses.ssim.Ssim``, in double precision."""
    import mitsuba as mi  # here: the variant, once selected, provides the tensor type

    from envedit.losses.ssim import Ssim

    a, b = _pair(a, b)
    return float((1 - Ssim(mi.TensorXd(b))(mi.TensorXd(a)))[0])


def compare(
    a: np.ndarray,
    b: np.ndarray,
    tonemap: str = "gamma",
    lpips: distances.Lpips | None = None,
    seen: np.ndarray | None = None,
    views: Views = (),
) -> dict:
    """Compare two images of linear radiance under a tonemap, ``clip(E, 0, 1)^(1/2.2)`` by default.

    ``lpips`` measures LPIPS of the display values. ``mse`` and ``psnr`` are taken over the pixels ``seen``,
    bool (H, W); all by default, or where none is. ``views`` are the rows of each view, where the images are
    of several: ``ssim`` and ``lpips`` are means over views, weighted by their pixels.

    Returns ``psnr`` (dB), ``ssim``, ``mse`` for a data range of 1; ``lpips``, None without one, or of images
    that are too small for it; ``log_rmse``; and ``beyond_display``, the share of the samples that differ of
    which a display shows nothing: both black, or both white.
    """
    radiance = _pair(a, b)
    a, b = (apply_tonemap(image, tonemap) for image in radiance)
    parts = [(len(a[rows]) / len(a), a[rows], b[rows]) for rows in views or (slice(None),)]
    alike = sum(share * ssim(x, y) for share, x, y in parts)
    apart = None
    if lpips is not None and min(min(x.shape[:2]) for _, x, _ in parts) >= lpips.backbone.least_size:
        apart = sum(share * lpips(x, y) for share, x, y in parts)
    here = np.ones(a.shape[:2], bool) if seen is None or not np.any(seen) else seen
    a, b, radiance_a, radiance_b = (image[here][None] for image in (a, b, *radiance))
    shown = {"psnr": psnr(a, b), "ssim": alike, "mse": mse(a, b), "lpips": apart}
    beyond = _beyond_display(a, b, radiance_a, radiance_b)
    return shown | {"log_rmse": log_rmse(radiance_a, radiance_b), "beyond_display": beyond}


def saturated(compared: Iterable[dict]) -> bool:
    """Say whether PSNR is no score in one of some results of `compare`, and `log_rmse` is one in all."""
    beyond = any((result.get("beyond_display") or 0) > SATURATED for result in compared)
    return beyond and all(result.get("log_rmse") is not None for result in compared)


def gained(result: dict, other: dict) -> float:
    """Return by which share the first of two results of `compare` with an image is nearer; below 0: farther.

    In RMS of display values, or `log_rmse` where PSNR is no score; 0 where both are the image.
    """
    after, before = (
        entry["log_rmse"] if saturated([result, other]) else 10 ** (-entry["psnr"] / 20)
        for entry in (result, other)
    )
    return 1 - after / before if before else float(-after)


def off(result: dict, among: Iterable[dict]) -> bool:
    """Say whether a result of `compare` among others is farther from its image than noise explains."""
    return result["log_rmse"] > OFF_STOPS if saturated([result, *among]) else result["psnr"] < OFF_DECIBELS


def score(result: dict, among: Iterable[dict], digits: int = 1) -> str:
    """Return the score of a result of `compare` among others: PSNR in dB, or `log_rmse` in stops."""
    if saturated([result, *among]):
        return f"{result['log_rmse']:.{max(digits, 2)}f} stops"
    return f"{result['psnr']:.{digits}f} dB"


def _beyond_display(shown_a, shown_b, a, b):
    differ = a != b
    if not differ.any():
        return 0.0
    low, high = np.minimum(shown_a, shown_b), np.maximum(shown_a, shown_b)
    half = DISPLAY_STEP / 2
    return float(((low >= 1 - half) | (high <= half))[differ].mean())


def log_rmse(a: np.ndarray, b: np.ndarray) -> float | None:
    """Compute the root mean square of ``log2((a + e) / (b + e))`` in stops, over texels and channels.

    e is `RELATIVE_EPS` of the median of the reference ``b`` where it is above 0: the same at every exposure,
    and blind only far below what is there. Negative radiance counts as 0. None if the reference is black and
    the images differ.
    """
    a, b = (np.maximum(image, 0) for image in _pair(a, b))
    if np.array_equal(a, b):
        return 0.0
    if not (b > 0).any():
        return None
    offset = RELATIVE_EPS * np.median(b[b > 0])
    return float(np.sqrt(np.mean(np.square(np.log2(a + offset) - np.log2(b + offset)))))


def painted(
    edited: np.ndarray,
    target: np.ndarray,
    initial: np.ndarray,
    coverage: np.ndarray,
    tonemap: str = "gamma",
    seen: np.ndarray | None = None,
    noise: np.ndarray | None = None,
) -> dict:
    """Measure how far a painted picture was followed, and how still the rest was held.

    The result's rendering, the painted picture and what it was painted on (h, w, 3) are linear radiance;
    ``coverage`` c (h, w, 1) is how much each pixel was painted, in [0, 1], and ``seen`` (h, w) which pixels
    count. ``noise`` (h, w) is the standard error of the display values of both renderings under "gamma".

    Returns, of display values, ``towards``: 1 - sum c |edited - target| / sum c |initial - target|, None
    where that was to change by less than the noise, of which the mean of |x - y| is 2 / sqrt(pi); and
    ``elsewhere``: mean of |edited - initial| weighted by 1 - c, None where all was painted.
    """
    edited, target = _pair(edited, target)
    _, initial = _pair(edited, initial)
    d, t, before = (apply_tonemap(image, tonemap) for image in (edited, target, initial))
    counts = 1.0 if seen is None else np.asarray(seen, np.float64)[..., None]
    cover = counts * np.broadcast_to(coverage, d.shape).astype(np.float64)
    left = np.broadcast_to(counts - cover, d.shape)
    requested = float((cover * np.abs(before - t)).sum())
    rest = float(left.sum())
    measured = requested > 0
    if noise is not None:
        change = np.abs(apply_tonemap(initial, "gamma") - apply_tonemap(target, "gamma"))
        by_noise = 2 / np.sqrt(np.pi) * float((cover * noise[..., None]).sum())
        measured &= float((cover * change).sum()) > by_noise
    return {
        "towards": 1 - float((cover * np.abs(d - t)).sum()) / requested if measured else None,
        "elsewhere": float((left * np.abs(d - before)).sum()) / rest if rest > 0 else None,
    }


def painted_verdict(measured: dict) -> str:
    """Say how far a painted picture was followed: ``towards``, ``reachable``, ``elsewhere`` of a run."""
    if measured["towards"] is None:
        return "the painted change is below the noise of the renderings"
    line = f"{round(100 * measured['towards'])} % of the painted change reached"
    if measured["reachable"] is not None:
        line += f" ({100 * measured['reachable']:.0f} % feasible)"
    if measured["elsewhere"] is not None:
        line += f", mean change elsewhere {measured['elsewhere']:.3f}"
    return line


def _log(values):
    return np.log(np.maximum(values, 0) + LOG_EPS)


def log_psnr(a: np.ndarray, b: np.ndarray) -> float | None:
    """Compute the PSNR of log radiance, normalised as in Eq. 1 by the range of the reference ``b``.

    The logarithm is that of ``max(E, 0) + LOG_EPS``. None if the reference is constant and the images differ.
    """
    a, b = (_log(image) for image in _pair(a, b))
    span = float(np.ptp(b))
    if span == 0:
        return PSNR_CAP if np.array_equal(a, b) else None
    return psnr(a, b, data_range=span)


# ---- Lights, and texture -----------------------------------------------------------------------------------


def peak_position(image: np.ndarray) -> tuple[int, int]:
    """Find the row and column of the greatest luminance, the first of several."""
    values = luminance(checked(image, "image"))
    row, column = np.unravel_index(int(np.argmax(values)), values.shape)
    return int(row), int(column)


def sun_offset(a: np.ndarray, b: np.ndarray) -> float:
    """Measure the distance between the brightest texels of two lat-long maps, in texels, columns periodic."""
    a, b = _pair(a, b)
    (row_a, column_a), (row_b, column_b) = peak_position(a), peak_position(b)
    across = abs(column_a - column_b)
    return math.hypot(row_a - row_b, min(across, a.shape[1] - across))


def _ratio(a, b):
    # A quotient that overflows, or has no denominator, says nothing: null in the file.
    ratio = float(a) / float(b) if b else math.inf
    return ratio if math.isfinite(ratio) else None


def peak_ratio(a: np.ndarray, b: np.ndarray) -> float | None:
    """Divide the greatest luminance of ``a`` by that of the reference ``b``; None where that is 0."""
    a, b = _pair(a, b)
    return _ratio(luminance(a).max(), luminance(b).max())


def mean_luminance_ratio(a: np.ndarray, b: np.ndarray) -> float | None:
    """Divide the mean luminance of ``a`` by that of the reference ``b``; None where that is 0.

    Texels count alike, not by their solid angle, as in Eq. 7.
    """
    a, b = _pair(a, b)
    return _ratio(luminance(a).mean(), luminance(b).mean())


def high_frequency_energy(image: np.ndarray) -> float:
    """Compute the mean squared high-pass response of a lat-long map: speckle that PSNR does not see.

    The high pass is ``log(max(L, 0) + LOG_EPS)`` of the luminance L minus its 5 x 5 binomial blur
    (1, 4, 6, 4, 1) / 16 on either axis; columns are periodic, the outermost rows repeat. Independent noise of
    variance s^2 gives 0.794 s^2, a smooth gradient about 0.
    """
    values = _log(luminance(checked(image, "image")))
    height, width = values.shape
    padded = np.pad(values, ((2, 2), (0, 0)), mode="edge")
    blurred = sum(tap * padded[k : k + height] for k, tap in enumerate(_BINOMIAL))
    padded = np.pad(blurred, ((0, 0), (2, 2)), mode="wrap")
    blurred = sum(tap * padded[:, k : k + width] for k, tap in enumerate(_BINOMIAL))
    return float(np.mean(np.square(values - blurred)))


_BINOMIAL = (1 / 16, 4 / 16, 6 / 16, 4 / 16, 1 / 16)
