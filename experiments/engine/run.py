r"""Measure the engine beside the machine's own floors, in one run.

    [ENVEDIT_DATA=...] python -m experiments.engine.run [--torch PYTHON] [--out runs/engine] \
        [--only floors|siren|transport|quality|scaling|fits ...]
    python -m experiments.engine.run --quick

Writes results.json, results.md and plots into the output folder; a section that is measured again replaces
its earlier numbers. ``--quick`` measures tiny sizes without data and fails if what must hold does not.
"""

import argparse
import json
import math
import os
import sys
import tempfile
import time
from pathlib import Path

import drjit as dr
import mitsuba as mi

from envedit.cli import doctor
from envedit.core.atomic_files import write_atomically
from envedit.core.errors import EnveditError
from envedit.report.manifest import manifest

SECTIONS = ("floors", "siren", "transport", "quality", "scaling", "fits")
VARIANT = "llvm_ad_rgb"


def measure(section: str, results: dict, arguments) -> dict:
    """Measure one section; ``results`` are those of this run so far."""
    from . import fits, floors, network, quality, scaling, transport

    quick = arguments.quick
    if section == "floors":
        return floors.measure(quick)
    if section == "siren":
        return network.measure(quick, arguments.torch)
    if section == "transport":
        known = results.get("floors")
        return transport.measure(quick, known and known["found"]["bandwidth"])
    if section == "quality":
        return quality.measure(quick)
    if section == "scaling":
        return scaling.measure(quick)
    overrides = ["fit.epochs=60", "input.width=32", "representation.hidden=32"] if quick else []
    return fits.measure(overrides=overrides, quick=quick, out=arguments.out)


def about() -> dict:
    """Describe machine and versions, and how busy the machine is with other things."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        cpu = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), None)
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
        load = os.getloadavg()[0]
    except (OSError, ValueError):
        cpu = memory = load = None
    found = {"cpu": cpu, "threads": dr.thread_count(), "memory_bytes": memory, "load": load}
    return manifest({}, {}, VARIANT) | found


def in_tables(results: dict) -> dict[str, str]:
    """Return the tables of all sections that there are, by the names of the markers in docs/engine.md."""
    from . import tables

    measured = [section for section in SECTIONS if section in results]
    found = {"machine": tables.machine({section: results[section] for section in measured})}
    for section in measured:
        found |= getattr(tables, section)(results[section]["found"])
    return found


def document(results: dict) -> str:
    """Return all tables as one Markdown text."""
    lines = ["# The engine, measured"]
    for name, text in in_tables(results).items():
        lines += ["", f"<!-- table: {name} -->", "", text]
    return "\n".join(lines) + "\n"


def _finite(value):
    """Replace what JSON does not know by null."""
    if isinstance(value, dict):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _parser():
    parser = argparse.ArgumentParser(
        prog="python -m experiments.engine.run", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--only", nargs="+", choices=SECTIONS, default=SECTIONS, help="sections to measure")
    parser.add_argument("--quick", action="store_true", help="check this program at tiny sizes, without data")
    parser.add_argument("--torch", metavar="PYTHON", help="an interpreter with PyTorch, to compare with")
    parser.add_argument(
        "--out", type=Path, help="folder of the results (default: runs/engine; none if --quick)"
    )
    return parser


def run(arguments) -> int:
    """Measure, write, print; returns the exit code."""
    from . import check, plot

    file = arguments.out / "results.json"
    fresh = arguments.quick or not file.exists()
    kept = {} if fresh else json.loads(file.read_text())
    results = {}
    for section in arguments.only:
        print(f"{section} ...", file=sys.stderr, flush=True)
        machine, start = about(), time.perf_counter()
        found = measure(section, results, arguments)
        seconds = time.perf_counter() - start
        results[section] = {"about": machine, "seconds": seconds, "found": found}
        kept[section] = results[section]
        write_atomically(file, json.dumps(_finite(kept), indent=1).encode())
        write_atomically(arguments.out / "results.md", document(kept).encode())
    plots = plot.draw(kept, arguments.out)
    if not arguments.quick:
        print(document(kept))
        print(f"results.json, results.md{''.join(f', {p.name}' for p in plots)} in {arguments.out}")
        return 0
    if missing := [section for section in SECTIONS if section not in results]:
        print(f"measured; not checked without {', '.join(missing)}")
        return 0
    if wrong := check.failures(results, in_tables(results), plots):
        print(document(results), *(f"FAILED: {line}" for line in wrong), sep="\n")
        return 1
    print(f"engine: self-check passed in {sum(r['seconds'] for r in results.values()):.0f} s")
    return 0


def main(argv=None) -> int:
    """Run the command line; returns the exit code."""
    arguments = _parser().parse_args(argv)
    try:
        doctor.ensure(VARIANT)
        mi.set_variant(VARIANT)
        with tempfile.TemporaryDirectory() as folder:
            arguments.out = arguments.out or Path(folder if arguments.quick else "runs/engine")
            arguments.out.mkdir(parents=True, exist_ok=True)
            return run(arguments)
    except EnveditError as error:
        print(f"envedit: {error}", file=sys.stderr)
        return error.exit_code


if __name__ == "__main__":
    sys.exit(main())
