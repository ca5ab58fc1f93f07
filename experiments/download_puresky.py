"""Fetch the PureSky maps of Poly Haven that the pages use: ``python -m experiments.download_puresky DIR``.

Needs pooch and requests (extra ``dev``). A map that is there with the right MD5 is left alone, any other is
fetched whole and put in place when its MD5 is right. The maps are CC0; Poly Haven asks for a credit.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from envedit import __version__
from envedit.cli.sweep import exit_code
from envedit.core.atomic_files import make_folder
from envedit.core.extras import required

ADDRESS = "https://dl.polyhaven.org/file/ph-assets/HDRIs/hdr/1k/"
MAPS = {
    "aristea_wreck": "af70994dfdd8a5d6850665540a637c31",
    "autumn_field": "f9a6bd6d95a55e2d677b8a84b7f53673",
    "evening_road_01": "12b3257981a14e194e6b77c804a2f136",
    "industrial_sunset": "622cc98d705210e283318c306089bb2e",
    "kloofendal_48d_partly_cloudy": "c69498687e876bf68d2a8b8a62234eb9",
    "kloppenheim_06": "995d68b1656f26452572645c0ffe898b",
    "mud_road": "297b64450baca1b573b20ed88b6b9a7d",
    "overcast_soil": "7fbca6264f4618a787092b9e1679a578",
    "rustig_koppie": "31122bc2490f50e8d65bde749b45ca21",
    "snow_field": "e159e4186107737aacc52e7d79b47542",
    "sunflowers": "38fcaa021880c8ca8aa0cbaabefa1602",
    "syferfontein_18d_clear": "76ef39faee475a3629841e58c04e1b43",
    "wasteland_clouds": "1d845d676974dc1b9f20ed1258ed2576",
}
"""MD5 of each map's Radiance file at 1k."""
TRIES = 4
"""For a file that does not arrive, or with another MD5; pooch waits a second longer from one to the next."""
SILENCE = 30.0
"""Longest that the server may be silent, seconds."""


def download(folder: Path) -> list[str]:
    """Fetch the maps that are not in a folder yet; returns a line for each that cannot be had.

    InputError if the folder cannot be made, MachineError if pooch is not installed.
    """
    pooch = required("pooch", "dev", "fetching maps")
    make_folder(folder)
    known = {f"{name}_puresky_1k.hdr": f"md5:{md5}" for name, md5 in MAPS.items()}
    files = pooch.Pooch(folder, ADDRESS, known, retry_if_failed=TRIES - 1)
    agent = f"envedit/{__version__} (experiments.download_puresky)"
    downloader = pooch.HTTPDownloader(headers={"User-Agent": agent}, timeout=SILENCE)
    failed = []
    for file in known:
        try:
            path = Path(files.fetch(file, downloader=downloader))
            path.chmod(0o644)  # pooch leaves the 0600 of its temporary file
        except (OSError, ValueError) as error:  # ValueError: the MD5
            failed.append(f"{file}: {error}")
    return failed


def main(argv: list[str] | None = None) -> int:
    """Run the command line; returns the exit code: 0, 1 if a map is missing, 2 for usage, 3, 4, 130."""
    about = "Fetch the PureSky maps of Poly Haven that the pages use (CC0)."
    parser = argparse.ArgumentParser(prog="python -m experiments.download_puresky", description=about)
    parser.add_argument("folder", type=Path, metavar="DIR", help="where to; maps that are there stay")
    folder = parser.parse_args(argv).folder

    def act() -> int:
        failed = download(folder)
        for line in failed:
            print(line, file=sys.stderr)
        print(f"{len(MAPS) - len(failed)} of {len(MAPS)} maps are in {folder}")
        print("Powered by Poly Haven, https://polyhaven.com; the maps are CC0")
        return 1 if failed else 0

    return exit_code("download_puresky", act)


if __name__ == "__main__":
    sys.exit(main())
