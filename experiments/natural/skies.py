"""How much photographed skies differ: the measure of painted targets' prior and of ``natural.patches``.

Of every pair of maps, with the suns at one azimuth: the field of differences of log radiance in cells of the
upper half, along luminance, blue-amber and green-magenta. Its covariance by angle is fitted by that of
``envedit.solve.prior.SkyDifference``. Four maps take no part (:data:`KEPT`): they are for judging.
"""

import itertools

import numpy as np

from envedit.images import images
from envedit.losses import naturalness
from envedit.solve.prior import AXES, DEGREES
from experiments import puresky
from experiments.harness import Experiment, calling

WIDTH = 256
KEPT = ("aristea_wreck", "evening_road_01", "rustig_koppie", "syferfontein_18d_clear")
EXPONENTS = np.arange(0.6, 3.01, 0.1)
BINS = np.radians([0, 5, 15, 30, 45, 60, 75, 90, 105, 120, 135, 150, 165])


def fields(files: list[str]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return log radiance (maps, cells, 3) along the axes, and the cells' directions and solid angles."""
    logs_of_maps = []
    for file in files:
        envmap, _ = images.load_envmap(file, WIDTH)
        half = envmap[: len(envmap) // 2]
        sun = np.unravel_index(half.mean(axis=2).argmax(), half.shape[:2])[1]
        turned = np.roll(envmap, WIDTH // 2 - sun, axis=1)
        channels = [naturalness.cells(np.repeat(turned[..., c : c + 1], 3, axis=2)) for c in range(3)]
        logs_of_maps.append(np.stack([logs for logs, _, _ in channels], axis=1) @ AXES.T)
        _, directions, omega = channels[0]
    return np.array(logs_of_maps), directions, omega / omega.sum()


def fitted(angle: np.ndarray, covariance: np.ndarray) -> dict:
    """Fit whole^2 + sum (2 l + 1) (gradient l^-falloff)^2 P_l to a covariance by angle."""
    best: dict = {"error": np.inf}
    degree = np.arange(1, DEGREES + 1)
    for exponent in EXPONENTS:
        series = np.append(0, (2 * degree + 1) * degree ** (-2 * exponent))
        shape = np.polynomial.legendre.legval(np.cos(angle), series)
        design = np.stack([np.ones_like(shape), shape], axis=1)
        squares, *_ = np.linalg.lstsq(design, covariance, rcond=None)
        error = float(np.square(design @ squares - covariance).sum())
        if error < best["error"]:
            whole, gradient = np.sqrt(np.maximum(squares, 0))
            best = {"error": error, "whole": whole, "gradient": gradient, "falloff": float(exponent)}
    return best


def differences(settings, folder, files: list[str]) -> list[dict]:
    """Measure all pairs; returns rows for the axes, each with the patches between skies."""
    logs, directions, omega = fields(files)
    angle = np.arccos(np.clip(directions @ directions.T, -1, 1))
    which = np.digitize(angle, BINS) - 1
    weight = np.outer(omega, omega)
    pairs = list(itertools.combinations(range(len(files)), 2))
    rows = []
    for axis, name in enumerate(("luminance", "blue-amber", "green-magenta")):
        off = np.array([logs[a, :, axis] - logs[b, :, axis] for a, b in pairs])
        products = np.einsum("ka,kb->ab", off, off) / len(pairs) * weight
        at = [k for k in range(len(BINS)) if (which == k).any()]
        mean = [(angle * weight)[which == k].sum() / weight[which == k].sum() for k in at]
        covariance = np.array([products[which == k].sum() / weight[which == k].sum() for k in at])
        rows.append({"axis": name, **fitted(np.array(mean), covariance)})
    between = []
    for a, b in pairs:
        first, second = (images.load_envmap(files[k], WIDTH)[0] for k in (a, b))
        between.append(naturalness.patches(first, second))
    patches = float(np.sqrt(np.mean(np.square(between))))
    return [row | {"patches": patches} for row in rows]


def cases(args):
    files = [str(file) for name, file in sorted(puresky.find().items()) if name not in KEPT]
    return [calling("skies", differences, {}, files=files)]


EXPERIMENT = Experiment(
    cases,
    columns={
        "axis of log radiance": "{axis}",
        "factor of the whole sky": "{whole:.3f}",
        "gradients (degree 1)": "{gradient:.3f}",
        "falloff by degree": "{falloff:.1f}",
        "RMS of patches between two skies": "{patches:.2f}",
    },
)
