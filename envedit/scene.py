"""Load a Mitsuba scene lit by one environment emitter, and render it under any map: the reference renderer.

A scene comes from an XML file, a dict or the name of a shipped scene. Mitsuba's parser turns it into a list
of nodes, and four things are changed there before anything is built, so that a broken reference in a part
that is not used cannot get in the way:

- the environment emitter, whatever its kind, becomes an ``envmap`` with the same orientation whose texels
  are set by :meth:`Scene.set_envmap`;
- the film gets the asked size and float32 RGB; its reconstruction filter stays the author's;
- a rough BSDF whose alpha is zero becomes its smooth sibling, the exact limit, where Mitsuba would clamp;
- a shape with the properties ``fit_height`` (and ``fit_up``, one of x, y, z with or without a minus) is
  centred on the y axis, set on the plane y = 0 and scaled to that height, or to 1.5 times it in width.

With scene and camera fixed a rendering is I = T E + I_0: linear in the map E, plus a constant I_0 where the
scene has lamps besides its environment, which stay as they are.
"""

import difflib
import hashlib
import os
import re
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np

from . import latlong
from .errors import ConfigError, InputError, NumericalError

__all__ = ["SHIPPED", "Scene", "load"]

SHIPPED = ("sphere", "mirror", "matte", "statue", "mesh")
"""Names of the scenes that come with the package."""

# Emitters at infinity that shine from every direction, with the rotation that brings an envmap's zenith (+y)
# to theirs. Mitsuba's sky models stand upright on z.
_UPRIGHT_ON_Z = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
_ENVIRONMENTS = {
    "envmap": np.eye(3),
    "constant": np.eye(3),
    "sky": _UPRIGHT_ON_Z,
    "sunsky": _UPRIGHT_ON_Z,
    "timed_sunsky": _UPRIGHT_ON_Z,
}
_SMOOTH = {"roughconductor": "conductor", "roughplastic": "plastic", "roughdielectric": "dielectric"}
_SMALLEST_ALPHA = 1e-4  # Mitsuba's own clamp
_AXES = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1)}
_MESHES = {".ply": "ply", ".obj": "obj", ".serialized": "serialized"}
_MOST_WIDTH_PER_HEIGHT = 1.5
_PASS_SAMPLES = 2**22  # bounds the memory of a wavefront, whatever the film and spp


# ----------------------------------------------------------------------------------------------------------
# The scene


@dataclass(frozen=True, eq=False)
class Scene:
    """A scene under one replaceable environment map; made by :func:`load`.

    Attributes
    ----------
    mi : mitsuba.Scene
        The scene itself; its only emitter is an ``envmap``.
    path : Path or None
        The XML file, None for a dict.
    width, height : int
        Size of a rendering in pixels.
    envmap_key : str
        Name of the texels in ``params``; their layout is :func:`envedit.latlong.to_envmap_data`'s.
    to_world : array (3, 3) float64
        Rotation from the emitter's frame to the scene's.
    digest : str
        SHA-256 (hex) of all that a rendering depends on but the map: objects, files they name, camera, film.
        Comments and the place of the files do not count.
    params : mitsuba.SceneParameters
        ``mi.traverse`` of the scene.
    """

    mi: mi.Scene
    path: Path | None
    width: int
    height: int
    envmap_key: str
    to_world: np.ndarray
    digest: str
    params: mi.SceneParameters

    def set_envmap(self, image) -> None:
        """Light the scene by a map.

        Parameters
        ----------
        image : array (H, W, 3)
            Linear radiance, finite and not negative; any resolution, also another than before.

        Raises
        ------
        InputError
            If the shape is not that of a map.
        NumericalError
            If a texel is not finite or is negative in float32; one such texel spoils every lit pixel.
        """
        image = np.asarray(image)
        if image.ndim != 3 or image.shape[2] != 3 or not np.issubdtype(image.dtype, np.number):
            what = f"shape {image.shape} of {image.dtype}"
            raise InputError(f"environment map: came {what}, wanted (H, W, 3) numbers")
        with np.errstate(over="ignore"):  # a float64 too large for float32 becomes inf, and is named below
            image = image.astype(np.float32)
        if not (good := np.isfinite(image) & (image >= 0)).all():
            row, column, channel = np.argwhere(~good)[0]
            bad = np.count_nonzero(~good.all(axis=2))
            raise NumericalError(
                f"environment map: {bad} texels are not finite or are negative, "
                f"the first at row {row}, column {column}: {image[row, column, channel]} in {'RGB'[channel]}"
            )
        self.params[self.envmap_key] = mi.TensorXf(latlong.to_envmap_data(image))
        self.params.update()

    def render(self, image, spp: int = 64, seed: int = 0, max_depth: int = -1) -> np.ndarray:
        """Render the scene under a map by Mitsuba's ``path`` integrator, with fresh samples.

        The samples are split into passes of at most 2^22, each with its own seed derived from ``seed``, and
        averaged in float64.

        Parameters
        ----------
        image : array (H, W, 3)
            Linear radiance.
        spp : int
            Samples per pixel.
        seed : int
            The same seed gives the same samples.
        max_depth : int
            Longest path in segments, as Mitsuba counts them: 2 is direct light; -1 has no bound.

        Returns
        -------
        array (height, width, 3) float32
            Linear radiance.

        Raises
        ------
        ConfigError
            If ``spp``, ``seed`` or ``max_depth`` is out of range.
        InputError, NumericalError
            As :meth:`set_envmap`; also NumericalError if a pixel comes out non-finite.
        """
        spp = _whole("spp", spp, 1)
        seed = _whole("seed", seed, 0)
        max_depth = _whole("max_depth", max_depth, -1)
        self.set_envmap(image)
        integrator = mi.load_dict({"type": "path", "max_depth": max_depth, "hide_emitters": False})
        most = max(1, _PASS_SAMPLES // (self.width * self.height))
        counts = [most] * (spp // most) + ([spp % most] if spp % most else [])
        total = np.zeros((self.height, self.width, 3))
        for i, count in enumerate(counts):
            pass_seed = int(np.random.SeedSequence([seed, i]).generate_state(1)[0])
            picture = mi.render(self.mi, integrator=integrator, spp=count, seed=pass_seed)
            total += count / spp * np.array(picture, dtype=np.float64)
        with np.errstate(over="ignore"):
            result = total.astype(np.float32)
        if not (finite := np.isfinite(result).all(axis=2)).all():
            row, column = np.argwhere(~finite)[0]
            raise NumericalError(
                f"rendering of {self.path or 'the scene'}: {np.sum(~finite)} pixels are not finite, "
                f"the first at row {row}, column {column}; look for broken materials or too much light"
            )
        return result


def load(file, width=None, height=None, parameters=None, base=None) -> Scene:
    """Load a scene and make its environment emitter replaceable.

    Parameters
    ----------
    file : path, str or dict
        A Mitsuba XML file, the name of a shipped scene (``SHIPPED``, with or without ``.xml``; a file of that
        name in the working folder comes first), or a dict as ``mi.load_dict`` takes it.
    width, height : int, optional
        Size of the rendering in pixels. None or 0: the scene's own, or by its aspect if one of both is given.
    parameters : dict, optional
        Values for the ``$names`` of the XML.
    base : path, optional
        Folder for relative file names that are not beside the XML, such as a mesh in ``parameters``.
        Default: the working folder.

    Returns
    -------
    Scene
        Lit by a grey map until :meth:`Scene.set_envmap` or :meth:`Scene.render` sets another. If the scene
        has several sensors its first one is used, as Mitsuba does.

    Raises
    ------
    ConfigError
        If a parameter is unknown, missing or unusable, or the size is.
    InputError
        If a file is missing or damaged, or the scene is not lit by exactly one environment emitter.
    """
    if not (mi.variant() or "").endswith("_rgb"):
        raise ConfigError(f"variant: came {mi.variant()}, wanted one that ends in _rgb, such as llvm_ad_rgb")
    width, height = _whole("width", width or 0, 0), _whole("height", height or 0, 0)
    config = mi.parser.ParserConfig(mi.variant())
    config.merge_meshes = False  # shapes keep their names
    config.unused_parameters = mi.LogLevel.Debug  # checked here, with the nearest name
    base = Path(base or ".").absolute()
    if isinstance(file, dict):
        if parameters:
            raise ConfigError("scene.parameters: a scene given as a dict has no $names to fill")
        path, where, folders = None, "scene dict", (base,)
        state = _told(where, mi.parser.parse_dict, config, file)
    else:
        path = _find(file)
        where, folders = str(path), (path.parent, base)
        filled = _check_parameters(path, parameters or {})
        state = _told(where, mi.parser.parse_file, config, str(path), **filled)
    _told(where, mi.parser.transform_all, config, state)

    emitter, to_world = _replace_environment(state, where)
    digest = hashlib.sha256(b"envedit scene 1")
    _set_film(state, where, width, height)
    _find_files(state, where, folders)
    for node in state.nodes:
        _smooth_limit(state, node)
        _fit(state, node)
        _hash_node(digest, node)
    emitter["bitmap"] = mi.Bitmap(np.full((4, 8, 3), 0.5, np.float32))
    # Mitsuba refuses properties that nobody has asked for, which finds typing errors; we asked for all.
    for node in state.nodes:
        for name in node.props.keys():  # noqa: SIM118 (no dict)
            node.props.mark_queried(name, False)

    built = _told(where, mi.parser.instantiate, config, state)
    scene = built[0] if isinstance(built, list | tuple) else built
    if scene.environment() is None or scene.environment().id() != emitter.id():
        raise InputError(f"{where}: a ready-made environment emitter cannot be replaced; give its dict")
    params = mi.traverse(scene)
    key = next(name for name, _ in params if name.split(".")[-2:] == [emitter.id(), "data"])
    columns, rows = (int(n) for n in scene.sensors()[0].film().crop_size())
    return Scene(scene, path, columns, rows, key, to_world, digest.hexdigest(), params)


# ----------------------------------------------------------------------------------------------------------
# Files and parameters


def _find(file) -> Path:
    """Return the XML file meant by a path or by the bare name of a shipped scene."""
    path = Path(file)
    if path.is_file():
        return path.absolute()
    name = path.name.removesuffix(".xml")
    bare = path.name == str(file)
    here = Path(__file__).parent
    if bare and name in SHIPPED:
        # In a source checkout the scenes lie beside the package, in an installed wheel inside it.
        for folder in (here / "scenes", here.parent / "scenes"):
            if (folder / f"{name}.xml").is_file():
                return folder / f"{name}.xml"
        raise InputError(f"scene {name}: {name}.xml is missing from this installation; install envedit again")
    if path.is_dir():
        raise InputError(f"scene {file}: this is a folder, wanted a Mitsuba XML file")
    close = difflib.get_close_matches(name, SHIPPED, 1) if bare else []
    wanted = f"wanted a Mitsuba XML file or one of {', '.join(SHIPPED)}"
    hint = f"did you mean {close[0]}?" if close else wanted
    raise InputError(f"scene {file}: no such file; {hint}")


def _check_parameters(path: Path, parameters: dict) -> dict[str, str]:
    """Return the parameters as text, after comparing their names with the ``$names`` of the XML."""
    used, defaults = _names(path, set())
    for name in parameters:
        if name not in used | defaults:
            close = difflib.get_close_matches(str(name), used | defaults, 1)
            known = ", ".join(sorted(used | defaults)) or "none"
            raise ConfigError(
                f"scene.parameters: {path.name} has no parameter {name}"
                + (f"; did you mean {close[0]}?" if close else "")
                + f" (known: {known})"
            )
    if missing := sorted(used - defaults - parameters.keys()):
        raise ConfigError(
            f"scene.parameters: {path.name} needs {', '.join(missing)}, which has no default; "
            f"write parameters = {{ {missing[0]} = ... }}"
        )
    filled = {}
    for name, value in parameters.items():
        if isinstance(value, bool):
            value = "true" if value else "false"
        elif isinstance(value, float | np.floating) and not np.isfinite(value):
            raise ConfigError(f"scene.parameters: {name} is {value}, wanted a finite number")
        elif not isinstance(value, str | os.PathLike | int | float | np.integer | np.floating):
            kind = type(value).__name__
            raise ConfigError(f"scene.parameters: {name} is a {kind}, wanted text or a number")
        filled[name] = str(value)
    return filled


def _names(path: Path, seen: set) -> tuple[set, set]:
    """Return the ``$names`` used in an XML file and those with a default, included files too."""
    seen.add(path)
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise InputError(f"scene {path}: {error.strerror or error}") from None
    text = re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL)
    used = set(re.findall(r"\$\{?([A-Za-z_]\w*)", text))
    defaults = set()
    for tag in re.findall(r"<default\b[^>]*>", text):
        defaults |= set(re.findall(r"\bname\s*=\s*[\"']([^\"']*)", tag))
    for tag in re.findall(r"<include\b[^>]*>", text):
        for name in re.findall(r"\bfilename\s*=\s*[\"']([^\"'$]+)[\"']", tag):
            included = path.parent / name
            if included not in seen and included.is_file():
                more = _names(included, seen)
                used, defaults = used | more[0], defaults | more[1]
    return used, defaults


def _find_files(state, where: str, folders) -> None:
    """Make every file name absolute; the environment's own bitmap is already gone and need not exist."""
    for node in state.nodes:
        if "filename" not in node.props or not isinstance(name := node.props["filename"], str):
            continue
        found = [f / name for f in folders if (f / name).is_file()]
        if not found:
            kind = str(node.type).rpartition(".")[2].lower()
            raise InputError(
                f"{_at(state, node, where)}: the {kind} names a missing file: {name or '(empty)'}\n"
                f"looked in {' and '.join(dict.fromkeys(map(str, folders)))}"
            )
        node.props["filename"] = str(found[0])


def _told(where: str, call, *arguments, **filled):
    """Call the parser, and say in one line what it says in many."""
    try:
        return call(*arguments, **filled)
    except (RuntimeError, ValueError, TypeError, LookupError, OSError) as error:
        text = re.sub(r"\[[A-Za-z][\w.]*(:\d+)?\] ", "", str(error))
        text = " ".join(text.split())
        for prefix in (f"At {where} ", f"Error while loading {where} ", f"While loading {where} ",
                       f"Parsing of XML file {where} failed: ", f'Parsing of XML file "{where}" failed: ',
                       'At dictionary node "root": '):  # fmt: skip
            text = text.replace(prefix, "")
        raise InputError(f"{where}: {text if len(text) <= 300 else text[:297] + '...'}") from None


def _at(state, node, where: str) -> str:
    return mi.parser.file_location(state, node) if state.files else f"{where}, {node.props.id()}"


def _whole(name: str, value, low: int) -> int:
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < low:
        raise ConfigError(f"{name}: came {value!r}, wanted a whole number of at least {low}")
    return int(value)


# ----------------------------------------------------------------------------------------------------------
# Changes to the parsed scene


def _replace_environment(state, where: str) -> tuple[mi.Properties, np.ndarray]:
    """Put an ``envmap`` in place of the one environment emitter; return its properties and rotation."""
    nodes = [n for n in state.nodes if n.type == mi.ObjectType.Emitter]
    found = [n for n in nodes if n.props.plugin_name() in _ENVIRONMENTS]
    if len(found) != 1:
        kinds = ", ".join(n.props.plugin_name() for n in found)
        what = f"{len(found)} environment emitters ({kinds})" if found else "no environment emitter"
        raise InputError(f'{where}: {what}; wanted exactly one, such as <emitter type="constant"/>')
    node, plugin = found[0], found[0].props.plugin_name()
    matrix = np.eye(4)
    if plugin != "constant" and "to_world" in node.props:
        matrix = np.array(node.props["to_world"].matrix, np.float64).reshape(4, 4)
    rotation = matrix[:3, :3]
    proper = np.isfinite(rotation).all() and np.linalg.det(rotation) > 0
    if not proper or np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-4:
        raise InputError(
            f"{_at(state, node, where)}: to_world of the environment emitter scales, shears or mirrors; "
            "wanted a rotation (the axis of <rotate> has length 1)"
        )
    rotation = rotation @ _ENVIRONMENTS[plugin]
    matrix = np.eye(4)  # where an environment stands has no meaning: a translation is dropped
    matrix[:3, :3] = rotation
    taken = {n.props.id() for n in state.nodes if n is not node}
    emitter = mi.Properties("envmap")
    emitter.set_id(next(name for i in range(len(taken) + 1) if (name := f"envmap{i or ''}") not in taken))
    emitter["to_world"] = mi.ScalarTransform4d(matrix)
    node.props = emitter
    return node.props, rotation


def _set_film(state, where: str, width: int, height: int) -> None:
    """Give the first sensor's film the asked size and float32 RGB pixels."""
    sensors = [n for n in state.nodes if n.type == mi.ObjectType.Sensor]
    if not sensors:
        raise InputError(f'{where}: the scene has no sensor; add <sensor type="perspective">')
    inside = [
        state.nodes[v.index()]
        for _, v in sensors[0].props.items()
        if isinstance(v, mi.Properties.ResolvedReference)
    ]
    films = [n for n in inside if n.type == mi.ObjectType.Film]
    if not films or films[0].props.plugin_name() != "hdrfilm":
        raise InputError(f'{_at(state, sensors[0], where)}: the sensor needs a <film type="hdrfilm">')
    film = films[0].props
    own = [int(film.get("width", 768)), int(film.get("height", 576))]  # Mitsuba's defaults
    if width or height:
        if any(str(name).startswith("crop_") for name, _ in film.items()):
            raise ConfigError(
                f"scene.width: the film of {where} is cropped; remove the crop or leave width and height"
            )
        if not height:
            height = max(1, round(width * own[1] / own[0]))
        if not width:
            width = max(1, round(height * own[0] / own[1]))
        film["width"], film["height"] = width, height
    film["pixel_format"], film["component_format"] = "rgb", "float32"


def _smooth_limit(state, node) -> None:
    """Turn a rough BSDF of roughness zero into the smooth one; refuse a negative roughness."""
    props = node.props
    if node.type != mi.ObjectType.BSDF or props.plugin_name() not in _SMOOTH:
        return
    alphas = [k for k in ("alpha", "alpha_u", "alpha_v") if isinstance(props.get(k, None), float | int)]
    for key in alphas:
        if not props[key] >= 0:
            where = _at(state, node, "scene")
            raise ConfigError(f"{where}: roughness {key} is {props[key]}, wanted 0 or more")
    if alphas and all(props[k] <= _SMALLEST_ALPHA for k in alphas):
        for key in (*alphas, "distribution", "sample_visible"):
            if key in props:
                del props[key]
        props.set_plugin_name(_SMOOTH[props.plugin_name()])


def _fit(state, node) -> None:
    """Set a shape that carries ``fit_height`` on the plane y = 0, centred and scaled; see the module."""
    props = node.props
    if node.type != mi.ObjectType.Shape or "fit_height" not in props:
        return
    where = _at(state, node, "scene")
    target, up = float(props["fit_height"]), str(props.get("fit_up", "y")).lower()
    for key in ("fit_height", "fit_up"):
        if key in props:
            del props[key]
    if not (np.isfinite(target) and target > 0):
        raise ConfigError(f"{where}: fit_height is {target}, wanted a positive number")
    if up.removeprefix("-") not in _AXES:
        raise ConfigError(f"{where}: the up axis is {up!r}, wanted x, y, z, -x, -y or -z")
    filename = str(props.get("filename", ""))
    if filename:
        if (suffix := Path(filename).suffix.lower()) not in _MESHES:
            raise InputError(f"{filename}: cannot read a mesh of this kind; wanted {', '.join(_MESHES)}")
        props.set_plugin_name(_MESHES[suffix])

    # First the mesh's own up to +y, then the author's to_world (a turn about y, say), then size and place.
    transform = np.eye(4)
    transform[:3, :3] = _upright(up)
    if "to_world" in props:
        transform = np.array(props["to_world"].matrix, np.float64).reshape(4, 4) @ transform
    props["to_world"] = mi.ScalarTransform4d(transform)
    probe = {k: v for k, v in props.items() if not isinstance(v, mi.Properties.ResolvedReference)}
    box = _told(where, mi.load_dict, {"type": props.plugin_name(), **probe}).bbox()
    low, high = (np.array(v, np.float64).ravel() for v in (box.min, box.max))
    extent = high - low
    if not (np.isfinite(extent).all() and extent[1] > 0):
        raise InputError(f"{filename or where}: the mesh has no height along its up axis {up}")
    scale = min(target / extent[1], _MOST_WIDTH_PER_HEIGHT * target / max(extent[0], extent[2], 1e-30))
    place = np.eye(4)
    place[:3, :3] *= scale
    place[:3, 3] = -scale * np.array([(low[0] + high[0]) / 2, low[1], (low[2] + high[2]) / 2])
    props["to_world"] = mi.ScalarTransform4d(place @ transform)


def _upright(up: str) -> np.ndarray:
    """Return the rotation ``(3, 3)`` about a coordinate axis that brings an axis to +y."""
    a = np.array(_AXES[up.removeprefix("-")], float) * (-1 if up.startswith("-") else 1)
    y = np.array([0.0, 1, 0])
    v, c = np.cross(a, y), a @ y
    if c < -0.5:
        return np.diag([1.0, -1, -1])
    skew = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.eye(3) + skew + skew @ skew / (1 + c)


# ----------------------------------------------------------------------------------------------------------
# Digest


def _hash_node(digest, node) -> None:
    digest.update(f"{node.type}|{node.props.plugin_name()}\n".encode())
    for key, value in node.props.items():
        digest.update(f"{key}=".encode())
        if key == "filename":
            digest.update(hashlib.sha256(Path(value).read_bytes()).digest())
        else:
            _hash_value(digest, value)


def _hash_value(digest, value) -> None:
    if isinstance(value, bool | int | float | str):
        digest.update(repr(value).encode())
    elif isinstance(value, mi.Properties.ResolvedReference):
        digest.update(f"@{value.index()}".encode())
    elif hasattr(value, "matrix"):
        digest.update(np.array(value.matrix, np.float64).tobytes())
    elif hasattr(value, "wavelengths"):
        digest.update(repr((list(value.wavelengths), list(value.values))).encode())
    elif isinstance(value, mi.Object) and not isinstance(value, mi.Bitmap):
        digest.update(type(value).__name__.encode())
        for key, inner in mi.traverse(value).items():
            digest.update(key.rpartition(".")[2].encode())
            _hash_value(digest, inner)
    else:
        array = np.array(value)
        digest.update(f"{array.dtype}{array.shape}".encode())
        digest.update(array.tobytes() if array.dtype != object else repr(value).encode())
    digest.update(b"\n")
