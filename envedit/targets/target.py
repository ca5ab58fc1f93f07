"""What the rendering should look like: under another light, as a painted picture, or under strokes.

Pixels under paint should become as painted, and all others stay as they are. Each of the two has a weight of
its own, shared among its pixels, so that a small stroke is not outvoted by the many pixels around it. Views
of a scene on which nothing was painted stay as they are: their target is their initial rendering.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from envedit import config, inputs
from envedit.core import extensions, latlong
from envedit.core.color import tonemap as apply_tonemap
from envedit.core.errors import ConfigError, InputError, counted
from envedit.core.radiance import BRIGHTEST, require_radiance
from envedit.core.seeds import Seeds
from envedit.images import images
from envedit.scene.renderings import rendered
from envedit.scene.scene import Scene
from envedit.targets import initial_rendering, painted_image, rendered_anew, strokes
from envedit.targets import photo as photographs
from envedit.targets.pixel_weights import first_hold, hidden_pixels, pixel_weight

FOUND_ANEW = (
    " (its noise is not that of the initial rendering: it is solved as a rendering under other light; "
    "if it was painted, give a mask)"
)

MOST_WHITE = 0.1
"""Share of the target's pixels that may be white without a warning."""


@dataclass(frozen=True)
class Target:
    """The picture wanted."""

    picture: np.ndarray  # (h, w, 3), linear radiance
    weight: np.ndarray  # (h, w, 1) float32, how much each pixel counts
    envmap: np.ndarray | None  # (H, W, 3), the map that makes the picture, where it is known
    source: str  # one line for the report
    warnings: tuple[str, ...] = ()  # what the user should know about the picture
    # (h, w, 3), what was painted on: the rendering under the map as it is; None where nothing was painted
    initial: np.ndarray | None = None
    coverage: np.ndarray | None = None  # (h, w, 1), how much each pixel was painted; None likewise
    # What the target was made from beside the configuration, for a checkpoint to know it by. Not the
    # rendering that was painted on: rendered anew, it may differ in its last bits
    asked: tuple[np.ndarray, ...] = ()
    # (h, w), standard error of the picture's display values; None where it is not known
    noise: np.ndarray | None = None
    # Samples a pixel that the picture was rendered with; None where it was not rendered
    spp: int | None = None
    # (h, w, 3), what the loop compares T E with, linear radiance; None: the picture. Usually the picture as T
    # sees it (:meth:`seen_as`)
    compared: np.ndarray | None = None
    # bool (h, w, 3), values that say "at least so bright"; None: none
    clipped: np.ndarray | None = None
    # The photograph that the picture is, as far as its camera is known
    photo: photographs.Photo | None = None

    @property
    def painted(self) -> bool:
        """Whether it is a painted picture, and not a picture of the scene under other light."""
        return self.coverage is not None

    @property
    def aim(self) -> np.ndarray:
        """The picture that the loop compares with, (h, w, 3)."""
        return self.picture if self.compared is None else self.compared

    @property
    def known_weight(self) -> np.ndarray:
        """How much each pixel counts where lower bounds do not, (h, w, 1)."""
        if self.clipped is None:
            return self.weight
        known = np.where(self.clipped.any(axis=2, keepdims=True), 0, self.weight).astype(np.float32)
        return known if known.any() else self.weight  # a few pixels of bounds: better these than nothing

    def aimed_at(self, picture: np.ndarray) -> Target:
        """Return the target with another :attr:`aim`."""
        return replace(self, picture=picture) if self.compared is None else replace(self, compared=picture)

    def seen_as(self, seen: np.ndarray, rendering: np.ndarray) -> Target:
        """Return the target as T sees it (:func:`beside`), ``seen`` of a map's ``rendering`` (h, w, 3)."""
        return replace(self, compared=beside(seen, rendering, self.picture))

    def developed(self, photograph: photographs.Photo) -> Target:
        """Return the target with its photograph, whose camera and place are known better."""
        picture = np.minimum(photograph.picture, np.float32(BRIGHTEST))
        weight = self.weight
        if self.photo is not None and photograph.placed != self.photo.placed:
            before = self.photo.counts
            share = np.divide(weight, before, out=np.zeros_like(before), where=before > 0)
            weight = share * photograph.counts
        known = replace(self, photo=photograph, clipped=photograph.clipped)
        return replace(known, picture=picture, weight=weight, compared=None)

    def held(self, paint: float, hold: float) -> Target:
        """Return the target with other weights of paint and rest, among the pixels that count."""
        assert self.coverage is not None, "nothing was painted"
        uncounted = self.weight[..., 0] == 0
        return replace(self, weight=pixel_weight(self.coverage, uncounted, paint, hold))


def beside(seen: np.ndarray, rendering: np.ndarray, picture: np.ndarray) -> np.ndarray:
    """Return a picture as T sees it: without what T, ``seen``, misses of a map's rendering; (h, w, 3) all.

    What is asked for beside the rendering is asked for beside T's: more light as a sum, less as a factor, so
    that nothing falls below black. Nothing is spent on the noise of both.
    """
    less = np.minimum(picture, rendering)
    factor = np.divide(less, rendering, out=np.ones_like(less), where=rendering > 0)
    return (factor * seen + (picture - less)).astype(np.float32)


def make(
    settings: config.Config,
    scene: Scene,
    envmap: np.ndarray,
    replacements: inputs.Replacements = inputs.NO_REPLACEMENTS,
) -> Target:
    """Make the target of a configuration.

    ``envmap`` (H, W, 3) is the map that will be edited; turned by ``rotate_degrees`` where the target names
    no file. Of ``replacements`` the target, its mask and its map take the place of files.

    InputError if a file cannot be read, a picture does not fit the film, or the other map is brighter than
    :data:`.radiance.BRIGHTEST`; a picture that is so bright is cut there, with a warning. ConfigError if a
    view is not the scene's, or is given twice, or strokes paint nothing; as of :func:`.extensions.load`.
    """
    made = _made(settings, scene, envmap, replacements)
    return _seen(made, hidden_pixels(scene), settings.output.tonemap)


def _made(settings, scene, envmap, replacements):
    """Make the target, without regard to pixels that see no surface where nothing was painted."""
    # ---- The scene under another map
    chosen = settings.target
    picture, mask, other = replacements.target, replacements.mask, replacements.target_map
    if picture is None and chosen.kind == "envmap":
        if other is not None or not chosen.file or images.is_panorama(str(chosen.file)):
            return _rendered(settings, scene, envmap, other)
        settings = replace(settings, target=replace(chosen, kind="rendering"))
        return _of_rendering(settings, scene, envmap, None, None, " (it is not 2:1, as a map is)")

    # ---- A picture of the scene under other light
    if chosen.kind == "photo":
        return _of_photo(settings, scene, envmap, picture, mask)
    if chosen.kind not in config.TARGET_KINDS and picture is None:
        picture = extensions.load(extensions.TARGETS, chosen.kind)(settings, scene, envmap)
        return _of_rendering(settings, scene, envmap, picture, mask)
    if chosen.kind == "rendering":
        if picture is None and not chosen.file:  # an array may take its place
            raise ConfigError(
                'target.file: got "", expected the picture of the scene, as target.kind is "rendering"'
            )
        return _of_rendering(settings, scene, envmap, picture, mask)

    return _of_paint(settings, scene, envmap, picture, mask)


def _of_paint(settings, scene, envmap, picture, mask):
    """Take what was painted on the initial rendering; a picture that was rendered anew is one of a scene."""
    # ---- The picture
    chosen = settings.target
    initial = initial_rendering.initial(scene, envmap, settings)
    if picture is not None:
        painted = painted_image.given(picture, (scene.height, scene.width), initial, mask)
        source = "painted: given as an array"
    elif chosen.kind == "image":
        painted = _painted_files(scene, initial, settings)
        source = f"painted: {', '.join(chosen.files)}"
    else:
        painted = painted_strokes(scene, initial, chosen.strokes, chosen.display_tonemap)
        if not painted.coverage.any():
            raise ConfigError("; ".join(painted.warnings))
        source = f"painted: {counted(len(chosen.strokes), 'stroke', 'strokes')} on the initial rendering"
    if chosen.kind == "image" and mask is None and not chosen.masks:

        def again():
            seed, cache = Seeds(settings.seed).judged, settings.renderer.cache
            return rendered(scene, envmap, chosen.spp, seed, cache)[0]

        if rendered_anew.is_rendered_anew(painted.picture, initial, painted.coverage, again, scene.rows):
            return _of_rendering(settings, scene, envmap, picture, mask, FOUND_ANEW)
    asked = _asked(chosen, picture, mask)
    picture, warnings = painted.picture, painted.warnings
    if over := int((picture > BRIGHTEST).any(axis=2).sum()):
        # Squares and sums of what is more would leave single precision; on a display it is as white.
        picture = np.minimum(picture, np.float32(BRIGHTEST))
        pixels_are = counted(over, "pixel is", "pixels are")
        warnings += (f"target: {pixels_are} brighter than {BRIGHTEST:.3g}: taken as that bright",)

    # ---- How much each pixel counts
    hidden = hidden_pixels(scene)
    coverage = np.where(hidden[..., None], 0, painted.coverage)
    if painted.coverage.any() and not coverage.any():
        raise InputError(
            "target: all paint lies where no surface is seen (hide_emitters): paint on a surface"
        )
    uncounted = painted.excluded & (coverage[..., 0] > 0)  # what was not painted has the initial value
    hold = first_hold(settings)
    weight = pixel_weight(coverage, uncounted | hidden, chosen.paint, hold)
    share = 100 * float((coverage > 0).mean())
    source += f", {share:.3g} % of the pixels; weights {chosen.paint:g} (paint) and {hold:g} (the rest)"
    return Target(picture, weight, None, source, warnings, initial, coverage, asked)


def _asked(chosen, picture, mask):
    """Return what a target was made from: the arrays given, or what the files of a [target] hold."""
    if picture is None:
        return tuple(np.fromfile(file, np.uint8) for file in (*chosen.files, *chosen.masks) if file)
    return (picture,) if mask is None else (picture, mask)


def _of_rendering(settings, scene, envmap, picture, mask, how=""):
    """Take a picture of the scene under other light; ``how``: why it is taken for one."""
    # ---- The picture
    chosen, shape = settings.target, (scene.height, scene.width)
    if picture is not None:
        everywhere = np.ones(shape) if mask is None else mask
        image = painted_image.given(picture, shape, np.zeros((*shape, 3)), everywhere)
        source = "a picture of the scene, given as an array"
    else:
        unnamed = {"tonemap": "srgb"}
        by_view = _files_by_view(scene, chosen)

        def of_view(k, before):
            file, mask = by_view[k]
            return painted_image.read(file, before.shape[:2], chosen.tonemap, None, mask, unnamed)

        image = _of_views(scene, np.zeros((*shape, 3), np.float32), by_view, of_view)
        source = f"a picture of the scene: {', '.join(chosen.files)}"

    # ---- Pixels that count, and its noise
    asked = _asked(chosen, picture, mask)
    if not ((image.coverage[..., 0] > 0) & ~image.excluded).any():
        raise InputError("target: no pixel of the picture counts: all are clipped, masked or transparent")
    picture = np.minimum(image.picture, np.float32(BRIGHTEST))
    noise = rendered_anew.noise(picture, scene.rows)
    initial, spp, _ = with_noise(settings, scene, envmap)
    spp = rendered_anew.samples(noise, initial, spp, scene.rows)
    source += f"{how}, as noisy as {spp} samples a pixel"
    made = Target(picture, image.coverage, None, source, image.warnings, asked=asked, noise=noise, spp=spp)
    return replace(made, clipped=image.clipped)


def _of_photo(settings, scene, envmap, picture, mask):
    """Take a photograph, on the film of the scene, under the camera that fits the map as it is."""
    # ---- The photograph, laid on the rendering under light from everywhere
    chosen = settings.target
    if picture is not None or mask is not None or len(chosen.files) != 1 or len(scene.views) > 1:
        raise ConfigError('target.kind = "photo": expected one file in target.file, and a scene of one view')
    everywhere = np.ones_like(envmap, np.float32)
    spp, cache = chosen.spp, settings.renderer.cache
    outlines, _, _ = rendered(scene, everywhere, spp, Seeds(settings.seed).target_again, cache)
    file = chosen.files[0]
    mask_file = "".join(chosen.masks)
    photo, warnings = photographs.read(file, mask_file, outlines, chosen.align, chosen.vignetting)

    # ---- Its camera
    initial, spp, _ = with_noise(settings, scene, envmap)
    curves = photo.curves if chosen.curve == "auto" or photo.curves == ("linear",) else (chosen.curve,)
    known = [None if value == "auto" else value for value in (chosen.exposure, chosen.white_balance)]
    photo = replace(photo, curves=curves, stops=known[0], kelvin=known[1])
    photo = photo.under(curves[0], initial, photo.counts)
    asked = _asked(chosen, None, None)
    placed = f", {photo.placed.summary}" if photo.placed.summary else ""
    source = f"a photograph of the scene: {file}{placed}"
    target = Target(photo.picture, photo.counts, None, source, tuple(warnings), asked=asked, photo=photo)
    target = target.developed(photo)

    # ---- Its noise
    noise = rendered_anew.noise(target.picture, scene.rows)
    spp = rendered_anew.samples(noise, initial, spp, scene.rows)
    return replace(target, noise=noise, spp=spp)


def _by_view(scene, views, values):
    """Return the value for each view, by the view's number."""
    numbers = [scene.view(view, "target.view") for view in views]
    if len(set(numbers)) < len(numbers):
        raise ConfigError("target.view: got a view by index and by name, expected each once")
    return dict(zip(numbers, values, strict=True))


def _files_by_view(scene, chosen):
    """Return picture and mask, "" without one, for each view that has them."""
    masks = chosen.masks or ("",) * len(chosen.files)
    return _by_view(scene, chosen.views, zip(chosen.files, masks, strict=True))


def _painted_files(scene, initial, settings):
    """Read what was painted on views, each from its file."""
    chosen, name = settings.target, initial_rendering.png_tonemap(initial, settings)
    painted = _files_by_view(scene, chosen)

    def of_view(k, before):
        file, mask = painted[k]
        exported = initial_rendering.origin(settings, before.shape, name)
        return painted_image.read(file, before.shape[:2], chosen.tonemap, before, mask, exported)

    return _of_views(scene, initial, painted, of_view)


def painted_strokes(
    scene: Scene, picture: np.ndarray, painted: Sequence[dict], tonemap: str
) -> strokes.Painted:
    """Paint strokes on a picture of all views (h, w, 3), each on its own; as of :func:`.strokes.paint`.

    ConfigError if a stroke is of a view that the scene has not.
    """
    numbers = [scene.view(s.get("view", 0), f"target.strokes[{i}].view") for i, s in enumerate(painted)]

    def of_view(k, before):
        own = [i for i, number in enumerate(numbers) if number == k]
        return strokes.paint(before, [painted[i] for i in own], tonemap, own)

    return _of_views(scene, picture, numbers, of_view)


def _of_views(scene, initial, painted, of_view):
    """Put together what was painted on each view; those that are not ``painted`` hold."""
    parts = []
    for k, rows in enumerate(scene.rows):
        before = initial[rows]
        if k in painted:
            parts.append(of_view(k, before))
        else:
            shape = before.shape[:2]
            bare = np.zeros((*shape, 1), np.float32)
            parts.append(strokes.Painted(before, bare, np.zeros(shape, bool), np.zeros(before.shape, bool)))
    names = "picture", "coverage", "excluded", "clipped"
    stacked = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    warnings = tuple(line for part in parts for line in part.warnings)
    return strokes.Painted(**stacked, warnings=warnings)


def _seen(target, hidden, curve):
    """Take the pixels that see no surface, where the scene hides what lights it, out of the loss.

    And warn of a target that is largely white on a display.
    """
    white = (apply_tonemap(target.picture, curve) >= 1).all(axis=2)
    share = (white & ~hidden).sum() / max((~hidden).sum(), 1)
    if share > MOST_WHITE and target.photo is None:
        line = f"target: {100 * share:.3g} % of its pixels are white under the tonemap '{curve}', where "
        line += "measures and pictures show no difference: lower scene.scale, or set another output.tonemap"
        target = replace(target, warnings=(*target.warnings, line))
    if not hidden.any():
        return target
    weight = np.where(hidden[..., None], 0, target.weight).astype(np.float32)
    if not weight.any():
        raise InputError("target: no pixel counts: none that is asked for sees a surface (hide_emitters)")
    share = f"{100 * hidden.mean():.3g} % of the pixels see no surface (hide_emitters) and do not count"
    return replace(target, weight=weight, source=f"{target.source}; {share}")


def _rendered(settings, scene, envmap, other):
    """Render the scene under another map."""
    chosen = settings.target
    if chosen.file or other is not None:
        file = chosen.file if other is None else other
        true, info = images.load_envmap(file, envmap.shape[1], settings.input.repair, name="target_map")
        require_radiance(true, str(chosen.file), brightest=BRIGHTEST)
        true = inputs.scaled(true, scene.own.scale, str(chosen.file))
        source = f"rendered under {chosen.file}"
        warnings = tuple(f"{info['path']}: {line}" for line in info["warnings"])
        if other is None and info["size"] in {(scene.width, rows.stop - rows.start) for rows in scene.rows}:
            line = "is 2:1 and read as a map, though of the size of the rendering"
            remedy = 'for a picture of the scene set target.kind = "rendering"'
            warnings = (*warnings, f"{file}: {line}; {remedy}")
    else:
        true, warnings = latlong.rotate(envmap, chosen.degrees), ()
        source = f"rendered under the map turned by {chosen.degrees:g} degrees"
    true = np.ascontiguousarray(true, np.float32)
    picture, spp, noise = with_noise(settings, scene, true)
    weight = np.ones((*picture.shape[:2], 1), np.float32)
    for view, mask in _by_view(scene, chosen.views, chosen.masks).items():
        if mask:
            rows = scene.rows[view]
            weight[rows] = painted_image.read_mask(mask, weight[rows].shape[:2])
    asked = (true, weight) if chosen.masks else (true,)
    source += f", {spp} samples a pixel"
    return Target(picture, weight, true, source, warnings, asked=asked, noise=noise, spp=spp)


def with_noise(
    settings: config.Config, scene: Scene, envmap: np.ndarray
) -> tuple[np.ndarray, int, np.ndarray]:
    """Render a target under a map (H, W, 3), with samples, seed and cache of the configuration.

    Returned are the picture (h, w, 3), linear radiance, the samples a pixel that were taken, and the standard
    error (h, w) of display values, RMS over channels: where it is not known from passes, |d1 - d2| / sqrt(2),
    with d2 a second rendering with as many samples.
    """
    seeds = Seeds(settings.seed)
    samples = settings.target.spp
    keep = settings.renderer.cache
    picture, spp, noise = rendered(scene, envmap, samples, seeds.target, keep)
    if noise is None:
        again, _, _ = rendered(scene, envmap, samples, seeds.target_again, keep)
        off = np.float64(apply_tonemap(picture)) - apply_tonemap(again)
        noise = np.sqrt(np.square(off).mean(axis=2) / 2)
    return picture, spp, noise
