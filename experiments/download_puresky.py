"""Fetch Poly Haven's PureSky maps: ``python -m experiments.download_puresky DIR``.

Poly Haven's public API lists the maps (``/assets``), and for each its files with address, MD5 and size
(``/files/SLUG``); no address is guessed. One request at a time, with pauses, by requests and pooch (extra
``dev``). A map that is there with the right MD5 is left alone, any other is fetched whole and put in place
when its MD5 is right. The maps are CC0; the API requires a user agent that names the program, and asks for a
credit.
"""

from __future__ import annotations

import argparse
import re
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tqdm import tqdm

from envedit import __version__
from envedit.cli.progress import Progress
from envedit.core.atomic_files import make_folder
from envedit.core.errors import EnveditError
from envedit.core.extras import required

API = "https://api.polyhaven.com"
AGENT = f"envedit/{__version__} (experiments.download_puresky)"
TRIES, WHOLE_TRIES = 6, 3
"""Requests for an answer, and for a file that arrives cut short or with another MD5."""
PAUSE, SILENCE, MOST_WAIT = 0.5, 30.0, 600
"""Seconds before each request; longest that the server may be silent, and may ask to wait."""
MOST_BYTES = 4 << 30
"""Of a file; a map of 16k has some 500 MB."""
CHUNK = 1 << 12

# The API's own pattern of an asset's name: no dot and no separator, so none leads out of a folder.
_SLUG = re.compile(r"[A-Za-z0-9_-]{1,100}")
_MD5 = re.compile(r"[0-9a-f]{32}")


class Refused(Exception):
    """Why something cannot be had, on one line."""

    def __init__(self, reason: object):
        super().__init__(" ".join(str(reason).split())[:400])


@dataclass(frozen=True)
class Remote:
    """A file that can be had: its name here, its address, MD5 and bytes."""

    name: str
    url: str
    md5: str
    size: int


def connected() -> Any:
    """Return a session with the program's name, which repeats requests that the server could not answer.

    Raises MachineError if pooch or requests is not installed.
    """
    pooch = required("pooch", "dev", "fetching maps")
    requests = required("requests", "dev", "fetching maps")
    retry = required("urllib3.util", "dev", "fetching maps").Retry(
        TRIES - 1,
        status_forcelist=(408, 425, 429, *range(500, 600)),
        backoff_factor=1,
        retry_after_max=MOST_WAIT,
        raise_on_status=False,
    )
    session = requests.Session()
    session.headers["User-Agent"] = AGENT
    for kind in ("http://", "https://"):  # requests has no adapter for any other
        session.mount(kind, requests.adapters.HTTPAdapter(max_retries=retry))
    pooch.get_logger().setLevel("WARNING")  # Progress shows what is fetched
    return session


def response(session: Any, url: str) -> Any:
    """Request an address; Refused if there is no answer but an error."""
    time.sleep(PAUSE)
    try:
        found = session.get(url, stream=True, timeout=SILENCE)
    except (OSError, ValueError) as error:  # requests' own errors are OSErrors
        raise Refused(f"{url}: {error}") from None
    if found.status_code != 200:
        raise Refused(f"{url}: HTTP {found.status_code} {found.reason}")
    return found


def document(session: Any, url: str) -> dict:
    """Fetch a JSON object, or raise Refused."""
    try:
        found = response(session, url).json()
    except (OSError, ValueError, RecursionError):
        raise Refused(f"{url}: the answer is not JSON") from None
    if not isinstance(found, dict):
        raise Refused(f"{url}: got a {type(found).__name__}, expected an object")
    return found


def pure_skies(session: Any, base: str) -> list[str]:
    """List the names of all PureSky maps, sorted: HDRIs of that category, or named ``..._puresky``.

    Names are passed on as they are: :func:`find` refuses what is no name.
    """
    assets = document(session, f"{base}/assets?type=hdris")
    if found := sorted(name for name, asset in assets.items() if _is_pure(name, asset)):
        return found
    raise Refused(f"{base}/assets: no PureSky map among {len(assets)} HDRIs")


def _is_pure(name, asset):
    asset = asset if isinstance(asset, dict) else {}
    older = asset.get("categories")
    listed = isinstance(older, list) and "pure skies" in older
    return name.endswith("_puresky") or asset.get("category") == "Pure Skies" or listed


def find(session: Any, slug: str, base: str) -> Remote:
    """Look up the Radiance file of a map at 1k, or raise Refused."""
    if not _SLUG.fullmatch(slug):
        raise Refused(f"{slug!r}: not the name of an asset, refused")
    where = f"{base}/files/{slug}"
    try:
        entry = document(session, where)["hdri"]["1k"]["hdr"]
        remote = Remote(f"{slug}_1k.hdr", entry["url"], entry["md5"].lower(), entry["size"])
    except (AttributeError, KeyError, TypeError):
        raise Refused(f"{where}: no hdr file at 1k") from None
    if not isinstance(remote.url, str) or not _MD5.fullmatch(remote.md5):
        raise Refused(f"{where}: the entry has no usable url and md5")
    if type(remote.size) is not int or not 0 < remote.size <= MOST_BYTES:
        raise Refused(f"{where}: the entry has size {remote.size!r}")
    return remote


def fetch(session: Any, remote: Remote, folder: Path, progress: Progress) -> bool:
    """Put a file into a folder; return False where it is there already, with its MD5.

    Raises Refused if it cannot be had, or was damaged :data:`WHOLE_TRIES` times; nothing of it is kept.
    """
    fetched = False

    def stream(url, temporary, _):
        nonlocal fetched
        fetched = True
        with response(session, url) as answer, open(temporary, "wb") as file:
            for chunk in answer.iter_content(CHUNK):
                file.write(chunk)
                if file.tell() > remote.size:
                    raise Refused(f"{url}: more than {remote.size} bytes")
                progress.update(file.tell() // 1024, -(-remote.size // 1024), "kB")

    pooch = required("pooch", "dev", "fetching maps")
    known = {remote.name: f"md5:{remote.md5}"}
    urls = {remote.name: remote.url}
    files = pooch.Pooch(folder, "", known, urls, retry_if_failed=WHOLE_TRIES - 1)
    try:
        path = Path(files.fetch(remote.name, downloader=stream))
        if fetched:
            path.chmod(0o644)  # pooch leaves the 0600 of its temporary file
    except (OSError, ValueError) as error:  # ValueError: the MD5
        raise Refused(f"{remote.url}: {error}") from None
    return fetched


def download(
    folder: Path, session: Any, progress: Progress, base: str
) -> tuple[list[str], list[str], list[str]]:
    """Fetch the PureSky maps that are not in a folder yet.

    Returns the files that were fetched, those that were there, and for each map that cannot be had a line
    with the reason, which is printed to stderr too. Raises Refused if there is no list of maps, and
    InputError if the folder cannot be made.
    """
    make_folder(folder)
    progress.stage(f"requesting the list of PureSky maps from {base}")
    slugs = pure_skies(session, base)
    fetched, present, failed = [], [], []
    for number, slug in enumerate(slugs, 1):
        progress.stage(f"{number}/{len(slugs)} {slug[:60]!r}")
        try:
            remote = find(session, slug, base)
            (fetched if fetch(session, remote, folder, progress) else present).append(remote.name)
        except Refused as reason:
            failed.append(f"{slug[:60]!r}: {reason}")
            tqdm.write(failed[-1], file=sys.stderr)
    return fetched, present, failed


def main(argv: list[str] | None = None) -> int:
    """Run the command line; returns the exit code: 0, 1 if a map is missing, 2 for usage, 3, 4, 130."""
    about = "Fetch Poly Haven's PureSky maps (CC0)."
    parser = argparse.ArgumentParser(prog="python -m experiments.download_puresky", description=about)
    parser.add_argument("folder", type=Path, metavar="DIR", help="where to; maps that are there stay")
    folder = parser.parse_args(argv).folder
    try:
        with Progress() as progress:
            fetched, present, failed = download(folder, connected(), progress, API)
    except (EnveditError, Refused) as error:
        print(f"download_puresky: {error}", file=sys.stderr)
        return getattr(error, "exit_code", 1)
    except KeyboardInterrupt:
        print("download_puresky: interrupted; run again for the maps that are missing", file=sys.stderr)
        return 130
    print(f"{len(fetched)} maps fetched, {len(present)} were there, {len(failed)} failed: {folder}")
    print("Powered by Poly Haven, https://polyhaven.com; the maps are CC0")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
