r"""The configuration: TOML to frozen dataclasses, presets, overrides. The only module that knows TOML.

A value comes from the last of these that gives it: the dataclass default, the preset, the file, a
``--set table.key=value`` override. Each layer is checked by itself, so that an error names the place the
value came from; what depends on two keys at once is checked when the dataclasses are built, however they are.
Whether input files exist is not looked at here: the modules that read them say so.

>>> config = loads("[fit]\nepochs = 100", preset="draft", overrides=["seed=3"])
>>> config.fit.epochs, config.representation.hidden, config.seed
(100, 64, 3)
"""

from __future__ import annotations

import difflib
import json
import math
import re
import tomllib
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, fields
from numbers import Integral, Real
from os import PathLike, fspath
from pathlib import Path
from typing import Any

from .errors import ConfigError

Ramp = float | tuple[float, float]

TONEMAPS = ("gamma", "srgb", "log", "linear")
_FLOAT32_TINY, _FLOAT32_MAX = 2.0**-126, (2 - 2.0**-23) * 2.0**127
_MOST_BYTES = 1 << 20  # more than any configuration; an EXR given by mistake is not read to its end
_MOST_DIM = 16384


class _WantedError(Exception):
    """A value is refused; the text says what is wanted instead."""


# ---- checks: value -> normalised value, or _WantedError ----------------------------------------------------


def _string(value: Any) -> str:
    if isinstance(value, PathLike):
        value = fspath(value)
    if not isinstance(value, str):
        raise _WantedError("a string")
    # A NUL cannot be in a path, a lone surrogate (an argument that is not UTF-8) cannot be written to a file.
    if "\0" in value or any("\ud800" <= c <= "\udfff" for c in value):
        raise _WantedError("a string of valid characters, without NUL")
    return str(value)


def _boolean(value: Any) -> bool:
    if not isinstance(value, bool):
        raise _WantedError("true or false")
    return value


def _choice(*names: str) -> Callable:
    def check(value: Any) -> str:
        if isinstance(value, str) and value in names:
            return value
        close = difflib.get_close_matches(value[:60], names, 1) if isinstance(value, str) else ()
        hint = f"; did you mean {close[0]}?" if close else ""
        raise _WantedError(f"one of {', '.join(names)}{hint}")

    return check


def _integer(low: int, high: int, even: bool = False) -> Callable:
    def check(value: Any) -> int:
        whole = isinstance(value, Integral) and not isinstance(value, bool)
        if not whole or not low <= value <= high or (even and value % 2):
            raise _WantedError(f"an {'even ' if even else ''}integer from {low} to {high}")
        return int(value)

    return check


def _number(low: float, high: float = math.inf, positive: bool = False) -> Callable:
    """Accept a finite number in [low, high] that single precision can hold."""
    text = f"a number above {low:g}" if positive else f"a number of at least {low:g}"
    text = text if math.isinf(high) else f"{text} and at most {high:g}"

    def check(value: Any) -> float:
        if not isinstance(value, Real) or isinstance(value, bool):
            raise _WantedError(text)
        try:
            number = float(value)
        except (OverflowError, ValueError):
            raise _WantedError("a finite number") from None
        if not math.isfinite(number):
            raise _WantedError("a finite number")
        if abs(number) > _FLOAT32_MAX or 0 < abs(number) < _FLOAT32_TINY:
            raise _WantedError("a number that single precision can hold")
        if not low <= number <= high or (positive and number == low):
            raise _WantedError(text)
        return number

    return check


def _or_auto(check: Callable) -> Callable:
    def check_auto(value: Any) -> Any:
        try:
            return value if isinstance(value, str) and value == "auto" else check(value)
        except _WantedError as error:
            raise _WantedError(f'{error}, or "auto"') from None

    return check_auto


def _weight(value: Any) -> Ramp:
    """Accept a constant weight, or the two ends of a geometric ramp."""
    wanted = "a number of at least 0, or [start, end], both above 0"
    try:
        if isinstance(value, list | tuple):
            start, end = value
            return _number(0, positive=True)(start), _number(0, positive=True)(end)
        return _number(0)(value)
    except (ValueError, _WantedError):
        raise _WantedError(wanted) from None


def _rows(value: Any) -> str | tuple[int, int]:
    try:
        if isinstance(value, list | tuple):
            first, last = map(_integer(0, _MOST_DIM), value)
            if first <= last:
                return first, last
        elif isinstance(value, str):
            return _choice("upper", "all")(value)
    except (ValueError, _WantedError):
        pass
    raise _WantedError('"upper", "all" or [first, last], rows from 0 at the zenith, last included')


def _representation(value: Any) -> str:
    if isinstance(value, str) and value == "layers":
        raise _WantedError("siren, pixels or log-pixels: the layers representation comes later")
    return _choice("siren", "pixels", "log-pixels")(value)


def _plain(value: Any, depth: int = 8) -> Any:
    """Accept what the writer below can write: strings, numbers, booleans, and lists and tables of them."""
    if isinstance(value, bool):
        return value
    if isinstance(value, str):
        return _string(value)
    if isinstance(value, Integral):
        return _integer(-(2**63), 2**63 - 1)(value)
    if isinstance(value, Real):
        return _number(-math.inf)(value)
    if depth and isinstance(value, list | tuple):
        return [_plain(v, depth - 1) for v in value]
    if depth and isinstance(value, dict):
        return {_string(k): _plain(v, depth - 1) for k, v in value.items()}
    raise _WantedError("strings, finite numbers, true or false, and not too deep lists and tables of them")


def _strokes(value: Any) -> tuple[dict, ...]:
    if not isinstance(value, list | tuple) or not all(isinstance(v, dict) for v in value):
        raise _WantedError("a list of tables")
    return tuple(_plain(v) for v in value)


def _parameters(value: Any) -> dict[str, str | float | bool]:
    if not isinstance(value, dict) or any(isinstance(v, dict | list | tuple) for v in value.values()):
        raise _WantedError("a table of strings, numbers and booleans")
    return _plain(value)


# ---- tables ------------------------------------------------------------------------------------------------


def _key(default: Any, check: Callable, doc: str) -> Any:
    metadata = {"check": check, "doc": doc}
    if isinstance(default, dict):
        return field(default_factory=default.copy, metadata=metadata)
    return field(default=default, metadata=metadata)


class _Table:
    """Checks and normalises every field on construction, so also in ``dataclasses.replace``."""

    def __post_init__(self) -> None:
        for f in fields(self):
            name = f.name if isinstance(self, Config) else f"{type(self).__name__.lower()}.{f.name}"
            object.__setattr__(self, f.name, _checked(f, name, getattr(self, f.name)))
        self._check_together()

    def _check_together(self) -> None:
        """Check what depends on several keys of this table."""


@dataclass(frozen=True)
class Input(_Table):
    """The environment map to edit."""

    envmap: str = _key("sunsky", _string, 'HDR lat-long image, or "sunsky": Mitsuba\'s analytic sky')
    width: int = _key(256, _integer(4, _MOST_DIM, even=True), "working width, texels; height is half")
    rows: str | tuple[int, int] = _key(
        "upper", _rows, 'rows the edit may change: "upper" half, "all", or [first, last] inclusive'
    )
    azimuth: float = _key(90.0, _number(-360, 360), "sunsky: azimuth of the sun, degrees")
    elevation: float = _key(35.0, _number(0, 90), "sunsky: elevation of the sun above the horizon, degrees")
    turbidity: float = _key(3.0, _number(1, 10), "sunsky: haziness of the air, 1 (pure) to 10")
    repair: bool = _key(False, _boolean, "replace non-finite and negative texels instead of refusing the map")

    def _check_together(self) -> None:
        if not self.envmap:
            raise ConfigError('input.envmap: came "", wanted an image file or "sunsky"')
        if not isinstance(self.rows, str) and self.rows[1] >= self.width // 2:
            raise ConfigError(
                f"input.rows: came {list(self.rows)}, wanted rows below {self.width // 2}: "
                f"a map {self.width} wide has {self.width // 2} rows"
            )


@dataclass(frozen=True)
class Scene(_Table):
    """What the map lights."""

    file: str = _key("sphere", _string, "Mitsuba XML, or one shipped: sphere, mirror, matte, statue, mesh")
    width: int = _key(128, _integer(4, _MOST_DIM), "width of the rendering while editing, pixels")
    height: int = _key(0, _integer(0, _MOST_DIM), "height of the rendering, pixels; 0: by the scene's aspect")
    parameters: dict[str, str | float | bool] = _key({}, _parameters, "values for the scene's <default>s")

    def _check_together(self) -> None:
        if not self.file:
            raise ConfigError('scene.file: came "", wanted a Mitsuba XML file or the name of a shipped scene')


@dataclass(frozen=True)
class Target(_Table):
    """What the rendering should look like."""

    kind: str = _key(
        "envmap", _choice("envmap", "image", "strokes"), "given by: another map, a painted image, or strokes"
    )
    file: str = _key("", _string, "kind envmap: the other map; kind image: the painted rendering")
    rotate_degrees: float = _key(
        60.0, _number(-360, 360), "kind envmap: turn of the input about the vertical, degrees; 0 with a file"
    )
    mask: str = _key("", _string, "image that is white where the target counts; empty: everywhere")
    tonemap: str = _key("gamma", _choice(*TONEMAPS), "tonemap under which the image was painted")
    strokes: tuple[dict, ...] = _key((), _strokes, "kind strokes: list of tables, painted in order")
    spp: int = _key(1024, _integer(1, 1 << 20), "samples a pixel of the target's rendering")

    def _check_together(self) -> None:
        if self.kind == "envmap" and self.file:
            object.__setattr__(self, "rotate_degrees", 0.0)
        if self.kind == "image" and not self.file:
            raise ConfigError('target.file: came "", wanted the painted image, as target.kind is "image"')
        if (self.kind == "strokes") != bool(self.strokes):
            raise ConfigError(
                f'target.strokes: came {len(self.strokes)} strokes with target.kind = "{self.kind}"; '
                'give strokes exactly where the kind is "strokes"'
            )


@dataclass(frozen=True)
class Representation(_Table):
    """What the optimiser's parameters are."""

    kind: str = _key("siren", _representation, "siren, pixels (radiance) or log-pixels")
    hidden: int = _key(128, _integer(1, 4096), "siren: width of a layer")
    depth: int = _key(3, _integer(0, 64), "siren: hidden sine layers after the first")
    omega: float = _key(30.0, _number(0, positive=True), "siren: angular frequency of the sine layers")


@dataclass(frozen=True)
class Fit(_Table):
    """Fit of the SIREN to the input map (paper, Sec. 4 and 6.1)."""

    epochs: int = _key(600, _integer(0, 10**7), "full passes over the active texels")
    lr: float = _key(2e-3, _number(0, positive=True), "initial learning rate of Adam")
    schedule: str = _key(
        "cosine", _choice("cosine", "warm-restarts", "constant"), "course of both learning rates"
    )
    restart_period: int = _key(100, _integer(1, 10**7), "warm-restarts: epochs between restarts")
    log_mse: float = _key(0.85, _number(0), "weight of the squared error in normalised log space")
    log_ssim: float = _key(0.25, _number(0), "weight of 1 - SSIM in normalised log space")
    hdr: float = _key(1e-2, _number(0), "weight of the absolute error of radiance")
    awp_gamma: float = _key(0.01, _number(0, 1), "weight perturbation, fraction of a layer's norm; 0: off")
    awp_lr: float = _key(1e-4, _number(0, positive=True), "learning rate of the proxy Adam that perturbs")
    awp_every: int = _key(1, _integer(1, 10**7), "epochs between fresh perturbations")
    cache: bool = _key(True, _boolean, "keep fits on disk and reuse them")

    def _check_together(self) -> None:
        if not self.log_mse + self.log_ssim + self.hdr:
            raise ConfigError("fit.log_mse, fit.log_ssim, fit.hdr: came 0 for all, wanted one above 0")


@dataclass(frozen=True)
class Loss(_Table):
    """Weights of the edit's losses (Eq. 10): a number, or [start, end] for a geometric ramp over the run."""

    ssim: Ramp = _key(1.0, _weight, "1 - SSIM of rendering and target")
    luminance: Ramp = _key(0.0, _weight, "change of the map's summed luminance (Eq. 8)")
    l1: Ramp = _key(0.0, _weight, "sum of the map's radiance (Eq. 9)")
    dists: Ramp = _key(0.0, _weight, "DISTS of map and original")
    tv: Ramp = _key(0.0, _weight, "total variation of the map")
    image_l1: Ramp = _key(0.0, _weight, "mean absolute difference of rendering and target")

    def _check_together(self) -> None:
        if not self.ssim and not self.image_l1:
            raise ConfigError("loss.ssim, loss.image_l1: came 0 for both, wanted one above 0")


@dataclass(frozen=True)
class Optimizer(_Table):
    """The edit loop's Adam."""

    iterations: int = _key(400, _integer(0, 10**7), "steps of the edit")
    lr: float = _key(1e-4, _number(0, positive=True), "learning rate")
    checkpoint_s: float = _key(10.0, _number(0), "seconds between checkpoints; 0: after every step")


@dataclass(frozen=True)
class Renderer(_Table):
    """How the rendering is computed while editing."""

    kind: str = _key("transport", _choice("transport", "path"), "stored transport, or a path tracer")
    spp: int | str = _key("auto", _or_auto(_integer(1, 1 << 20)), 'samples a pixel, or "auto"')
    max_depth: int | str = _key("auto", _or_auto(_integer(1, 1024)), 'longest path, in segments, or "auto"')
    refresh: int | str = _key(
        0, _or_auto(_integer(0, 10**7)), 'steps between fresh recordings; 0: never; or "auto"'
    )
    memory_gb: float | str = _key(
        2.0, _or_auto(_number(0, positive=True)), 'most memory the transport may take, GB, or "auto"'
    )


@dataclass(frozen=True)
class Output(_Table):
    """What a run leaves behind."""

    dir: str = _key("", _string, "folder of the results; empty: <config stem>_out beside the file")
    tonemap: str = _key("gamma", _choice(*TONEMAPS), "tonemap of previews and metrics")
    spp: int = _key(1024, _integer(1, 1 << 20), "samples a pixel of the judged renderings")
    report: bool = _key(True, _boolean, "write preview.png and report.html")


def _table_key(table: type[_Table]) -> Any:
    return field(default_factory=table, metadata={"table": table})


# Presets are nested dicts of defaults. "paper" is Sec. 6 of the paper, every number of it spelled out even
# where it is a default today; the path tracer's samples a pixel and the rendering's size are not in it.
PRESETS: dict[str, dict[str, Any]] = {
    "draft": {
        "input": {"width": 128},
        "scene": {"width": 96},
        "target": {"spp": 256},
        "representation": {"hidden": 64},
        "fit": {"epochs": 150},
        "optimizer": {"iterations": 150},
        "output": {"spp": 256},
    },
    "standard": {},
    "paper": {
        "input": {"width": 256, "rows": "upper"},
        "scene": {"width": 256},
        "representation": {"kind": "siren", "hidden": 256, "depth": 6, "omega": 30.0},
        "fit": {
            "epochs": 1500, "lr": 5e-5, "schedule": "warm-restarts", "restart_period": 100,
            "log_mse": 0.85, "log_ssim": 0.25, "hdr": 1e-2, "awp_gamma": 0.01, "awp_lr": 1e-4, "awp_every": 1,
        },
        "loss": {
            "ssim": (1.0, 1e4), "luminance": (1e-4, 1e-8), "l1": (1e-4, 1e-8), "dists": 0.6,
            "tv": 0.0, "image_l1": 0.0,
        },
        "optimizer": {"iterations": 400, "lr": 5e-6},
        "renderer": {"kind": "path", "spp": 16, "refresh": 1},
    },
}  # fmt: skip


@dataclass(frozen=True)
class Config(_Table):
    """Everything a run depends on."""

    preset: str = _key("standard", _choice(*PRESETS), "named set of defaults")
    seed: int = _key(0, _integer(0, 2**32 - 1), "base of every random number")
    variant: str = _key("llvm_ad_rgb", _choice("llvm_ad_rgb", "cuda_ad_rgb"), "Mitsuba variant")
    input: Input = _table_key(Input)
    scene: Scene = _table_key(Scene)
    target: Target = _table_key(Target)
    representation: Representation = _table_key(Representation)
    fit: Fit = _table_key(Fit)
    loss: Loss = _table_key(Loss)
    optimizer: Optimizer = _table_key(Optimizer)
    renderer: Renderer = _table_key(Renderer)
    output: Output = _table_key(Output)


_TOP = {f.name: f for f in fields(Config)}
_TABLES: dict[str, dict[str, Any]] = {
    name: {f.name: f for f in fields(top.metadata["table"])}
    for name, top in _TOP.items()
    if "table" in top.metadata
}

_PATHS = (("input", "envmap"), ("scene", "file"), ("target", "file"), ("target", "mask"), ("output", "dir"))

# help(Input) shows each key's meaning, which is written once, beside its default.
for _name, _cls in [("", Config), *((name, _TOP[name].metadata["table"]) for name in _TABLES)]:
    _keys = _TABLES[_name] if _name else {k: f for k, f in _TOP.items() if k not in _TABLES}
    _cls.__doc__ += "\n\nAttributes\n----------\n" + "\n".join(
        f"{key} : {f.type}\n    {f.metadata['doc']}." for key, f in _keys.items()
    )


# ---- reading -----------------------------------------------------------------------------------------------


def preset_names() -> tuple[str, ...]:
    """Name the presets, the quickest first."""
    return tuple(PRESETS)


def load(path: str | PathLike, preset: str | None = None, overrides: Iterable[str] = ()) -> Config:
    """Read a configuration file.

    Parameters
    ----------
    path : path
        TOML file, UTF-8. Relative paths in it, and in overrides, are relative to its folder.
    preset : str, optional
        Beats the preset that the file or an override names.
    overrides : iterable of str
        ``"table.key=value"``, later ones beat earlier ones. The value is TOML; what is not TOML is a string.

    Returns
    -------
    Config
        Resolved: every path absolute, ``output.dir`` filled in.

    Raises
    ------
    ConfigError
        The file cannot be read, is not TOML, or holds an unknown key or an unusable value.
    """
    try:
        with open(path, "rb") as file:
            data = file.read(_MOST_BYTES + 1)
    except IsADirectoryError:
        raise ConfigError(f"{path}: a folder, wanted a TOML file") from None
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such configuration file") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ConfigError(f"{str(path)!r}: cannot be read: {reason}") from None
    if len(data) > _MOST_BYTES:
        raise ConfigError(f"{path}: more than {_MOST_BYTES >> 20} MiB, wanted a TOML file")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        row = data.count(b"\n", 0, error.start) + 1
        raise ConfigError(f"{path}: not UTF-8 text at line {row}; wanted a TOML file") from None
    path = Path(path)
    return loads(text, path.absolute().parent, str(path), preset, overrides)


def loads(
    text: str,
    base_dir: str | PathLike = ".",
    name: str = "config.toml",
    preset: str | None = None,
    overrides: Iterable[str] = (),
) -> Config:
    """Read a configuration from TOML text; see `load`.

    Parameters
    ----------
    text : str
        The TOML document.
    base_dir : path
        Folder that relative paths start from.
    name : str
        What errors call the document; its stem names the output folder.
    preset, overrides
        As in `load`.

    Raises
    ------
    ConfigError
        The text is not TOML, or holds an unknown key or an unusable value.
    """
    try:
        table = tomllib.loads(text)
    except RecursionError:
        raise ConfigError(f"{name}: not TOML: nested too deeply") from None
    except ValueError as error:  # TOMLDecodeError, or an integer of thousands of digits
        row, column = text.count("\n") + 1, len(text) - (text.rfind("\n") + 1) + 1
        end = f"at line {row}, column {column}: end of document"
        reason = str(error).replace("at end of document", end)
        raise ConfigError(f"{name}: not TOML: {reason}") from None
    return from_dict(table, base_dir, name, preset, overrides)


def from_dict(
    table: dict[str, Any],
    base_dir: str | PathLike = ".",
    name: str = "config.toml",
    preset: str | None = None,
    overrides: Iterable[str] = (),
) -> Config:
    """Build a configuration from nested dicts with the tables and keys of the TOML file; see `loads`.

    Raises
    ------
    ConfigError
        An unknown key or an unusable value.
    """
    file = _checked_layer(table, name)
    assigned: dict[str, Any] = {}
    for text in overrides:
        keys, value = parse_override(text)
        layer: Any = value
        for key in reversed(keys):
            layer = {key: layer}
        assigned = _merged(assigned, _checked_layer(layer, f"--set {_show(text)}"))

    chosen = assigned.get("preset", file.get("preset", "standard"))
    if preset is not None:
        chosen = _checked(_TOP["preset"], "preset", preset)
    merged = _merged(_merged(PRESETS[chosen], file), assigned) | {"preset": chosen}
    merged["target"] = _one_target(merged, {name: file, "--set": assigned})
    try:
        _resolve_paths(merged, Path(base_dir).absolute(), Path(name).stem or "config")
        tables = {key: _TOP[key].metadata["table"](**merged.pop(key, {})) for key in _TABLES}
        return Config(**merged, **tables)
    except ConfigError as error:
        raise ConfigError(f"{name}: {error}") from None


def parse_override(text: str) -> tuple[tuple[str, ...], Any]:
    """Split ``"table.key=value"`` into the key's parts and the value.

    The value is parsed as TOML; what is not TOML is taken as a string, so words and paths need no quotes.

    >>> parse_override("fit.epochs=10"), parse_override("input.envmap=maps/sky.exr")
    ((('fit', 'epochs'), 10), (('input', 'envmap'), 'maps/sky.exr'))

    Raises
    ------
    ConfigError
        There is no ``=``, or a part of the key is empty.
    """
    key, equals, raw = text.partition("=") if isinstance(text, str) else ("", "", "")
    keys = tuple(part.strip() for part in key.split("."))
    if not equals or not all(keys):
        raise ConfigError(f"--set {_show(text)}: wanted table.key=value, such as fit.epochs=100")
    raw = raw.strip()
    try:
        parsed = tomllib.loads(f"value = {raw}")
    except (ValueError, RecursionError):
        return keys, raw
    # A value with a line break could smuggle in a second key.
    return keys, parsed["value"] if parsed.keys() == {"value"} else raw


def to_toml(config: Config) -> str:
    """Write a configuration, every key spelled out.

    A configuration that came from `load`, `loads` or `from_dict` loads back to an equal one from any folder,
    as its paths are absolute.
    """
    lines = [f"{key} = {_written(getattr(config, key))}" for key in _TOP if key not in _TABLES]
    for name, keys in _TABLES.items():
        table = getattr(config, name)
        lines += ["", f"[{name}]", *(f"{key} = {_written(getattr(table, key))}" for key in keys)]
    return "\n".join(lines) + "\n"


# ---- inside ------------------------------------------------------------------------------------------------


def _checked(f: Any, name: str, value: Any) -> Any:
    if "table" in f.metadata:
        if not isinstance(value, f.metadata["table"]):
            raise ConfigError(f"{name}: came {_show(value)}, wanted a table")
        return value
    try:
        return f.metadata["check"](value)
    except _WantedError as error:
        raise ConfigError(f"{name}: came {_show(value)}, wanted {error}") from None


def _checked_layer(layer: Any, where: str) -> dict[str, Any]:
    """Check every table, key and value that one source gives, and normalise the values."""
    if not isinstance(layer, dict):
        raise ConfigError(f"{where}: came {_show(layer)}, wanted a table of tables")
    checked: dict[str, Any] = {}
    try:
        for name, value in layer.items():
            if name in _TABLES:
                if not isinstance(value, dict):
                    raise ConfigError(f"{name}: came {_show(value)}, wanted a table, [{name}]")
                checked[name] = {}
                for key, entry in value.items():
                    if key not in _TABLES[name]:
                        raise ConfigError(_unknown(key, name))
                    checked[name][key] = _checked(_TABLES[name][key], f"{name}.{key}", entry)
            elif name in _TOP:
                checked[name] = _checked(_TOP[name], name, value)
            else:
                raise ConfigError(_unknown(name, ""))
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from None
    return checked


def _unknown(key: Any, table: str) -> str:
    """Say that a key is unknown, with the nearest name: of its own table first, then of any other."""
    own = _TABLES[table] if table else _TOP
    text = key[:60] if isinstance(key, str) else ""
    shown = key if re.fullmatch(r"[\w-]{1,60}", text) else _show(key)
    kind = f"[{table}] has no key {shown}" if table else f"unknown table or key {shown}"
    if close := difflib.get_close_matches(text, own, 1):
        return f"{kind}; did you mean {close[0]}?"
    elsewhere = {k: f"{name}.{k}" for name, keys in _TABLES.items() for k in keys} | {k: k for k in _TOP}
    if close := difflib.get_close_matches(text, elsewhere, 1, 0.8):
        return f"{kind}; did you mean {elsewhere[close[0]]}?"
    return f"{kind}; known: {', '.join(own)}"


def _merged(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    """Lay one nested dict over another: tables are merged key by key, anything else is replaced."""
    merged = dict(below)
    for key, value in above.items():
        both = isinstance(value, dict) and isinstance(merged.get(key), dict)
        merged[key] = _merged(merged[key], value) if both else value
    return merged


def _one_target(merged: dict[str, Any], sources: dict[str, dict]) -> dict[str, Any]:
    """Settle ``target.file`` against ``rotate_degrees``: a source gives one of them, the last source wins."""
    target = dict(merged.get("target", {}))
    if target.get("kind", "envmap") == "envmap":
        for where, source in sources.items():
            given = source.get("target", {})
            if given.get("file") and given.get("rotate_degrees"):
                raise ConfigError(
                    f"{where}: target.file and target.rotate_degrees: came both, wanted one: "
                    "the other map, or the input turned"
                )
            if given.get("rotate_degrees"):
                target["file"] = ""
            elif given.get("file"):
                target["file"] = given["file"]
    return target


def _resolve_paths(merged: dict[str, Any], base: Path, stem: str) -> None:
    """Make the paths absolute in place; ``sunsky`` and the bare names of shipped scenes are no paths."""
    output = dict(merged.get("output", {}))
    output["dir"] = output.get("dir") or f"{stem}_out"
    merged["output"] = output
    for table, key in _PATHS:
        value = merged.get(table, {}).get(key, "")
        shipped = key == "file" and table == "scene" and Path(value).name == value and not Path(value).suffix
        if value and not shipped and not (key == "envmap" and value == "sunsky"):
            merged[table] = merged[table] | {key: str(base / value)}


def _show(value: Any) -> str:
    """Show a value in an error: short, on one line, whatever it is."""
    try:
        text = ascii(value) if isinstance(value, str) and not value.isprintable() else repr(value)
    except (ValueError, RecursionError):  # an integer of thousands of digits
        text = f"a huge {type(value).__name__}"
    text = {"True": "true", "False": "false"}.get(text, text)
    text = " ".join(text.split())
    return text if len(text) <= 60 else text[:57] + "..."


def _written(value: Any) -> str:
    """Write a value as TOML on one line."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        # JSON's escapes are TOML's, but for DEL, which TOML alone wants escaped.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, dict):
        bare = {k: k if re.fullmatch(r"[A-Za-z0-9_-]+", k) else _written(k) for k in value}
        return f"{{ {', '.join(f'{bare[k]} = {_written(v)}' for k, v in value.items())} }}" if value else "{}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_written, value))}]"
    return repr(value)
