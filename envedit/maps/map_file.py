"""The file of a map: read at its own resolution, and written in its own format and colour space."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from envedit import config, inputs
from envedit.core import primaries
from envedit.core.errors import ConfigError, texels_are
from envedit.core.radiance import HALF_MAX
from envedit.core.rows import bands
from envedit.core.types import FilePath
from envedit.images import images
from envedit.inputs import InputMap

EXR, HDR = ".exr", ".hdr"
"""Endings of the files that are written."""


def read(path: FilePath, repair: bool = False) -> InputMap:
    """Read a map at the resolution of its file; errors as of :func:`.images.load_envmap`.

    OpenEXR or Radiance; PNG and JPEG are read as well. ``repair`` replaces texels that are not finite instead
    of refusing them. Of the result ``radiance`` is (H, W, 3) float32 in Rec. 709, and ``as_stored`` turns
    edited radiance into the file's colours.
    """
    return inputs.read_file(os.fsdecode(path), None, config.Input(repair=repair), 1.0)


def radiance_of(input_map: InputMap) -> np.ndarray:
    """Return :attr:`.InputMap.radiance` (H, W, 3), which the map does not keep in another colour space."""
    return replace(input_map).radiance


def as_stored(edited: np.ndarray, like: InputMap) -> np.ndarray:
    """Return edited radiance (H, W, 3) in the colours of a map's file, as :meth:`.InputMap.as_stored`.

    A map of another size has texels of its own, none of which are kept.
    """
    if like.chromaticities is None:
        return edited
    result = np.empty(edited.shape, np.float32)
    stored = like.stored if like.stored.shape == edited.shape else np.zeros_like(edited)
    for rows in bands(len(edited)):
        result[rows] = replace(like, stored=stored[rows]).as_stored(edited[rows])
    return result


def output_path(
    requested: FilePath | None, word: str, sources: Iterable[FilePath], overwrite: bool = False
) -> Path:
    """Return the file that a result goes to: as requested, or ``SOURCE_WORD`` in the working folder.

    >>> output_path(None, "adjusted", ["skies/sky.hdr"])
    PosixPath('sky_adjusted.hdr')

    ``sources`` are the files that are read, ``word`` says what has been done to them. A file that is not
    requested has the format of the first source (PNG and JPEG: .exr), and a number if there is one already.
    ConfigError if a requested one is a source, does not end in .exr or .hdr, or exists already and may not be
    replaced.
    """
    names = [os.fsdecode(source) for source in sources]
    if requested is None:
        stem = f"{Path(names[0]).stem}_{word}" if names else word
        ending = HDR if names and names[0].lower().endswith(HDR) else EXR
        path = Path(stem + ending)
        number = 1
        while path.exists():
            number += 1
            path = Path(f"{stem}_{number}{ending}")
        return path
    path = Path(os.fsdecode(requested))
    if path.suffix.lower() not in (EXR, HDR):
        raise ConfigError(f"{path}: got a name that ends in {path.suffix!r}, expected .exr or .hdr")
    if os.path.realpath(path) in {os.path.realpath(name) for name in names}:
        raise ConfigError(f"{path}: is read by this command: give another name with --out")
    if path.exists() and not overwrite:
        raise ConfigError(f"{path}: exists already: give another name with --out, or --overwrite")
    return path


def write(
    path: FilePath,
    values: np.ndarray,
    like: InputMap | None = None,
    half: bool | None = None,
    rec709: bool = False,
) -> list[str]:
    """Write a map, by the ending of its name as OpenEXR or Radiance; returns warnings: what half cannot hold.

    ``values`` (H, W, 3) are linear, in the colours of ``like``, the map that was read, whose chromaticities
    are those of the result; with ``rec709`` they are converted. None: Rec. 709. ``half`` is for OpenEXR; by
    default as the file of ``like``, otherwise float. NumericalError if a value is not finite, InputError if
    the file cannot be written.
    """
    path = Path(os.fsdecode(path))
    space = None if like is None else like.chromaticities
    if rec709 and space is not None:
        values = primaries.converted(values, primaries.to_rec709(space))
        space = None
    if path.suffix.lower() == HDR:
        images.write_hdr(path, values, space)
        return []
    marks = {} if like is None else {"source": like.source}
    if half is None:
        half = like is not None and like.half

    # ---- What half cannot hold is cut
    warnings: list[str] = []
    over = np.asarray((values > HALF_MAX).any(axis=2))
    if half and over.any():
        lost = np.maximum(values[over] - HALF_MAX, 0).sum(dtype=np.float64) / values.sum(dtype=np.float64)
        values = np.minimum(values, np.float32(HALF_MAX))
        warnings.append(
            f"{path}: {texels_are(over, f'brighter than {HALF_MAX:g}, the largest half')}; cut there: "
            f"{100 * lost:.2g} % of the sum of all texels is lost; write floats or .hdr, or darken the map"
        )
    images.write_exr(path, values, marks, half=half, chromaticities=space)
    return warnings
