"""``envedit run``: carry out an edit; leaves the map, renderings, metrics and a report in a folder.

The edit is that of a configuration, or of a scene and a few options. Output goes to stdout as text, or
with ``--json`` as one object at the end; progress, warnings and errors go to stderr, as text or JSON lines.
"""

from __future__ import annotations

import difflib
import json
import os
import time
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from envedit.cli import doctor, run_options
from envedit.cli.console import Console, exit_code
from envedit.core import shipped
from envedit.core.errors import ConfigError, InputError

if TYPE_CHECKING:
    from envedit import config


def main(argv: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    begun = time.perf_counter()
    parser = run_options.make_parser()
    arguments = parser.parse_args(argv)
    if arguments.config is None:
        known = ", ".join(shipped.configurations())
        parser.error(f"got no CONFIG, expected a file, such as CONFIG.toml, or one of {known}")
    console = Console(arguments.quiet, arguments.json, arguments.progress == "json")
    fit = "an unfinished SIREN fit continues from its last saved state"
    interrupted = f"interrupted before the first checkpoint; --resume would start anew ({fit})"
    if arguments.dry_run or arguments.export_initial is not None:
        interrupted = "interrupted; run the same command again"
    return exit_code(console, lambda: _run(arguments, console, begun), interrupted)


def load(name: str, preset: str | None, overrides: Iterable[str]) -> tuple[config.Config, Path | None, Path]:
    """Read a configuration, given as a path or as the name of a shipped one; returns it and its file.

    And the folder that relative paths start from: the file's; the working folder where the name was given.
    Results of a shipped configuration go to ``runs/NAME`` in the working folder.
    """
    from envedit import config

    if run_options.is_scene(name):
        file = Path(name)
        by_default = [
            f"scene.file={config.quote(name)}",
            f"output.dir={config.quote(f'{scene_name(file)}_out')}",
        ]
        overrides = [*by_default, *overrides]
        return config.loads("", Path.cwd(), "command line", preset, overrides), None, Path.cwd()
    by_name = None if os.path.isfile(name) else shipped.configuration(name)
    file = by_name or Path(name)
    try:
        os.stat(file)
    except FileNotFoundError:
        close = difflib.get_close_matches(name, [*shipped.configurations(), *shipped.scenes()], 1)
        hint = f"did you mean the shipped {close[0]}?" if close else "to write one: envedit init"
        raise ConfigError(f"{name}: no such configuration file; {hint}") from None
    except (OSError, ValueError):  # reading it will explain
        pass
    if shipped.holds(file):
        results = Path.cwd() / "runs" / file.stem
        overrides = [f"output.dir={config.quote(str(results))}", *overrides]
    if by_name is None:
        return config.load(file, preset, overrides), file, file.absolute().parent
    text = file.read_text(encoding="utf-8")
    return config.loads(text, Path.cwd(), str(file), preset, overrides), file, Path.cwd()


def scene_name(file: Path) -> str:
    """Return the name of a scene: of its file, with the folder's for a ``scene.xml`` that lies elsewhere."""
    name = file.stem or "scene"
    folder = file.absolute().parent
    return f"{folder.name}_{name}" if name == "scene" and folder != Path.cwd() and folder.name else name


def _run(arguments, console, begun):
    from envedit import config
    from envedit.report import output_folder

    # ---- Configuration
    overrides = [*run_options.quick(arguments), *arguments.overrides]
    if arguments.out:
        overrides.append(f"output.dir={config.quote(str(Path(arguments.out).absolute()))}")
    settings, file, base = load(arguments.config, arguments.preset, overrides)
    budget = None if arguments.budget is None else run_options.seconds(arguments.budget)

    # ---- Only the initial rendering, or the target
    if arguments.export_initial is not None:
        return _export_initial(settings, base, Path(arguments.export_initial), console)
    if arguments.dry_run:
        if settings.target.kind == "none":
            raise ConfigError('--dry-run: got target.kind "none", expected a target to write: run without it')
        return _dry_run(settings, base, console)

    # ---- The edit
    doctor.select(settings.variant)
    folder = Path(settings.output.dir)
    read = output_folder.inputs_of(settings, base)
    spare = [] if file is None else [file]
    with output_folder.results_in(folder, output_folder.names(folder), read, arguments.resume, spare):
        unfinished = (folder / "checkpoint.npz").exists() or not (folder / "metrics.json").exists()
        if arguments.resume and not unfinished:
            _check_same(settings, folder)
            console.say(f"{folder}: this run is complete, there is nothing to resume")
            _note_results(console, folder)
            return 0
        return _edit(settings, base, budget, arguments.resume, console, begun)


def _edit(settings, base, budget, resume, console, begun):
    """Carry out an edit and leave its results in its folder, in which nobody else works."""
    from envedit import pipeline

    folder = Path(settings.output.dir)
    import_s = time.perf_counter() - begun

    # ---- Settings that fit a budget, which are not those of the configuration that --resume would continue
    notes = []
    again = "; continue with --resume"
    if budget is not None:
        from envedit.cli import budget as budgets

        settings, note = budgets.apply(settings, budget, import_s, base)
        notes.append(note)
        console.say(note)
        again = ""

    # ---- Edit
    try:
        with console.progress() as progress:
            watch = pipeline.Watch(progress.stage, progress.update)
            result = pipeline.run(settings, folder=folder, resume=resume, base=base, watch=watch)
            result.notes = notes + result.notes
            result.metrics["choices"] = result.notes
            progress.stage("writing")
        _write(result, folder, import_s, console, result.notes[len(notes) :])
        return 0
    except pipeline.Stopped as stop:
        _keep_map(folder, stop)
        raise
    except pipeline.Interrupted as stop:
        if not (folder / "checkpoint.npz").exists():  # nothing was found yet
            raise KeyboardInterrupt from None
        _keep_map(folder, stop)
        console.error(f"{stop}; checkpoint and edited.exr so far are in {folder}{again}")
        return 130
    except KeyboardInterrupt:  # outside the loop of the edit
        if not (folder / "checkpoint.npz").exists():
            raise
        console.error(f"interrupted; a checkpoint is in {folder}{again}")
        return 130


def _write(result, folder, import_s, console, notes):
    """Write the results of an edit, and say what they are."""
    from envedit.report import run_folder
    from envedit.report.verdict import verdict

    console.warn(*run_folder.write(folder, result, import_s))
    console.say(*notes)
    console.say(verdict(result.metrics))
    console.say(f"results in {folder.resolve()}")
    _note_results(console, folder)


def _keep_map(folder, stop):
    """Write the map that an edit has come to which was cut short."""
    from envedit import config
    from envedit.report import map_files

    map_files.write_map(config.Output(), folder / "edited", stop.envmap, stop.input_map)


def _export_initial(settings, base, file, console):
    """Write the picture to paint on, and nothing else."""
    doctor.select(settings.variant)
    from envedit import inputs
    from envedit.report import output_folder
    from envedit.targets import initial_rendering

    initial_rendering.check_export(file)
    with console.progress() as progress:
        progress.stage("rendering the picture to paint on")
        scene = inputs.load_scene(settings.scene, base)

        # ---- A file for each view
        views = output_folder.of_views(file.name, scene.rows)
        files = [(file.with_name(name), rows) for name, rows in views[1:] or views]
        for view_file, _ in files:
            initial_rendering.check_export(view_file)

        # ---- The picture, marked by what it is made from
        input_map = inputs.read_map(settings.input, scene, settings.input.width)
        notes = inputs.notes(settings.input, scene, input_map)
        warnings = input_map.warnings
        picture = initial_rendering.initial(scene, input_map.radiance, settings)
        tonemap = initial_rendering.export_tonemap(file, picture, settings)
        for view_file, rows in files:
            warnings += initial_rendering.export(view_file, picture[rows], settings, tonemap)

    # ---- What to do with it
    console.warn(*warnings)
    console.say(*notes)
    declared = settings.target.display_tonemap
    if tonemap not in ("linear", declared):
        console.say(
            f"{file}: tonemap '{tonemap}' is used, because '{declared}' would clip highlights; "
            "the file's metadata names it"
        )
    under = "linear" if tonemap == "linear" else f"under the '{tonemap}' tonemap"
    for k, (view_file, rows) in enumerate(files):
        size = f"{scene.width}x{rows.stop - rows.start}"
        view = f", view = {k}" if len(files) > 1 else ""
        keys = f'[target] kind = "image", file = "{view_file.absolute()}"{view}'
        console.say(f"{view_file}: {size}, {under}; paint on it, then set {keys}")
    console.facts["files"] = {view_file.name: str(view_file.absolute()) for view_file, _ in files}
    return 0


def _dry_run(settings, base, console):
    """Write what a run would edit towards, and nothing else: a picture to look at, and linear radiance."""
    doctor.select(settings.variant)
    from envedit import config, inputs
    from envedit.core.atomic_files import write_atomically
    from envedit.images import images
    from envedit.report import output_folder, preview
    from envedit.targets.target import make as make_target

    folder = Path(settings.output.dir)
    picture_file = folder / "dry_run.png"
    radiance_file = folder / "dry_run.exr"
    with output_folder.alone(folder), console.progress() as progress:
        progress.stage("rendering the target")
        scene = inputs.load_scene(settings.scene, base)
        input_map = inputs.read_map(settings.input, scene, settings.input.width)
        envmap = input_map.radiance
        target = make_target(settings, scene, envmap)
        sheet = preview.sheet(
            {"initial": target.initial, "target": target.picture},
            {"initial": envmap, "target": target.envmap},
            settings.output.tonemap,
            scene.rows,
        )
        write_atomically(picture_file, sheet)
        images.write_exr(radiance_file, target.picture, {"content": "target"}, panorama=False)
    solver = None if settings.newton else "adam"  # a mirror's detail is solved for by Adam, too
    console.warn(*input_map.warnings, *target.warnings, *config.unused(settings, solver))
    files = {file.name: str(file.resolve()) for file in (picture_file, radiance_file)}
    console.say(*inputs.notes(settings.input, scene, input_map), target.source, *files.values())
    console.facts["files"] = files
    return 0


def _check_same(settings, folder):
    """Refuse to call the run in a folder complete when it was asked for something else."""
    from envedit import config
    from envedit.losses.perceptual import installed
    from envedit.report import manifest

    try:
        finished = config.load(folder / "config.toml")
        finished = replace(finished, output=replace(finished.output, dir=settings.output.dir))
        same = finished == installed.settled(settings)
    except ConfigError:
        same = False
    if not same:
        raise InputError(f"{folder}: holds a finished run of another configuration: run without --resume")
    if changed := manifest.changed(folder / "manifest.json"):
        raise InputError(f"{changed[0]}: has changed since the run in {folder}: run without --resume")


def _note_results(console, folder):
    """Note a finished run for the object of ``--json``: its folder, files and metrics.json."""
    from envedit.report import output_folder

    names = output_folder.names(folder)
    files = {name: str((folder / name).resolve()) for name in names if (folder / name).is_file()}
    metrics = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
    console.facts |= {"folder": str(folder.resolve()), "files": files, "metrics": metrics}
