"""``envedit run``: carry out an edit; leaves the map, renderings, metrics and a report in a folder.

The edit is that of a configuration, or of a scene and a few options. Output goes to stdout as text, or
with ``--json`` as one object at the end; progress, warnings and errors go to stderr, as text or JSON lines.
"""

from __future__ import annotations

import difflib
import json
import os
import sys
import time
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from envedit.cli import run_options
from envedit.cli.streams import steady
from envedit.core import shipped

if TYPE_CHECKING:
    from envedit import config


@steady
def main(argv: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    start = time.perf_counter()
    from envedit.core.errors import EnveditError, unwrapped

    parser = run_options.parser()
    arguments = parser.parse_args(argv)
    if arguments.config is None:
        known = ", ".join(shipped.configurations())
        parser.error(f"got no CONFIG, expected a file, such as CONFIG.toml, or one of {known}")
    arguments.facts = {}
    try:
        with unwrapped():
            code = _run(arguments, start)
    except EnveditError as error:
        _tell(arguments, "error", str(error))
        code = error.exit_code
    except KeyboardInterrupt:
        fit = "an unfinished SIREN fit continues from its last saved state"
        before = f"interrupted before the first checkpoint; --resume would start anew ({fit})"
        if arguments.dry_run or arguments.export_initial is not None:
            before = "interrupted; run the same command again"
        _tell(arguments, "error", before)
        code = 130
    if arguments.json:
        print(json.dumps({"ok": code == 0, "exit_code": code, **arguments.facts}))
    return code


def _tell(arguments, kind, text):
    """Write a warning or an error to stderr, and note it for the object of ``--json``."""
    if kind == "error":
        arguments.facts["error"] = text
    else:
        arguments.facts.setdefault("warnings", []).append(text)
    if arguments.progress == "json":
        from envedit.cli.progress import JsonProgress

        JsonProgress().tell(kind, text=text)
    else:
        print(f"envedit: {'warning: ' if kind == 'warning' else ''}{text}", file=sys.stderr)


def _progress(arguments):
    """Return what shows progress."""
    from envedit.cli.progress import JsonProgress, Progress

    as_json = arguments.progress == "json" and not arguments.quiet
    return JsonProgress() if as_json else Progress(quiet=arguments.quiet)


def load(name: str, preset: str | None, overrides: Iterable[str]) -> tuple[config.Config, Path | None, Path]:
    """Read a configuration, given as a path or as the name of a shipped one.

    Returns
    -------
    settings : config.Config
        Results of a shipped configuration go to ``runs/NAME`` in the working folder.
    file : Path
        The configuration's.
    base : Path
        Folder that relative paths start from: the file's; the working folder where the name was given.
    """
    from envedit import config
    from envedit.core.errors import ConfigError

    if run_options.is_scene(name):
        file = Path(name)
        overrides = [f"scene.file={config.quote(name)}", *overrides]
        label = str(file.with_name(f"{scene_name(file)}.toml"))  # its stem names the folder of results
        return config.loads("", Path.cwd(), label, preset, overrides), None, Path.cwd()
    by_name = None if os.path.isfile(name) else shipped.configuration(name)
    file = by_name or Path(name)
    if _missing(file):
        close = difflib.get_close_matches(name, shipped.configurations(), 1)
        hint = f"did you mean the shipped {close[0]}?" if close else "to write one: envedit init"
        raise ConfigError(f"{name}: no such configuration file; {hint}")
    if shipped.holds(file):
        results = Path.cwd() / "runs" / file.stem
        overrides = [f"output.dir={config.quote(str(results))}", *overrides]
    if by_name is None:
        return config.load(file, preset, overrides), file, file.absolute().parent
    text = file.read_text(encoding="utf-8")
    return config.loads(text, Path.cwd(), str(file), preset, overrides), file, Path.cwd()


def scene_name(file: Path) -> str:
    """Return the name of a scene: of its file, with the folder's for a ``scene.xml`` that lies elsewhere."""
    own, folder = file.stem or "scene", file.absolute().parent
    return f"{folder.name}_{own}" if own == "scene" and folder != Path.cwd() and folder.name else own


def _missing(file):
    """Return whether a file is missing; False where it cannot be looked at, which reading it will explain."""
    try:
        os.stat(file)
    except FileNotFoundError:
        return True
    except (OSError, ValueError):
        pass
    return False


def _run(arguments, start):
    from envedit import config
    from envedit.core.errors import ConfigError
    from envedit.report import output_folder

    overrides = [*run_options.quick(arguments), *arguments.overrides]
    if arguments.out:
        overrides.append(f"output.dir={config.quote(str(Path(arguments.out).absolute()))}")
    settings, arguments.config, arguments.base = load(arguments.config, arguments.preset, overrides)
    allowed = None if arguments.budget is None else run_options.seconds(arguments.budget)
    if arguments.export_initial is not None:
        return _export_initial(settings, arguments)
    if arguments.dry_run:
        if settings.target.kind == "none":
            raise ConfigError('--dry-run: got target.kind "none", expected a target to write: run without it')
        return _dry_run(settings, arguments)
    folder = Path(settings.output.dir)
    with output_folder.alone(folder):
        return _edit(settings, arguments, folder, allowed, start)


def _edit(settings, arguments, folder, allowed, start):
    """Carry out an edit and leave its results in a folder."""
    from envedit.cli import doctor
    from envedit.report import output_folder

    spare = [] if arguments.config is None else [arguments.config]
    read = output_folder.inputs_of(settings, arguments.base)
    output_folder.prepare_folder(folder, output_folder.names(folder), read, arguments.resume, spare)
    if arguments.resume and not (folder / "checkpoint.npz").exists() and (folder / "metrics.json").exists():
        _check_same(settings, folder)
        _say(arguments, f"{folder}: this run is complete, there is nothing to resume")
        _note_results(arguments, folder)
        return 0

    doctor.ensure(settings.variant)
    import mitsuba as mi

    mi.set_variant(settings.variant)
    mi.set_log_level(mi.LogLevel.Error)
    from envedit import pipeline

    import_s = time.perf_counter() - start
    said, base = [], arguments.base
    if allowed is not None:
        from envedit.cli import budget

        settings, note = budget.apply(settings, allowed, import_s, base)
        said.append(note)
        _say(arguments, note)

    # What a budget has chosen is not in the configuration that would be continued.
    again = "" if allowed else "; continue with --resume"
    with _progress(arguments) as progress:
        try:
            result = pipeline.run(
                settings,
                folder=folder,
                resume=arguments.resume,
                base=base,
                watch=pipeline.Watch(progress.stage, progress.update),
            )
        except pipeline.Interrupted as stop:
            if not (folder / "checkpoint.npz").exists():  # nothing was found yet
                return _interrupted(arguments, folder, again)
            _keep_map(folder, stop)
            _tell(arguments, "error", f"{stop}; checkpoint and edited.exr so far are in {folder}{again}")
            return 130
        except KeyboardInterrupt:
            return _interrupted(arguments, folder, again)
        except pipeline.Stopped as stop:
            _keep_map(folder, stop)
            raise
        result.metrics["choices"] = result.notes = said + result.notes
        progress.stage("writing")
    try:
        return _write(arguments, folder, result, import_s, said)
    except KeyboardInterrupt:
        return _interrupted(arguments, folder, again)


def _keep_map(folder, stop):
    """Write the map that an edit has come to which was cut short."""
    from envedit import config
    from envedit.report import map_files

    map_files.write_map(config.Output(), folder / "edited", stop.envmap, stop.given)


def _interrupted(arguments, folder, again):
    """Say what a run that was interrupted outside the loop has left; raises if that is nothing."""
    if not (folder / "checkpoint.npz").exists():
        raise KeyboardInterrupt
    _tell(arguments, "error", f"interrupted; a checkpoint is in {folder}{again}")
    return 130


def _export_initial(settings, arguments):
    """Write the picture to paint on, and nothing else."""
    from envedit.cli import doctor

    file = Path(arguments.export_initial)
    doctor.ensure(settings.variant)
    import mitsuba as mi

    mi.set_variant(settings.variant)
    mi.set_log_level(mi.LogLevel.Error)
    from envedit import inputs
    from envedit.report import output_folder
    from envedit.targets import initial_rendering

    initial_rendering.check_export(file)
    with _progress(arguments) as progress:
        progress.stage("rendering the picture to paint on")
        lit = inputs.load_scene(settings.scene, arguments.base)
        named = output_folder.of_views(file.name, lit.rows)
        files = [(file.with_name(name), rows) for name, rows in named[1:] or named]
        for one, _ in files:
            initial_rendering.check_export(one)
        envmap, warnings = inputs.load_map(settings.input, lit)
        notes = inputs.notes(settings.input, lit)
        source = inputs.source_of(settings.input, lit)  # what the picture is marked as made from
        settings = replace(settings, input=replace(settings.input, envmap=source))
        picture = initial_rendering.initial(lit, envmap, settings)
        under = initial_rendering.export_tonemap(file, picture, settings)
        for one, rows in files:
            warnings += initial_rendering.export(one, picture[rows], settings, under)
    for line in warnings:
        _tell(arguments, "warning", line)
    for line in notes:
        _say(arguments, line)
    declared = settings.target.display_tonemap
    if under not in ("linear", declared):
        _say(
            arguments,
            f"{file}: tonemap '{under}' is used, because '{declared}' would clip highlights; "
            "the file's metadata names it",
        )
    under = "linear" if under == "linear" else f"under the '{under}' tonemap"
    for k, (one, rows) in enumerate(files):
        ask = f'[target] kind = "image", file = "{one.absolute()}"' + (
            f", view = {k}" if len(files) > 1 else ""
        )
        size = f"{lit.width}x{rows.stop - rows.start}"
        _say(arguments, f"{one}: {size}, {under}; paint on it, then set {ask}")
    arguments.facts["files"] = {one.name: str(one.absolute()) for one, _ in files}
    return 0


def _dry_run(settings, arguments):
    """Write what a run would edit towards, and nothing else: a picture to look at, and linear radiance."""
    from envedit.cli import doctor
    from envedit.report import output_folder

    doctor.ensure(settings.variant)
    import mitsuba as mi

    mi.set_variant(settings.variant)
    mi.set_log_level(mi.LogLevel.Error)
    from envedit import inputs
    from envedit.images import images
    from envedit.report import preview
    from envedit.targets.target import make as make_target

    folder = Path(settings.output.dir)
    with output_folder.alone(folder), _progress(arguments) as progress:
        progress.stage("rendering the target")
        lit = inputs.load_scene(settings.scene, arguments.base)
        envmap, warnings = inputs.load_map(settings.input, lit)
        notes = inputs.notes(settings.input, lit)
        target = make_target(settings, lit, envmap)
        files = {name: folder / name for name in ("dry_run.png", "dry_run.exr")}
        preview.preview(
            files["dry_run.png"],
            {"initial": target.initial, "target": target.picture},
            {"initial": envmap, "target": target.envmap},
            settings.output.tonemap,
            views=[view.rows for view in lit.views],
        )
        images.write_exr(files["dry_run.exr"], target.picture, {"content": "target"}, panorama=False)
    for line in (*warnings, *target.warnings):
        _tell(arguments, "warning", line)
    for line in (*notes, target.source, *(str(file.resolve()) for file in files.values())):
        _say(arguments, line)
    arguments.facts["files"] = {name: str(file.resolve()) for name, file in files.items()}
    return 0


def _check_same(settings, folder):
    """Refuse to call the run in a folder complete when it was asked for something else."""
    from envedit import config
    from envedit.core.errors import ConfigError, InputError
    from envedit.losses.perceptual import installed
    from envedit.report import manifest

    try:
        done = config.load(folder / "config.toml")
        same_place = replace(done, output=replace(done.output, dir=settings.output.dir))
        same = same_place == installed.settled(settings)
    except ConfigError:
        same = False
    if not same:
        raise InputError(f"{folder}: holds a finished run of another configuration: run without --resume")
    if changed := manifest.changed(folder / "manifest.json"):
        raise InputError(f"{changed[0]}: has changed since the run in {folder}: run without --resume")


def _write(arguments, folder, result, import_s, said):
    from envedit.report import run_folder

    for line in run_folder.write(result.settings, folder, result, import_s, arguments.base):
        _tell(arguments, "warning", line)
    for line in result.notes[len(said) :]:
        _say(arguments, line)
    _say(arguments, _verdict(result.metrics))
    _say(arguments, f"results in {folder.resolve()}")
    _note_results(arguments, folder)
    return 0


def _note_results(arguments, folder):
    """Note a finished run for the object of ``--json``: its folder, files and metrics.json."""
    from envedit.report import output_folder

    names = output_folder.names(folder)
    here = {name: str((folder / name).resolve()) for name in names if (folder / name).is_file()}
    measured = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
    arguments.facts |= {"folder": str(folder.resolve()), "files": here, "metrics": measured}


def _verdict(measured):
    from envedit.losses import metrics

    def change(before, after):
        pair = measured[before], measured[after]
        first, last = (metrics.score(one, pair) for one in pair)
        beyond = " (most of the difference is outside the display's range)"
        what = beyond if metrics.saturated(pair) else ""
        return f"{first.rpartition(' ')[0]} -> {last}{what}"

    painted = measured["painted"]
    if painted and painted["towards"] is None:
        line = "share of the painted change reached: unknown"
    elif painted:
        line = f"{100 * painted['towards']:.0f} % of the painted change reached"
        if painted["reachable"] is not None:
            line += f" ({100 * painted['reachable']:.0f} % feasible)"
        if painted["elsewhere"] is not None:
            line += f", mean change elsewhere {painted['elsewhere']:.3f}"
    elif not measured["iterations"] and measured["initial"]["log_rmse"] == 0:
        measure = "log RMSE" if metrics.saturated([measured["render"]]) else "PSNR"
        line = f"no target; {measure} of the rendering against the initial one "
        line += metrics.score(measured["render"], [])
    else:
        line = f"rendering {change('initial', 'render')}"
        if measured["envmap"]:
            line += f", map {change('initial_envmap', 'envmap')}"
        if measured["ceiling"]:
            line += f", noise alone leaves {metrics.score(measured['ceiling'], [measured['render']])}"
    return line + f", {measured['timing']['total_s']:.1f} s"


def _say(arguments, line):
    if not (arguments.quiet or arguments.json):
        print(line)


if __name__ == "__main__":
    sys.exit(main())
