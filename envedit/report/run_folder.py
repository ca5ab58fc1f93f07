"""What a run leaves in its folder: maps, renderings, metrics, manifest and report."""

from __future__ import annotations

import os
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from envedit import config, inputs
from envedit.core import atomic_files
from envedit.core.errors import InputError, NumericalError
from envedit.export import file_resolution
from envedit.images import images
from envedit.losses.perceptual import installed
from envedit.report import html_report, manifest, map_files, output_folder, plain_files, preview, variants
from envedit.solve import checkpoint

if TYPE_CHECKING:
    from envedit import results


def write(folder: Path, result: results.Result, import_s: float) -> list[str]:
    """Write a result; the checkpoint goes last of all.

    Files of the same names are replaced, and the timing of the result's metrics is completed, with the
    seconds ``import_s`` that imports took. Returns warnings: the result's, and numbers that were not finite.
    """
    settings = result.settings

    # ---- Maps and renderings
    start = time.perf_counter()
    _write_maps(folder, result)
    _write_renderings(folder, result)
    _write_full_resolution(folder, result)
    map_files.write_lights(folder, result)
    result.warnings += map_files.write_look(folder, result)
    if settings.output.scene:
        result.warnings += map_files.write_scene(folder, result)
    maps_written = time.perf_counter()

    # ---- What explains the run later
    atomic_files.write_atomically(folder / "config.toml", config.to_toml(settings).encode())
    plain_files.write_history(folder / "history.csv", result.history)
    facts = manifest.manifest(
        {"seed": settings.seed, "preset": settings.preset}, _inputs(result), settings.variant
    )
    plain_files.write_json(folder / "manifest.json", facts)

    # ---- The report, which shows the time but for its own, and names what metrics.json will lack
    lost: list[str] = []
    plain_files.plain(result.metrics, "", lost)
    result.warnings += [f"metrics.json: {name} was not finite and is null" for name in lost]
    timing = result.metrics["timing"]
    timing["full_s"] = round(maps_written - start, 3)
    timing["import_s"] = round(import_s, 3)
    timing["total_s"] = round(timing["total_s"] + timing["import_s"] + timing["full_s"], 3)
    if settings.output.report:
        sheet = preview.sheet(result.shown, result.maps, settings.output.tonemap, result.rows)
        atomic_files.write_atomically(folder / "preview.png", sheet)
        html_report.write_report(folder / "report.html", result, facts)
    timing["report_s"] = round(time.perf_counter() - maps_written, 3)
    timing["total_s"] = round(timing["total_s"] + timing["report_s"], 3)

    # ---- metrics.json, which says that the run is complete, and what is no longer needed
    plain_files.write_json(folder / "metrics.json", result.metrics)
    checkpoint.remove(folder)
    output_folder.tidy(folder)
    return result.warnings


def write_given(
    settings: config.Config, folder: Path, replacements: inputs.Replacements, warnings: list[str]
) -> config.Config:
    """Write the arrays that a run was given, and return the configuration that names their files.

    A scene that has no file is named in a warning.
    """
    if replacements.scene is not None and replacements.scene.path is None:
        warnings.append(
            "config.toml: the scene was given as an object: name a file in [scene] file to run it again; "
            "edited.xml is not written"
        )
        settings = replace(settings, output=replace(settings.output, scene=False))
    arrays = {name: getattr(replacements, name) for name in ("envmap", "target_map", "target", "mask")}
    files = {name: folder / f"given_{name}.exr" for name, array in arrays.items() if array is not None}
    for name, file in files.items():
        array = np.asarray(arrays[name], np.float32)
        array = array if name != "mask" else array.reshape(*array.shape[:2], 1).repeat(3, axis=2)
        images.write_exr(file, array, panorama=name in ("envmap", "target_map"))
    if "envmap" in files:
        settings = replace(settings, input=replace(settings.input, envmap=str(files["envmap"])))
    if {"target", "target_map"} & files.keys():
        file, mask = files.get("target") or files["target_map"], files.get("mask")
        target = replace(settings.target, file=str(file), mask=str(mask) if mask else "")
        settings = replace(settings, target=target)
    return settings


def _inputs(result):
    """Return the files that a run has read, by what they are to it; several of a kind are numbered."""
    settings = result.settings
    paths = {
        "envmap": result.input_map.source,
        "scene": result.scene or "",
        "start": settings.optimizer.start,
    }
    for role, files in (("target", settings.target.files), ("mask", settings.target.masks)):
        paths |= {role if len(files) == 1 else f"{role} {i}": file for i, file in enumerate(files)}
    paths |= installed.files(settings)
    return {role: path for role, path in paths.items() if os.path.isfile(path)}


def _write_maps(folder, result):
    """Write the edited map, its layers, its other explanations, and what the target determines of it."""
    input_map = result.input_map
    output = result.settings.output
    result.warnings += map_files.write_map(output, folder / "edited", result.envmap, input_map)
    layers = {
        "edited": result.envmap,
        "initial": input_map.stored,
        "difference": result.envmap - input_map.stored,
    }
    if result.influence is not None:
        grey = result.influence[..., None].repeat(3, axis=2)
        images.write_exr(folder / "influence.exr", grey, {"content": "T' 1: influence per texel"})
        preview.influence(folder / "influence.png", result.influence, result.frozen)
        layers["influence"] = result.influence
    if result.posterior is not None:
        layers["deviation"] = result.posterior.deviation
    images.write_layers(folder / "edited_layers.exr", layers, chromaticities=input_map.chromaticities)
    result.warnings += variants.write(folder / variants.FOLDER, result.variants, output, input_map)
    if result.photo is not None:
        pictures = preview.photograph(result.photo, result.render, result.outliers)
        images.write_png(folder / "photograph.png", np.concatenate(pictures, axis=1))
    if result.reach is not None:
        images.write_png(folder / "unreachable.png", preview.unreachable(result.reach))


def _write_renderings(folder, result):
    """Write the renderings, and each view of them where there are several."""
    for name, picture in result.renders.items():
        for file, rows in output_folder.of_views(f"render_{name}.exr", result.rows):
            alpha = None if result.alpha is None else result.alpha[rows]
            source = {"source": result.settings.scene.file}
            images.write_exr(folder / file, picture[rows], source, panorama=False, alpha=alpha)


def _write_full_resolution(folder, result):
    """Write the edit at the resolution of its input's file, where that is larger."""
    if not result.settings.output.full:
        return
    try:
        full = file_resolution.at_full_resolution(result)
        if full is not None:
            result.warnings += map_files.write_map(
                result.settings.output, folder / "edited_full", full, result.input_map
            )
    except MemoryError:
        result.warnings.append(
            f"{result.input_map.source}: not enough memory to carry the edit to its size; "
            "edited.exr has it at working resolution"
        )
    except (InputError, NumericalError) as error:  # the file may be gone by now
        result.warnings.append(
            f"edited_full.exr is not written: {error}; edited.exr has it at working resolution"
        )
