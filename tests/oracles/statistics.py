"""Statistics that judge renderings.

Two renderers agree if the differences of independent pictures, seed by seed, have mean zero. The t of
Student needs normal noise, which a pixel that a firefly visits does not have, but blocks of pixels and the
whole picture have.
"""

from statistics import NormalDist

import numpy as np

LEVEL = 1e-4  # chance of a false alarm in one comparison; some hundred are made in all


def student(t, freedom: int):
    """Return the two-sided tail probability of Student's t; with t = sqrt(f) tan(a), a ~ cos(a)^(f - 1)."""
    angle = np.linspace(0, np.pi / 2, 20001)
    density = np.cos(angle) ** (freedom - 1)
    tail = np.cumsum((density + np.append(density[1:], 0))[::-1])[::-1]
    where = np.arctan(np.abs(t) / np.sqrt(freedom))
    return np.exp(np.interp(where, angle, np.log(np.maximum(tail / tail[0], 1e-300))))


def normal_square(p):
    """Return z^2 of a normal deviate with two-sided tail probability p."""
    return np.vectorize(NormalDist().inv_cdf)(np.clip(p, 1e-300, 1) / 2) ** 2


def blocks(pictures, size):
    """Average (K, h, w, 3) over blocks of size x size pixels; 0: over the picture."""
    if size == 0:
        return pictures.mean(axis=(1, 2), keepdims=True)
    k, h, w, c = pictures.shape
    high, wide = min(size, h), min(size, w)
    h, w = h // high, w // wide
    return pictures[:, : h * high, : w * wide].reshape(k, h, high, w, wide, c).mean(axis=(2, 4))


def disagreement(ours, theirs, sizes=(1, 4, 0)) -> str:
    """Compare independent pictures (K, h, w, 3) of two renderers; return what is wrong, or nothing.

    For each block size (0: the whole picture): the largest |t| against the Bonferroni bound at ``LEVEL``. For
    pixels also the mean of z^2, which is 1 if they agree: with some 500 pixels, whose three channels move
    together, it has a standard deviation of sqrt(2/500) = 0.06; 1.4 leaves six of them.
    """
    ours, theirs = np.asarray(ours, np.float64), np.asarray(theirs, np.float64)
    assert ours.shape == theirs.shape and ours.ndim == 4
    assert np.isfinite(ours).all() and np.isfinite(theirs).all()
    wrong = []
    for size in sizes:
        a, b = blocks(ours, size), blocks(theirs, size)
        count = len(a)
        # Pixels without noise differ by rounding: sums of hundreds of float32 terms are good to 1e-5.
        rounding = 1e-5 * np.abs(b).mean(axis=0) + 1e-9
        error = np.sqrt((a - b).var(axis=0, ddof=1) / count + rounding**2)
        p = student((a - b).mean(axis=0) / error, count - 1)
        place = np.unravel_index(np.argmin(p), p.shape)
        if p.min() * p.size < LEVEL:
            values = f"{a.mean(axis=0)[place]:.6g} +- {error[place]:.2g} for {b.mean(axis=0)[place]:.6g}"
            wrong.append(f"blocks of {size}: p = {p.min():.2g} at {tuple(map(int, place))}, {values}")
        if size == 1:
            noisy = error > 3 * rounding
            z2 = normal_square(p[noisy]).mean() if noisy.sum() >= 300 else 1.0
            if z2 > 1.4:
                wrong.append(f"pixels: mean z^2 is {z2:.2f}, not 1")
    return "; ".join(wrong)
