"""The folder of a run: the names of what it may hold, one run at a time, nothing of an earlier run lost."""

from __future__ import annotations

import contextlib
import filecmp
import os
import re
import shutil
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from envedit import config
from envedit.core import file_locks
from envedit.core.errors import EnveditError, InputError
from envedit.core.types import FilePath, Views

COMPLETE, CHECKPOINT = "metrics.json", "checkpoint.npz"
"""Files of a run that is complete, and of one that may go on."""
RESULTS = (
    COMPLETE, "edited.exr", "edited.hdr", "edited_full.exr", "edited_full.hdr", "edited_layers.exr",
    "edited_sky.exr", "edited_lights.exr", "lights.json", "look.toml", "edited.xml", "edited.usda",
    "render_initial.exr", "render_target.exr", "render_edited.exr", "influence.exr", "influence.png",
    "unreachable.png", "photograph.png",
    "preview.png", "report.html", "history.csv", "config.toml", "manifest.json", "given_envmap.exr",
    "given_target_map.exr", "given_target.exr", "given_mask.exr", "variants", CHECKPOINT,
)  # fmt: skip
"""What a run may leave in its folder, beside the files of single views (:func:`names`).

Whoever moves them away moves :data:`COMPLETE` first of all.
"""
_NUMBERED = re.compile(r"render_(initial|target|edited)_\d+\.exr")  # of one view among several
EARLIER = "earlier"
"""With a number, the folder that what an earlier run left is moved to."""


def of_views(name: str, views: Views) -> list[tuple[str, slice]]:
    """List the files of a rendering and the rows in each: of several views one more for each, numbered.

    >>> of_views("render_edited.exr", [slice(0, 4), slice(4, 9)])[1:]
    [('render_edited_0.exr', slice(0, 4, None)), ('render_edited_1.exr', slice(4, 9, None))]
    """
    stem, dot, ending = name.rpartition(".")
    numbered = [(f"{stem}_{k}{dot}{ending}", rows) for k, rows in enumerate(views)]
    return [(name, views[0]), *(numbered if len(views) > 1 else [])]


def names(folder: Path) -> tuple[str, ...]:
    """Return :data:`RESULTS`, and the numbered renderings that are in a folder."""
    numbered = sorted(path.name for path in folder.glob("render_*.exr") if _NUMBERED.fullmatch(path.name))
    return (*RESULTS, *numbered)


def inputs_of(settings: config.Config, base: Path | None = None) -> Iterator[FilePath]:
    """Yield the files that a configuration reads, which no result may replace; at last those of its scene.

    ``base`` is as of :func:`.scene.load`. Mitsuba is imported when the last are asked for.
    """
    target, weights = settings.target, settings.perceptual
    yield from filter(None, (settings.input.envmap, settings.optimizer.start, *target.files, *target.masks))
    yield from filter(None, (weights.vgg, weights.dists, weights.backbone, weights.heads))
    from envedit.scene import scene

    yield from scene.files(settings.scene, base)


def tidy(folder: Path) -> None:
    """Remove what killed processes were writing in a folder, in which this one is :func:`alone`.

    That are temporary names of what a run may leave.
    """
    for path in folder.glob(".*.*.*"):
        stem, ending, writer = path.name[1:].split(".")[:3]
        name = f"{stem}.{ending}"
        if writer.isdecimal() and (name in RESULTS or _NUMBERED.fullmatch(name)):
            with contextlib.suppress(OSError):
                path.unlink()


@contextlib.contextmanager
def alone(folder: Path) -> Iterator[None]:
    """Make a folder for results, and let no other process of this machine work in it meanwhile.

    What is made is removed again where nothing was written into it. InputError if it cannot be made, or
    another process works in it.
    """
    made: list[Path] = []
    try:
        made += (path for path in (folder, *folder.parents) if not path.exists())
        if folder.exists() and not folder.is_dir():
            raise InputError(f"{folder}: is a file, the results need another folder")
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _unusable(folder, error) from error
    descriptor = None
    with contextlib.suppress(OSError):  # Windows does not open folders
        descriptor = os.open(folder, os.O_RDONLY)
    try:
        if descriptor is not None and not file_locks.lock(descriptor):
            raise InputError(f"{folder}: another run works in it: wait, or use another folder")
        yield
    finally:
        if descriptor is not None:
            os.close(descriptor)
        with contextlib.suppress(OSError):  # something is in it
            for path in made:
                path.rmdir()


@contextlib.contextmanager
def results_in(
    folder: Path,
    names: Sequence[str],
    inputs: Iterable[FilePath] = (),
    keep: bool = False,
    spare: Iterable[FilePath] = (),
) -> Iterator[None]:
    """Make a folder for results, as :func:`alone`, and move what an earlier run left there to ``earlier-N``.

    InputError if an input lies where a result would go, or the folder cannot be used. Of the results'
    ``names`` the first, which says that a run is complete, is moved first.
    After an error of the user's before any result is written, what was moved is moved back.

    ``inputs`` are what the run reads, and must not be moved; they are looked at where the folder holds any
    result. ``keep`` leaves what is there, if it is complete or there is a checkpoint: it is to be continued.
    What is to ``spare`` is copied and not moved, if it is among the results: the run will be asked for by it
    again.
    """
    with alone(folder):
        try:
            moved = _set_aside(folder, names, inputs, keep, spare)
        except OSError as error:
            raise _unusable(folder, error) from error
        if not os.access(folder, os.W_OK):
            raise InputError(f"{folder}: cannot be written to: use another folder")
        left = _found(folder, names)
        try:
            yield
        except EnveditError:
            if moved and _found(folder, names) == left:
                for path in reversed(moved):
                    path.rename(folder / path.name)
                shutil.rmtree(moved[0].parent)  # copies
            raise


def _found(folder, names):
    """Return the results that lie in a folder."""
    return [folder / name for name in names if (folder / name).exists()]


def _set_aside(folder, names, inputs, keep, spare):
    """Move results to the next ``earlier-N``; returns where those lie that were moved, and not copied."""
    # ---- What lies there, and whether an input is among it
    old = _found(folder, names)
    read = {os.path.realpath(path) for path in inputs} if old else set()
    read |= {os.path.dirname(path) for path in read}  # a result may be a folder
    if mine := [path for path in old if os.path.realpath(path) in read]:
        raise InputError(f"{mine[0]}: this input lies where its own results would go: use another folder")

    # ---- What is moved or copied
    if keep and {folder / COMPLETE, folder / CHECKPOINT} & set(old):
        return []
    spared = {os.path.realpath(path) for path in spare}
    copied = [path for path in old if os.path.realpath(path) in spared]
    moved = [path for path in old if path not in copied]
    if not moved and all(map(_is_kept, copied)):
        return []
    numbers = [path.name.rpartition("-")[2] for path in folder.glob(f"{EARLIER}-*")]
    number = 1 + max((int(n) for n in numbers if n.isdecimal()), default=0)
    aside = folder / f"{EARLIER}-{number}"
    aside.mkdir()
    for path in copied:
        shutil.copy2(path, aside / path.name)
    for path in moved:
        path.rename(aside / path.name)
    return [aside / path.name for path in moved]


def _is_kept(path):
    """Say whether a file lies in one of the folders of earlier runs beside it, as it is."""
    return any(
        filecmp.cmp(path, earlier, shallow=False)
        for earlier in path.parent.glob(f"{EARLIER}-*/{path.name}")
        if earlier.is_file()
    )


def _unusable(folder, error):
    reason = f"{folder}: cannot be used for the results ({error.strerror or error})"
    return InputError(f"{reason}: use another folder")
