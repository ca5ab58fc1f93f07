r"""The configuration: TOML to frozen dataclasses, presets, overrides. The only module that knows TOML.

A value comes from the last of these that gives it: the dataclass default, the preset, what the preset has for
the kinds of representation and target, the file, a ``--set table.key=value`` override. Each layer is checked
by itself, so that an error names the place the value came from; what depends on two keys at once is checked
when the dataclasses are built, however they are.
Whether input files exist is not looked at here: the modules that read them say so.

>>> config = loads("[fit]\nepochs = 100", preset="draft", overrides=["seed=3"])
>>> config.fit.epochs, config.representation.hidden, config.seed
(100, 64, 3)

Longer than 400 lines: a line for every key.
"""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Iterable
from dataclasses import dataclass, field, fields
from os import PathLike
from pathlib import Path
from typing import Any

from envedit.config import presets
from envedit.config.light_schema import light_list
from envedit.config.stroke_schema import stroke_list
from envedit.config.validators import (
    MOST_DIM,
    Ramp,
    Table,
    boolean,
    checked,
    choice,
    integer,
    kelvin,
    number,
    one_or_more,
    or_auto,
    parameter_table,
    row_range,
    show,
    string,
    view,
    view_list,
    weight,
)
from envedit.config.validators import key as _key
from envedit.core.atomic_files import opened
from envedit.core.color import TONEMAPS
from envedit.core.errors import ConfigError

_MOST_BYTES = 1 << 20  # more than any configuration; an EXR given by mistake is not read to its end
# a.b.c...: tomllib takes time and memory with the square of the parts, gigabytes for a file of 100 kB.
_LONG_KEY = re.compile(r"""(?<![\w-])(?:(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){100}""", re.ASCII)


# ---- tables ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Input(Table):
    """The environment map to edit."""

    envmap: str = _key(
        "auto",
        string,
        'HDR lat-long image; "scene": the one that the scene names; "sunsky": Mitsuba\'s analytic sky; '
        '"auto": the scene\'s if it names one, else the analytic sky',
    )
    width: int = _key(256, integer(6, MOST_DIM, even=True), "working width, texels; height is half")
    rows: str | tuple[int, int] = _key(
        "all", row_range, 'rows the edit may change: "all", the "upper" half, or [first, last] inclusive'
    )
    horizon: str = _key(
        "auto",
        choice("auto", "mirror", "keep", "free"),
        'layers, all rows: those below the horizon follow the sky as its blurred "mirror", "keep" but for a '
        'fade, or are "free" as the sky is; "auto" detects which',
    )
    azimuth: float = _key(90.0, number(-360, 360), "sunsky: azimuth of the sun, degrees")
    elevation: float = _key(35.0, number(0, 90), "sunsky: elevation of the sun above the horizon, degrees")
    turbidity: float = _key(3.0, number(1, 10), "sunsky: haziness of the air, 1 (pure) to 10")
    rotate_degrees: float = _key(
        0.0, number(-360, 360), "turn of the map about the vertical before the edit, as target.rotate_degrees"
    )
    lights: tuple[dict, ...] = _key(
        (), light_list, "lights moved, changed or added by hand, before turn and edit: list of tables"
    )
    repair: bool = _key(False, boolean, "replace NaN and Inf by their neighbours instead of refusing the map")

    def _check_together(self) -> None:
        if not self.envmap:
            raise ConfigError('input.envmap: got "", expected an image file, "scene", "sunsky" or "auto"')
        if not isinstance(self.rows, str) and self.rows[1] >= self.width // 2:
            raise ConfigError(
                f"input.rows: got {list(self.rows)}, expected rows below {self.width // 2}: "
                f"a map {self.width} wide has {self.width // 2} rows"
            )


@dataclass(frozen=True)
class Scene(Table):
    """What the map lights."""

    file: str = _key(
        "sphere", string, "Mitsuba XML, or one shipped: sphere, mirror, matte, statue, pair, mesh"
    )
    width: int = _key(128, integer(4, MOST_DIM), "width of the rendering while editing, pixels")
    height: int = _key(0, integer(0, MOST_DIM), "height of the rendering, pixels; 0: by the scene's aspect")
    sensors: str | tuple[int | str, ...] = _key(
        (0,), view_list, 'views that one map explains: a list of sensors, by id or index from 0, or "all"'
    )
    parameters: dict[str, str | float | bool] = _key({}, parameter_table, "values for the scene's <default>s")

    def _check_together(self) -> None:
        if not self.file:
            raise ConfigError('scene.file: got "", expected a Mitsuba XML file or a shipped scene')


@dataclass(frozen=True)
class Target(Table):
    """What the rendering should look like."""

    kind: str = _key(
        "envmap",
        choice("envmap", "image", "strokes", "none"),
        'given by: another map, a painted image, or strokes; "none": only [lights], exposure, white balance',
    )
    file: str | tuple[str, ...] = _key(
        "",
        one_or_more(string),
        "kind envmap: the other map; kind image: the painted rendering, or a list of them",
    )
    rotate_degrees: float = _key(
        60.0, number(-360, 360), "kind envmap: turn of the input about the vertical, degrees; 0 with a file"
    )
    mask: str | tuple[str, ...] = _key(
        "",
        one_or_more(string),
        "image that is white where the target counts, or a list; kind image: where it was painted",
    )
    view: int | str | tuple[int | str, ...] = _key(
        (),
        one_or_more(view),
        "view that each file, or mask, belongs to: index or id; []: the first, the second, ...",
    )
    tonemap: str = _key("gamma", choice(*TONEMAPS), "tonemap under which the image, or a stroke, is painted")
    strokes: tuple[dict, ...] = _key((), stroke_list, "kind strokes: list of tables, see docs/painting.md")
    paint: float = _key(1.0, number(0), "kinds image, strokes: weight of all that was painted together")
    hold: float = _key(1.0, number(0), "kinds image, strokes: weight of all pixels that were not painted")
    spp: int | str = _key(
        "auto", or_auto(integer(1, 1 << 20)), "samples a pixel of the target's rendering; auto: until quiet"
    )

    @property
    def files(self) -> tuple[str, ...]:
        """The files of :attr:`file`."""
        return _each(self.file)

    @property
    def masks(self) -> tuple[str, ...]:
        """The files of :attr:`mask`."""
        return _each(self.mask)

    @property
    def views(self) -> tuple[int | str, ...]:
        """The view of each painted file, or of each mask."""
        given = self.view if isinstance(self.view, tuple) else (self.view,)
        count = len(self.files) if self.kind == "image" else len(self.masks)
        return given or tuple(range(count))

    def _check_together(self) -> None:
        if self.kind == "envmap" and isinstance(self.file, tuple):
            raise ConfigError('target.file: got a list, expected one map, as target.kind is "envmap"')
        if self.view != () and self.kind == "strokes":
            raise ConfigError("target.view: got one, expected none: each stroke has a view of its own")
        named = len(self.files) if self.kind == "image" else len(self.masks)
        if self.view != () and len(self.views) != named:
            raise ConfigError(f"target.view: got {len(self.views)} views, expected {named}, one a file")
        if len({*self.views}) != len(self.views):
            raise ConfigError("target.view: got a view twice, expected each once")
        if self.kind == "image" and self.mask and len(self.masks) != named:
            raise ConfigError(f"target.mask: got {len(self.masks)} masks, expected {named}, one a file")
        if self.kind == "envmap" and self.file:
            object.__setattr__(self, "rotate_degrees", 0.0)
        if self.kind == "image" and not self.file:
            raise ConfigError('target.file: got "", expected the painted image, as target.kind is "image"')
        if self.kind == "strokes" and not self.strokes:
            raise ConfigError('target.strokes: got none, expected at least one, as target.kind is "strokes"')
        if self.kind == "none" and (self.file or self.mask):
            raise ConfigError('target.file, target.mask: got one, expected none, as target.kind is "none"')
        if self.kind == "strokes" and self.file:
            raise ConfigError(
                f"target.file: got {show(self.file)}, expected none: strokes go on the initial rendering"
            )
        if self.kind == "strokes" and self.mask:
            raise ConfigError(f"target.mask: got {show(self.mask)}, expected none: strokes have a place")
        if self.kind in ("image", "strokes") and not self.paint + self.hold:
            raise ConfigError("target.paint, target.hold: got 0 for both, expected one above 0")
        if self.kind != "strokes" and self.strokes:
            raise ConfigError(
                f'target.strokes: got {len(self.strokes)}, expected none, as target.kind is "{self.kind}": '
                'set target.kind = "strokes"'
            )


def _each(files):
    """List the files of a key that takes one or several."""
    return files if isinstance(files, tuple) else (files,) if files else ()


@dataclass(frozen=True)
class Lights(Table):
    """What is done to the lights of the edited map at last; their flux is kept."""

    max_radiance: float = _key(
        0.0, number(0), "spread lights until no texel of the map's file is above; 0: no bound"
    )
    soften_degrees: float = _key(0.0, number(0, 90), "radius over which each texel of a light is spread")


@dataclass(frozen=True)
class Representation(Table):
    """What the optimiser's parameters are."""

    kind: str = _key(
        "layers",
        choice("layers", "siren", "pixels", "log-pixels"),
        "layers (lights and a smooth gain), siren (the paper's), pixels (radiance) or log-pixels",
    )
    cycles: int | str = _key(
        "auto",
        or_auto(integer(1, 256)),
        "layers: finest detail of the gain, cycles around the horizon; auto: 12, or what is identifiable",
    )
    turn: str | bool = _key(
        "auto",
        or_auto(boolean),
        'turn the whole sky about the vertical first; "auto": where that explains the target, not for paint',
    )
    hidden: int = _key(128, integer(1, 4096), "siren: width of a layer")
    depth: int = _key(3, integer(0, 64), "siren: hidden sine layers after the first")
    omega: float = _key(30.0, number(0, positive=True), "siren: angular frequency of the sine layers")
    coordinates: str = _key(
        "plane", choice("plane", "sphere"), "siren: inputs are row and column as in the paper, or directions"
    )


@dataclass(frozen=True)
class Fit(Table):
    """Fit of the SIREN to the input map (paper, Sec. 4 and 6.1)."""

    epochs: int = _key(1200, integer(0, 10**7), "steps of Adam")
    lr: float = _key(1e-3, number(0, positive=True), "initial learning rate of Adam")
    beta2: float = _key(0.99, number(0, 0.999999), "Adam's decay of squared gradients")
    stride: int = _key(2, integer(1, 64), "a step samples every stride-th row and column, at varying offsets")
    schedule: str = _key(
        "cosine", choice("cosine", "warm-restarts", "constant"), "course of both learning rates"
    )
    restart_period: int = _key(100, integer(1, 10**7), "warm-restarts: epochs between restarts")
    log_mse: float = _key(0.85, number(0), "weight of the squared error in normalised log space")
    log_ssim: float = _key(0.25, number(0), "weight of 1 - SSIM in normalised log space")
    hdr: float = _key(1e-2, number(0), "weight of the absolute error of radiance")
    awp_gamma: float = _key(0.01, number(0, 1), "weight perturbation, fraction of a layer's norm; 0: off")
    awp_lr: float = _key(1e-4, number(0, positive=True), "learning rate of the proxy Adam that perturbs")
    awp_every: int = _key(2, integer(1, 10**7), "epochs between fresh perturbations")
    headroom: float = _key(0.05, number(0, 0.45), "share of the network's range left free above and below")
    polish: str = _key(
        "auto", choice("auto", "always", "never"), "finish exactly; auto: unless the fit is to be edited"
    )
    awp_until: float = _key(0.7, number(0, 1), "polish: share of the epochs that are perturbed before")
    light: float = _key(1.0, number(0), "polish: weight of light in the last layer's solution; 0: none")
    cache: bool = _key(True, boolean, "keep fits on disk and reuse them")

    def _check_together(self) -> None:
        if not self.log_mse + self.log_ssim + self.hdr:
            raise ConfigError("fit.log_mse, fit.log_ssim, fit.hdr: got 0 for all, expected one above 0")


@dataclass(frozen=True)
class Loss(Table):
    """Weights of the edit's losses (Eq. 10): a number, or [start, end] for a geometric ramp over the run."""

    ssim: Ramp = _key(0.1, weight, "1 - SSIM of rendering and target")
    luminance: Ramp = _key(0.0, weight, "change of the map's summed luminance (Eq. 8)")
    l1: Ramp = _key(0.0, weight, "sum of the map's radiance (Eq. 9)")
    dists: Ramp = _key(0.0, weight, "DISTS of map and original")
    tv: Ramp = _key(0.0, weight, "total variation of the map")
    change: Ramp = _key(0.0, weight, "mean change of the map's logarithm: what need not change stays")
    image_l1: Ramp = _key(1.0, weight, "mean absolute difference of rendering and target")
    image_l2: Ramp = _key((1.0, 100.0), weight, "mean squared difference of rendering and target")

    def _check_together(self) -> None:
        if not self.ssim and not self.image_l1 and not self.image_l2:
            raise ConfigError("loss.ssim, loss.image_l1, loss.image_l2: got 0 for all, expected one above 0")


@dataclass(frozen=True)
class Perceptual(Table):
    """Weights of perceptual terms, from files of the user's; without them DISTS is off and LPIPS null."""

    vgg: str = _key("", string, "DISTS: VGG16 (safetensors or npz, torchvision's names)")
    dists: str = _key("", string, "DISTS: its alpha and beta (safetensors or npz)")
    network: str = _key("alex", choice("alex", "vgg", "squeeze"), "LPIPS: its network")
    backbone: str = _key("", string, "LPIPS: weights of that network (safetensors or npz)")
    heads: str = _key("", string, "LPIPS: its heads, version 0.1 (safetensors or npz)")

    def _check_together(self) -> None:
        for one, other in (("vgg", "dists"), ("backbone", "heads")):
            if bool(getattr(self, one)) != bool(getattr(self, other)):
                raise ConfigError(f"perceptual.{one}, perceptual.{other}: got one, expected both or none")


@dataclass(frozen=True)
class Optimizer(Table):
    """How the parameters are found."""

    kind: str = _key(
        "auto",
        choice("auto", "gauss-newton", "adam"),
        "gauss-newton (layers through a stored transport) or adam; auto: the first where it can be had",
    )
    iterations: int = _key(100, integer(0, 10**7), "most steps of the edit")
    lr: float | str = _key(
        "auto", or_auto(number(0, positive=True)), 'learning rate, or "auto": what suits the representation'
    )
    beta2: float = _key(0.99, number(0, 0.999999), "Adam's decay of squared gradients; 0.999 spikes")
    schedule: str = _key(
        "cosine",
        choice("cosine", "constant"),
        "course of the learning rate; cosine: to 0 at the end of the run",
    )
    checkpoint_s: float = _key(
        10.0, number(0), "seconds between checkpoints; 0: whenever losses are read back"
    )


@dataclass(frozen=True)
class Renderer(Table):
    """How the rendering is computed while editing."""

    kind: str = _key("transport", choice("transport", "path"), "stored transport, or a path tracer")
    spp: int | str = _key(
        "auto",
        or_auto(integer(1, 1 << 20)),
        'samples a pixel, or "auto": most where detail is identifiable',
    )
    max_depth: int | str = _key("auto", or_auto(integer(1, 1024)), 'longest path, in segments, or "auto"')
    refresh: int | str = _key(
        0, or_auto(integer(0, 10**7)), 'steps between fresh recordings; 0: never; or "auto"'
    )
    memory_gb: float | str = _key(
        2.0, or_auto(number(0, positive=True)), 'most memory the transport may take, GB, or "auto"'
    )
    cache: bool = _key(True, boolean, "keep transports and renderings on disk and reuse them")
    influence_threshold: float = _key(
        1e-3,
        number(0, 1),
        "texels with less than this share of the mean influence on the rendering keep their value; 0: none",
    )


@dataclass(frozen=True)
class Output(Table):
    """What a run leaves behind."""

    dir: str = _key("", string, "folder of the results; empty: <config stem>_out beside the file")
    tonemap: str = _key("gamma", choice(*TONEMAPS), "tonemap of previews and metrics")
    spp: int | str = _key(
        "auto", or_auto(integer(1, 1 << 20)), "samples a pixel of the judged rendering; auto: until quiet"
    )
    report: bool = _key(True, boolean, "write preview.png and report.html")
    full: bool = _key(True, boolean, "write edited_full.exr, at the resolution of the input's file")
    format: str = _key(
        "exr", choice("exr", "hdr"), "file of the edited map: OpenEXR, or Radiance (.hdr), 8 bits a channel"
    )
    exposure: float = _key(0.0, number(-100, 100), "stops by which the edited map is brightened at last")
    white_balance: float = _key(
        0.0,
        kelvin,
        "temperature of the light that becomes neutral in the edited map, kelvin; 0: as it is",
    )
    half: bool = _key(
        False, boolean, "OpenEXR with 16 bits a channel; what is above 65504 is cut, with a warning"
    )
    scene: bool = _key(True, boolean, "write edited.xml, the scene lit by the edited map")

    def _check_together(self) -> None:
        if self.half and self.format != "exr":
            raise ConfigError('output.half: got true with output.format "hdr", expected "exr"')


def _table_key(table: type[Table]) -> Any:
    return field(default_factory=table, metadata={"table": table})


@dataclass(frozen=True)
class Config(Table):
    """Everything a run depends on."""

    preset: str = _key("standard", choice(*presets.PRESETS), "named set of defaults")
    seed: int = _key(0, integer(0, 2**32 - 1), "base of every random number")
    variant: str = _key("llvm_ad_rgb", choice("llvm_ad_rgb", "cuda_ad_rgb"), "Mitsuba variant")
    input: Input = _table_key(Input)
    scene: Scene = _table_key(Scene)
    target: Target = _table_key(Target)
    lights: Lights = _table_key(Lights)
    representation: Representation = _table_key(Representation)
    fit: Fit = _table_key(Fit)
    loss: Loss = _table_key(Loss)
    perceptual: Perceptual = _table_key(Perceptual)
    optimizer: Optimizer = _table_key(Optimizer)
    renderer: Renderer = _table_key(Renderer)
    output: Output = _table_key(Output)

    def _name(self, key: str) -> str:
        return key

    def _check_together(self) -> None:
        """Put the preset's defaults in the place of what was not given, however the tables were made."""
        tables = {name: getattr(self, name) for name in _TABLES}
        given = {name: {key: getattr(table, key) for key in table.given} for name, table in tables.items()}
        chosen = presets.defaults(self.preset, given)
        for name, table in tables.items():
            object.__setattr__(self, name, table.with_defaults(chosen.get(name, {})))
        able = self.representation.kind == "layers" and self.renderer.kind == "transport"
        if self.optimizer.kind == "gauss-newton" and not able:
            raise ConfigError(
                'optimizer.kind: got "gauss-newton", expected adam or auto: it solves for layers '
                "(representation.kind) through a stored transport (renderer.kind)"
            )


_TOP = {f.name: f for f in fields(Config)}
_TABLES: dict[str, dict[str, Any]] = {
    name: {f.name: f for f in fields(top.metadata["table"])}
    for name, top in _TOP.items()
    if "table" in top.metadata
}

# help(Input) shows each key's meaning, which is written once, beside its default.
for _name, _cls in [("", Config), *((name, _TOP[name].metadata["table"]) for name in _TABLES)]:
    _keys = _TABLES[_name] if _name else {k: f for k, f in _TOP.items() if k not in _TABLES}
    _cls.__doc__ += "\n\nAttributes\n----------\n" + "\n".join(
        f"{key} : {f.type}\n    {f.metadata['doc']}." for key, f in _keys.items()
    )


# ---- reading -----------------------------------------------------------------------------------------------


def preset_names() -> tuple[str, ...]:
    """Name the presets, the quickest first."""
    return tuple(presets.PRESETS)


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
        with opened(path) as file:
            data = file.read(_MOST_BYTES + 1)
    except IsADirectoryError:
        raise ConfigError(f"{path}: a folder, expected a TOML file") from None
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such configuration file") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ConfigError(f"{str(path)!r}: cannot be read: {reason}") from None
    if len(data) > _MOST_BYTES:
        raise ConfigError(f"{path}: more than {_MOST_BYTES >> 20} MiB, expected a TOML file")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        row = data.count(b"\n", 0, error.start) + 1
        raise ConfigError(f"{path}: not UTF-8 text at line {row}; expected a TOML file") from None
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
        table = _parsed(text)
    except RecursionError:
        raise ConfigError(f"{name}: not TOML: nested too deeply") from None
    except ValueError as error:  # TOMLDecodeError, or an integer of thousands of digits
        row, column = text.count("\n") + 1, len(text) - (text.rfind("\n") + 1) + 1
        end = f"at line {row}, column {column}: end of document"
        reason = str(error).replace("at end of document", end)
        if len(reason) > 200:  # it may hold a key of any length; its end says where
            reason = f"{reason[:120]} ... {reason[-60:]}"
        raise ConfigError(f"{name}: not TOML: {reason}") from None
    return from_dict(table, base_dir, name, preset, overrides)


def _parsed(text: str) -> dict[str, Any]:
    if found := _LONG_KEY.search(text):
        row = text.count("\n", 0, found.start()) + 1
        raise ValueError(f"a key of more than 100 parts (at line {row})")
    return tomllib.loads(text)


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
    file = presets.checked_layer(table, name, _TOP, _TABLES)
    assigned: dict[str, Any] = {}
    for text in overrides:
        keys, value = parse_override(text)
        layer: Any = value
        for key in reversed(keys):
            layer = {key: layer}
        layer = presets.checked_layer(layer, f"--set {show(text)}", _TOP, _TABLES)
        assigned = presets.overlaid(assigned, layer)

    chosen = assigned.get("preset", file.get("preset", "standard"))
    if preset is not None:
        chosen = checked(_TOP["preset"], "preset", preset)
    given = presets.overlaid(file, assigned)
    merged = given | {"preset": chosen}
    merged["target"] = presets.one_target(merged, {name: file, "--set": assigned})
    try:
        presets.resolve_paths(merged, Path(base_dir).absolute(), Path(name).stem or "config")
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
        raise ConfigError(f"--set {show(text)}: expected table.key=value, such as fit.epochs=100")
    raw = raw.strip()
    try:
        parsed = _parsed(f"value = {raw}")
    except (ValueError, RecursionError):
        return keys, raw
    # A value with a line break could smuggle in a second key.
    return keys, parsed["value"] if parsed.keys() == {"value"} else raw


def to_toml(config: Config) -> str:
    """Write a configuration, every key spelled out.

    A configuration that came from `load`, `loads` or `from_dict` loads back to an equal one from any folder,
    as its paths are absolute.
    """
    lines = [f"{key} = {quote(getattr(config, key))}" for key in _TOP if key not in _TABLES]
    for name, keys in _TABLES.items():
        table = getattr(config, name)
        lines += ["", f"[{name}]", *(f"{key} = {quote(getattr(table, key))}" for key in keys)]
    return "\n".join(lines) + "\n"


def quote(value: Any) -> str:
    """Write a value as TOML on one line."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        # JSON's escapes are TOML's, but for DEL, which only TOML requires to be escaped.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, dict):
        bare = {k: k if re.fullmatch(r"[A-Za-z0-9_-]+", k) else quote(k) for k in value}
        return f"{{ {', '.join(f'{bare[k]} = {quote(v)}' for k, v in value.items())} }}" if value else "{}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(quote, value))}]"
    return repr(value)
