"""What is run: cells (a map in a scene), settings (what differs from the standard preset), and their jobs."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from envedit.config.presets import overlaid
from envedit.core.errors import InputError
from envedit.sweep import Job
from experiments.harness import Case

MEASURED = Path(__file__).with_name("measured.py")
COMMAND = ("{python}", "-S", str(MEASURED), "{folder}", "{threads}")
"""What carries out a job; the session is added to it."""
MAPS = ("overcast_soil", "wasteland_clouds", "kloofendal_48d_partly_cloudy")
"""Overcast, in between, and sunny: peaks of 4.5, 309 and 8,963 at 256 texels across."""
SCENES = {
    "matte": {"file": "matte"},
    "glossy": {"file": "sphere", "parameters": {"roughness": 0.05}},
}
ANGLE = 60.0
"""Degrees by which the map is to be turned."""
REFERENCES = 3
"""Runs of the standard preset in each cell: before, amid and after the others, each with its own seed."""
LONG = "paper"
"""The group that is not run in every cell by default: a run takes about twenty minutes."""


@dataclass(frozen=True)
class Cell:
    """A map in a scene; ``map`` and ``scene`` are names, ``file`` is the map's."""

    map: str
    scene: str
    file: Path

    @property
    def name(self) -> str:
        """What tables call it."""
        return f"{self.map}, {self.scene}"


@dataclass(frozen=True)
class Setting:
    """What is changed in the standard preset.

    Attributes
    ----------
    name : str
        What tables call it; "KNOB: LEVEL" for a knob.
    group : str
        "standard", "preset", "knob", "siren", "joint" or "paper".
    table : dict
        Tables and keys as in a configuration.
    seconds : float
        Rough guess of a run and its judgement on two cores, for the estimate at the start.
    """

    name: str
    group: str
    table: dict
    seconds: float = 10.0


def _levels(knob: str, group: str, levels: dict[str, dict], seconds: dict[str, float] | None = None):
    return [
        Setting(f"{knob}: {level}", group, table, (seconds or {}).get(level, 10.0))
        for level, table in levels.items()
    ]


def _key(knob: str, table: str, key: str, values, **seconds) -> list[Setting]:
    """One key at several values; ``seconds`` are of ``v`` + value."""
    guesses = {name.removeprefix("v"): value for name, value in seconds.items()}
    return _levels(knob, "knob", {str(v): {table: {key: v}} for v in values}, guesses)


def knobs() -> list[Setting]:
    """List one change at a time from the standard preset, whose own level is not repeated."""
    return [
        *_key("samples of T", "renderer", "spp", (16, 64, 512), v512=24),
        *_key("path depth", "renderer", "max_depth", (2,)),
        *_key("map width", "input", "width", (64, 128, 512), v64=8, v512=20),
        # Larger pictures are solved on a film of 128 pixels: experiments/solver.
        *_key("film width", "scene", "width", (64,), v64=8),
        # Gauss-Newton makes at most 16, Adam, where detail is identifiable, all of them.
        *_key("steps at most", "optimizer", "iterations", (4, 30, 200)),
        # A number means those cycles and no finer grids, wherever the picture may tell them.
        *_key("gain without detail, cycles", "representation", "cycles", (4, 12)),
        *_key("optimizer", "optimizer", "kind", ("adam",), vadam=15),
        *_levels(
            "samples of target and result",
            "knob",
            {str(n): {"target": {"spp": n}, "output": {"spp": n}} for n in (16, 64)},
        ),
    ]


def siren() -> list[Setting]:
    """List the standard robust SIREN, on a map of 128 texels across: at 256 it takes ten times as long."""
    table = {"representation": {"kind": "siren"}, "input": {"width": 128}}
    return [Setting("siren, map 128", "siren", table, 50.0)]


FACTORS = {
    "T": (16, 32, 64, 128, 256),
    "map": (64, 96, 128, 192, 256, 384),
    "film": (32, 48, 64, 96, 128),
    "samples": (16, 64, 256, 1024),
}
"""Knobs that are changed together, and their levels: about evenly spaced in their logarithm."""


def joint(count: int, seed: int = 0) -> list[Setting]:
    """Draw combinations of :data:`FACTORS` by Latin hypercube sampling (McKay, Beckman and Conover 1979).

    Of ``count`` combinations, each ``count``-th part of every knob's range is met once, so that all levels
    are met about equally often, whatever the other knobs are.
    """
    rng = np.random.default_rng(seed)
    drawn = {}
    for factor, levels in FACTORS.items():
        u = (rng.permutation(count) + rng.random(count)) / max(count, 1)
        drawn[factor] = [levels[int(x * len(levels))] for x in u]
    settings = []
    for i in range(count):
        t, width, film, samples = (drawn[factor][i] for factor in FACTORS)
        table = {
            "renderer": {"spp": t},
            "input": {"width": width},
            "scene": {"width": film},
            "target": {"spp": samples},
            "output": {"spp": samples},
        }
        name = f"joint {i + 1}: T {t}, map {width}, film {film}, samples {samples}"
        settings.append(Setting(name, "joint", table))
    return settings


def small() -> list[Setting]:
    """List smaller maps with smaller pictures: the two knobs that are the cheapest alone, for presets."""

    def both(width, film, **more):
        table = {"input": {"width": width}, "scene": {"width": film}} | more
        return Setting(f"map {width}, film {film}" + ", samples 64" * bool(more), "joint", table, 8.0)

    few = {"target": {"spp": 64}, "output": {"spp": 64}}
    return [both(96, 32, **few), both(96, 48, **few), both(128, 64), both(128, 96)]


DRAFT = Setting("draft", "preset", {"preset": "draft"}, 10.0)
PAPER = Setting("paper", LONG, {"preset": "paper"}, 1300.0)


def settings(count: int, quick: bool = False) -> list[Setting]:
    """List all settings but the standard preset itself and the paper's, the presets first."""
    if quick:
        some = {"samples of T: 64", "map width: 128", "film width: 64", "steps at most: 4", "optimizer: adam"}
        some |= {"gain without detail, cycles: 12", "samples of target and result: 64"}
        network = {"preset": "draft", "representation": {"kind": "siren"}}
        return [
            DRAFT,
            *(s for s in knobs() if s.name in some),
            Setting("siren: draft", "siren", network, 16.0),
            *joint(count),
            *small(),
        ]
    return [DRAFT, *knobs(), *siren(), *joint(count), *small()]


def cells(folder: Path, names=MAPS, scenes=tuple(SCENES)) -> list[Cell]:
    """List maps times scenes, from a folder of NAME_puresky_1k.hdr or .exr, or NAME.hdr or .exr.

    Raises
    ------
    InputError
        If a map is not there.
    """
    files = {name: _file(folder, name) for name in names}
    return [Cell(name, scene, file) for name, file in files.items() for scene in scenes]


def _file(folder, name):
    for form in (f"{name}_puresky_1k", name):
        for ending in (".hdr", ".exr"):
            if (file := Path(folder) / f"{form}{ending}").is_file():
                return file.absolute()
    raise InputError(f"{folder}: no map {name}_puresky_1k.hdr in it: give the folder with --maps")


def case_of(cell: Cell, setting: Setting, session: str = "", own: bool = False) -> Case:
    """Make the case of a setting in a cell.

    Fits and transports are not kept on disk, so that every run pays for its own; its metrics hold what they
    took. ``session`` names the call that runs it; a case that is that session's ``own`` is no other's: the
    standard preset is measured anew beside whatever it is compared with.
    """
    base = {
        # Where the sky turned, every setting would find the same map.
        "input": {"envmap": str(cell.file)},
        "scene": SCENES[cell.scene],
        "target": {"rotate_degrees": ANGLE},
        "representation": {"turn": False},
        "renderer": {"cache": False},
        "fit": {"cache": False},
    }
    return Case(
        f"{cell.name}: {setting.name}" + f" [{session}]" * own,
        overlaid(base, setting.table),
        {"cell": cell, "setting": setting},
        (*COMMAND, session),
        f"{hashlib.sha256(MEASURED.read_bytes()).hexdigest()} {session * own}",
        "cost.json",
    )


def job_of(cell: Cell, setting: Setting, session: str = "") -> Job:
    """Return the job of a setting in a cell, or of a session's own."""
    return case_of(cell, setting, session, bool(session)).job()


def references(n: int) -> Setting:
    """Return the standard preset's n-th repetition; its seed tells how far results differ by chance."""
    return Setting(f"standard, seed {n}", "standard", {"seed": n})
