"""What a run leaves to be looked at: preview, history, metrics, manifest and a one-file HTML report.

Pictures come in as linear radiance, ``(H, W, 3)``, and are tonemapped here for display only; nothing in this
module feeds back into an edit. Curves are inline SVG and pictures base64 PNG, so the report is one file that
opens offline, and needs no plotting library. Only the command line imports this module.

Every file is written under a temporary name and moved into place: a reader sees the old file or the new one.
"""

import base64
import csv
import datetime
import hashlib
import html
import importlib.metadata
import io
import json
import math
import os
import platform
import subprocess
from pathlib import Path

import mitsuba as mi
import numpy as np

from envedit.errors import InputError
from envedit.image import luminance
from envedit.image import tonemap as apply_tonemap
from envedit.latlong import solid_angles

NOT_FINITE = (255, 0, 255)  # NaN and Inf are shown, never painted over: no photograph has this magenta
PLACEHOLDER = (216, 216, 216)
GAP, BACKGROUND, INK = 6, (250, 250, 250), (40, 40, 40)

# 5x7 display font: five columns a glyph, least significant bit on top.
_COLUMNS = (
    "7E1111117E 7F49494936 3E41414122 7F4141221C 7F49494941 7F09090901 3E4149497A 7F0808087F 00417F4100 "
    "2040413F01 7F08142241 7F40404040 7F020C027F 7F0408107F 3E4141413E 7F09090906 3E4151215E 7F09192946 "
    "4649494931 01017F0101 3F4040403F 1F2040201F 3F4038403F 6314081463 0708700807 6151494543 3E5149453E "
    "00427F4000 4261514946 2141454B31 1814127F10 2745454539 3C4A494930 0171090503 3649494936 064949291E "
    "0000000000 0060600000 0050300000 0036360000 0808080808 08083E0808 1414141414 2010080402 2313086462 "
    "001C224100 0041221C00 4040404040 0201510906"
)
_FONT = {
    glyph: bytes.fromhex(columns)
    for glyph, columns in zip(
        "ABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789 .,:-+=/%()_?",
        _COLUMNS.split(),
        strict=True,
    )
}


# ------------------------------------------------------------------------------------------------ files


def _write_atomically(path, data: bytes) -> None:
    """Write bytes beside ``path`` and move them into place; a failure leaves an older file untouched."""
    path = Path(path)
    partial = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        try:
            partial.write_bytes(data)
            os.replace(partial, path)
        finally:
            partial.unlink(missing_ok=True)
    except OSError as error:
        why = error.strerror or error
        raise InputError(f"{path}: cannot be written ({why}).\nName a writable folder with --out.") from None


def _plain(value, where, lost):
    """Turn a nested value into what JSON knows; the places of non-finite numbers are appended to ``lost``."""
    if isinstance(value, dict):
        inside = f"{where}." if where else ""
        return {str(key): _plain(item, f"{inside}{key}", lost) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item, f"{where}[{i}]", lost) for i, item in enumerate(value)]
    if isinstance(value, np.ndarray):
        return _plain(list(value) if value.ndim else value[()], where, lost)
    if value is None or isinstance(value, (bool, str, int)):
        return value
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, np.floating) and np.isfinite(value):
        return float(str(value))  # the shortest decimal that is this float32, not its 17 digits as a double
    if isinstance(value, np.generic):
        value = value.item()
        return _plain(value, where, lost)
    if isinstance(value, float):
        if math.isfinite(value):
            return value
        lost.append(where)
        return None
    raise TypeError(f"{where}: {type(value).__name__} cannot be written as JSON")


def _write_json(path, value) -> list[str]:
    lost: list[str] = []
    text = json.dumps(_plain(value, "", lost), indent=1, allow_nan=False)
    _write_atomically(path, text.encode("ascii") + b"\n")
    return lost


def write_metrics(path, metrics: dict) -> list[str]:
    """Write ``metrics.json``; numbers are finite or null.

    Returns
    -------
    list of str
        Where a NaN or Inf became null, as ``"render.psnr"``, so that the caller can warn.

    Raises
    ------
    InputError
        If the file cannot be written.
    TypeError
        If a value is neither number, text, list, dict, path nor NumPy scalar or array.
    """
    return _write_json(path, metrics)


def write_manifest(path, manifest: dict) -> list[str]:
    """Write ``manifest.json``; returns and raises as `write_metrics`."""
    return _write_json(path, manifest)


def write_history(path, rows: list[dict]) -> list[str]:
    """Write ``history.csv``, a row an iteration.

    The columns are the union of the rows' keys in the order first seen. A value that is missing, None, NaN
    or Inf is an empty cell.

    Returns
    -------
    list of str
        Where a NaN or Inf became an empty cell, as ``"[17].loss"`` (index of the row, column).

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    lost: list[str] = []
    text = io.StringIO()
    writer = csv.DictWriter(text, _columns(rows) or ["iteration"], lineterminator="\n")
    writer.writeheader()
    writer.writerows(_plain(rows, "", lost))
    _write_atomically(path, text.getvalue().encode("utf-8", "backslashreplace"))
    return lost


def _columns(rows):
    return list(dict.fromkeys(str(key) for row in rows for key in row))


# --------------------------------------------------------------------------------------------- pictures


def _checked(image, name):
    image = np.asarray(image)
    if image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
        raise InputError(f"report: picture {name!r} has shape {image.shape}, wanted (H, W, 3)")
    return image


def _resampling(old, new):
    """Make the (new, old) matrix of one axis: area average to shrink, nearest to enlarge; rows sum to 1."""
    if new >= old:
        nearest = ((np.arange(new) + 0.5) * old / new).astype(int)
        return np.eye(old, dtype=np.float32)[nearest]
    edges = np.arange(new + 1) * (old / new)
    texel = np.arange(old)
    overlap = np.minimum(edges[1:, None], texel + 1) - np.maximum(edges[:-1, None], texel)
    return (np.clip(overlap, 0, None) * (new / old)).astype(np.float32)


def _fit(image, height, width):
    """Scale (H, W, C) to (height, width, C) in linear radiance; always a copy."""
    old_height, old_width, channels = image.shape
    image = np.array(image, np.float32)
    if old_height != height:
        image = _resampling(old_height, height) @ image.reshape(old_height, -1)
        image = image.reshape(height, old_width, channels)
    if old_width != width:
        image = np.matmul(_resampling(old_width, width), image)
    return image


def _fit_finite(image, height, width):
    """Scale what is finite, and return the (height, width) mask of pixels that hold a NaN or Inf as well."""
    finite = np.isfinite(image).all(axis=2, keepdims=True)
    if finite.all():
        return _fit(image, height, width), np.zeros((height, width), bool)
    return _fit(np.where(finite, image, 0), height, width), _fit(~finite, height, width)[..., 0] > 0


def _display(image, height, width, tonemap="gamma", exposure=0.0):
    """Scale, expose and tonemap linear radiance to 8 bits; whatever holds a NaN or Inf is magenta."""
    scaled, bad = _fit_finite(image, height, width)
    shown = apply_tonemap(scaled.astype(np.float64) * 2.0**exposure, tonemap)
    pixels = np.rint(255 * np.clip(shown, 0, 1)).astype(np.uint8)
    pixels[bad] = NOT_FINITE
    return pixels


def _text(label, width, scale):
    """(7 scale, width) mask of a one-line label, cut with two dots where it is too long for the width."""
    room = max(width // (6 * scale), 1)
    label = label if len(label) <= room else label[: max(room - 2, 0)] + ".."[: min(room, 2)]
    columns = b"".join(_FONT.get(glyph, _FONT["?"]) + b"\0" for glyph in label.upper())
    bits = np.unpackbits(np.frombuffer(columns, np.uint8)[None], axis=0, bitorder="little")[:7].astype(bool)
    mask = np.zeros((7 * scale, width), bool)
    bits = np.kron(bits, np.ones((scale, scale), bool))[:, :width]
    mask[:, : bits.shape[1]] = bits
    return mask


def _png(pixels) -> bytes:
    """Encode (H, W, 3) uint8, already tonemapped, as PNG."""
    stream = mi.MemoryStream()
    mi.Bitmap(np.ascontiguousarray(pixels)).write(stream, mi.Bitmap.FileFormat.PNG)
    return stream.raw_buffer()


def preview(path, renders, maps, tonemap="gamma", labels=True, exposure=0.0) -> None:
    """Draw ``preview.png``: a row of renderings and under each its environment map.

    Parameters
    ----------
    path : path
        File to write.
    renders, maps : dict of str to array or None
        Linear radiance, ``(H, W, 3)``, in the order of the columns, usually ``initial``, ``target``,
        ``edited``. A map stands under the rendering of the same name; one that is missing or None (the true
        map is not always known) leaves a grey rectangle. Maps are drawn 2:1.
    tonemap : str
        A name of `envedit.image.TONEMAPS`.
    labels : bool
        Write the names above the columns.
    exposure : float
        Exposure of the maps in stops, on top of the tonemap; renderings are never exposed.

    Raises
    ------
    InputError
        If a picture is not ``(H, W, 3)``, there is none, or the file cannot be written.
    ConfigError
        If there is no such tonemap.
    """
    scale = 2  # of the labels: pixels a dot
    names = list(dict.fromkeys([*renders, *maps]))
    renders = {name: _checked(image, name) for name, image in renders.items() if image is not None}
    maps = {name: _checked(image, name) for name, image in maps.items() if image is not None}
    if not renders and not maps:
        raise InputError("report: no picture to preview")
    # Columns of 214 to 768 pixels whatever the run's size; small pictures are enlarged by a whole factor.
    widest = max((image.shape[1] for image in renders.values()), default=512)
    width = min(widest * max(1, round(320 / widest)), 768)
    heights = {
        name: min(max(round(width * image.shape[0] / image.shape[1]), 1), 4 * width)
        for name, image in renders.items()
    }
    top = 7 * scale + GAP if labels else 0
    render_height = max(heights.values(), default=0)
    map_top = GAP + top + render_height + GAP
    canvas = np.empty((map_top + width // 2 + GAP, GAP + len(names) * (width + GAP), 3), np.uint8)
    canvas[:] = BACKGROUND
    for i, name in enumerate(names):
        column = slice(GAP + i * (width + GAP), (i + 1) * (width + GAP))
        if labels:
            canvas[GAP : GAP + 7 * scale, column][_text(str(name), width, scale)] = INK
        if name in renders:
            rows = slice(GAP + top, GAP + top + heights[name])
            canvas[rows, column] = _display(renders[name], heights[name], width, tonemap)
        else:
            canvas[GAP + top : map_top - GAP, column] = PLACEHOLDER
        rows = slice(map_top, map_top + width // 2)
        canvas[rows, column] = PLACEHOLDER
        if name in maps:
            canvas[rows, column] = _display(maps[name], width // 2, width, tonemap, exposure)
    _write_atomically(path, _png(canvas))


# Blue, white, red: where a is darker than b, equal, brighter.
_DIVERGING = np.array([[33, 102, 172], [146, 197, 222], [247, 247, 247], [244, 165, 130], [178, 24, 43]])


def difference_image(a, b, kind="tonemapped", tonemap="gamma", scale=None):
    """Draw the difference a - b in luminance: red where a is brighter, blue where it is darker.

    Parameters
    ----------
    a, b : array
        Linear radiance, ``(H, W, 3)``.
    kind : str
        ``"tonemapped"``: difference of the luminance of the tonemapped pictures, for renderings.
        ``"stops"``: log2 of the ratio of luminances, for maps, whose sun the tonemap clips; both are
        lifted by a thousandth of b's median so that a black texel is dark and not minus infinity.
    tonemap : str
        A name of `envedit.image.TONEMAPS`, for ``"tonemapped"``.
    scale : float, optional
        Difference drawn in full red or blue. By default the 99.5th percentile, rounded up to 1, 2 or 5
        times a power of ten, and at least 0.01 (tonemapped) or 0.1 (stops): rounding is no edit.

    Returns
    -------
    pixels : array
        ``(H, W, 3)`` uint8; magenta where a or b is not finite.
    scale : float
        The scale used, to be printed beside the picture.

    Raises
    ------
    InputError
        If the shapes differ.
    """
    a, b = _checked(a, "a"), _checked(b, "b")
    if a.shape != b.shape:
        raise InputError(f"report: cannot subtract a picture of shape {b.shape} from one of {a.shape}")
    finite = np.isfinite(a).all(axis=2) & np.isfinite(b).all(axis=2)
    a, b = (np.where(finite[..., None], image, 0).astype(np.float64) for image in (a, b))
    if kind == "stops":
        la, lb = np.maximum(luminance(a), 0), np.maximum(luminance(b), 0)
        lift = max(1e-3 * float(np.median(lb[finite])) if finite.any() else 0.0, 1e-9)
        difference, least = np.log2((la + lift) / (lb + lift)), 0.1
    elif kind == "tonemapped":
        difference, least = luminance(apply_tonemap(a, tonemap)) - luminance(apply_tonemap(b, tonemap)), 0.01
    else:
        raise ValueError(f"difference_image: kind {kind!r} is neither 'tonemapped' nor 'stops'")
    if scale is None:
        typical = float(np.percentile(np.abs(difference[finite]), 99.5)) if finite.any() else 0.0
        scale = _round_up(max(typical, least))
    position = np.clip(difference / scale, -1, 1) * 2 + 2
    pixels = np.stack([np.interp(position, np.arange(5), _DIVERGING[:, c]) for c in range(3)], axis=-1)
    pixels = np.rint(pixels).astype(np.uint8)
    pixels[~finite] = NOT_FINITE
    return pixels, float(scale)


def _round_up(value):
    """Smallest of 1, 2, 5 times a power of ten that is not below ``value`` > 0."""
    decade = 10.0 ** math.floor(math.log10(value))
    return next(m * decade for m in (1, 2, 5, 10) if m * decade >= value * (1 - 1e-9))


# ----------------------------------------------------------------------------------------------- curves

_PALETTE = ("#22223b", "#c8553d", "#2a7f9e", "#588157", "#b5838d", "#8d6a9f", "#d4a017", "#6c757d")
_TIMES = ("_s", "_ms", "time", "seconds")
_NOT_LOSSES = ("iteration", "step", "epoch", "lr", "non_finite", "skipped")


def _number(value):
    """Read a cell as a finite float, or None for whatever else it may hold."""
    if isinstance(value, (bool, str)) or value is None:
        return None
    try:
        value = float(value)
    except (TypeError, ValueError, OverflowError):
        return None
    return value if math.isfinite(value) else None


def _ticks(low, high, count, least=0.0):
    step = max(_round_up((high - low) / count), least)
    first = math.ceil(low / step - 1e-9)
    return [k * step for k in range(first, math.floor(high / step + 1e-9) + 1)]


def _log_ticks(low, high):
    """List (log10 position, label) pairs: whole decades, or round numbers where there are not two of them."""
    first, last = math.ceil(low - 1e-9), math.floor(high + 1e-9)
    if last > first:
        decades = range(first, last + 1, -(-(last - first) // 8))
        return [(d, f"1e{d}" if abs(d) > 3 else f"{10.0**d:g}") for d in decades]
    decade = math.floor(low)  # taken out, so that 1e-320 and 1e300 are as good as 1
    plain = abs(decade) < 300
    return [
        (decade + math.log10(v), f"{v * 10.0**decade:.4g}" if plain else f"{v:.4g}e{decade}")
        for v in _ticks(10 ** (low - decade), 10 ** (high - decade), 5)
        if v > 0
    ]


def _thin(points, most=600):
    """Keep lowest and highest of every stretch so that a long run stays a small file and no spike is lost."""
    size = -(-len(points) // most)
    if size < 3:
        return points
    kept = []
    for start in range(0, len(points), size):
        chunk = [p for p in points[start : start + size] if p[1] is not None]
        ends = {min(chunk, key=lambda p: p[1]), max(chunk, key=lambda p: p[1])} if chunk else {points[start]}
        kept += sorted(ends, key=lambda p: p[0])
    return kept


def curves_svg(rows: list[dict], width=860, height=340) -> str:
    """Draw every loss column of a history on a logarithmic axis against the iteration, as an SVG element.

    Columns that are no losses (iteration, learning rates, times) are left out, and so is what a logarithm
    cannot show: a value that is missing, not finite, zero or negative interrupts its line. The axis ends
    twelve decades below the largest value. An empty string where there is nothing to draw.
    """
    series = {}
    for name in _columns(rows):
        if name in _NOT_LOSSES or name.startswith(("lr_", "weight")) or name.endswith(_TIMES):
            continue
        points = []
        for i, row in enumerate(rows):
            x, y = _number(row.get("iteration", i)), _number(row.get(name))
            points.append((float(i) if x is None else x, math.log10(y) if y is not None and y > 0 else None))
        if any(y is not None for _, y in points):
            series[name] = _thin(points)
    if not series:
        return ""
    values = [y for points in series.values() for _, y in points if y is not None]
    low, high = max(min(values), max(values) - 12), max(values)
    margin = max(0.04 * (high - low), 0.01)
    low, high = low - margin, high + margin
    steps = [x for points in series.values() for x, _ in points]
    start, end = min(steps), max(steps)
    end = end if end > start else start + 1

    left, right, top, bottom = 64, width - 190, 12, height - 44

    def across(x):
        return left + (x - start) / (end - start) * (right - left)

    def down(y):
        return bottom - (max(y, low) - low) / (high - low) * (bottom - top)

    out = [f'<svg class="curves" viewBox="0 0 {width} {height}" role="img" aria-label="losses by iteration">']
    for y, label in _log_ticks(low, high):
        out.append(f'<line class="grid" x1="{left}" x2="{right}" y1="{down(y):.1f}" y2="{down(y):.1f}"/>')
        out.append(f'<text x="{left - 8}" y="{down(y) + 4:.1f}" text-anchor="end">{label}</text>')
    for x in _ticks(start, end, 8, least=1):
        out.append(f'<path class="axis" d="M{across(x):.1f} {bottom}v5"/>')
        out.append(f'<text x="{across(x):.1f}" y="{bottom + 19}" text-anchor="middle">{x:g}</text>')
    out.append(f'<path class="axis" d="M{left} {top}V{bottom}H{right}"/>')
    out.append(f'<text x="{(left + right) / 2:.0f}" y="{height - 6}" text-anchor="middle">iteration</text>')
    # The total is drawn last, on top of its terms, and named first.
    for i, (name, points) in reversed(list(enumerate(series.items()))):
        colour, pen, drawing = _PALETTE[i % len(_PALETTE)], [], False
        for x, y in points:
            if y is not None:  # h0 makes a lone point visible
                pen.append(f"{'L' if drawing else 'M'}{across(x):.1f} {down(y):.1f}{'' if drawing else 'h0'}")
            drawing = y is not None
        total = ' class="total"' if name in ("loss", "total") else ""
        out.append(f'<path{total} stroke="{colour}" d="{"".join(pen)}"/>')
        if i < 14:
            last = next((y for _, y in reversed(points) if y is not None), low)
            label = name if len(name) <= 14 else name[:13] + "…"
            level = top + 10 + 21 * i
            out.append(f'<rect x="{right + 16}" y="{level - 6}" width="16" height="3" fill="{colour}"/>')
            out.append(f'<text x="{right + 38}" y="{level}">{_escape(label)} {10.0**last:.3g}</text>')
    return "\n".join([*out, "</svg>"])


# --------------------------------------------------------------------------------------------- manifest


def manifest(config_summary: dict, inputs: dict, variant: str) -> dict:
    """Collect what it takes to explain a run later: versions, machine, seeds, and the digests of its inputs.

    Parameters
    ----------
    config_summary : dict
        Whatever of the configuration is worth repeating; its keys that name a seed are listed as ``seeds``.
    inputs : dict of str to path or None
        Files read, by role. None is left out; a file that cannot be read any more is listed with the reason.
    variant : str
        Mitsuba variant.

    Returns
    -------
    dict
        Ready for `write_manifest`. ``commit`` is None unless the package runs from its own git checkout.
    """
    versions = {"envedit": _envedit_version(), "python": platform.python_version()}
    for package in ("mitsuba", "drjit", "numpy", "OpenEXR"):
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            versions[package] = None
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return {
        "time_utc": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "versions": versions,
        "commit": _commit(Path(__file__).resolve().parent.parent),
        "variant": variant,
        "llvm": _llvm() if variant.startswith("llvm") else None,
        "platform": platform.platform(),
        "cores": {"usable": usable, "machine": os.cpu_count()},
        "seeds": {key: value for key, value in config_summary.items() if "seed" in str(key)},
        "inputs": {role: _digest(path) for role, path in inputs.items() if path is not None},
        "config": config_summary,
    }


def _envedit_version():
    import envedit  # here: the package may import its modules before it has its version

    return getattr(envedit, "__version__", None)


def _digest(path):
    try:
        with open(path, "rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
            return {"path": str(path), "bytes": os.fstat(file.fileno()).st_size, "sha256": digest}
    except (OSError, ValueError) as error:
        return {"path": str(path), "bytes": None, "sha256": None, "error": str(error)}


def _commit(root):
    """Commit of the checkout whose top is ``root``, with ``-dirty`` after it; None for any other folder."""

    def git(*arguments):
        command = ["git", "--no-optional-locks", "-C", str(root), *arguments]
        return subprocess.run(command, capture_output=True, text=True, timeout=10, check=True).stdout.strip()

    try:
        # An installed package may lie inside somebody else's repository: that commit would be a lie.
        top, commit = git("rev-parse", "--show-toplevel", "HEAD").splitlines()
        if Path(top).resolve() != Path(root).resolve():
            return None
        return commit + ("-dirty" if git("status", "--porcelain", "--untracked-files=no") else "")
    except (OSError, ValueError, subprocess.SubprocessError):
        return None


def _llvm():
    """Version and file of the LLVM that Dr.Jit loaded, as far as they can be had."""
    try:
        from drjit.detail import llvm_version

        version = ".".join(map(str, llvm_version()))
    except Exception:  # an optional line of the manifest must not end a finished run
        version = None
    try:
        loaded = Path("/proc/self/maps").read_text().splitlines()
        path = next((line.split(maxsplit=5)[-1] for line in loaded if "/libLLVM" in line), None)
    except OSError:
        path = os.environ.get("DRJIT_LIBLLVM_PATH")
    return {"version": version, "path": path}


# ----------------------------------------------------------------------------------------------- report

_STYLE = """
:root { --ink: #22223b; --soft: #6b6b7b; --line: #e4e4ea; --alarm: #a63d2f; }
* { box-sizing: border-box; }
body { font: 15px/1.55 system-ui, -apple-system, "Segoe UI", "DejaVu Sans", sans-serif; color: var(--ink);
  background: #fbfbfc; margin: 0 auto; max-width: 1120px; padding: 2.5rem 1.5rem 4rem;
  overflow-wrap: anywhere; }
h1 { font-size: 1.6rem; font-weight: 600; margin: 0 0 .3rem; }
h2 { font-size: 1.05rem; font-weight: 600; margin: 2.6rem 0 .8rem; padding-top: .9rem;
  border-top: 1px solid var(--line); }
p { margin: .4rem 0; } .soft, figcaption { color: var(--soft); font-size: .87rem; }
.verdict { font-size: 1.1rem; } .alarm { color: var(--alarm); }
.warnings { border-left: 3px solid var(--alarm); background: #fff; margin: 1.2rem 0; padding: .6rem 1rem; }
ul { margin: .4rem 0; padding-left: 1.2rem; }
.grid { display: grid; gap: 1rem; align-items: end; }
figure { margin: 0; } figcaption { margin: .3rem 0 0; }
figure img { display: block; width: 100%; border-radius: 3px; }
img.small { image-rendering: pixelated; }
.unknown { aspect-ratio: 2; background: #e9e9ee; border-radius: 3px; color: var(--soft);
  display: grid; place-items: center; font-size: .87rem; }
.scale { height: 8px; border-radius: 2px; margin-top: .5rem;
  background: linear-gradient(90deg, #2166ac, #92c5de, #f7f7f7, #f4a582, #b2182b); }
.ends { display: flex; justify-content: space-between; color: var(--soft); font-size: .8rem; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; min-width: 22rem;
  overflow-wrap: normal; }
th { font-weight: 500; color: var(--soft); } th, td { text-align: right; padding: .28rem .9rem; }
th:first-child, td:first-child { text-align: left; padding-left: 0; }
td:has(.bar) { text-align: left; } tbody tr td { border-top: 1px solid var(--line); }
.bar { display: inline-block; height: .55rem; background: #b9c3d6; border-radius: 2px;
  vertical-align: middle; }
svg.curves { width: 100%; background: #fff; border: 1px solid var(--line); border-radius: 3px; }
svg.curves text { font-size: 12px; fill: var(--soft); }
svg.curves path { fill: none; stroke-width: 1.4; stroke-linecap: round; stroke-linejoin: round; }
svg.curves path.total { stroke-width: 2.4; }
svg.curves .axis { stroke: #9a9aa8; } svg.curves line.grid { stroke: var(--line); }
pre { background: #fff; border: 1px solid var(--line); border-radius: 3px; padding: .9rem; font-size: .8rem;
  white-space: pre-wrap; }
summary { cursor: pointer; }
@media (max-width: 640px) { .grid { grid-template-columns: 1fr !important; } }
"""


def _escape(text):
    """Escape text for HTML and SVG, control characters included."""
    return html.escape("".join(c if c >= " " or c in "\n\t" else "\ufffd" for c in str(text)))


def _show(value, digits=4):
    """Print a number of a table; a missing one, or one that is not finite, is a dash."""
    number = _number(value)
    if value is None or isinstance(value, (float, np.floating)) and number is None:
        return "–"
    if number is None:
        return _escape(value)
    return f"{number:.0f}" if number == int(number) and abs(number) < 1e6 else f"{number:.{digits}g}"


def _table(head, body):
    """Build a table of cells that are HTML already, its head and first column text."""
    cells = "".join(f"<th>{_escape(cell)}</th>" for cell in head)
    lines = [
        f"<tr><td>{_escape(first)}</td>" + "".join(f"<td>{cell}</td>" for cell in rest) + "</tr>"
        for first, *rest in body
    ]
    body = "\n".join(lines)
    return f'<div class="scroll"><table><thead><tr>{cells}</tr></thead><tbody>{body}</tbody></table></div>'


def _figure(pixels, caption, below=""):
    picture = base64.b64encode(_png(pixels)).decode("ascii")
    caption = _escape(caption)
    small = ' class="small"' if pixels.shape[1] < 400 else ""  # texels with edges where they are enlarged
    return (
        f'<figure><img{small} alt="{caption}" src="data:image/png;base64,{picture}">{below}'
        f"<figcaption>{caption}</figcaption></figure>"
    )


def _figure_of(pictures, name, what, tonemap):
    if name in pictures:
        return _figure(_shrunk(pictures[name], tonemap), f"{name}, {what}")
    return f'<div class="unknown">{_escape(f"{name}, {what}: not known")}</div>'


def _grid(figures):
    columns = max(len(figures), 3)
    return f'<div class="grid" style="grid-template-columns:repeat({columns},1fr)">{"".join(figures)}</div>'


def _shrunk(image, tonemap, exposure=0.0, widest=1024):
    """Tonemap a picture at its own size, or at 1024 pixels where it is wider."""
    height, width = image.shape[:2]
    factor = min(1.0, widest / width)
    return _display(image, max(round(height * factor), 1), max(round(width * factor), 1), tonemap, exposure)


def _difference_figure(a, b, caption, kind, tonemap):
    factor = min(1.0, 1024 / a.shape[1])
    size = max(round(a.shape[0] * factor), 1), max(round(a.shape[1] * factor), 1)
    (a, bad_a), (b, bad_b) = _fit_finite(a, *size), _fit_finite(b, *size)
    a[bad_a | bad_b] = np.nan
    pixels, scale = difference_image(a, b, kind, tonemap)
    unit = " stops" if kind == "stops" else ""
    ends = f'<div class="ends"><span>−{scale:g}{unit}</span><span>0</span><span>+{scale:g}{unit}</span></div>'
    return _figure(pixels, caption, f'<div class="scale"></div>{ends}')


def _map_statistics(image):
    """Fill the table's cells for one map: luminances (linear) and the peak's place."""
    bad = ~np.isfinite(image).all(axis=2)
    light = np.where(bad, 0, luminance(np.where(bad[..., None], 0, image).astype(np.float64)))
    height, width = light.shape
    weight = np.broadcast_to(np.reshape(solid_angles(height, width), (height, 1)), light.shape)
    row, column = np.unravel_index(np.argmax(light), light.shape)
    position = f"{row}, {column}" if light[row, column] > 0 else "–"
    mean = float((light * weight).sum() / weight.sum())
    cells = [_show(light.max()), position, _show(mean), _show(float(np.median(light))), _show(light.min())]
    return [f"{width} × {height}", *cells, f'<span class="alarm">{bad.sum()}</span>' if bad.any() else "0"]


def _verdict(metrics):
    def psnr(table):
        return _number((metrics.get(table) or {}).get("psnr"))

    before, after, true_map = psnr("initial"), psnr("render"), psnr("envmap")
    total = _number((metrics.get("timing") or {}).get("total_s"))

    def decibel(value):
        return "unknown" if value is None else f"{value:.1f} dB"

    parts = [f"Rendering against the target: {decibel(before)} → <strong>{decibel(after)}</strong> PSNR"]
    parts += [f"map against the true one: {decibel(true_map)}"] if true_map is not None else []
    parts += [f"{total:.1f} s in total"] if total is not None else []
    line = f'<p class="verdict">{" · ".join(parts)}</p>'
    if before is not None and after is not None and after < before:
        line += '<p class="alarm">The edited rendering is further from the target than the unedited one.</p>'
    return line


def write_report(
    path,
    *,
    title,
    config_toml,
    metrics,
    manifest,
    history,
    renders,
    maps,
    warnings=(),
    notes=(),
    tonemap="gamma",
) -> None:
    """Write ``report.html``: verdict, pictures, differences, curves, tables and configuration in one file.

    Parameters
    ----------
    path : path
        File to write.
    title : str
        Heading of the page.
    config_toml : str
        The resolved configuration.
    metrics, manifest : dict
        As written by `write_metrics` and `write_manifest`; whatever is missing is shown as a dash.
    history : list of dict
        A row an iteration; may be empty.
    renders, maps : dict of str to array or None
        As for `preview`. Differences are drawn between the names ``initial``, ``target`` and ``edited``.
    warnings, notes : sequence of str
        What the user should know, and the choices made for settings left at "auto".
    tonemap : str
        A name of `envedit.image.TONEMAPS`, for the pictures.

    Raises
    ------
    InputError
        If a picture is not ``(H, W, 3)`` or the file cannot be written.
    ConfigError
        If there is no such tonemap.
    """
    names = list(dict.fromkeys([*renders, *maps]))
    renders = {name: _checked(image, name) for name, image in renders.items() if image is not None}
    maps = {name: _checked(image, name) for name, image in maps.items() if image is not None}
    lost: list[str] = []
    metrics = _plain(metrics, "metrics: ", lost)
    _plain(history, "history", lost)
    warnings = [str(warning) for warning in warnings]
    if lost:
        shown = ", ".join(lost[:5]) + (f" and {len(lost) - 5} more" if len(lost) > 5 else "")
        warnings.append(f"Not finite, shown as missing: {shown}.")
    for kind, pictures in (("rendering", renders), ("map", maps)):
        for name, image in pictures.items():
            if bad := int((~np.isfinite(image).all(axis=2)).sum()):
                warnings.append(f"{kind} {name}: {bad} pixels are not finite, drawn in magenta.")

    # Pictures
    figures = [_figure_of(renders, name, "rendering", tonemap) for name in names]
    map_figures = [_figure_of(maps, name, "environment map", tonemap) for name in names]
    differences = []
    for pictures, other in ((renders, "target"), (maps, "initial"), (maps, "target")):
        if "edited" not in pictures or other not in pictures:
            continue
        kind, what = ("stops", "maps") if pictures is maps else ("tonemapped", "renderings")
        a, b = pictures["edited"], pictures[other]
        if a.shape != b.shape:
            sizes = f"{a.shape[:2]} and {b.shape[:2]}"
            warnings.append(f"{what} edited and {other} differ in size, {sizes}: no difference is drawn.")
            continue
        how = "luminance in stops" if kind == "stops" else "tonemapped luminance"
        differences.append(_difference_figure(a, b, f"{what}, edited − {other}: {how}", kind, tonemap))

    # Tables
    quality = [metrics.get(table) or {} for table in ("initial", "render", "envmap")]
    measures = {"psnr": "PSNR (dB)", "ssim": "SSIM", "mse": "MSE", "lpips": "LPIPS"}
    quality_rows = [[name, *(_show(table.get(key)) for table in quality)] for key, name in measures.items()]
    others = [(key, value) for key, value in metrics.items() if not isinstance(value, (dict, type(None)))]
    others += [(f"fit {key}", value) for key, value in (metrics.get("fit") or {}).items()]
    timing = {key: _number(value) for key, value in (metrics.get("timing") or {}).items()}
    longest = max((t for key, t in timing.items() if t and key.endswith("_s")), default=0)
    timing_rows = []
    for key, seconds in timing.items():
        unit = "ms" if key.endswith("_ms") else "s"
        share = max(seconds, 0) / longest * 12 if seconds and longest and unit == "s" else 0
        label = key.removesuffix("_ms").removesuffix("_s").replace("_", " ")
        cell = f"{_show(seconds, 3)} {unit}" if seconds is not None else "–"
        timing_rows.append([label, cell, f'<span class="bar" style="width:{share:.2f}rem"></span>'])
    map_rows = [[name, *_map_statistics(maps[name])] for name in names if name in maps]
    map_head = ["map", "size", "peak luminance", "at row, column", "mean", "median", "lowest", "not finite"]

    # The page
    curves = curves_svg(history) or f'<p class="soft">No loss to draw in {len(history)} rows of history.</p>'
    manifest_text = json.dumps(_plain(manifest, "", []), indent=1, ensure_ascii=False)
    page = [
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>{_escape(title)}</title><style>{_STYLE}</style></head><body>",
        f"<h1>{_escape(title)}</h1>{_verdict(metrics)}",
        f'<div class="warnings"><strong>Warnings</strong>{_list(warnings)}</div>' if warnings else "",
        f"<h2>Renderings and maps</h2>{_grid(figures)}<p></p>{_grid(map_figures)}" if names else "",
        f'<p class="soft">Tonemap of the pictures: {_escape(tonemap)}.</p>' if names else "",
        f"<h2>Differences</h2>{_grid(differences)}" if differences else "",
        f"<h2>Losses</h2>{curves}",
        "<h2>Quality</h2>",
        _table(["", "initial rendering", "edited rendering", "edited map"], quality_rows),
        _table(["", ""], [[k.replace("_", " "), _show_list(v)] for k, v in others]) if others else "",
        f"<h2>Environment maps</h2>{_table(map_head, map_rows)}" if map_rows else "",
        '<p class="soft">Luminances are linear; the mean is over the sphere.</p>' if map_rows else "",
        f"<h2>Time</h2>{_table(['', '', ''], timing_rows)}" if timing_rows else "",
        f"<h2>Choices made</h2>{_list(notes)}" if notes else "",
        f"<h2>Configuration</h2><pre>{_escape(config_toml)}</pre>",
        f"<h2>Manifest</h2><details><summary>Versions, machine, seeds, inputs</summary>"
        f"<pre>{_escape(manifest_text)}</pre></details>",
        "</body></html>\n",
    ]
    _write_atomically(path, "\n".join(part for part in page if part).encode("utf-8", "backslashreplace"))


def _list(items):
    return "<ul>" + "".join(f"<li>{_escape(item)}</li>" for item in items) + "</ul>"


def _show_list(value):
    return ", ".join(_show(item) for item in value) if isinstance(value, list) else _show(value)
