"""The options of ``envedit run``, and what they stand for in a configuration."""

from __future__ import annotations

import argparse
import os
import re

from envedit.cli import console
from envedit.core import shipped
from envedit.core.errors import ConfigError


def make_parser() -> argparse.ArgumentParser:
    """Make the parser of the command line."""
    parser = console.make_parser(
        "run",
        "Edit an HDR environment map so that a scene renders like a target.",
        [
            "envedit run quickstart",
            "envedit run edit.toml --set scene.width=256",
            "envedit run scene.xml --envmap sky.hdr --rotate 90",
            "envedit run scene.xml --export-initial paint_me.png",
            "envedit run scene.xml --paint paint_me.png",
            "envedit run edits/move_shadow --out shadow --preset draft",
        ],
        f"shipped configurations: {', '.join(shipped.configurations())}\n"
        f"shipped scenes, for [scene] file: {', '.join(shipped.scenes())}\n\n"
        "exit codes: 0 done; 2 bad configuration or usage; 3 bad image or scene file; 4 this machine cannot\n"
        "run it; 5 the optimisation could not proceed; 130 interrupted, after writing a checkpoint",
    )
    parser.add_argument(
        "config",
        metavar="CONFIG",
        nargs="?",
        help="a file, CONFIG.toml, or the name of a shipped one; or SCENE.xml, SCENE.usd, or the name of a "
        "shipped scene, with --envmap and one of --paint, --target and --rotate",
    )

    # ---- An edit of a scene
    quick = parser.add_argument_group(
        "edits of a scene without a configuration",
        "config.toml among the results records the run; without a target option the target is the map "
        "turned by 60 degrees",
    )
    quick.add_argument(
        "--envmap",
        metavar="MAP",
        help="map to edit: a file, scene or sunsky (default: the scene's own light; of a shipped scene, an "
        "analytic sky)",
    )
    quick.add_argument(
        "--camera", metavar="NAME", help="sensor by id, of a USD file by path (default: the only one)"
    )
    target = quick.add_mutually_exclusive_group()
    target.add_argument("--paint", metavar="PICTURE", help="target: the rendering, painted over")
    target.add_argument(
        "--target",
        metavar="FILE",
        help="target: the rendering under this map (2:1), or this picture of the scene under other light",
    )
    target.add_argument(
        "--rotate",
        metavar="DEGREES",
        type=float,
        help="target: the rendering under the map turned by DEGREES about the vertical",
    )

    # ---- Settings and results
    parser.add_argument(
        "--out",
        metavar="DIR",
        help="folder for the results (default: CONFIG_out beside the configuration; "
        "in the working folder, for a shipped one runs/NAME, for a scene SCENE_out, "
        "for FOLDER/scene.xml FOLDER_scene_out)",
    )
    parser.add_argument(
        "--preset",
        choices=("draft", "standard", "paper"),
        help="named set of defaults: standard; draft, smaller, in two fifths of the time; paper, settings "
        "of D'Orazio et al. 2024",
    )
    console.add_overrides(parser, "optimizer.iterations=50")

    # ---- One of several things to do
    instead = parser.add_mutually_exclusive_group()
    instead.add_argument(
        "--resume", action="store_true", help="continue an interrupted run from its checkpoint"
    )
    instead.add_argument(
        "--export-initial",
        metavar="FILE",
        help="only write the initial rendering, to paint on: linear .exr, or 16-bit .png under "
        "[target] tonemap; and FILE.envedit.json, which says what it was made with",
    )
    instead.add_argument(
        "--dry-run",
        action="store_true",
        help="only write the target, dry_run.png and dry_run.exr in the folder of the results: no edit",
    )
    instead.add_argument(
        "--budget", metavar="TIME", help="choose widths and samples so that the run ends within 30, 30s or 2m"
    )

    # ---- Output
    parser.add_argument("--quiet", action="store_true", help="print nothing but errors")
    parser.add_argument(
        "--json",
        action="store_true",
        help="print one JSON object at the end: folder, files, metrics, or error",
    )
    parser.add_argument(
        "--progress",
        choices=("text", "json"),
        default="text",
        help="progress on stderr as text or JSON lines",
    )
    return parser


def is_scene(name: str) -> bool:
    """Distinguish a scene from a configuration: an XML or USD file, or the name of a shipped scene."""
    plain = not os.path.isfile(name) and name in shipped.scenes() and name not in shipped.configurations()
    return name.lower().endswith((".xml", *shipped.USD_ENDINGS)) or plain


def quick(arguments: argparse.Namespace) -> list[str]:
    """Return the overrides that --envmap, --camera, --paint, --target and --rotate stand for.

    ConfigError where they are given beside a configuration, which says the same.
    """
    from envedit import config

    keys = {
        "envmap": (("input.envmap", arguments.envmap),),
        "camera": (("scene.sensors", arguments.camera and [arguments.camera]),),
        "paint": (("target.kind", "image"), ("target.file", arguments.paint)),
        "target": (("target.file", arguments.target),),
        "rotate": (("target.rotate_degrees", arguments.rotate),),
    }
    options = [name for name in keys if getattr(arguments, name) is not None]
    known = os.path.exists(arguments.config) or arguments.config in shipped.configurations()
    if options and known and not is_scene(arguments.config):
        key = keys[options[0]][-1][0]
        raise ConfigError(
            f"--{options[0]}: got it beside a configuration, expected it beside a scene: "
            f"set {key} in {arguments.config}, or --set {key}=..."
        )
    return [f"{key}={config.quote(value)}" for name in options for key, value in keys[name]]


def seconds(text: str) -> float:
    """Read --budget."""
    match = re.fullmatch(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*(s|sec|m|min|)\s*", text)
    value = float(match[1]) * (60 if match[2].startswith("m") else 1) if match else 0
    if not 0 < value < 1e6:
        raise ConfigError(f"--budget: got {text!r}, expected seconds or minutes, such as 30s or 2m")
    return value
