"""``envedit run CONFIG``: carry out an edit; leaves the map, renderings, metrics and a report in a folder."""

from __future__ import annotations

import argparse
import difflib
import os
import re
import sys
import time
from pathlib import Path

from envedit.cli.streams import steady
from envedit.core import shipped


@steady
def main(argv: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    start = time.perf_counter()
    from envedit.core.errors import EnveditError, unwrapped

    parser = _parser()
    arguments = parser.parse_args(argv)
    if arguments.config is None:
        known = ", ".join(shipped.configurations())
        parser.error(f"got no CONFIG, expected a file, such as CONFIG.toml, or one of {known}")
    try:
        with unwrapped():
            return _run(arguments, start)
    except EnveditError as error:
        print(f"envedit: {error}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        goes_on = "a fit under way goes on where it was last kept"
        print(f"envedit: interrupted; there is no checkpoint to resume from ({goes_on})", file=sys.stderr)
        return 130


def _load(name, preset, overrides):
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


def _missing(file):
    """Tell whether a file is not there; False where it cannot be looked at, which reading it will explain."""
    try:
        os.stat(file)
    except FileNotFoundError:
        return True
    except (OSError, ValueError):
        pass
    return False


def _parser():
    parser = argparse.ArgumentParser(
        prog="envedit run",
        description="Edit an HDR environment map so that a scene renders like a target.",
        epilog="examples:\n  envedit run quickstart\n  envedit run edit.toml --set scene.width=256\n"
        "  envedit run edits/move_shadow --out shadow --preset draft\n\n"
        f"shipped configurations: {', '.join(shipped.configurations())}\n"
        f"shipped scenes, for [scene] file: {', '.join(shipped.scenes())}\n\n"
        "exit codes: 0 done; 2 bad configuration or usage; 3 bad image or scene file; 4 this machine cannot\n"
        "run it; 5 the optimisation could not proceed; 130 interrupted, after writing a checkpoint",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "config", metavar="CONFIG", nargs="?", help="a file, CONFIG.toml, or the name of a shipped one"
    )
    parser.add_argument(
        "--out",
        metavar="DIR",
        help="folder for the results (default: CONFIG_out beside the configuration; "
        "for a shipped one runs/NAME in the working folder)",
    )
    parser.add_argument(
        "--preset",
        choices=("draft", "standard", "paper"),
        help="named set of defaults: standard; draft, in a third of the time; paper, the paper's method",
    )
    parser.add_argument(
        "--set",
        metavar="table.key=value",
        action="append",
        default=[],
        dest="overrides",
        help="change one key of the configuration, such as optimizer.iterations=50; may be repeated",
    )
    instead = parser.add_mutually_exclusive_group()
    instead.add_argument(
        "--resume", action="store_true", help="continue an interrupted run from its checkpoint"
    )
    instead.add_argument(
        "--export-initial",
        metavar="FILE",
        help="only write the initial rendering, to paint on: linear .exr, or 16-bit .png under "
        "[target] tonemap",
    )
    instead.add_argument(
        "--budget",
        metavar="TIME",
        help="choose widths, steps and samples so that the run ends within 30, 30s or 2m",
    )
    parser.add_argument("--quiet", action="store_true", help="print nothing but errors")
    return parser


def _run(arguments, start):
    from envedit import config
    from envedit.report import output_folder

    overrides = list(arguments.overrides)
    if arguments.out:
        overrides.append(f"output.dir={config.quote(str(Path(arguments.out).absolute()))}")
    settings, arguments.config, arguments.base = _load(arguments.config, arguments.preset, overrides)
    allowed = None if arguments.budget is None else _seconds(arguments.budget)
    if arguments.export_initial is not None:
        return _export_initial(settings, arguments)
    folder = Path(settings.output.dir)
    with output_folder.alone(folder):
        return _edit(settings, arguments, folder, allowed, start)


def _edit(settings, arguments, folder, allowed, start):
    """Carry out an edit and leave its results in a folder."""
    from envedit.cli import doctor
    from envedit.report import output_folder

    named = (settings.input.envmap, settings.scene.file, settings.target.file, settings.target.mask)
    inputs = [path for path in named if path]
    output_folder.prepare_folder(folder, output_folder.RESULTS, inputs, arguments.resume, [arguments.config])
    if arguments.resume and not (folder / "checkpoint.npz").exists() and (folder / "metrics.json").exists():
        _check_same(settings, folder)
        _say(arguments.quiet, f"{folder}: this run is complete, there is nothing to resume")
        return 0

    doctor.ensure(settings.variant)
    import mitsuba as mi

    mi.set_variant(settings.variant)
    mi.set_log_level(mi.LogLevel.Error)
    from envedit import pipeline
    from envedit.images import images

    import_s = time.perf_counter() - start
    from envedit.cli.progress import Progress

    said, base = [], arguments.base
    if allowed is not None:
        from envedit.cli import budget

        settings, note = budget.apply(settings, allowed, import_s, base)
        said.append(note)
        _say(arguments.quiet, note)

    # What a budget has chosen is not in the configuration that would be continued.
    again = "" if allowed else "; continue with --resume"
    with Progress(quiet=arguments.quiet) as progress:
        try:
            result = pipeline.run(
                settings,
                folder=folder,
                resume=arguments.resume,
                base=base,
                watch=pipeline.Watch(progress.stage, progress.update),
            )
        except pipeline.Interrupted as stop:
            images.write_exr(folder / "edited.exr", stop.envmap, {"source": settings.input.envmap})
            kept = f"checkpoint and edited.exr so far are in {folder}{again}"
            print(f"envedit: {stop}; {kept}", file=sys.stderr)
            return 130
        except KeyboardInterrupt:
            return _interrupted(folder, again)
        except pipeline.Stopped as stop:
            images.write_exr(folder / "edited.exr", stop.envmap, {"source": settings.input.envmap})
            raise
        result.metrics["choices"] = result.notes = said + result.notes
        progress.stage("writing")
    try:
        return _write(settings, folder, result, import_s, arguments.quiet, said)
    except KeyboardInterrupt:
        return _interrupted(folder, again)


def _interrupted(folder, again):
    """Say what a run that was interrupted outside the loop has left; raises if that is nothing."""
    if not (folder / "checkpoint.npz").exists():
        raise KeyboardInterrupt
    print(f"envedit: interrupted; a checkpoint is in {folder}{again}", file=sys.stderr)
    return 130


def _seconds(text):
    """Read --budget."""
    from envedit.core.errors import ConfigError

    found = re.fullmatch(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*(s|sec|m|min|)\s*", text)
    value = float(found[1]) * (60 if found[2].startswith("m") else 1) if found else 0
    if not 0 < value < 1e6:
        raise ConfigError(f"--budget: got {text!r}, expected seconds or minutes, such as 30s or 2m")
    return value


def _export_initial(settings, arguments):
    """Write the picture to paint on, and nothing else."""
    from envedit.cli import doctor

    file = Path(arguments.export_initial)
    doctor.ensure(settings.variant)
    import mitsuba as mi

    mi.set_variant(settings.variant)
    mi.set_log_level(mi.LogLevel.Error)
    from envedit import inputs
    from envedit.cli.progress import Progress
    from envedit.targets import painted_image

    painted_image.check_export(file)
    with Progress(quiet=arguments.quiet) as progress:
        progress.stage("rendering the picture to paint on")
        envmap, warnings = inputs.load_map(settings.input)
        lit = inputs.load_scene(settings.scene, arguments.base)
        warnings += painted_image.export(file, painted_image.initial(lit, envmap, settings), settings)
    for line in warnings:
        print(f"envedit: warning: {line}", file=sys.stderr)
    under = "linear" if file.suffix.lower() == ".exr" else f"under the '{settings.target.tonemap}' tonemap"
    ask = f'[target] kind = "image", file = "{file.absolute()}"'
    _say(arguments.quiet, f"{file}: {lit.width}x{lit.height}, {under}; paint on it, then set {ask}")
    return 0


def _check_same(settings, folder):
    """Refuse to call the run in a folder complete when it was asked for something else."""
    from dataclasses import replace

    from envedit import config
    from envedit.core.errors import ConfigError, InputError
    from envedit.report import manifest

    try:
        done = config.load(folder / "config.toml")
        same = replace(done, output=replace(done.output, dir=settings.output.dir)) == settings
    except ConfigError:
        same = False
    if not same:
        raise InputError(f"{folder}: holds a finished run of another configuration: run without --resume")
    if changed := manifest.changed(folder / "manifest.json"):
        raise InputError(f"{changed[0]}: has changed since the run in {folder}: run without --resume")


def _write(settings, folder, result, import_s, quiet, said):
    from envedit.report import run_folder

    for line in run_folder.write(settings, folder, result, import_s):
        print(f"envedit: warning: {line}", file=sys.stderr)
    for line in result.notes[len(said) :]:
        _say(quiet, line)
    _say(quiet, _verdict(result.metrics))
    _say(quiet, f"results in {folder.resolve()}")
    return 0


def _verdict(measured):
    painted = measured["painted"]
    if painted and painted["towards"] is not None:
        line = f"{100 * painted['towards']:.0f} % of the way to the paint"
        if painted["reachable"] is not None:
            line += f" ({100 * painted['reachable']:.0f} % are feasible)"
        line += (
            f", changed elsewhere by {painted['elsewhere']:.3f}" if painted["elsewhere"] is not None else ""
        )
    else:
        line = f"rendering {measured['initial']['psnr']:.1f} -> {measured['render']['psnr']:.1f} dB"
        if measured["envmap"]:
            line += f", map {measured['initial_envmap']['psnr']:.1f} -> {measured['envmap']['psnr']:.1f} dB"
    return line + f", {measured['timing']['total_s']:.1f} s"


def _say(quiet, line):
    if not quiet:
        print(line)


if __name__ == "__main__":
    sys.exit(main())
