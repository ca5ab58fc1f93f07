"""A painted picture: what it asks for, and where it was painted.

A picture has no information where it is clipped, and requests nothing where it was not painted. The latter is
seen by comparing it with the initial rendering, in display values, as that would look in the picture's own
format.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from envedit.core.color import TONEMAPS, inverse_tonemap, tonemap
from envedit.core.errors import InputError, counted, place_of, texels_are
from envedit.core.resampling import fit
from envedit.core.types import FilePath, Shape
from envedit.images import images
from envedit.targets import initial_rendering
from envedit.targets.paint_detection import differs
from envedit.targets.strokes import Painted

NEARLY_ALL = 0.9
MOST_RESIZED = 16
"""Times as wide, or as narrow, as the rendering that a picture may be: others are no resized exports."""


def read(
    file: FilePath,
    shape: Shape,
    tonemap_name: str,
    initial: np.ndarray | None = None,
    mask: FilePath = "",
    exported: Mapping[str, object] = {},
) -> Painted:
    """Read a painted picture, for a rendering of ``shape`` (h, w).

    - Float files are linear radiance. Others are undone by the tonemap that they were painted under:
      ``tonemap_name``, where it is one of ``color.TONEMAPS`` and not "auto"; else the one that the file
      names, or that of the export, unless the unpainted pixels are those of the rendering under another.
    - A picture of another size and the rendering's aspect is resampled.
    - Where a PNG or JPEG is white in a channel, the value is a lower bound, ``clipped``: such pixels are
      excluded, but for those that were neither painted nor clipped before.
    - With alpha, colour counts as laid over the initial rendering, or is taken as it is without one.

    ``initial`` (h, w, 3), linear radiance, is what was painted on; without it every pixel counts as painted.
    A ``mask`` (:func:`read_mask`), white where it was painted, takes the place of comparing. ``exported`` is
    what an export of ``initial`` as a PNG says of itself (:func:`.initial_rendering.origin`): what the file
    says is compared with it, and its tonemap is that of a file which says nothing.

    InputError if the file cannot be read, was exported from another rendering or under another tonemap than
    the declared one, is of another aspect, holds values that are not finite, is grey where the rendering is
    not, or shows nothing painted.
    """
    # ---- The file, and what it says of itself
    pixels, info = images.read_stored(file)
    file = info["path"]
    facts = initial_rendering.stated_origin(file, info, exported)
    warnings = [f"{file}: {line}" for line in info["warnings"]]
    spread = _spread_of_resampling(file, pixels.shape, initial, shape, warnings)
    check_finite(file, pixels, "repair it in the program it came from (half floats end at 65504)")

    # ---- Values, alpha and clipped pixels, at the size of the rendering
    values, alpha, top = planes(file, pixels, warnings)
    clipped = _clipped(values, info) & (alpha > 0)[..., None]
    if spread:
        values, alpha, clipped = _resampled(values, alpha, clipped, shape, info["hdr"])
    uncertain = clipped.any(axis=2)

    # ---- The tonemap, and the rendering under it
    before = None
    name = _tonemap_of(file, info, facts, tonemap_name, exported, warnings)
    if initial is not None:
        if not info["hdr"] and "envedit.tonemap" not in info["metadata"]:
            seen = (alpha > 0) & ~uncertain & (initial > 0).any(axis=2)
            name = _recognised(file, values, seen, initial, name, tonemap_name, warnings)
        if pixels.shape[2] < 3 and not mask and _coloured(initial, name):
            raise InputError(f"{file}: is grey, the rendering is in colour: save it as RGB, or give a mask")
        before = np.asarray(initial, np.float64) if info["hdr"] else tonemap(np.float64(initial), name)

    # ---- What was painted, and what of it has information
    if (alpha < 1).any():
        values = _laid_over(values, alpha[..., None], before, info["hdr"])
        over = "laid over the initial rendering" if before is not None else "taken as it is"
        pixels_are = counted((alpha == 0).sum(), "pixel is", "pixels are")
        warnings.append(
            f"{file}: {pixels_are} transparent, which counts as not painted; "
            f"the colour of {((alpha < 1) & (alpha > 0)).sum()} half transparent ones is {over}"
        )
    painted = alpha > 0
    if before is not None:
        painted &= differs(values, before, info, top, spread)
        if not mask:
            other = {key: value for key, value in facts.items() if value != str(exported.get(key))}
            _check_painted(file, painted, before, info, other, top, warnings)
    coverage = alpha * (read_mask(mask, shape)[..., 0] if mask else painted)
    if not coverage.any():
        remarks = f" ({'; '.join(info['warnings'])})" if info["warnings"] else ""
        raise InputError(
            f"{file}: nothing of it is painted{remarks}; paint on it, or give a mask that is white there"
        )
    excluded = uncertain | (alpha == 0)
    if before is not None:
        excluded = uncertain & ((coverage > 0) | (before >= 1 - 0.5 / top).any(axis=2))
    warnings += _clipped_paint(file, excluded, coverage, before is None)

    # ---- The picture, in linear radiance
    picture = values if info["hdr"] else inverse_tonemap(values, name)
    if initial is not None:  # to the last bit, not as the file has rounded it
        picture = np.where((painted & (coverage > 0))[..., None], picture, initial)
    picture = np.minimum(picture, np.finfo(np.float32).max).astype(np.float32)
    return Painted(picture, coverage[..., None].astype(np.float32), excluded, clipped, tuple(warnings))


def _clipped_paint(file, excluded, coverage, whole):
    """Return a warning of painted pixels that are clipped; InputError where there are no others.

    Of a ``whole`` picture, painted everywhere, nothing is said.
    """
    uncounted = excluded & (coverage > 0)
    if not uncounted.any():
        return []
    if (excluded | (coverage == 0)).all():
        raise InputError(
            f"{file}: all that is painted is clipped, and says only 'at least so bright': "
            'paint below white, or on an .exr, or under [target] tonemap = "reinhard"'
        )
    if whole:
        return []
    pixels_are = counted(uncounted.sum(), "painted pixel is", "painted pixels are")
    return [
        f"{file}: {pixels_are} clipped ('at least so bright') and left out; to "
        "have them count, paint below white, or on an .exr"
    ]


def given(picture: np.ndarray, shape: Shape, initial: np.ndarray, mask: np.ndarray | None = None) -> Painted:
    """Take a painted picture (h, w, 3), linear radiance, from arrays; negative values become 0.

    ``initial`` (h, w, 3), of ``shape`` (h, w), is what was painted on. Pixels that differ by less than a half
    float rounds were not painted; a ``mask`` (h, w) or (h, w, 1), how much each was painted, in [0, 1], takes
    the place of comparing. InputError if the sizes differ, a value is not finite, or nothing is painted.
    """
    picture = np.asarray(picture, np.float64)
    if picture.shape != (*shape, 3):
        raise InputError(f"target: the picture has shape {picture.shape}, the rendering {(*shape, 3)}")
    check_finite("target", picture, "repair it where it comes from")
    picture = np.maximum(picture, 0)
    if mask is None:
        coverage = differs(picture, np.asarray(initial, np.float64), {"hdr": True, "format": "exr"}, 1)
    else:
        coverage = np.asarray(mask, np.float64)
        if coverage.size != shape[0] * shape[1] or coverage.shape[:2] != tuple(shape):
            raise InputError(f"mask: has shape {coverage.shape}, the rendering {tuple(shape)}")
        coverage = coverage.reshape(shape)
        check_finite("mask", coverage[..., None], "it is how much each pixel was painted, from 0 to 1")
        coverage = np.clip(coverage, 0, 1)
    if not coverage.any():
        raise InputError("target: nothing of the picture is painted")
    picture = np.where(coverage[..., None] > 0, np.minimum(picture, np.finfo(np.float32).max), initial)
    nothing = np.zeros(shape, bool)
    return Painted(picture.astype(np.float32), coverage[..., None].astype(np.float32), nothing)


def read_mask(file: FilePath, shape: Shape) -> np.ndarray:
    """Read a mask as the weight of each pixel, (h, w, 1) float32: 1 of white, 0 of black, greys in between.

    Half grey is meant as a half, whatever curve the file has; transparent is black; float values are cut to
    [0, 1]. InputError if it cannot be read, is not (h, w), is not finite, or is black everywhere.
    """
    pixels, info = images.read_stored(file)
    file, rows, columns = info["path"], *pixels.shape[:2]
    if (rows, columns) != tuple(shape[:2]):
        raise InputError(
            f"{file}: is {columns}x{rows} pixels, the target is {shape[1]}x{shape[0]}: "
            "the mask must have the target's size"
        )
    check_finite(file, pixels, "paint the mask in black and white")
    values = pixels if info["hdr"] else pixels / np.iinfo(pixels.dtype).max
    if values.shape[2] in (2, 4):
        alpha = 1 if info["hdr"] else values[..., -1:]  # OpenEXR is premultiplied
        values = values[..., :-1] * alpha
    weight = np.clip(values.mean(axis=2, keepdims=True, dtype=np.float64), 0, 1)  # exact where all are equal
    if info["format"] == "jpeg":  # its black and white are not quite
        weight = np.clip((weight - 0.02) / 0.96, 0, 1)
    if not weight.any():
        raise InputError(f"{file}: is black everywhere: paint white where the target counts")
    return weight.astype(np.float32)


def _spread_of_resampling(file, size, initial, shape, warnings):
    """Check a picture's size; returns over how many pixels resampling mixes the rendering's, 0 without.

    Editors resample with filters of at most three lobes, each as wide as the larger of the two pixels.
    """
    (rows, columns), (height, width) = size[:2], shape[:2]
    if (rows, columns) == (height, width):
        return 0
    sizes = f"{file}: is {columns}x{rows} pixels, the rendering is {width}x{height}: "
    if abs(columns * height - rows * width) > max(height, width):
        raise InputError(sizes + "another aspect; crop it, or paint on what --export-initial writes")
    if max(columns, width) > MOST_RESIZED * min(columns, width):
        raise InputError(f"{sizes}more than {MOST_RESIZED} times apart; save it at the size of the export")
    if initial is not None:  # paint is looked for
        warnings.append(
            f"{sizes}resampled, by which faint or thin paint is lost: better keep the size of the export"
        )
    return int(np.ceil(3 * max(1, height / rows, width / columns)))


def _clipped(values, info):
    """Return which values (h, w, 3) of a file say "at least so bright": a JPEG's white is not quite."""
    if info["hdr"]:
        return np.zeros(values.shape, bool)
    return values >= 1 - (2 / 255 if info["format"] == "jpeg" else 0)


def _resampled(values, alpha, clipped, shape, premultiplied):
    """Return values, alpha and clipped pixels at another size; colour is averaged by its alpha."""
    weight = alpha[..., None]
    new_alpha = fit(weight, *shape[:2]).astype(np.float64)
    new = fit(values if premultiplied else values * weight, *shape[:2]).astype(np.float64)
    if not premultiplied:
        new = new / np.where(new_alpha > 0, new_alpha, 1)
    new_alpha = np.where(new_alpha > 1 - 1e-6, 1, new_alpha)  # a sum of weights, in single precision
    return new, new_alpha[..., 0], fit(clipped, *shape[:2]) > 0


def check_finite(file: FilePath, pixels: np.ndarray, advice: str) -> None:
    """Refuse a picture (H, W, C) with values that are not finite: InputError with the place and an advice."""
    if (bad := ~np.isfinite(pixels)).any():
        raise InputError(f"{file}: pixel at {place_of(bad)} is not finite: {advice}")


def _tonemap_of(file, info, facts, declared, exported, warnings):
    """Return the tonemap of the file's values: the declared one, that of its name, or the export's."""
    unnamed = str(exported.get("tonemap", "gamma")) if declared == "auto" else declared
    name = facts.get("tonemap") or unnamed
    if info["hdr"]:
        if "tonemap" in facts and name != "linear":
            warnings.append(f"{file}: says that it is under {name[:40]!a}; it is read as linear radiance")
        return unnamed
    if name not in TONEMAPS:
        warnings.append(f"{file}: says that it is under {name[:40]!a}, which is unknown: '{unnamed}' is used")
        return unnamed
    if declared not in ("auto", name):
        raise InputError(
            f"{file}: was exported under '{name}', where target.tonemap is '{declared}': "
            f'set that to "{name}" or "auto"'
        )
    return name


def planes(file: FilePath, pixels: np.ndarray, warnings: list[str]) -> tuple[np.ndarray, np.ndarray, int]:
    """Return values (h, w, 3) and alpha (h, w), float64, and the largest code; codes become [0, 1]."""
    top = 1 if pixels.dtype == np.float32 else int(np.iinfo(pixels.dtype).max)
    values = pixels.astype(np.float64) / top
    if top == 65535 and not (pixels % 257).any():
        top = 255  # 8 bits that were written as 16
    alpha = np.ones(pixels.shape[:2])
    if pixels.shape[2] in (2, 4):
        values, alpha = values[..., :-1], np.clip(values[..., -1], 0, 1)
    if values.shape[2] == 1:
        values = values.repeat(3, axis=2)
        if not any(line.endswith("read as grey") for line in warnings):  # of OpenEXR its reader says so
            warnings.append(f"{file}: read as grey")
    if (negative := values < 0).any():
        warnings.append(f"{file}: {texels_are(negative, 'negative', unit='pixel')}: set to 0")
    return np.maximum(values, 0), alpha, top


def _coloured(picture, name):
    shown = tonemap(picture, name)
    return bool((np.ptp(shown, axis=2) > 4 / 255).mean() > 0.001)


def _laid_over(values, alpha, before, premultiplied):
    """Composite in the space that editors composite in: the file's own."""
    values = np.where(alpha > 0, values, 0)  # colour without alpha would be light that is added
    if before is None:
        return values / np.where(alpha > 0, alpha, 1) if premultiplied else values
    return (values if premultiplied else alpha * values) + (1 - alpha) * before


def _check_painted(file, painted, before, info, other, top, warnings):
    """Warn where paint is recognised badly: in a JPEG, and where nearly all would be paint."""
    if info["format"] == "jpeg":
        warnings.append(f"{file}: paint is found but roughly in a JPEG, faint paint not at all: save a PNG")
    telling = ~((before == 0) | ((before >= 1 - 0.5 / top) & (not info["hdr"]))).all(axis=2)
    share = float(painted[telling].mean()) if telling.any() else 0.0
    if share < NEARLY_ALL:
        return
    line = f"{file}: {100 * share:.0f} % of the pixels differ from the initial rendering"
    made = f" (it was made with {', '.join(f'{k} {v}' for k, v in other.items())})" if other else ""
    warnings.append(
        f"{line}: unless all of it was painted, it is of another rendering{made}; "
        "export that again with --export-initial, or give a mask"
    )


def _recognised(file, values, seen, initial, name, declared, warnings):
    """Return the tonemap under which a picture that names none is the initial rendering, but for its paint.

    That is ``name``, unless the median difference over the pixels ``seen`` is more than four times as large
    as under another, which it equals to three steps of 8 bits: editors drop the name when they save. A
    declared one holds in any case. Pixels that are clipped in the picture, or black in the rendering, are so
    under every tonemap, and do not count.
    """
    if not seen.any():
        return name
    difference = {one: np.abs(values - tonemap(np.float64(initial), one)).max(axis=2) for one in TONEMAPS}
    error = {one: float(np.median(off[seen])) for one, off in difference.items()}
    best = min(error, key=error.__getitem__)
    if error[best] > 3 / 255 or 4 * error[best] >= error[name]:
        if error[name] > 3 / 255 and declared == "auto":
            warnings.append(f"{file}: names no tonemap: read under '{name}', that of an export")
        return name
    line = f"{file}: is the initial rendering under '{best}', and read "
    if declared == "auto":
        warnings.append(f"{line}so, not under '{name}'")
        return best
    warnings.append(f"{line}under '{name}', as target.tonemap declares")
    return name
