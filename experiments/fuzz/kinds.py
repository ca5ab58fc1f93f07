"""The kinds of files: where whole ones come from, how they are damaged, and what reads them."""

import zlib
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from . import documents, mutate, pictures, readers, scenes


class Kind(NamedTuple):
    """A kind of files: makes whole ones by name, reads one of a case, and damages the content of one.

    Of the cases that are asked for, one in ``one_in`` is carried out: a file of a scene takes a process.
    """

    files: Callable[[], dict[str, bytes]]
    read: Callable[[Path, int], None]
    damage: Callable[[bytes, np.random.Generator], bytes] = mutate.mutated
    one_in: int = 1


KINDS = {
    "exr": Kind(pictures.exr_files, readers.environment),
    "hdr": Kind(pictures.hdr_files, readers.environment),
    "toml": Kind(documents.toml_files, readers.configuration, documents.mutated),
    "painted": Kind(pictures.painted_files, readers.picture),
    "weights": Kind(pictures.weight_files, readers.tensors),
    "checkpoint": Kind(pictures.checkpoint_files, readers.checkpointed),
    "scene": Kind(scenes.scene_files, readers.scene_file, scenes.mutated_scene),
    "mesh": Kind(scenes.mesh_files, readers.mesh, one_in=10),
    "texture": Kind(pictures.painted_files, readers.texture, one_in=10),
    "entry": Kind(scenes.entry_files, readers.transport, scenes.mutated_entry),
    "state": Kind(scenes.state_files, readers.continued, scenes.mutated_state),
}


def seeds(what: str) -> list[tuple[str, bytes]]:
    """Return the whole files of a kind, (name, content), in a fixed order."""
    return sorted(KINDS[what].files().items())


def case(what: str, whole: list[tuple[str, bytes]], seed: int, index: int) -> tuple[str, bytes]:
    """Return name and content of a damaged file: the same for the same seeds, kind, seed and index."""
    rng = np.random.default_rng([seed, zlib.crc32(what.encode()), index])
    name, data = mutate.one_of(whole, rng)
    return name, KINDS[what].damage(data, rng)
