"""The server of the page: 127.0.0.1 only, a token in every address, the page's own origin only.

Addresses: ``/TOKEN/`` the page and its modules, ``/TOKEN/ws`` the WebSocket, ``/TOKEN/result/NAME`` a file of
the results, ``/TOKEN/map/NAME`` (PUT) a map that is dropped on the page. Nothing else is served or written.
"""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import os
import re
import secrets
import socket
from pathlib import Path

import numpy as np
from starlette.applications import Starlette
from starlette.requests import ClientDisconnect, HTTPConnection, Request
from starlette.responses import FileResponse, PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from envedit.cli.paint import project, protocol, taken_files, thumbnails
from envedit.cli.paint.session import Tell
from envedit.cli.paint.worker import Again, Refused, Worker
from envedit.core import shipped
from envedit.core.types import Views
from envedit.report import output_folder

HOST = "127.0.0.1"
PAGE = Path(__file__).parent / "page"
MOST_CLIENTS = 8
LARGEST_FILE = 1 << 30
"""Bytes of a file that the page sends."""
_IMAGE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_. -]{0,100}\.(exr|hdr|png|jpg|jpeg)", re.IGNORECASE)
_SAFE = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "img-src 'self' data:; connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}
_KEPT = ("opened", "lights", "status", "error", "saved", "start", "thumbnail")
"""Kinds of message of which the last is sent to a page that comes later; of thumbnails that of each file."""


class Client:
    """What waits for one page, ``name``: of each kind of frame and of state the latest, all else in turn."""

    def __init__(self, name: str):
        self.name = name
        self.waiting: dict[str, bytes | dict] = {}
        self.event = asyncio.Event()

    def put(self, key: str, value: bytes | dict) -> None:
        """Let something wait, after all else, and drop what waits under that key."""
        self.waiting.pop(key, None)
        self.waiting[key] = value
        self.event.set()

    async def next(self) -> list:
        """Wait for something, and take all that waits."""
        await self.event.wait()
        self.event.clear()
        taken, self.waiting = list(self.waiting.values()), {}
        return taken


class Hub(Tell):
    """Hands the worker's messages to all pages; called from the worker's thread."""

    def __init__(self):
        self.clients: set[Client] = set()
        self.loop: asyncio.AbstractEventLoop | None = None
        self.last: dict[str, dict] = {}
        self.count = 0

    def frame(self, kind: str, source: str, image: np.ndarray, rows: Views = (slice(None),)) -> None:
        """Show an image, each view by itself, with the number of the frame in front."""
        if kind == "render":
            self.count += 1
        for view, part in enumerate(rows):
            sent = protocol.frame(kind, source, self.count, image[part], view)
            self._send(f"frame {kind} {view}", sent)

    def say(self, message: dict) -> None:
        """Send a message, of each type the latest; a status says which frame it is about.

        A document goes to all pages but the one that it is of, which has it, and to those that come later.
        """
        kind = message["type"]
        key = f"thumbnail {message['file']}" if kind == "thumbnail" else kind
        if kind == "status":
            message = {**message, "frame": self.count}
        if kind in ("opened", "document"):  # what is painted is no longer what was saved
            self.last.pop("saved", None)
        if kind == "document":
            self.last["opened"] = {**self.last["opened"], "document": message["document"]}
        if kind in _KEPT:
            self.last[key] = message
        if kind in ("opened", "status"):  # what went wrong before is over
            self.last.pop("error", None)
        if kind == "opened":
            self.last = {key: value for key, value in self.last.items() if value["type"] != "thumbnail"}
        self._send(key, message)

    def _send(self, key, value):
        if self.loop is not None:
            with contextlib.suppress(RuntimeError):  # the loop has ended
                self.loop.call_soon_threadsafe(self._put, key, value)

    def _put(self, key, value):
        for client in self.clients:
            if key != "document" or value["client"] != client.name:
                client.put(key, value)


class Server:
    """Page, worker and what lies between them.

    ``opened`` is what is painted on; None: the start page. With port 0 any that is free is taken. OSError if
    the port is in use. A random ``token`` is part of every address.
    """

    def __init__(self, opened: project.Project | None = None, port: int = 0):
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            self.socket.bind((HOST, port))
            self.socket.listen(64)
        except OSError:
            self.socket.close()
            raise
        self.port = self.socket.getsockname()[1]
        self.token = secrets.token_urlsafe(16)
        self.hub = Hub()
        self.opened, self.worker = opened, Worker(self.hub, opened)
        self.thumbnails = thumbnails.Thumbnails(self.hub.say)
        if opened is None:
            self.hub.say(_start())

    @property
    def url(self) -> str:
        """Address of the page."""
        return f"http://{HOST}:{self.port}/{self.token}/"

    @property
    def origins(self) -> tuple[str, ...]:
        """Origins that the page may have."""
        return f"http://{HOST}:{self.port}", f"http://localhost:{self.port}"

    def app(self) -> Starlette:
        """Return the application."""

        @contextlib.asynccontextmanager
        async def lifespan(app):
            self.hub.loop = asyncio.get_running_loop()
            self.worker.start()
            if self.opened is None:
                start = self.hub.last["start"]
                earlier = [(one["picture"], False) for one in start["recent"] if one["picture"]]
                self.thumbnails.make([*((file, True) for file in start["maps"]), *earlier])
            yield
            self.thumbnails.stop()
            self.worker.stop()

        app = Starlette(
            routes=[
                Route("/{token}/", self._page),
                WebSocketRoute("/{token}/ws", self._socket),
                Route("/{token}/result/{name}", self._result),
                Route("/{token}/map/{name}", self._map, methods=["PUT"]),
                Route("/{token}/image/{name}", self._image, methods=["PUT"]),
                Route("/{token}/{name}", self._page),
            ],
            lifespan=lifespan,
        )
        app.router.redirect_slashes = False  # it would answer without asking for the token
        return app

    def _known(self, request: HTTPConnection) -> bool:
        """Whether a request has the token, and comes to this machine's own name."""
        host = request.headers.get("host", "")
        own = [origin.removeprefix("http://") for origin in self.origins]
        return host in own and hmac.compare_digest(request.path_params["token"].encode(), self.token.encode())

    def _from_page(self, request):
        return self._known(request) and request.headers.get("origin") in self.origins

    async def _page(self, request: Request) -> Response:
        if not self._known(request):
            return PlainTextResponse("the address lacks its token: take it from the terminal", 403, _SAFE)
        name = request.path_params.get("name", "index.html")
        served = {path.name: path for path in PAGE.iterdir()}
        if name not in served:
            return PlainTextResponse("no such file", 404, _SAFE)
        script = "text/javascript" if name.endswith(".js") else None  # Windows may have another for it
        return FileResponse(served[name], media_type=script, headers=_SAFE)

    async def _result(self, request: Request) -> Response:
        if not self._known(request):
            return PlainTextResponse("the address lacks its token", 403, _SAFE)
        session, name = self.worker.session, request.path_params["name"]
        file = None if session is None else session.project.folder / name
        if file is None or name not in output_folder.RESULTS or not file.is_file() or file.is_symlink():
            return PlainTextResponse("no such result", 404, _SAFE)
        # The report has its pictures and its style in itself.
        policy = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
        safe = {**_SAFE, "Content-Security-Policy": policy}
        return FileResponse(file, headers=safe)

    async def _map(self, request: Request) -> Response:
        if self._from_page(request) and self.worker.session is not None:
            return PlainTextResponse("a painting is open: maps are taken before that", 409, _SAFE)
        answer = await self._taken(request, taken_files.MAPS)
        if answer.status_code == 200:
            self.hub.say(_start())
            self.thumbnails.make([(bytes(answer.body).decode(), True)])
        return answer

    async def _image(self, request: Request) -> Response:
        answer = await self._taken(request, taken_files.IMAGES)
        if answer.status_code == 200:  # painted.toml lies elsewhere
            return PlainTextResponse(str(Path.cwd() / bytes(answer.body).decode()), headers=_SAFE)
        return answer

    async def _taken(self, request, folder):
        """Write a file that the page sends to a folder, and answer with its name."""
        if not self._from_page(request):
            return PlainTextResponse("not from the page", 403, _SAFE)
        name = request.path_params["name"]
        if not _IMAGE_NAME.fullmatch(name):
            wanted = "expected a plain name that ends in .exr, .hdr, .png or .jpg"
            return PlainTextResponse(wanted, 400, _SAFE)
        part, size = None, 0
        try:
            part = taken_files.part(name, folder)
            with open(part, "xb") as file:
                async for piece in request.stream():
                    size += len(piece)
                    if size > LARGEST_FILE:
                        return PlainTextResponse(f"more than {LARGEST_FILE} bytes", 413, _SAFE)
                    file.write(piece)
            return PlainTextResponse(taken_files.place(part, name), headers=_SAFE)
        except (OSError, ClientDisconnect) as error:
            return PlainTextResponse(f"not written: {error}", 500, _SAFE)
        finally:
            with contextlib.suppress(OSError):
                if part is not None:
                    part.unlink(missing_ok=True)

    async def _socket(self, socket: WebSocket) -> None:
        if not self._from_page(socket):
            await socket.close(4403)  # before it is accepted: HTTP 403
            return
        if len(self.hub.clients) >= MOST_CLIENTS:
            await socket.close(1013)
            return
        await socket.accept()
        client = Client(secrets.token_hex(4))
        for kind, message in list(self.hub.last.items()):  # the worker may say something meanwhile
            client.put(kind, message)
        self.hub.clients.add(client)
        await socket.send_json({"type": "hello", "client": client.name})
        self.worker.post(Again())
        sender = asyncio.create_task(_send(client, socket))
        try:
            while True:
                received = await socket.receive()
                if received["type"] == "websocket.disconnect":
                    break
                given = received.get("text")
                given = received["bytes"] if given is None else given
                try:
                    # A message of many points takes seconds, in which frames go on to all pages.
                    request = await asyncio.to_thread(protocol.read, given, client.name)
                except protocol.BadMessageError as error:
                    client.put("error", {"type": "refused", "text": str(error)})
                    self.worker.post(Refused())
                    continue
                if isinstance(request, protocol.Open):
                    self.thumbnails.stop()
                self.worker.post(request)
        except WebSocketDisconnect:
            pass
        finally:
            self.hub.clients.discard(client)
            sender.cancel()
            with contextlib.suppress(asyncio.CancelledError, WebSocketDisconnect, RuntimeError):
                await sender


async def _send(client, socket):
    """Send what waits for a page, until it goes."""
    with contextlib.suppress(WebSocketDisconnect, RuntimeError):
        while True:
            for one in await client.next():
                await (socket.send_bytes(one) if isinstance(one, bytes) else socket.send_json(one))


def _start():
    """Return what the start page offers."""
    folders = [Path.cwd(), Path.cwd() / taken_files.MAPS]
    return {
        "type": "start",
        "maps": [os.path.relpath(file) for file in thumbnails.maps(folders)],
        "scenes": list(shipped.complete_scenes()),
        "configurations": [name for name in shipped.configurations() if name.startswith("edits/")],
        "recent": project.recent(),
    }
