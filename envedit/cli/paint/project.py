"""A project: the folder of one painting, and ``painted.toml`` in it, which ``envedit run`` carries out."""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from envedit import config
from envedit.cli import run
from envedit.cli.paint.protocol import ORIENTATION, TABLES, Document
from envedit.config import presets
from envedit.core import array_cache, atomic_files, file_locks
from envedit.core.errors import ConfigError, InputError

NAME, SOLUTION = "painted.toml", "painted.npz"
"""Files of a painting: what was painted, and the solution that was saved last."""
MATCHED = "matched.exr"
"""The map that explains a photograph, in the folder of the run that has found it."""
LISTS = ("lights", "regions", "strokes")
"""What a document lists, each entry a table of its own in ``painted.toml``."""
_RECENT = 12


@dataclass(frozen=True)
class Project:
    """What is painted on, and where results go."""

    # Without what the document has: strokes, lights placed by hand, and how they are solved for
    settings: config.Config
    folder: Path  # of the results and ``painted.toml``
    base: Path  # what file names in scene parameters are relative to
    document: Document  # as it was left the last time
    again: bool = False  # whether ``painted.toml`` was there already
    start: str = ""  # file of the solution that was saved of the document, "" where it has changed since
    # The run that makes the map: it matches a photograph. None without one, and where it is done
    photo: config.Config | None = None
    note: str = ""  # what a user should know

    def configured(self, document: Document, start: str = "") -> config.Config:
        """Return the configuration that makes the map of a document; arguments as of :meth:`text`."""
        settings = config.loads(self.text(document, start), self.folder, str(self.folder / NAME))
        return replace(settings, output=_without(settings.output, dir=str(self.folder)))

    def text(self, document: Document, start: str = "") -> str:
        """Return ``painted.toml``: what was given, what was painted, and the solution where there is one."""
        settings = self.settings
        target = {"kind": "strokes", "strokes": document.strokes} if document.strokes else {"kind": "none"}
        kept = ("tonemap", "paint", "hold", "spp") if document.strokes else ("spp",)
        given = settings.given_tables
        given["target"] = {key: given["target"][key] for key in kept if key in given["target"]} | target
        given["scene"]["file"] = settings.scene.file
        if "parameters" in given["scene"]:
            named = given["scene"]["parameters"]
            given["scene"]["parameters"] = {key: self._found(value) for key, value in named.items()}
        given["input"] = {"envmap": settings.input.envmap} | given["input"]
        for name, value in document.plain().items():
            if name not in LISTS and value != getattr(Document, name):
                given[TABLES[name]][name] = value
        if start:
            given["optimizer"] |= {"start": start, "iterations": 0}  # the map that was shown, and no other
        given["output"].pop("dir", None)
        lines = [
            f"# Painted with `envedit paint`; `envedit run {NAME}` makes the same map.",
            f"preset = {config.quote(settings.preset)}",
            f"seed = {settings.seed}",
            f"variant = {config.quote(settings.variant)}",
        ]
        for name, table in given.items():
            plain = {key: value for key, value in table.items() if key not in LISTS}
            if plain:
                lines += ["", f"[{name}]", *(f"{key} = {config.quote(v)}" for key, v in plain.items())]
        of_input = [(f"input.{name}", getattr(document, name)) for name in ("lights", "regions")]
        for name, entries in [*of_input, ("target.strokes", document.strokes)]:
            for entry in entries:
                lines += ["", f"[[{name}]]", *(f"{key} = {config.quote(v)}" for key, v in entry.items())]
        return "\n".join(lines) + "\n"

    def _found(self, value):
        """Make a parameter that names a file beside the configuration absolute."""
        with contextlib.suppress(OSError, ValueError):
            if isinstance(value, str) and value and (self.base / value).is_file():
                return str((self.base / value).absolute())
        return value

    @contextlib.contextmanager
    def alone(self) -> Iterator[None]:
        """Make the folder, and let no other server paint in it meanwhile.

        InputError if it cannot be made, or another server has it.
        """
        atomic_files.make_folder(self.folder)
        with contextlib.ExitStack() as stack:
            try:
                stack.enter_context(file_locks.locked(self.folder / "painted.lock"))
            except file_locks.Busy as busy:
                raise InputError(
                    f"{self.folder}: {busy} has this painting open: end that `envedit paint`, or "
                    "give a configuration of another [output] dir"
                ) from None
            yield

    def keep(self, document: Document, start: str = "") -> None:
        """Write ``painted.toml``, whole or not at all; as of :meth:`text`; InputError if it cannot."""
        atomic_files.make_folder(self.folder)
        atomic_files.write_atomically(self.folder / NAME, self.text(document, start).encode())


def opened(name: str, envmap: str = "", preset: str | None = None, camera: str = "") -> Project:
    """Open a configuration, a scene or what was painted before: a file, or the name of a shipped one.

    ``envmap``, ``preset`` and ``camera``, the id of a sensor, of a USD file its path, take the place of the
    configuration's. ConfigError as of :func:`.schema.load`; also for a target that is no paint, where the
    configuration says so.
    """
    overrides = [f"input.envmap={config.quote(_path(envmap))}"] if envmap else []
    overrides += [f"scene.sensors={config.quote([camera])}"] if camera else []
    settings, file, base = run.load(name, preset, overrides)
    if settings.representation.kind != "layers" or settings.renderer.kind != "transport":
        raise ConfigError(
            f"{name}: got representation.kind {settings.representation.kind!r} and renderer.kind "
            f"{settings.renderer.kind!r}, expected layers and transport: paint solves with these"
        )
    document = Document(**{name: getattr(getattr(settings, table), name) for name, table in TABLES.items()})
    if settings.target.kind == "photo":
        return _continued(_of_photo(settings, base))
    if file is not None and file.name == NAME:
        folder = file.absolute().parent
        plain = _plain(settings, folder)
        return Project(plain, folder, base, document, again=True, start=settings.optimizer.start)
    return _continued(Project(settings, Path(settings.output.dir), base, document))


def on_another_map(before: Project, document: Document, envmap: str) -> Project:
    """Return the painting of a document on another map, without what it says of the lights of its own.

    Its folder is beside that of the painting before; a painting of this map that is there is gone on with.
    """
    given = _without(before.settings.input, "unclip", "repair", "colour_space", envmap=_path(envmap))
    added = tuple(light for light in document.lights if "light" not in light)
    document = replace(document, lights=added)
    settings = replace(before.settings, input=given)
    return _continued(Project(settings, before.folder, before.base, document), its_own=True)


def _of_photo(settings, base):
    """Return a project on the map that explains a photograph, which one run makes for each photograph."""
    files = *settings.target.files, *settings.target.masks
    read = [atomic_files.digest(file) for file in files if Path(file).is_file()]
    key = hashlib.sha256(b"".join([config.to_toml(settings).encode(), *read])).hexdigest()[:8]
    folder = Path(settings.output.dir)
    matched = folder / f"photograph-{key}" / MATCHED
    photo = replace(settings, output=_without(settings.output, dir=str(matched.parent), format="exr"))
    given = settings.input.given_values
    kept = {name: given[name] for name in ("width", "rows", "horizon") if name in given}
    matched_input = config.Input(envmap=str(matched), **kept)
    settings = replace(settings, lights=config.Lights(), input=matched_input)
    return Project(settings, folder, base, Document(), photo=None if matched.exists() else photo)


def _path(envmap):
    """Return a word as it is, and a path from the working folder as an absolute one."""
    return envmap if envmap in presets.MAP_WORDS else str(Path(envmap).absolute())


def _plain(settings, folder):
    """Return settings without what the document has."""
    solved = ("start", "iterations") if settings.optimizer.start else ()
    return replace(
        settings,
        input=_without(settings.input, "lights", "regions", *ORIENTATION),
        output=_without(settings.output, "exposure", "temperature", dir=str(folder)),
        target=_without(settings.target, "kind", "strokes", "file", "mask", "rotate_degrees", "rest"),
        solve=_without(settings.solve, "freedom"),
        optimizer=_without(settings.optimizer, *solved),
    )


def _without(table, *names, **more):
    """Return a table with some keys as if they had not been given, and others as given."""
    kept = {key: value for key, value in table.given_values.items() if key not in names}
    return type(table)(**kept | more)


def _continued(project, its_own=False):
    """Go on from a ``painted.toml`` of the same scene and map, with this project's preset and settings.

    Of another scene or map, in a folder beside it. ``its_own``: with the settings of that painting.
    """
    folder, tried = project.folder, 1
    settings = project.settings
    while (folder / NAME).exists():
        with contextlib.suppress(ConfigError):  # not ours to overwrite
            before = config.load(folder / NAME, settings.preset)
            if before.scene == settings.scene and before.input.envmap == settings.input.envmap:
                painting = opened(str(folder / NAME), preset=settings.preset)
                if its_own:
                    return replace(painting, base=project.base)
                again = replace(painting, settings=_plain(settings, folder), base=project.base)
                if again.text(again.document) == painting.text(painting.document):
                    return again
                note = f"Goes on from {NAME} of {folder.name}, with the configuration's present settings"
                return replace(again, start="", note=note)
        tried += 1
        folder = project.folder.with_name(f"{project.folder.name}-{tried}")
    return replace(project, settings=_plain(settings, folder), folder=folder)


def recent() -> list[dict]:
    """List what was painted lately, the last first: ``path`` of ``painted.toml``, ``title``, ``picture``.

    That is the rendering that was saved, "" where none was.
    """
    with contextlib.suppress(OSError, ValueError, TypeError, KeyError, AttributeError):
        listed = json.loads(_recent_file().read_text(encoding="utf-8"))
        found = [{"path": str(one["path"]), "title": str(one["title"])} for one in listed]
        there = [one for one in found if Path(one["path"]).is_file()][:_RECENT]
        for one in there:
            picture = Path(one["path"]).with_name("render_edited.exr")
            one["picture"] = str(picture) if picture.is_file() else ""
        return there
    return []


def note(project: Project) -> None:
    """Note that a project was worked on; a cache that cannot be written is no error."""
    path = str(project.folder / NAME)
    title = f"{run.scene_name(Path(project.settings.scene.file))}, {Path(project.settings.input.envmap).stem}"
    listed = [{"path": path, "title": title}, *(one for one in recent() if one["path"] != path)]
    with contextlib.suppress(OSError, AttributeError, InputError):
        file = _recent_file()
        file.parent.mkdir(parents=True, exist_ok=True)
        atomic_files.write_atomically(file, json.dumps(listed[:_RECENT]).encode())


def _recent_file():
    folder = array_cache.cache_folder("paint")
    return None if folder is None else folder / "recent.json"
