"""A photograph of the scene as target: its values, and the camera between a rendering and them.

With x the radiance of a rendering and c the log factor of a channel, exposure and white balance together, a
camera shows curve(exp(c) v x), where the curve is one of ``tone_curves.py`` and v what its lens lets through
of the centre's light, 1 unless it is given. Of one picture exposure and the brightness of the map are not
separable: both are drawn to what they are without the picture.
"""

from __future__ import annotations

import functools
from dataclasses import asdict, astuple, dataclass, field, replace

import numpy as np

from envedit.core.color import AXES, linear_to_srgb, luminance, srgb_to_linear
from envedit.core.errors import InputError
from envedit.core.resampling import fit
from envedit.core.tone_curves import TONE_CURVES
from envedit.core.types import FilePath, Shape
from envedit.images import images
from envedit.targets import alignment, painted_image
from envedit.targets.strokes import balance, gains

KELVIN = np.geomspace(2000, 25000, 400)
"""Temperatures that a white balance is looked for among."""
DARKEST = 0.02
"""Display value below which a pixel says little of exposure: five steps of 8 bits."""
LEAST_TELLING = 0.02
"""Share of the values that must be neither clipped nor black."""
EXPOSURE_DEVIATION = 3.0
"""Standard deviation of the exposure, in stops: cameras make a picture of any light."""
BALANCE_DEVIATION, TINT_DEVIATION = 0.59, 0.1
"""Standard deviations of a white balance along the second and third of :data:`.AXES`: of temperatures from
3200 to 9000 K, evenly in mired, about 6500 K; and of a sky's tint."""
HELD_DEVIATION = 1e-3
"""Standard deviation of what the configuration gives."""
MOST_ASPECT = 1.03
"""Aspect of the photograph over that of the rendering from which on it is another picture."""
WHITE = 1 - 2.5 / 255
"""Display value from which on a pixel is at least so bright: a JPEG's white is not quite."""
SUPERSAMPLED = 2
"""Pixels of the photograph for one of the rendering, along each axis, at most, when it is aligned."""


def _nothing():
    return np.zeros((0, 0, 3))


@dataclass(frozen=True)
class Camera:
    """Exposure, white balance and tone curve.

    ``curve`` is one of :data:`.TONE_CURVES`, "linear" of a file that holds linear radiance; ``log_factor``
    (3,) the natural logarithm of the factor of red, green and blue.
    """

    curve: str
    log_factor: np.ndarray = field(default_factory=lambda: np.zeros(3))

    @property
    def stops(self) -> float:
        """Exposure: the factor of grey's luminance."""
        return float(np.log2(luminance(np.exp(self.log_factor))))

    @property
    def kelvin(self) -> float:
        """Temperature of the light that the white balance makes neutral; 6500 changes nothing."""
        off = [abs(self.log_factor @ (1, 0, -1) + np.log(g[0] / g[2])) for g in map(gains, KELVIN)]
        return float(KELVIN[np.argmin(off)])

    def shown(self, radiance: np.ndarray) -> np.ndarray:
        """Return the values that the camera makes of radiance (..., 3)."""
        exposed = np.float64(radiance) * np.exp(self.log_factor)
        return exposed if self.curve == "linear" else TONE_CURVES[self.curve].shown(exposed)

    def radiance(self, values: np.ndarray) -> np.ndarray:
        """Return the radiance of values (..., 3)."""
        exposed = values if self.curve == "linear" else TONE_CURVES[self.curve].exposed(values)
        return exposed / np.exp(self.log_factor)


@dataclass(frozen=True)
class Photo:
    """A photograph on the film of the rendering."""

    # (H, W, 8), of the file, at most :data:`SUPERSAMPLED` times as wide as the film: linear radiance, which
    # of its values are clipped, what the lens lets through, and how much a pixel counts
    file: np.ndarray
    camera: Camera  # as far as it is known
    curves: tuple[str, ...]  # that the camera may have
    placed: alignment.Placement = alignment.Placement()  # where the film lies in the file's picture
    # (h, w, 3), on the film: display values in [0, 1], or linear radiance
    values: np.ndarray = field(default_factory=_nothing)
    # bool (h, w, 3), values that say "at least so bright"
    clipped: np.ndarray = field(default_factory=_nothing)
    # (h, w, 1), v, the share of the light that the lens lets through beside that of the centre
    let_through: np.ndarray = field(default_factory=_nothing)
    counts: np.ndarray = field(default_factory=_nothing)  # (h, w, 1) float32, how much each pixel counts
    # stops, kelvin: exposure and white balance, where they are known
    stops: float | None = None
    kelvin: float | None = None
    aligns: bool = True  # it may lie otherwise than as it is
    recognised: bool = False  # its outlines are those of the scene
    settled: bool = False  # curve and placement have been compared under the light that was found

    def laid(self, shape: Shape, placed: alignment.Placement | None = None) -> Photo:
        """Return it on a film of shape (h, w, ...), or placed otherwise on it."""
        placed = placed or self.placed
        height, width = shape[:2]
        factor = min(max(1, len(self.file) // height), SUPERSAMPLED)
        stack, inside = placed.sampled(self.file, factor * height, factor * width)
        stack[..., -1] *= inside
        stack = fit(stack, height, width).astype(np.float64)
        linear, clipped, let_through, counts = np.split(stack, (3, 6, 7), axis=2)
        values = linear if self.camera.curve == "linear" else linear_to_srgb(linear)
        counts = counts.astype(np.float32)
        laid = replace(self, placed=placed, values=values, clipped=clipped > 0, counts=counts)
        return replace(laid, let_through=let_through)

    def aligned(self, rendering: np.ndarray) -> Photo:
        """Return it where its outlines are those of a rendering (h, w, 3), if they are and it may move."""
        if not self.aligns:
            return self
        placed, clear = alignment.find(luminance(self.file[..., :3]), luminance(rendering))
        moved = self.laid(rendering.shape, placed) if clear else self
        return replace(moved, recognised=clear or self.recognised)

    @functools.cached_property
    def precision(self) -> np.ndarray:
        """Inverse covariance of the camera's log factor, (3, 3)."""
        exposure = np.sqrt(3) * np.log(2) * EXPOSURE_DEVIATION
        deviations = np.array([exposure, BALANCE_DEVIATION, TINT_DEVIATION])
        if self.stops is not None:
            deviations[0] = HELD_DEVIATION
        if self.kelvin is not None:
            deviations[1:] = HELD_DEVIATION
        return AXES.T @ (deviations[:, None] ** -2.0 * AXES)

    @functools.cached_property
    def centre(self) -> np.ndarray:
        """Log factor that it is drawn to, (3,): of a known exposure and white balance, otherwise none."""
        of_white = np.zeros(3) if self.kelvin is None else np.log(balance(self.kelvin))
        return np.log(2) * (self.stops or 0.0) + of_white

    @property
    def off_centre(self) -> np.ndarray:
        """The camera's log factor less what it is drawn to, (3,)."""
        return self.camera.log_factor - self.centre

    @property
    def picture(self) -> np.ndarray:
        """The photograph as radiance of the scene, (h, w, 3) float32."""
        return (self.camera.radiance(self.values) / self.let_through).astype(np.float32)

    def under(self, curve: str, rendering: np.ndarray, weight: np.ndarray) -> Photo:
        """Return it with another curve, and the factor at which a rendering is nearest in the median."""
        exposed = Camera(curve).radiance(self.values) / self.let_through
        telling = ~self.clipped & (self.values > DARKEST) & (rendering > 0) & (exposed > 0) & (weight > 0)
        if telling.mean() < LEAST_TELLING:
            raise InputError(
                f"target: {100 * telling.mean():.2g} % of the photograph's values are neither black nor "
                f"clipped, and {100 * LEAST_TELLING:g} % are needed: take another exposure"
            )
        ratio = np.log(np.where(telling, exposed, 1) / np.where(telling, rendering, 1))
        grey = np.median(ratio[telling])
        factor = np.array([
            np.median(ratio[..., c][telling[..., c]]) if telling[..., c].any() else grey for c in range(3)
        ])  # fmt: skip
        along = AXES @ (factor - self.centre)
        along[:1] *= self.stops is None
        along[1:] *= self.kelvin is None
        return replace(self, camera=Camera(curve, self.centre + along @ AXES))

    @property
    def measures(self) -> dict:
        """What metrics.json has of its camera, and of where it lies."""
        camera = self.camera
        factor = [float(v) for v in np.exp(camera.log_factor)]
        found = {"exposure": camera.stops, "kelvin": camera.kelvin, "factor": factor, "curve": camera.curve}
        return found | {"placement": asdict(self.placed), "summary": self.summary}

    @property
    def summary(self) -> str:
        """Its camera, and where it lies, in words."""
        camera, placed = self.camera, self.placed.summary
        line = f"exposure {camera.stops:+.1f} stops, white balance {round(camera.kelvin, -2):.0f} K, "
        return line + f"curve {camera.curve}" + (f", {placed}" if placed else "")

    def missed(self, rendering: np.ndarray) -> np.ndarray:
        """Return what the camera shows of a rendering (h, w, 3) less the photograph's values."""
        return self.camera.shown(rendering * self.let_through) - self.values

    def displayed(self, radiance: np.ndarray) -> np.ndarray:
        """Return the light of a display, white at 1, on which the camera shows radiance (h, w, 3)."""
        shown = self.camera.shown(radiance * self.let_through)
        light = shown if self.camera.curve == "linear" else srgb_to_linear(shown)
        return np.asarray(light, np.float32)

    def exposed_by(self, log_factor: np.ndarray) -> Photo:
        """Return it with a camera whose log factor is larger by (3,)."""
        camera = replace(self.camera, log_factor=self.camera.log_factor + log_factor)
        return replace(self, camera=camera)

    @property
    def array(self) -> np.ndarray:
        """What is known of it, for a checkpoint: camera, placement, and whether it is settled."""
        curve = -1 if self.camera.curve == "linear" else list(TONE_CURVES).index(self.camera.curve)
        known = curve, self.settled, self.recognised
        return np.array([*known, *self.camera.log_factor, *astuple(self.placed)])

    def of_array(self, array: np.ndarray) -> Photo:
        """Return it with what :attr:`array` knew."""
        number, settled, recognised = array[:3].astype(int)
        curve = "linear" if number < 0 else list(TONE_CURVES)[number]
        camera, placed = Camera(curve, array[3:6]), alignment.Placement(*array[6:].tolist())
        photo = self.laid(self.values.shape, placed)
        return replace(photo, camera=camera, settled=bool(settled), recognised=bool(recognised))


def read(
    file: FilePath, mask: FilePath, outlines: np.ndarray, align: bool = True, vignetting: float = 0.0
) -> tuple[Photo, list[str]]:
    """Read a photograph and lay it on the film of a rendering; returns it, and warnings.

    ``mask`` is a file of the photograph's size, white where it counts; "" for none. ``outlines`` (h, w, 3) is
    the scene under light from everywhere, linear radiance. With ``align`` it is found how the photograph is
    shifted, scaled and rotated. By ``vignetting`` stops its corners are darker: with r the distance from the
    centre over that of the corners, v = 2^(-vignetting r^2). Its camera changes nothing.

    InputError if a file cannot be read, is of another aspect, is not finite, or lies farther off than is
    looked for.
    """
    # ---- The file
    pixels, info = images.read_stored(file)
    warnings = [f"{file}: {line}" for line in info["warnings"]]
    painted_image.check_finite(file, pixels, "repair it in the program it came from")
    values, alpha, _ = painted_image.planes(file, pixels, warnings)
    clipped = np.zeros(values.shape) if info["hdr"] else np.float64(values >= WHITE)
    counts = alpha[..., None] * (painted_image.read_mask(mask, alpha.shape) if mask else 1)
    (rows, columns), (height, width) = alpha.shape, outlines.shape[:2]
    aspect = columns * height / (rows * width)
    if not 1 / MOST_ASPECT < aspect < MOST_ASPECT:
        raise InputError(
            f"{file}: is {columns}x{rows} pixels, the rendering is {width}x{height}: another aspect; crop "
            "the photograph to what the scene's camera sees, or give the film its size"
        )

    # ---- At most as many pixels as are needed, averaged as light
    linear = values if info["hdr"] else srgb_to_linear(values)
    y, x = np.linspace(-1, 1, rows)[:, None], np.linspace(-1, 1, columns)
    of_corners = ((y * rows) ** 2 + (x * columns) ** 2) / (rows**2 + columns**2)
    stack = np.concatenate([linear, clipped, 2.0 ** (-vignetting * of_corners[..., None]), counts], axis=2)
    film = SUPERSAMPLED * height, SUPERSAMPLED * width
    stack = fit(stack, min(rows, film[0]), min(columns, film[1])).astype(np.float64)
    curves = ("linear",) if info["hdr"] else tuple(TONE_CURVES)
    photo = Photo(stack, Camera(curves[0]), curves, aligns=align).laid((height, width))
    if not photo.counts.any():
        raise InputError(f"{file}: no pixel counts: all are masked or transparent")

    # ---- Where it lies
    photo = photo.aligned(outlines)
    if np.abs(photo.placed.shares).max() > 1:
        raise InputError(
            f"{file}: fits the scene best if {photo.placed.summary}, which is more than is corrected: "
            "give the scene the photograph's camera, or set [target] align = false"
        )
    return photo, warnings
