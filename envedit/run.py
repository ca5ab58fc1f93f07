"""The command line: parse, call, print, write, exit code.

``python -m envedit.run CONFIG.toml`` carries out an edit and leaves the map, renderings, metrics and a report in a folder.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import sys
import time
from pathlib import Path

_START = time.perf_counter()
_EARLIER = "earlier"
_OUTPUTS = ("edited.exr", "render_initial.exr", "render_target.exr", "render_edited.exr", "influence.exr", "preview.png", "report.html",
            "history.csv", "config.toml", "manifest.json", "metrics.json", "checkpoint.npz")


def main(argv: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    from .errors import EnveditError

    arguments = _parser().parse_args(argv)
    try:
        return _run(arguments)
    except EnveditError as error:
        print(f"envedit: {error}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        print("envedit: interrupted; nothing was written yet", file=sys.stderr)
        return 130


def _parser():
    parser = argparse.ArgumentParser(prog="python -m envedit.run", description="Edit an HDR environment map by inverse rendering.")
    parser.add_argument("config", metavar="CONFIG.toml", help="what to do")
    parser.add_argument("--out", metavar="DIR", help="folder for the results (default: CONFIG_out beside the configuration)")
    parser.add_argument("--preset", choices=("draft", "standard", "paper"), help="named set of defaults")
    parser.add_argument("--set", metavar="table.key=value", action="append", default=[], dest="overrides",
                        help="change one key of the configuration; may be repeated")
    parser.add_argument("--resume", action="store_true", help="continue an interrupted run from its checkpoint")
    parser.add_argument("--quiet", action="store_true", help="print nothing but errors")
    return parser


def _run(arguments):
    from . import config, doctor

    overrides = list(arguments.overrides)
    if arguments.out:
        overrides.append(f"output.dir={json.dumps(str(Path(arguments.out).absolute()))}")
    settings = config.load(arguments.config, arguments.preset, overrides)
    folder = Path(settings.output.dir)
    _prepare(folder, arguments.resume)
    if arguments.resume and not (folder / "checkpoint.npz").exists() and (folder / "metrics.json").exists():
        _say(arguments.quiet, f"{folder}: this run is complete, there is nothing to resume")
        return 0

    doctor.ensure(settings.variant)
    import mitsuba as mi

    mi.set_variant(settings.variant)
    mi.set_log_level(mi.LogLevel.Error)
    from . import image, pipeline

    import_s = time.perf_counter() - _START
    from .progress import Progress

    with Progress(quiet=arguments.quiet) as progress:
        try:
            result = pipeline.run(settings, folder=folder, resume=arguments.resume, base=Path(arguments.config).absolute().parent,
                                  watch=pipeline.Watch(progress.stage, progress.update))
        except pipeline.Interrupted as stop:
            image.write_exr(folder / "edited.exr", stop.envmap, {"source": settings.input.envmap})
            print(f"envedit: {stop}; checkpoint and edited.exr so far are in {folder}; continue with --resume", file=sys.stderr)
            return 130
        except pipeline.Stopped as stop:
            image.write_exr(folder / "edited.exr", stop.envmap, {"source": settings.input.envmap})
            raise
        progress.stage("writing")
    return _write(settings, folder, result, import_s, arguments.quiet)


def _prepare(folder, resume):
    """Make the output folder; move what an earlier run left there out of the way."""
    from .errors import InputError

    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: is a file, the results need a folder: give another with --out or [output] dir")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        old = [folder / name for name in _OUTPUTS if (folder / name).exists()]
        if old and not resume:
            number = 1 + max((int(p.name.rpartition("-")[2]) for p in folder.glob(f"{_EARLIER}-*") if p.name.rpartition("-")[2].isdigit()),
                             default=0)
            keep = folder / f"{_EARLIER}-{number}"
            keep.mkdir()
            for path in old:
                path.rename(keep / path.name)
    except OSError as error:
        raise InputError(f"{folder}: cannot be used for the results ({error.strerror}): give another with --out") from error
    if not os.access(folder, os.W_OK):
        raise InputError(f"{folder}: cannot be written to: give another folder with --out")


def _write(settings, folder, result, import_s, quiet):
    from . import checkpoint, config, files, image, manifest, preview, report

    start = time.perf_counter()
    source = {"source": settings.input.envmap}
    image.write_exr(folder / "edited.exr", result.envmap, source)
    for name, picture in result.renders.items():
        image.write_exr(folder / f"render_{name}.exr", picture, {"source": settings.scene.file})
    if result.influence is not None:
        image.write_exr(folder / "influence.exr", result.influence[..., None].repeat(3, axis=2), {"content": "T' 1: influence per texel"})
    text = config.to_toml(settings)
    files.write_atomically(folder / "config.toml", text.encode())
    manifest.write_history(folder / "history.csv", result.history)
    inputs = {name: path for name, path in (("envmap", settings.input.envmap), ("scene", settings.scene.file),
                                            ("target", settings.target.file), ("mask", settings.target.mask)) if Path(path).is_file()}
    facts = manifest.manifest({"seed": settings.seed, "preset": settings.preset}, inputs, settings.variant)
    manifest.write_manifest(folder / "manifest.json", facts)

    warnings = list(result.warnings)
    timing = result.metrics["timing"]
    timing["import_s"] = round(import_s, 3)
    with contextlib.suppress(ImportError):
        preview.preview(folder / "preview.png", result.renders, result.maps, settings.output.tonemap)
        if settings.output.report:
            report.write_report(folder / "report.html", title=f"{Path(settings.input.envmap).stem}, {Path(settings.scene.file).stem}",
                                config_toml=text, metrics=result.metrics, manifest=facts, history=result.history, renders=result.renders,
                                maps=result.maps, warnings=warnings, notes=result.notes, tonemap=settings.output.tonemap)
    timing["report_s"] = round(time.perf_counter() - start, 3)
    timing["total_s"] = round(timing["total_s"] + timing["import_s"] + timing["report_s"], 3)
    lost = manifest.write_metrics(folder / "metrics.json", result.metrics)
    checkpoint.remove(folder)
    for line in [*warnings, *(f"metrics.json: {name} was not finite and is null" for name in lost)]:
        print(f"envedit: warning: {line}", file=sys.stderr)
    for line in result.notes:
        _say(quiet, line)
    _say(quiet, _verdict(result.metrics))
    _say(quiet, f"results in {folder}")
    return 0


def _verdict(measured):
    line = f"rendering {measured['initial']['psnr']:.1f} -> {measured['render']['psnr']:.1f} dB"
    if measured["envmap"]:
        line += f", map {measured['initial_envmap']['psnr']:.1f} -> {measured['envmap']['psnr']:.1f} dB"
    return line + f", {measured['timing']['total_s']:.1f} s"


def _say(quiet, line):
    if not quiet:
        print(line)


if __name__ == "__main__":
    sys.exit(main())
