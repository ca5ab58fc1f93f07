"""Fetch Poly Haven's PureSky maps: ``python -m experiments.download_puresky DIR [--resolution 1k]``.

Poly Haven's public API lists the maps (``/assets``), and for each its files with address, MD5 and size
(``/files/SLUG``); no address is guessed. One request at a time, with pauses, by requests and pooch (extra
``dev``). A map that is there with the right MD5 is left alone, any other is fetched whole and put in place
when its MD5 is right; ``DIR/MANIFEST.tsv`` lists what is from where. The maps are CC0; the API requires a
user agent that names the program, and asks for a credit.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from tqdm import tqdm

from envedit import __version__
from envedit.cli.progress import Progress
from envedit.core.atomic_files import write_atomically
from envedit.core.errors import EnveditError, InputError, MachineError

API = "https://api.polyhaven.com"
AGENT = f"envedit/{__version__} (experiments.download_puresky)"
MANIFEST, HEADER = "MANIFEST.tsv", "file\tmd5\tsource\tlicence"
LICENCE = "CC0 1.0"

TRIES, WHOLE_TRIES = 6, 3
"""Requests for an answer, and for a file that arrives cut short or with another MD5."""
_MOST_WAIT = 600.0  # seconds that a server may ask to wait
_LEAST_RATE = 1000  # bytes a second
_MOST_JSON, _MOST_FILE = 64 << 20, 4 << 30  # bytes; a 16k map has some 500 MB
_CHUNK = 1 << 12

# The API's own pattern of an asset's name: no dot and no separator, so none leads out of a folder.
_SLUG = re.compile(r"[A-Za-z0-9_-]{1,100}")
_MD5 = re.compile(r"[0-9a-f]{32}")
_RESOLUTION = re.compile(r"[1-9][0-9]?k")


class Refused(Exception):
    """Why something cannot be had, on one line."""

    def __init__(self, reason: object):
        super().__init__(" ".join(str(reason).split())[:400])


class Connection:
    """One http or https request after the other, with the program's name.

    ``pause`` is the time before each request but the first, ``timeout`` the longest silence of the server,
    both in seconds. Raises MachineError if pooch or requests is not installed.
    """

    def __init__(self, pause: float = 0.5, timeout: float = 30.0):
        try:
            import pooch
            import requests
            from urllib3.util import Retry
        except ImportError as error:
            how = "run pip install '.[dev]', or pip install pooch"
            raise MachineError(f"needs {error.name}: {how}") from None

        class BoundedRetry(Retry):
            def get_retry_after(self, response):
                if (wait := super().get_retry_after(response)) and wait > _MOST_WAIT:
                    asked = response.headers["Retry-After"]
                    raise Refused(f"HTTP {response.status}, Retry-After: {asked}; run again later")
                return wait

        statuses = (408, 425, 429, *range(500, 600))
        retry = BoundedRetry(TRIES - 1, status_forcelist=statuses, backoff_factor=1, raise_on_status=False)
        self.pause, self.timeout, self._asked = pause, timeout, False
        self._slow = requests.Timeout
        self._session = requests.Session()
        self._session.headers["User-Agent"] = AGENT
        for kind in ("http://", "https://"):  # requests has no adapter for any other
            self._session.mount(kind, requests.adapters.HTTPAdapter(max_retries=retry))
        pooch.get_logger().setLevel("WARNING")  # Progress shows what is fetched

    def body(self, url: str, most: int) -> Iterator[bytes]:
        """Request an address and yield its body.

        Raises Refused if there is no answer but an error, or the body has more than ``most`` bytes;
        requests.RequestException if it is cut short, stops, or is slower than :data:`_LEAST_RATE`.
        """
        if self._asked:
            time.sleep(self.pause)
        self._asked = True
        try:
            response = self._session.get(url, stream=True, timeout=self.timeout)
        except (OSError, ValueError, Refused) as error:  # requests' own errors are OSErrors
            raise Refused(f"{url}: {error}") from None
        with response:
            if response.status_code != 200:
                raise Refused(f"{url}: HTTP {response.status_code} {response.reason}")
            begun, got = time.monotonic(), 0
            for chunk in response.iter_content(_CHUNK):
                got += len(chunk)
                if got > most:
                    raise Refused(f"{url}: more than {most} bytes")
                if (elapsed := time.monotonic() - begun) > self.timeout and got < _LEAST_RATE * elapsed:
                    raise self._slow(f"{got} bytes in {elapsed:.0f} s")
                yield chunk

    def json(self, url: str):
        """Fetch a JSON document, or raise Refused."""
        try:
            return json.loads(b"".join(self.body(url, _MOST_JSON)))
        except OSError as error:
            raise Refused(f"{url}: {error}") from None
        except (ValueError, RecursionError):
            raise Refused(f"{url}: the answer is not JSON") from None

    def fetch(self, remote: Remote, folder: Path, progress: Progress) -> bool:
        """Put a file into a folder; return False where it is there already, with its MD5.

        Raises Refused if it cannot be had, or was damaged :data:`WHOLE_TRIES` times; nothing of it is kept.
        """
        import pooch

        def stream(url, temporary, _):
            nonlocal fetched
            fetched = True
            with open(temporary, "wb") as file:
                for chunk in self.body(url, remote.size):
                    file.write(chunk)
                    progress.update(file.tell() // 1024, -(-remote.size // 1024), "kB")

        fetched, known, urls = False, {remote.name: f"md5:{remote.md5}"}, {remote.name: remote.url}
        files = pooch.Pooch(folder, "", known, urls, retry_if_failed=WHOLE_TRIES - 1)
        try:
            path = Path(files.fetch(remote.name, downloader=stream))
            if fetched:
                path.chmod(0o644)  # pooch leaves the 0600 of its temporary file
        except (OSError, ValueError) as error:  # ValueError: the MD5
            raise Refused(f"{remote.url}: {error}") from None
        return fetched


# ---- what Poly Haven has -----------------------------------------------------------------------------------


def pure_skies(connection: Connection, base: str = API) -> list[str]:
    """List the names of all PureSky maps, sorted: HDRIs of that category, or named ``..._puresky``.

    Names are passed on as they are: :func:`find` refuses what is no name.
    """
    assets = connection.json(f"{base}/assets?type=hdris")
    if not isinstance(assets, dict):
        raise Refused(f"{base}/assets: got a {type(assets).__name__}, expected an object of assets")
    if found := sorted(name for name, asset in assets.items() if _is_pure(name, asset)):
        return found
    raise Refused(f"{base}/assets: no PureSky map among {len(assets)} HDRIs")


def _is_pure(name, asset):
    asset = asset if isinstance(asset, dict) else {}
    older = asset.get("categories")
    listed = isinstance(older, list) and "pure skies" in older
    return name.endswith("_puresky") or asset.get("category") == "Pure Skies" or listed


@dataclass(frozen=True)
class Remote:
    """A file that can be had: its name here, its address, MD5 and bytes."""

    name: str
    url: str
    md5: str
    size: int


def find(connection: Connection, slug: str, resolution: str, base: str = API) -> Remote:
    """Look up the Radiance file of a map at one resolution, or raise Refused."""
    if not _SLUG.fullmatch(slug):
        raise Refused(f"{slug!r}: not the name of an asset, refused")
    where = f"{base}/files/{slug}"
    answer = connection.json(where)
    sizes = answer.get("hdri") if isinstance(answer, dict) else None
    try:
        entry = sizes[resolution]["hdr"]
        url, md5, size = entry["url"], entry["md5"], entry["size"]
    except (KeyError, TypeError):
        offered = ", ".join(sorted(sizes)) if isinstance(sizes, dict) else "nothing"
        raise Refused(f"{where}: no hdr file at {resolution}; offered: {offered}") from None
    texts = isinstance(url, str) and isinstance(md5, str)
    if not texts or re.search(r"\s", url) or not _MD5.fullmatch(md5.lower()):  # url: a cell of the manifest
        raise Refused(f"{where}: the entry for {resolution} hdr has no usable url and md5")
    if type(size) is not int or not 0 < size <= _MOST_FILE:
        raise Refused(f"{where}: the entry for {resolution} hdr has size {size!r}")
    return Remote(f"{slug}_{resolution}.hdr", url, md5.lower(), size)


# ---- the folder --------------------------------------------------------------------------------------------


def read_manifest(folder: Path) -> dict[str, str]:
    """Make a folder where there is none; return the lines of its ``MANIFEST.tsv`` by file.

    Raises InputError if that cannot be done, or the manifest is another program's.
    """
    path = folder / MANIFEST
    try:
        folder.mkdir(parents=True, exist_ok=True)
        header, *lines = path.read_text(encoding="utf-8").splitlines() or [""]
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be used ({error})") from None
    if header != HEADER:
        raise InputError(f"{path}: not a manifest of this program; give another folder")
    return {line.partition("\t")[0]: line for line in lines}


def download(
    folder: Path,
    connection: Connection,
    resolution: str = "1k",
    limit: int | None = None,
    base: str = API,
    progress: Progress | None = None,
) -> tuple[list[str], list[str], list[str]]:
    """Fetch the PureSky maps, at most ``limit``, the first by name, that are not in a folder yet.

    Returns the files that were fetched, those that were there, and for each map that cannot be had a line
    with the reason, which is printed to stderr too. Raises Refused if there is no list of maps, and
    InputError if the folder or its manifest cannot be used.
    """
    progress = progress or Progress(quiet=True)
    rows = read_manifest(folder)
    progress.stage(f"requesting the list of PureSky maps from {base}")
    slugs = pure_skies(connection, base)[:limit]
    fetched, present, failed = [], [], []
    for number, slug in enumerate(slugs, 1):
        progress.stage(f"{number}/{len(slugs)} {slug[:60]!r}")
        try:
            remote = find(connection, slug, resolution, base)
            (fetched if connection.fetch(remote, folder, progress) else present).append(remote.name)
        except Refused as reason:
            failed.append(f"{slug[:60]!r}: {reason}")
            tqdm.write(failed[-1], file=sys.stderr)
            continue
        rows[remote.name] = "\t".join((remote.name, remote.md5, remote.url, LICENCE))
        lines = [HEADER, *(rows[name] for name in sorted(rows)), ""]
        write_atomically(folder / MANIFEST, "\n".join(lines).encode())
    return fetched, present, failed


# ---- the command -------------------------------------------------------------------------------------------


def main(argv: list[str] | None = None) -> int:
    """Run the command line; returns the exit code: 0, 1 if a map is missing, 2 for usage, 3, 4, 130."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.download_puresky", description="Fetch Poly Haven's PureSky maps (CC0)."
    )
    parser.add_argument("folder", type=Path, metavar="DIR", help="where to; maps that are there stay")
    parser.add_argument("--resolution", default="1k", help="1k (default), 2k, 4k, ...")
    parser.add_argument("--limit", type=int, metavar="N", help="only the first N maps by name")
    parser.add_argument("--pause", type=float, default=0.5, metavar="S", help="seconds between requests")
    parser.add_argument("--timeout", type=float, default=30.0, metavar="S", help="longest silence, seconds")
    parser.add_argument("--base-url", default=API, metavar="URL", help=f"address of the API (default {API})")
    parser.add_argument("--quiet", action="store_true", help="print nothing but errors")
    given = parser.parse_args(argv)
    if not _RESOLUTION.fullmatch(given.resolution):
        parser.error(f"--resolution: got {given.resolution!r}, expected 1k, 2k, 4k, ...")
    if given.limit is not None and given.limit < 1:
        parser.error(f"--limit: got {given.limit}, expected 1 or more")
    if not given.pause >= 0 or not given.timeout > 0:
        parser.error("--pause, --timeout: expected numbers of seconds")
    base = given.base_url.rstrip("/")
    try:
        connection = Connection(given.pause, given.timeout)
        with Progress(quiet=given.quiet) as progress:
            found = download(given.folder, connection, given.resolution, given.limit, base, progress)
    except (EnveditError, Refused) as error:
        print(f"download_puresky: {error}", file=sys.stderr)
        return getattr(error, "exit_code", 1)
    except KeyboardInterrupt:
        print("download_puresky: interrupted; run again for the maps that are missing", file=sys.stderr)
        return 130
    fetched, present, failed = map(len, found)
    if not given.quiet:
        print(f"{fetched} maps fetched, {present} were there, {failed} failed: {given.folder}")
        print("Powered by Poly Haven, https://polyhaven.com; the maps are CC0")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
