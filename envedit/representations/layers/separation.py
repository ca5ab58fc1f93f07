"""Separation of a map into lights and background: which texels are lights, and what they do to the sky.

A map is separated as E = B * prod(1 + G_l) + sum(C_l). The **core** C_l of a light is the radiance that
stands out: a sun's disc, a lamp, a softbox. Its **glow** G_l is what the light does to the sky around it, as
a factor, beside sky of the same elevation elsewhere, that falls with the angle to the light: when the sun
moves, the clouds stay and their lighting changes. What is left is the background B, the map as it would be
without its lights. A light covers the sky: where a channel of its texels has less than the sky around it, as
the blue of a red sun, the map is darker than the formula by what is **hidden**, as far as the texel's light
is the core's.

All steps are in angles and shares of the light, not in texels or radiance: they mean the same for a map of
any resolution and exposure.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from envedit.core import latlong, resampling
from envedit.core.color import LUMINANCE

CONTRAST = 4.0
"""A light is this many times as bright as the median of its surroundings. Not measured."""
SURROUNDINGS = 20.0
"""Radius of the surroundings, degrees: more than that of a sun's aureole or a softbox. Not measured."""
LEAST_SHARE = 0.005
"""Share of the map's luminance, integrated over solid angle, below which something bright is no light. Not
measured beside other values."""
AS_BRIGHT = 0.8
"""Luminance over a part's mean from which a texel beside the part counts as bright as it. Not measured."""
MOST_AS_BRIGHT = 0.1
"""Most of the texels around a part that are as bright as it: with more it is no light but cut off from a
larger area, as the edge of a window that is larger than the surroundings. Not measured."""
MOST_LIGHTS = 8
"""Most lights that are separated, those with most flux. Not measured."""
MOVABLE = 4
"""Most lights that an edit may move: each costs time; weaker ones are part of the background and its gain.
Not measured."""
DETECT_WIDTH = 512
"""Most columns of the copy in which lights are looked for: what is smaller has no flux. Not measured."""
RING_SHARE = (0.1, 0.5)
"""Quantiles of luminance in a ring around a light that give its glow: clouds and the horizon are brighter.
Not measured beside other values."""
GLOW_MOST_DEGREES = 90.0
"""Largest radius of a glow. Not measured."""
GLOW_SMOOTHING = 1 / 12
"""Standard deviation by which a glow is smoothed, over the angle: 5 degrees, a ring, at 60. Derived from
``_RINGS``: kinks between rings are visible as arcs."""
GLOW_END = 1.05
"""A glow ends where its ring is at most this many times as bright as the darkest ring farther out. Not
measured."""
LEAST_EXPLAINED = 0.2
"""A glow is used only if it explains this share of the variance of log luminance. Not measured."""
GLOW_DEGREES = np.arange(0.0, 121.0)
"""Angles at which a glow is tabulated; 0 from the last on."""
_RINGS = np.concatenate(
    [[0, 1, 1.5], np.arange(2.0, 10), np.arange(10.0, 20, 2), np.arange(20.0, 121, 5)]
)  # edges, degrees
"""Edges of the rings in which a glow is measured, degrees: finer near the light. Not measured."""
SILHOUETTE = 0.5
"""Share of the mean luminance at an elevation below which a texel is rather no sky. Measured: with 1 gaps
between clouds count as roofs (``docs/decisions/sky_where_the_sun_was.md``)."""
SILHOUETTE_STEPS = 6
"""How often the mean of the sky at an elevation is taken again without silhouettes. Measured: with 12 steps
moved lights are as near to the truth."""
LEAST_SKY = 1e-9
"""Least weight of a texel among those of its elevation, where all others are silhouettes. Derived: of float64
mean and weight keep seven digits."""
COARSE_COLUMNS = 64
"""Columns of the grid on which medians of surroundings and means under a glow are taken. Not measured."""
RELAXATIONS = 30
"""Steps of relaxation of a membrane at every level of its pyramid. Not measured."""


@dataclass(frozen=True)
class Light:
    """One light of a map."""

    direction: np.ndarray  # (3,), unit vector to the centre of its flux, in the emitter's frame
    texels: np.ndarray  # (n,), its texels, row * W + column
    # radiance, hidden: (n, 3), radiance of the core in them, and of the sky that it hides
    radiance: np.ndarray
    hidden: np.ndarray
    # (len(GLOW_DEGREES), 3), factor by which it brightens the sky, less 1, at these angles from its centre
    glow: np.ndarray | None


@dataclass(frozen=True)
class Separation:
    """A separated map: ``background * glow + core``, less what lights hide, is the map to float precision."""

    # background, glow, core: (rows, W, 3): B, the product of 1 + G over all lights, and the sum of all cores
    background: np.ndarray
    glow: np.ndarray
    core: np.ndarray
    lights: list[Light] = field(default_factory=list)  # those with most flux first
    # Where the lights were found, to find the same lights in another resolution of the map; None without
    survey: Survey | None = None


@dataclass(frozen=True)
class Survey:
    """What the small copy of a map gives of its lights: all that does not depend on the map's resolution."""

    # (h, w), index in :attr:`Separation.lights` of the light that a texel of the copy belongs to, or -1
    label: np.ndarray
    below: np.ndarray  # (h, w, 3), the background of the copy, filled in under the lights
    rows: tuple[int, int]  # first row of the copy in its map, and the rows of that map
    # centres, glows: direction and :attr:`Light.glow` of each light
    centres: list[np.ndarray]
    glows: list[np.ndarray | None]


def survey_of(
    image: np.ndarray, rows: tuple[int, int] | None = None, most: int = MOST_LIGHTS
) -> Survey | None:
    """Find lights, the background under them and the glow of each on the small copy of a map.

    Parameters are as of :func:`separate`; None without lights.
    """
    small = _reduced(image, *(rows or (0, len(image))))
    label, count = _find(small, most)
    if not count:
        return None
    cores = label >= 0
    free = filled(small.image, cores)
    glows, centres = [], []
    for i in range(count):
        centre = small.centre(label == i)
        table = _glow(free, small, cores, centre)
        if table is not None:
            free = free / (1 + glow_at(table, small.directions @ centre))
        glows.append(table)
        centres.append(centre)
    return Survey(label, filled(free, cores), small.rows, centres, glows)


def separate(
    image: np.ndarray,
    rows: tuple[int, int] | None = None,
    most: int = MOST_LIGHTS,
    survey: Survey | None = None,
) -> Separation:
    """Separate the lights of a map from its background.

    ``image`` (rows, W, 3) is linear radiance, finite and not negative; ``rows`` are its first row in its map,
    and the rows of that map, by default of a whole map. Of the lights those ``most`` with most flux are
    separated; weaker ones stay in the background. ``survey`` is of a larger part of the map, of which the
    image is a band; None: of the image.

    Where nothing stands out there are no lights: the background is the image then, bit for bit.
    """
    image = np.asarray(image, np.float64)
    first, total = rows or (0, image.shape[0])
    height, width = image.shape[:2]
    if survey is None:
        survey = survey_of(image, rows, most)
    if survey is None:
        return Separation(image, np.ones_like(image), np.zeros_like(image), [])

    # ---- Glow, cores and background at the map's own resolution
    row, column = _places(survey, (height, width), (first, total))
    glow = glow_of(survey, latlong.directions(total, width, slice(first, first + height)))
    label = _nearest(survey.label, row, column)
    inside = (label >= 0)[..., None]
    below = survey.below
    if below.shape[:2] != (height, width):
        below = resampling.bilinear(below, row[:, None], column, around=True)
    above_sky = np.where(inside, image - below * glow, 0)
    core = np.maximum(above_sky, 0)
    of_core = core @ LUMINANCE / np.maximum(image @ LUMINANCE, 1e-300)
    hidden = of_core[..., None] * np.maximum(-above_sky, 0)
    background = (image - core + hidden) / glow

    # ---- Lights; those that leave nothing at this resolution are dropped
    shining = (core > 0).any(axis=2)
    texels = [np.flatnonzero((label == i) & shining) for i in range(len(survey.centres))]
    kept = [i for i, some in enumerate(texels) if len(some)]
    number = np.full(len(survey.centres) + 1, -1)  # the last for texels of no light
    number[kept] = np.arange(len(kept))
    centres = [survey.centres[i] for i in kept]
    glows = [survey.glows[i] for i in kept]
    lights = [
        Light(
            direction=survey.centres[i],
            texels=texels[i],
            radiance=core.reshape(-1, 3)[texels[i]],
            hidden=hidden.reshape(-1, 3)[texels[i]],
            glow=survey.glows[i],
        )
        for i in kept
    ]
    survey = replace(survey, label=number[survey.label], centres=centres, glows=glows)
    return Separation(background, glow, core, lights, survey)


def glow_of(survey: Survey, directions: np.ndarray) -> np.ndarray:
    """Return the product of 1 + G over all lights (..., 3) at directions (..., 3)."""
    glow = np.ones_like(directions)
    for table, centre in zip(survey.glows, survey.centres, strict=True):
        if table is not None:
            glow *= 1 + glow_at(table, directions @ centre)
    return glow


# ---- Finding -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Small:
    """The copy of an image in which lights are looked for; ``rows``: its first row, and those of its map."""

    image: np.ndarray
    directions: np.ndarray
    omega: np.ndarray
    rows: tuple[int, int]

    def centre(self, mask):
        """Direction of the flux of the brighter part of a light."""
        lum = np.where(mask, self.image @ LUMINANCE, 0)
        flux = np.where(lum > 0.1 * lum.max(), lum * self.omega, 0)
        centre = (self.directions * flux[..., None]).sum(axis=(0, 1))
        size = np.linalg.norm(centre)
        return centre / size if size else centre


def _places(survey, shape, rows):
    """Return at which fractional rows and columns of the small copy the texels of an image lie.

    ``shape`` is that of the image, ``rows`` its first row and those of its map.
    """
    height, width = shape
    start, small_total = survey.rows
    scale = (small_total - 1) / max(rows[1] - 1, 1)
    row = (np.arange(height) + rows[0]) * scale - start
    return row, (np.arange(width) + 0.5) * (survey.label.shape[1] / width) - 0.5


def _nearest(values, row, column):
    """Return the values of the small copy that are nearest to fractional rows and columns."""
    r = np.clip(np.rint(row).astype(np.int64), 0, values.shape[0] - 1)
    return values[r][:, np.rint(column).astype(np.int64) % values.shape[1]]


def _reduced(image, first, total):
    """Copy an image at no more than the width of detection."""
    height, width = image.shape[:2]
    h, w, start, stop = total, width, first, first + height
    small = np.asarray(image, np.float64)
    if width > DETECT_WIDTH:
        h, w = max(round(total * DETECT_WIDTH / width), 3), DETECT_WIDTH
        start = min(round(first * h / total), h - 1)
        stop = max(round((first + height) * h / total), start + 1)
        sums, known = _resized(image, first, total, (h, w))
        small = sums[start:stop] / np.maximum(known[start:stop], 1e-6)
    toward = latlong.directions(h, w, slice(start, stop))
    omega = np.repeat(latlong.solid_angles(h, w)[start:stop, None], w, axis=1)
    return _Small(small, toward, omega, (start, h))


def _resized(image, first, total, shape):
    """Resize a map of which some rows are known, 0 elsewhere: (h, w, n), and the known share (h, w, 1)."""
    height, width, channels = image.shape
    whole = np.zeros((total, width, channels + 1), np.float32)
    whole[first : first + height, :, :-1] = image
    whole[first : first + height, :, -1] = 1
    small = latlong.resize(whole, *shape).astype(np.float64)
    return small[..., :-1], small[..., -1:]


def _find(small: _Small, most: int) -> tuple[np.ndarray, int]:
    """Label the texels of each light: (label or -1, count), the light with most flux first."""
    lum = small.image @ LUMINANCE
    total = (lum * small.omega).sum()
    label = np.full(lum.shape, -1)
    if not total > 0:
        return label, 0
    base = _local_median(lum, *small.rows)

    # ---- Connected parts that stand out, and their shares of the map's light
    parts = components(lum > np.maximum(CONTRAST * base, 1e-12 * lum.max()))
    excess = np.maximum(lum - base, 0) * small.omega
    numbers, inverse = np.unique(parts, return_inverse=True)
    share = np.bincount(inverse.ravel(), excess.ravel()) / total

    # ---- Those that are lights
    strongest = np.argsort(-share, kind="stable")
    lights = [i for i in strongest if numbers[i] >= 0 and share[i] >= LEAST_SHARE]
    lights = [i for i in lights if not _cut_off(parts == numbers[i], lum, small.omega)][:most]
    for i, part in enumerate(lights):
        # One texel more to every side: a lens and a resampling spread light.
        mask = _grown(parts == numbers[part])
        label = np.where(mask & (label < 0), i, label)
    return label, len(lights)


def _cut_off(part, lum, omega):
    """Say whether a part is the edge of a larger area as bright, which is its own surroundings: a window."""
    weight = lum[part] * omega[part]
    mean = (lum[part] * weight).sum() / max(weight.sum(), 1e-300)
    around = _grown(part) & ~part
    return bool((lum[around] > AS_BRIGHT * mean).sum() > MOST_AS_BRIGHT * around.sum())


def coarse(
    image: np.ndarray, first: int, total: int
) -> tuple[tuple[int, int], np.ndarray, np.ndarray, np.ndarray]:
    """Average an image (rows, W, n) over some degrees, of rows from ``first`` of a map of ``total`` rows.

    Returns rows and columns of the coarse map, which of its texels are known, (h * w,) bool, and of those
    the mean, (known, n), and the known part of the solid angle.
    """
    w = min(COARSE_COLUMNS, image.shape[1])
    h = max(w // 2, 3)
    sums, share = _resized(image, first, total, (h, w))
    known = share.ravel() > 1e-6
    sums, share = sums.reshape(h * w, -1)[known], share.ravel()[known]
    weight = np.repeat(latlong.solid_angles(h, w), w)[known] * share
    return (h, w), known, sums / share[:, None], weight


def _local_median(lum, first, total):
    """Median luminance, by solid angle, of the disc around every texel, found on a coarse grid."""
    height, width = lum.shape
    (h, w), known, value, weight = coarse(lum[..., None], first, total)
    value = value[:, 0]
    d = latlong.directions(h, w).reshape(-1, 3)
    order = np.argsort(value, kind="stable")
    value, weight, others = value[order], weight[order], d[known][order]
    median = np.zeros(len(d))
    for start in range(0, len(d), 256):
        inside = (d[start : start + 256] @ others.T > np.cos(np.radians(SURROUNDINGS))) * weight
        sums = np.cumsum(inside, axis=1)
        place = (sums < 0.5 * sums[:, -1:]).sum(axis=1)
        median[start : start + 256] = value[np.minimum(place, len(value) - 1)]
    grid = median.reshape(h, w, 1)
    return latlong.resize(grid, total, width)[first : first + height, :, 0].astype(np.float64)


def _neighbours(values, outside):
    """Yield an array shifted to each of the 8 neighbours, columns periodic."""
    padded = np.pad(values, ((1, 1), (0, 0)), constant_values=outside)
    for row in (0, 1, 2):
        band = padded[row : row + values.shape[0]]
        for column in (-1, 0, 1):
            if (row, column) != (1, 0):
                yield np.roll(band, column, axis=1)


def _grown(mask):
    """Add every neighbour of a mask."""
    return np.logical_or.reduce([mask, *_neighbours(mask, False)])


def grown(label: np.ndarray) -> np.ndarray:
    """Give texels of no light (-1) that touch one the largest label around them; columns are periodic."""
    most = np.maximum.reduce(list(_neighbours(label, -1)))
    return np.where(label < 0, most, label)


def components(mask: np.ndarray) -> np.ndarray:
    """Return a number for each connected part of a mask, -1 outside; columns are periodic."""
    far = mask.size
    label = np.where(mask, np.arange(far).reshape(mask.shape), far)
    while True:
        least = np.minimum.reduce([label, *_neighbours(label, far)])
        least = np.where(mask, least, far)
        if np.array_equal(least, label):
            return np.where(mask, label, -1)
        # A part takes the least number that any of its texels has met: few rounds for large ones.
        met = np.arange(far + 1)
        np.minimum.at(met, label.ravel(), least.ravel())
        label = np.where(mask, met[least], far)


# ---- Glow and background -----------------------------------------------------------------------------------


def _glow(image: np.ndarray, small: _Small, cores: np.ndarray, centre: np.ndarray) -> np.ndarray | None:
    """Measure the glow around a centre: a table as :attr:`Light.glow`; None where none is believed.

    It is what the sky around a light is brighter by than the sky of the same elevation elsewhere, which is
    found beside a first measure of it.
    """
    table = _of_rings(image, small, cores, centre)
    if table is None:
        return None
    glow = 1 + glow_at(table, small.directions @ centre)
    faint = max(1e-6 * float(image.mean()), 1e-30)
    logs = np.log(image / glow + faint)
    weight = sky_weight(logs, np.where(cores[..., None], 0, away_weight(glow)))
    level = np.exp(mean_at_elevation(logs, weight))
    relative = _of_rings(image / level, small, cores, centre)
    return table if relative is None else relative


def away_weight(glow: np.ndarray) -> np.ndarray:
    """Return how much each texel says of the sky away from lights, (rows, W, 1); ``glow`` is (rows, W, 3)."""
    return np.maximum(glow.mean(axis=2, keepdims=True) ** -2.0, 1e-30)


def sky_weight(logs: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return weights (rows, W, 1) of the sky at each elevation, for weights that do not know it.

    A texel of less than :data:`SILHOUETTE` of the mean of its row is rather a roof or a tree than sky: its
    weight is multiplied by the fourth power of its luminance over that. ``logs`` (rows, W, 3) are radiance's.
    """
    luminance = (logs @ LUMINANCE)[..., None]
    of_sky = weight
    for _ in range(SILHOUETTE_STEPS):
        limit = mean_at_elevation(luminance, of_sky) + np.log(SILHOUETTE)
        darker = np.minimum(luminance - limit, 0)
        of_sky = weight * np.maximum(np.exp(4 * darker), LEAST_SKY)
    return of_sky


def mean_at_elevation(values: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return the weighted mean of each row of values (rows, W, n), (rows, 1, n)."""
    total = np.maximum(weight.sum(axis=1, keepdims=True), 1e-30)
    return (weight * values).sum(axis=1, keepdims=True) / total


def _of_rings(image, small, cores, centre):
    """Measure a glow by rings around its centre."""
    # ---- The colour of the sky in rings around the centre
    angle = np.degrees(np.arccos(np.clip(small.directions @ centre, -1, 1)))
    lum = image @ LUMINANCE
    ring = np.digitize(angle, _RINGS) - 1
    middles, colours, sizes = [], [], []
    for i in range(len(_RINGS) - 1):
        inside = (ring == i) & ~cores
        if inside.sum() < 4:
            continue
        values = lum[inside]
        low, high = np.quantile(values, RING_SHARE)
        middles.append((_RINGS[i] + _RINGS[i + 1]) / 2)
        colours.append(image[inside][(values >= low) & (values <= high)].mean(axis=0))
        sizes.append(small.omega[inside].sum())
    middle, colour = np.array(middles), np.array(colours).reshape(-1, 3)
    bright = colour @ LUMINANCE

    # ---- The widest glow that explains enough
    for last in range(_end(middle, bright), 2, -1):
        far = np.maximum(colour[last], 1e-3 * colour[last].max())
        if not far.min() > 0:
            continue
        rings = np.maximum(colour[: last + 1] / far - 1, 0)
        factor = np.stack([_falling(ring, np.array(sizes[: last + 1])) for ring in rings.T], axis=1)
        table = np.stack([np.interp(GLOW_DEGREES, middle[: last + 1], f) for f in factor.T], axis=1)
        table = _without_kinks(table)
        inside = (angle < middle[last]) & ~cores & (lum > 0)
        before = np.log(lum[inside])
        after = before - np.log(1 + glow_at(table, np.cos(np.radians(angle[inside]))) @ LUMINANCE)
        if len(before) and after.var() < (1 - LEAST_EXPLAINED) * before.var():
            return table
    return None


def _falling(values, weights):
    """Return the closest values that never rise: isotonic regression, by pooling adjacent violators.

    One dark ring, of a silhouette or a cloud, does not make all farther ones dark as a running minimum would.
    """
    means: list[float] = []
    sums: list[float] = []
    counts: list[int] = []
    for value, weight in zip(values, weights, strict=True):
        mean, total, count = float(value), float(weight), 1
        while means and means[-1] < mean:
            before = sums.pop()
            mean = (means.pop() * before + mean * total) / (before + total)
            total += before
            count += counts.pop()
        means.append(mean)
        sums.append(total)
        counts.append(count)
    return np.repeat(means, counts)


def _without_kinks(table):
    """Smooth a table over about the width of its rings (:data:`GLOW_SMOOTHING`)."""
    sd = np.maximum(GLOW_SMOOTHING * GLOW_DEGREES, 1e-3)
    share = np.exp(-0.5 * np.square(np.subtract.outer(GLOW_DEGREES, GLOW_DEGREES) / sd[:, None]))
    soft = np.minimum.accumulate(share @ table / share.sum(axis=1, keepdims=True), axis=0)
    soft[-1] = 0
    return soft


def _end(middle, bright):
    """Return the first ring from which on no ring is darker, or which is too far out."""
    for i, value in enumerate(bright):
        if value <= GLOW_END * bright[i:].min() or middle[i] > GLOW_MOST_DEGREES:
            return i
    return len(bright) - 1


def glow_at(table: np.ndarray, cosine: np.ndarray) -> np.ndarray:
    """Interpolate a :attr:`Light.glow` at angles given by their cosines; returns (..., 3) of their type."""
    table = np.asarray(table, cosine.dtype)
    glow = np.zeros((cosine.size, 3), cosine.dtype)
    reach = int(np.flatnonzero(table.any(axis=1)).max(initial=-1)) + 1  # most of a sphere is beyond it
    if reach == 0:
        return glow.reshape(*cosine.shape, 3)
    farthest = np.cos(np.radians(min(GLOW_DEGREES[-1], reach * GLOW_DEGREES[1])) + 1e-9)
    some = np.flatnonzero(cosine >= farthest)
    place = np.degrees(np.arccos(np.clip(cosine.ravel()[some], -1, 1))) / GLOW_DEGREES[1]  # evenly apart
    inside = place <= len(GLOW_DEGREES) - 1
    some, place = some[inside], place[inside]
    node = np.minimum(place.astype(np.int32), len(GLOW_DEGREES) - 2)
    share = place - node.astype(place.dtype)
    steps = np.diff(table, axis=0)
    for c in range(3):
        glow[some, c] = table[node, c] + steps[node, c] * share
    return glow.reshape(*cosine.shape, 3)


def filled(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Replace texels by a smooth surface through those around them: a membrane in log radiance.

    Coarse to fine: unknown texels start from the mean of known ones at the next coarser level, and are then
    relaxed towards the mean of their neighbours. Columns are periodic.

    ``image`` (rows, W, 3) is linear radiance, not negative; ``mask`` (rows, W) are the texels to replace.
    """
    if not mask.any():
        return image
    if mask.all():
        return np.zeros_like(image)
    small = max(1e-6 * float(image[~mask].max()), 1e-30)
    surface = np.exp(_membrane(np.log(image + small), mask)) - small
    return np.where(mask[..., None], np.maximum(surface, 0), image)


def _membrane(values, mask):
    """Fill masked texels of values (rows, W, n), coarse to fine."""
    height, width = mask.shape
    if not mask.any():
        return values
    if min(height, width) <= 2:
        return np.where(mask[..., None], values[~mask].mean(axis=0) if (~mask).any() else 0, values)

    # ---- Means of known texels, half as fine, filled likewise
    known = (~mask).astype(np.float64)[..., None]

    def of_four(image):
        padded = np.pad(image, ((0, height % 2), (0, width % 2), (0, 0)))
        rows, columns, channels = padded.shape
        return padded.reshape(rows // 2, 2, columns // 2, 2, channels).sum(axis=(1, 3))

    weight, total = of_four(known), of_four(values * known)
    coarse = _membrane(total / np.maximum(weight, 1), weight[..., 0] == 0)
    guess = coarse.repeat(2, axis=0).repeat(2, axis=1)[:height, :width]

    # ---- From there, relaxed towards the mean of the neighbours
    values = np.where(mask[..., None], guess, values)
    r, c = np.nonzero(mask)
    up, down = np.maximum(r - 1, 0), np.minimum(r + 1, height - 1)
    left, right = (c - 1) % width, (c + 1) % width
    for _ in range(RELAXATIONS):
        values[r, c] = (values[up, c] + values[down, c] + values[r, left] + values[r, right]) / 4
    return values
