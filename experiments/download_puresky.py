"""Fetch Poly Haven's PureSky maps: ``python -m experiments.download_puresky DIR [--resolution 1k]``.

Poly Haven's public API lists the maps (``/assets``), and for each its files with address, MD5 and size
(``/files/SLUG``); no address is guessed. One request at a time, with pauses. A map that is there with the
right MD5 is left alone, one that was cut short is continued, and ``DIR/MANIFEST.tsv`` says what came from
where. The maps are CC0; the API asks for a user agent that names the program, and for a credit.
"""

from __future__ import annotations

import argparse
import csv
import email.utils
import hashlib
import http.client
import io
import json
import re
import ssl
import sys
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tqdm import tqdm

from envedit import __version__
from envedit.cli.progress import Progress
from envedit.core.atomic_files import write_atomically
from envedit.core.errors import EnveditError, InputError

API = "https://api.polyhaven.com"
AGENT = f"envedit/{__version__} (experiments.download_puresky)"
MANIFEST, COLUMNS = "MANIFEST.tsv", ("file", "md5", "source", "licence")
LICENCE = "CC0 1.0"

TRIES = 6
"""Requests for one thing before it is given up."""
_MOST_BACKOFF, _MOST_WAIT = 60.0, 600.0  # seconds: of our own accord, and because the server asks for it
_LEAST_RATE = 1000  # bytes a second; a connection that is slower for a whole timeout is a broken one
_MOST_JSON, _MOST_FILE = 64 << 20, 4 << 30  # bytes; a 16k map has some 500 MB
_CHUNK = 1 << 16

# The API's own pattern of an asset's name: no dot and no separator, so none leads out of a folder.
_SLUG = re.compile(r"[A-Za-z0-9_-]{1,100}")
_MD5 = re.compile(r"[0-9a-f]{32}")
_RESOLUTION = re.compile(r"[1-9][0-9]?k")


class Refused(Exception):
    """Why a map cannot be had, on one line; ``status`` is the HTTP status that said so, if it was one."""

    def __init__(self, reason: str, status: int | None = None):
        super().__init__(reason)
        self.status = status


class _Passing(Exception):
    """What may be gone at the next try; ``wait`` is what the server asks for, seconds."""

    def __init__(self, reason: str, wait: float | None = None):
        super().__init__(reason)
        self.wait = wait


# ---- requests ----------------------------------------------------------------------------------------------


@dataclass
class Connection:
    """One request after the other, each with the program's name, pauses between them.

    Attributes
    ----------
    pause : float
        Least time between the end of one request and the next, seconds.
    timeout : float
        Longest silence of the server, seconds.
    sleep : callable
        Waits so many seconds; tests look at what it is asked.
    say : callable
        Told on one line why something is tried again.
    """

    pause: float = 0.5
    timeout: float = 30.0
    sleep: Callable[[float], None] = time.sleep
    say: Callable[[str], None] = lambda line: None

    def __post_init__(self):
        self._asked = False
        # Not urlopen: it would open file: and ftp: addresses too, and the addresses come from a server.
        self._opener = urllib.request.OpenerDirector()
        for kind in ("Proxy", "Unknown", "HTTP", "HTTPS", "HTTPDefaultError", "HTTPRedirect"):
            self._opener.add_handler(getattr(urllib.request, f"{kind}Handler")())
        self._opener.add_handler(urllib.request.HTTPErrorProcessor())

    def json(self, url: str):
        """Fetch a JSON document.

        Raises
        ------
        Refused
            If it cannot be had, or is no JSON. A body that was cut short is asked for again.
        """

        def once():
            data = bytearray()
            with self._open(url) as response:
                length = response.headers.get("Content-Length", "")
                for chunk in self._chunks(response):
                    data += chunk
                    if len(data) > _MOST_JSON:
                        raise Refused(f"{url}: more than {_MOST_JSON >> 20} MiB, wanted a list in JSON")
            if length.isdecimal() and len(data) < int(length):
                raise _Passing(f"{url}: cut short after {len(data)} of {length} bytes")
            try:
                return json.loads(data)
            except (ValueError, RecursionError):
                raise Refused(f"{url}: the answer is not JSON") from None

        return self._patiently(once)

    def file(self, url: str, path: Path, size: int, md5: str, tell: Callable[[int], None]) -> None:
        """Fetch a file, whole and with the right MD5, or raise; what came so far stays in ``path``.part.

        Parameters
        ----------
        url : str
            Address, http or https.
        path : Path
            Where to; replaced only by a file whose MD5 is right.
        size : int
            Bytes.
        md5 : str
            32 hexadecimal digits.
        tell : callable
            Told how many bytes are there.

        Raises
        ------
        Refused
            If it cannot be had, or its MD5 was wrong twice, from the first byte.
        """
        part, wrong = path.with_name(f"{path.name}.part"), 0

        def once():
            nonlocal wrong
            have = part.stat().st_size if part.exists() else 0
            if have < size:
                self._continue(url, part, have, size, tell)
            have = part.stat().st_size
            if have < size:
                raise _Passing(f"{path.name}: cut short after {have} of {size} bytes")
            found = digest(part)
            if have == size and found == md5:
                part.replace(path)
                return
            part.unlink()
            wrong += 1
            # Once may be the fault of a rest of an older file; twice is the server's.
            reason = f"{path.name}: MD5 {found} of {have} bytes, wanted {md5} of {size}"
            raise Refused(reason) if wrong > 1 else _Passing(reason)

        self._patiently(once)

    def _continue(self, url, part, have, size, tell):
        """Append what is missing to a part; a server that knows no ranges sends everything anew."""
        try:
            response = self._open(url, have)
        except _RangeRefused:
            part.unlink()
            raise _Passing(f"{part.name}: the server does not continue it, starting anew") from None
        with response:
            continued = response.status == 206
            if continued and not response.headers.get("Content-Range", "").startswith(f"bytes {have}-"):
                part.unlink(missing_ok=True)
                raise _Passing(f"{part.name}: the server sent another range than was asked for")
            have = have if continued else 0
            with open(part, "ab" if continued else "wb") as file:
                for chunk in self._chunks(response):
                    file.write(chunk)
                    have += len(chunk)
                    tell(have)
                    if have > size:  # do not fill the disk; the MD5 will say that it is wrong
                        break

    def _chunks(self, response):
        """Yield the body as it comes; raise _Passing at a silence, or if it only trickles."""
        since, got = time.monotonic(), 0
        while chunk := response.read1(_CHUNK):
            yield chunk
            got += len(chunk)
            if (elapsed := time.monotonic() - since) > self.timeout:
                if got < _LEAST_RATE * elapsed:
                    raise _Passing(f"{response.url}: {got} bytes in {elapsed:.0f} s")
                since, got = time.monotonic(), 0

    def _open(self, url, have=0):
        if urllib.parse.urlsplit(url).scheme not in ("http", "https"):
            raise Refused(f"{url}: not an http or https address")
        if self._asked:
            self.sleep(self.pause)
        self._asked = True
        request = urllib.request.Request(url, headers={"User-Agent": AGENT})
        if have:
            request.add_header("Range", f"bytes={have}-")
        try:
            return self._opener.open(request, timeout=self.timeout)
        except urllib.error.HTTPError as error:
            with error:
                what = f"{url}: HTTP {error.code} {error.reason}"
                if error.code == 416 and have:
                    raise _RangeRefused from None
                if error.code in (408, 425, 429) or error.code >= 500:
                    raise _Passing(what, _retry_after(error.headers.get("Retry-After"))) from None
                raise Refused(what, error.code) from None

    def _patiently(self, once):
        """Call until it succeeds, a bounded number of times, with waits that double."""
        for tried in range(1, TRIES + 1):
            try:
                return once()
            except urllib.error.URLError as error:  # connection refused, no such host, certificate, silence
                if isinstance(error.reason, ssl.SSLCertVerificationError | str):
                    raise Refused(f"{error.reason}") from None
                trouble = _Passing(f"{error.reason}")
            except _Passing as passing:
                trouble = passing
            except http.client.InvalidURL as error:
                raise Refused(f"{error}") from None
            except (TimeoutError, ConnectionError, http.client.HTTPException, ssl.SSLError) as error:
                trouble = _Passing(f"{error}" or type(error).__name__)
            except (ValueError, OSError) as error:
                # An address that is none, or this machine's disk: no second try will mend it.
                raise Refused(f"{error}") from None
            wait = min(2.0 ** (tried - 1), _MOST_BACKOFF) if trouble.wait is None else trouble.wait
            if wait > _MOST_WAIT:
                raise Refused(f"{trouble}; the server asks to wait {wait:.0f} s: run again later")
            if tried < TRIES:
                self.say(f"{trouble}; again in {wait:.0f} s")
                self.sleep(wait)
        raise Refused(f"{trouble}; given up after {TRIES} tries")


class _RangeRefused(Exception):
    """HTTP 416: the part is no beginning of this file."""


def _retry_after(value: str | None) -> float | None:
    """Seconds that a Retry-After header asks for, given as a number or as a date; None for none."""
    if not value:
        return None
    if value.strip().isdecimal():
        return float(value)
    try:
        return max(0.0, email.utils.parsedate_to_datetime(value).timestamp() - time.time())
    except ValueError:
        return None


def digest(path: Path) -> str:
    """MD5 of a file, 32 hexadecimal digits."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "md5").hexdigest()


# ---- what Poly Haven has -----------------------------------------------------------------------------------


def pure_skies(connection: Connection, base: str = API) -> list[str]:
    """List the names of all PureSky maps, sorted.

    They are asked for by category; an API that has no such category any more, or does not know it yet, is
    asked for all HDRIs. In either case what counts is the asset itself: its category, or a name that ends in
    ``_puresky``. Names are passed on as they come: :func:`find` refuses what is no name.

    Raises
    ------
    Refused
        If there is no list, or no PureSky map in it.
    """
    for query in ("type=hdris&category=pure-skies", "type=hdris"):
        try:
            assets = connection.json(f"{base}/assets?{query}")
        except Refused as reason:
            if reason.status and "category" in query:
                continue
            raise
        if not isinstance(assets, dict):
            raise Refused(f"{base}/assets: came a {type(assets).__name__}, wanted an object of assets")
        if found := sorted(name for name, asset in assets.items() if _is_pure(name, asset)):
            return found
    raise Refused(f"{base}/assets: no PureSky map among {len(assets)} HDRIs")


def _is_pure(name, asset):
    asset = asset if isinstance(asset, dict) else {}
    legacy = asset.get("categories")
    return (
        name.endswith("_puresky")
        or asset.get("category") == "Pure Skies"
        or (isinstance(legacy, list) and "pure skies" in legacy)
    )


@dataclass(frozen=True)
class Remote:
    """A file that can be had: its name here, its address, MD5 and bytes."""

    name: str
    url: str
    md5: str
    size: int


def find(connection: Connection, slug: str, resolution: str, base: str = API) -> Remote:
    """Ask for the Radiance file of a map at one resolution.

    Raises
    ------
    Refused
        If the name is none, or the answer has no such file.
    """
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
    if not isinstance(url, str) or not isinstance(md5, str) or not _MD5.fullmatch(md5.lower()):
        raise Refused(f"{where}: the entry for {resolution} hdr has no usable url and md5")
    if type(size) is not int or not 0 < size <= _MOST_FILE:
        raise Refused(f"{where}: the entry for {resolution} hdr has size {size!r}")
    return Remote(f"{slug}_{resolution}.hdr", url, md5.lower(), size)


# ---- the folder --------------------------------------------------------------------------------------------


def read_manifest(folder: Path) -> dict[str, dict[str, str]]:
    """Read ``MANIFEST.tsv``: rows by file; none where there is no such file.

    Raises
    ------
    InputError
        If it is something else, which is not to be overwritten.
    """
    path = folder / MANIFEST
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({error})") from None
    rows = csv.DictReader(io.StringIO(text), dialect="excel-tab")
    if tuple(rows.fieldnames or ()) != COLUMNS:
        raise InputError(f"{path}: not a manifest of this program; give another folder")
    return {row["file"]: row for row in rows}


def write_manifest(folder: Path, rows: dict[str, dict[str, str]]) -> None:
    """Write ``MANIFEST.tsv``, sorted by file, whole or not at all."""
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, dialect="excel-tab", lineterminator="\n", extrasaction="ignore")
    writer.writeheader()
    writer.writerows(rows[name] for name in sorted(rows))
    write_atomically(folder / MANIFEST, text.getvalue().encode())


def download(
    folder: Path,
    resolution: str = "1k",
    limit: int | None = None,
    base: str = API,
    connection: Connection | None = None,
    progress: Progress | None = None,
    say: Callable[[str], None] = lambda line: None,
) -> tuple[list[str], list[str], list[str]]:
    """Fetch the PureSky maps that are not in a folder yet.

    Parameters
    ----------
    folder : Path
        Where to; made if it is not there.
    resolution : str
        As Poly Haven calls them: 1k is 1024 texels wide.
    limit : int, optional
        At most so many maps, the first by name.
    base : str
        Address of the API.
    connection, progress : optional
        How to ask, and whom to tell how far it has come.
    say : callable
        Told, when it happens, why a map cannot be had.

    Returns
    -------
    fetched, present, failed : list of str
        Names of files, and for each map that could not be had a line that says why.

    Raises
    ------
    Refused
        If there is no list of maps.
    InputError
        If the folder or its manifest cannot be used.
    """
    connection, progress = connection or Connection(), progress or Progress(quiet=True)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be used for the maps ({error.strerror})") from None
    rows = read_manifest(folder)
    progress.stage(f"asking {base} for its PureSky maps")
    slugs = pure_skies(connection, base)[:limit]
    fetched, present, failed = [], [], []
    for number, slug in enumerate(slugs, 1):
        progress.stage(f"{number}/{len(slugs)} {slug[:60]!r}")
        try:
            remote = find(connection, slug, resolution, base)
            path = folder / remote.name
            if path.is_file() and path.stat().st_size == remote.size and digest(path) == remote.md5:
                present.append(remote.name)
            else:
                kilo = -(-remote.size // 1024)
                tell = lambda have, kilo=kilo: progress.update(min(have // 1024, kilo), kilo, "kB")  # noqa: E731
                connection.file(remote.url, path, remote.size, remote.md5, tell)
                fetched.append(remote.name)
        except (Refused, OSError) as reason:
            failed.append(f"{slug[:60]!r}: {' '.join(str(reason).split())[:400]}")
            say(failed[-1])
            continue
        row = (remote.name, remote.md5, remote.url, LICENCE)
        rows[remote.name] = dict(zip(COLUMNS, row, strict=True))
        write_manifest(folder, rows)
    return fetched, present, failed


# ---- the command -------------------------------------------------------------------------------------------


def main(argv: list[str] | None = None) -> int:
    """Run the command line; returns the exit code: 0, 1 if a map is missing, 2 for usage, 3, 130."""
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
        parser.error(f"--resolution: came {given.resolution!r}, wanted 1k, 2k, 4k, ...")
    if given.limit is not None and given.limit < 1:
        parser.error(f"--limit: came {given.limit}, wanted 1 or more")
    if not given.pause >= 0 or not given.timeout > 0:
        parser.error("--pause, --timeout: wanted numbers of seconds")

    def say(line):
        tqdm.write(line, file=sys.stderr)

    connection = Connection(given.pause, given.timeout)
    if not given.quiet:
        connection.say = say
    base = given.base_url.rstrip("/")
    try:
        with Progress(quiet=given.quiet) as progress:
            fetched, present, failed = download(
                given.folder, given.resolution, given.limit, base, connection, progress, say
            )
    except EnveditError as error:
        print(f"download_puresky: {error}", file=sys.stderr)
        return error.exit_code
    except Refused as reason:
        print(f"download_puresky: {reason}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("download_puresky: interrupted; run again to continue", file=sys.stderr)
        return 130
    if not given.quiet:
        print(f"{len(fetched)} maps fetched, {len(present)} were there, {len(failed)} failed: {given.folder}")
        print("Powered by Poly Haven, https://polyhaven.com; the maps are CC0")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
