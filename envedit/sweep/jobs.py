"""Jobs: a name, a complete configuration, and the hash of all that decides what comes out."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import envedit
from envedit import config
from envedit.config import presets
from envedit.config.toml import parsed
from envedit.core import atomic_files
from envedit.core.errors import ConfigError
from envedit.core.types import FilePath
from envedit.losses.perceptual import installed


@dataclass(frozen=True)
class Job:
    """One run to be made; by :func:`job` or :func:`read_jobs`."""

    name: str  # what the table calls it
    toml: str  # the configuration, every key spelled out, paths absolute, without an output folder
    # 32 hexadecimal digits of the SHA-256 of the configuration, of the files it names and of the program
    key: str
    program: str  # :func:`program` where the job was made
    command: tuple[str, ...] = ()  # what carries it out, as :data:`.process.COMMAND`; empty: that

    def folder(self, out: FilePath) -> Path:
        """Return the job's folder under ``out``."""
        return Path(out) / self.key


@functools.cache
def program() -> str:
    """Return the version of envedit and 12 digits of its files' SHA-256: ``1.0.0+0123456789ab``."""
    package = Path(envedit.__file__).parent
    sha = hashlib.sha256()
    for path in sorted(path for path in package.rglob("*.*") if path.is_file() and path.suffix != ".pyc"):
        sha.update(f"{path.relative_to(package).as_posix()}\0{_digest(path)}\n".encode())
    return f"{envedit.__version__}+{sha.hexdigest()[:12]}"


def job(
    name: str,
    toml: str | dict,
    base: FilePath = ".",
    version: str = "",
    command: Sequence[str] = (),
    overrides: Iterable[str] = (),
) -> Job:
    """Make a job of a configuration: TOML text, or its tables; the name is any printable text.

    ``overrides`` are as of :func:`envedit.config.load`. Relative paths start from the folder ``base``.
    ``version`` is whatever else decides what comes out, such as the code of ``command``, which carries it out
    in place of ``envedit run`` and is no part of the key.

    ConfigError if the configuration is not usable, InputError if a file that it names cannot be read. One
    that does not exist is left to the run to report.
    """
    if not name or not name.isprintable():
        raise ConfigError(f"job {name!r}: got no printable text, expected a name")
    base = Path(base).absolute()
    if isinstance(toml, str):
        settings = config.loads(toml, base, f"job {name}", overrides=overrides)
    else:
        settings = config.from_dict(toml, base, f"job {name}", overrides=overrides)

    # ---- Files in the scene's parameters: by absolute paths in the job, by their contents in the key
    scene = settings.scene
    parameters = dict(scene.parameters)
    contents = {}
    for key, value in scene.parameters.items():
        # The run looks beside the scene, then beside the configuration, which will lie in the job's folder.
        beside_scene = _file_in(Path(scene.file).parent, value) if os.path.isabs(scene.file) else None
        if beside_scene:
            contents[key] = _digest(beside_scene)
        elif file := _file_in(base, value):
            parameters[key] = str(file)
    settings = dataclasses.replace(
        installed.settled(settings),
        scene=dataclasses.replace(scene, parameters=parameters),
        output=dataclasses.replace(settings.output, dir=""),
    )

    # ---- The key
    content = _with_contents(dataclasses.asdict(settings) | {"weights": installed.files(settings)})
    content["scene"]["file"] = _scene_digests(scene, base)
    content["scene"]["parameters"] |= contents
    content["program"] = [program(), version]
    key = hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:32]
    return Job(name, config.to_toml(settings), key, program(), tuple(command))


def read_jobs(path: FilePath) -> list[Job]:
    """Read a TOML file of jobs, or the configurations in a folder; see the package's text.

    ConfigError or InputError if a file cannot be read, or holds no jobs, or one that is not usable.
    """
    path = Path(path)
    if path.is_dir():
        if not (files := sorted(path.glob("*.toml"))):
            raise ConfigError(f"{path}: no configuration NAME.toml in this folder")
        return [job(file.stem, _text(file), path) for file in files]
    tables = parsed(_text(path), str(path))
    common = tables.pop("common", {})
    jobs = tables.pop("jobs", {})
    if tables:
        raise ConfigError(f"{path}: unknown table or key {next(iter(tables))}; known: common, jobs.NAME")
    if not isinstance(jobs, dict) or not jobs:
        raise ConfigError(f"{path}: no job in it, expected a table [jobs.NAME] for each")
    for name, table in ({"common": common} | jobs).items():
        if not isinstance(table, dict):
            raise ConfigError(f"{path}: {name}: expected a table")
    return [job(name, presets.overlaid(common, table), path.parent) for name, table in jobs.items()]


def _text(path):
    try:
        with atomic_files.opened(path) as file:
            return file.read().decode("utf-8-sig")
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: cannot be read ({getattr(error, 'strerror', None) or error})") from None


# ---- contents ----------------------------------------------------------------------------------------------


def _file_in(folder, value):
    """Return the file in a folder that a value names; None for anything else."""
    if isinstance(value, str) and os.path.isfile(folder / value):  # False for what is no name
        return folder / value
    return None


def _with_contents(value):
    """Replace every absolute path of a file by the digest of its content."""
    if isinstance(value, dict):
        return {key: _with_contents(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_with_contents(item) for item in value]
    if isinstance(value, str) and os.path.isabs(value) and (file := _file_in(Path("/"), value)):
        return _digest(file)
    return value


def _scene_digests(scene, base):
    """Return the digests of a scene and of all that it may read; its name where there is no such file."""
    from envedit.scene import scene as scenes  # with Mitsuba

    files = filter(os.path.isfile, scenes.files(scene, base))
    return sorted({_digest(path) for path in files}) or scene.file


def _digest(path):
    return f"sha256:{atomic_files.digest(path).hex()}"
