"""The tables of what is edited, lit and asked for: ``[input]``, ``[scene]``, ``[target]``."""

from __future__ import annotations

from dataclasses import dataclass

from envedit.config.list_schema import LightList, RegionList, StrokeList
from envedit.config.tables import EDITED, LAYERS, PAINTED, PAINTED_KINDS, Table, key
from envedit.config.validators import (
    MOST_DIM,
    VIEW,
    VIEWS,
    Boolean,
    Choice,
    Integer,
    Number,
    OneOrMore,
    OrAuto,
    Parameters,
    RowRange,
    String,
    show,
)
from envedit.core import extensions
from envedit.core.color import TONEMAPS
from envedit.core.errors import ConfigError
from envedit.core.primaries import SPACES
from envedit.core.rotations import Orientation
from envedit.core.tone_curves import TONE_CURVES

TURN_DEGREES = 60.0
"""Turn of the target's map where neither a map nor a turn is given."""
TARGET_KINDS = ("envmap", "rendering", "photo", "image", "strokes", "none")
"""Kinds of target that are built in."""
_PICTURES = "rendering", "photo", "image"
_PHOTO = {"target.kind": ("photo",)}
_SUNSKY = {"input.envmap": ("sunsky", "auto")}


@dataclass(frozen=True)
class Input(Table):
    """The environment map to edit."""

    envmap: str = key(
        "auto",
        String(),
        'HDR lat-long image; "scene": the scene\'s own light, of which its file is read, or a map made; '
        '"sunsky": Mitsuba\'s analytic sky; "auto": the scene\'s own light, of a shipped scene the analytic '
        "sky",
    )
    width: int = key(256, Integer(6, MOST_DIM, even=True), "working width; height is half", "texels")
    rows: str | tuple[int, int] = key(
        "all",
        RowRange(),
        'rows the edit may change: "all", the "upper" half, or first and last, both included',
        "texels",
    )
    horizon: str = key(
        "auto",
        Choice("auto", "mirror", "keep", "free"),
        'rows below the horizon follow the sky as its blurred "mirror", "keep" their texture and go by '
        'the light that falls on them, or are "free" as the sky is; "auto" detects which',
        when=LAYERS | {"input.rows": ("all",)},
    )
    azimuth: float = key(90.0, Number(-360, 360), "sunsky: azimuth of the sun", "degrees", _SUNSKY)
    elevation: float = key(
        35.0, Number(0, 90), "sunsky: elevation of the sun above the horizon", "degrees", _SUNSKY
    )
    turbidity: float = key(3.0, Number(1, 10), "sunsky: haziness of the air, 1 is pure", when=_SUNSKY)
    rotate_degrees: float = key(
        0.0,
        Number(-360, 360),
        "turn of the map about the vertical before the edit, as target.rotate_degrees",
        "degrees",
    )
    tilt_degrees: float = key(
        0.0,
        Number(-180, 180),
        "rotate the map clockwise about its middle, with rotate_degrees and horizon_degrees as one rotation",
        "degrees",
    )
    horizon_degrees: float = key(
        0.0, Number(-90, 90), "likewise: raise the middle of the map, and lower its back", "degrees"
    )
    lights: tuple[dict, ...] = key(
        (), LightList(), "lights moved, changed or added by hand, before the map is rotated and edited"
    )
    regions: tuple[dict, ...] = key(
        (),
        RegionList(),
        "regions of the map that are kept, scaled or filled, after lights and before the rotation",
    )
    colour_space: str = key(
        "auto",
        Choice("auto", *SPACES),
        'colour space of the map\'s linear values; "auto": as its file says, Rec. 709 where it says nothing',
    )
    unclip: bool = key(
        False,
        Boolean(),
        "give a map whose sun was clipped its sun back, as envedit unclip does, before all else",
    )
    repair: bool = key(
        False,
        Boolean(),
        "replace NaN by its neighbours and +Inf by the brightest light, and do not refuse the map",
    )

    @property
    def orientation(self) -> Orientation:
        """How the map is rotated before the edit."""
        return Orientation(self.rotate_degrees, self.tilt_degrees, self.horizon_degrees)

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

    file: str = key(
        "sphere", String(), "Mitsuba XML, or one shipped: sphere, mirror, matte, statue, pair, mesh"
    )
    width: int = key(128, Integer(4, MOST_DIM), "width of the rendering while editing", "pixels")
    height: int = key(0, Integer(0, MOST_DIM), "height of the rendering; 0: by the scene's aspect", "pixels")
    sensors: str | tuple[int | str, ...] = key(
        (0,), VIEWS, 'views that one map explains: a list of sensors, by id or index from 0, or "all"'
    )
    parameters: dict[str, str | float | bool] = key(
        {}, Parameters(), "values for the scene's `<default>`s: strings, numbers, booleans"
    )
    up: str = key(
        "auto",
        Choice("auto", "x", "y", "z", "-x", "-y", "-z"),
        "axis of the map's zenith where the scene's light has no orientation (constant, or none); auto: the "
        "axis that is up for the first sensor",
    )
    scale: float | str = key(
        "auto",
        OrAuto(Number(0, positive=True)),
        "factor of every map in the scene; auto: the scale of its envmap emitter, which 1 drops",
    )

    def _check_together(self) -> None:
        if not self.file:
            raise ConfigError('scene.file: got "", expected a Mitsuba XML file or a shipped scene')


@dataclass(frozen=True)
class Target(Table):
    """What the rendering should look like."""

    kind: str = key(
        "envmap",
        Choice(*TARGET_KINDS, group=extensions.TARGETS),
        "given by: another map, a picture of the scene under other light, a photograph of it, a painted "
        "image, or strokes; "
        '"none": only [lights], exposure, white balance',
    )
    file: str | tuple[str, ...] = key(
        "",
        OneOrMore(String()),
        "kind envmap: the other map, which is not turned; kinds rendering and image: the picture, or a list; "
        "kind photo: the picture",
    )
    rotate_degrees: float | str = key(
        "auto",
        OrAuto(Number(-360, 360)),
        f"kind envmap: turn of the input about the vertical; auto: {TURN_DEGREES:g}, or none with a file",
        "degrees",
        {"target.kind": ("envmap",)},
    )
    mask: str | tuple[str, ...] = key(
        "",
        OneOrMore(String()),
        "image that is white where the target counts, or a list; kind image: where it was painted",
    )
    view: int | str | tuple[int | str, ...] = key(
        (),
        OneOrMore(VIEW),
        "view that each file, or mask, belongs to: index or id; []: the first, the second, ...",
    )
    tonemap: str = key(
        "auto",
        Choice("auto", *TONEMAPS),
        "tonemap under which a PNG is exported, and the image or a stroke is painted; auto: gamma, or of a "
        "PNG reinhard where gamma clips 0.1 % of its pixels; an image is read as it says or shows itself, "
        "a rendering that says nothing as sRGB",
        when={"target.kind": ("rendering", "image", "strokes")},
    )
    curve: str = key(
        "auto",
        Choice("auto", *TONE_CURVES),
        "tone curve of the photograph; auto: the likeliest; an EXR has none",
        when=_PHOTO,
    )
    exposure: float | str = key(
        "auto",
        OrAuto(Number(-30, 30)),
        "exposure of the photograph, a factor 2^exposure of the scene's radiance; auto: found, while "
        "surfaces keep their mean irradiance",
        "stops",
        _PHOTO,
    )
    white_balance: float | str = key(
        "auto",
        OrAuto(Number(2000, 25000)),
        "temperature of the light that the photograph shows as neutral; auto: found",
        "kelvin",
        _PHOTO,
    )
    vignetting: float = key(
        0.0, Number(0, 8), "how much darker the photograph's lens makes its corners", "stops", _PHOTO
    )
    align: bool = key(
        True, Boolean(), "find by how little the photograph is shifted, scaled and rotated", when=_PHOTO
    )
    strokes: tuple[dict, ...] = key((), StrokeList(), "kind strokes: what is painted on the rendering")
    paint: float = key(1.0, Number(0), "weight of all that was painted together", when=PAINTED)
    rest: str = key(
        "follow",
        Choice("follow", "keep"),
        "what the pixels do that were not painted: follow the light that the paint requires (shading, "
        "highlights, shadows), with the same mean; or keep their values",
        when=PAINTED,
    )
    hold: float | str = key(
        "auto",
        OrAuto(Number(0)),
        "weight of all pixels that were not painted, beside that of paint; auto: 1, but with Gauss-Newton "
        "steps 0.1 where they follow, and where they keep their values as much more than 1 as keeps their "
        "mean change of display values below 0.02",
        when=PAINTED,
    )
    spp: int | str = key(
        "auto",
        OrAuto(Integer(1, 1 << 20)),
        "samples of the target's rendering; auto: 256 to 768, until noise is below 48 dB",
        "per pixel",
        EDITED,
    )

    @property
    def painted(self) -> bool:
        """Whether a picture is painted on, and not rendered or photographed under other light."""
        return self.kind in PAINTED_KINDS

    @property
    def degrees(self) -> float:
        """Turn of the input that is the target's map, where :attr:`file` names no other."""
        return TURN_DEGREES if isinstance(self.rotate_degrees, str) else self.rotate_degrees

    @property
    def display_tonemap(self) -> str:
        """Tonemap of strokes, and of a picture that gamma does not clip."""
        return "gamma" if self.tonemap == "auto" else self.tonemap

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
        count = len(self.files) if self.kind in _PICTURES else len(self.masks)
        return given or tuple(range(count))

    def _check_together(self) -> None:
        self._check_files()
        self._check_views()
        if self.kind == "envmap" and self.file and self.rotate_degrees not in ("auto", 0):
            raise ConfigError(
                "target.file and target.rotate_degrees: got both, expected one: the other map, or the input "
                'turned; remove one, or set rotate_degrees = "auto"'
            )
        if self.painted and not self.paint and self.hold == 0:
            raise ConfigError("target.paint, target.hold: got 0 for both, expected one above 0")
        if self.kind == "strokes" and not self.strokes:
            raise ConfigError('target.strokes: got none, expected at least one, as target.kind is "strokes"')
        if self.kind != "strokes" and self.strokes:
            raise ConfigError(
                f'target.strokes: got {len(self.strokes)}, expected none, as target.kind is "{self.kind}": '
                'set target.kind = "strokes"'
            )

    def _check_files(self) -> None:
        """Raise ConfigError where a kind of target has files that it does not take, or lacks its own."""
        if self.kind == "envmap" and isinstance(self.file, tuple):
            raise ConfigError('target.file: got a list, expected one map, as target.kind is "envmap"')
        if self.kind in ("image", "photo") and not self.file:
            what = "painted image" if self.kind == "image" else "photograph"
            raise ConfigError(f'target.file: got "", expected the {what}, as target.kind is "{self.kind}"')
        for name in ("file", "mask"):
            if self.kind in ("none", "strokes") and (given := getattr(self, name)):
                raise ConfigError(
                    f'target.{name}: got {show(given)}, expected none, as target.kind is "{self.kind}"'
                )

    def _check_views(self) -> None:
        """Raise ConfigError where views do not match the files or masks, or are given twice."""
        files = len(self.files) if self.kind in _PICTURES else len(self.masks)
        if self.view != () and self.kind == "strokes":
            raise ConfigError("target.view: got one, expected none: each stroke has a view of its own")
        if self.view != () and len(self.views) != files:
            raise ConfigError(f"target.view: got {len(self.views)} views, expected {files}, one a file")
        if len({*self.views}) != len(self.views):
            raise ConfigError("target.view: got a view twice, expected each once")
        if self.kind in _PICTURES and self.mask and len(self.masks) != files:
            raise ConfigError(f"target.mask: got {len(self.masks)} masks, expected {files}, one a file")


def _each(files: str | tuple[str, ...]) -> tuple[str, ...]:
    """List the files of a key that takes one or several."""
    return files if isinstance(files, tuple) else (files,) if files else ()
