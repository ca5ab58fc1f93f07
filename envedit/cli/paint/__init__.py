"""``envedit paint``: paint on the rendering in the browser; the sky follows while one paints."""

from __future__ import annotations

import threading
import webbrowser
from typing import Any

from envedit.cli.console import Console, exit_code, make_parser
from envedit.core.errors import ConfigError
from envedit.core.extras import required

PORT = 8765


def main(argv: list[str] | None = None) -> int:
    """Serve the page until Ctrl-C; returns the exit code."""
    parser = _parser()
    arguments = parser.parse_args(argv)
    if arguments.name is None and arguments.envmap is not None:
        arguments.name = "sphere"
    if arguments.name is None and (arguments.camera or arguments.preset):
        parser.error("--camera and --preset are of a CONFIG or SCENE: name one")
    return exit_code(Console(), lambda: _paint(arguments))


def _paint(arguments):
    # ---- What is painted on
    for module in ("starlette", "websockets"):
        required(module, "paint", "paint")
    uvicorn = required("uvicorn", "paint", "paint")
    from envedit.cli.paint import project
    from envedit.cli.paint.server import HOST, Server

    opened = None
    if arguments.name is not None:
        opened = project.opened(
            arguments.name, arguments.envmap or "", arguments.preset, arguments.camera or ""
        )
        with opened.alone():  # an error here if another server has it; the worker holds it
            pass

    # ---- Where it is served
    try:
        server = Server(opened, arguments.port)
    except OSError as error:
        raise ConfigError(
            f"port {arguments.port} on {HOST}: cannot be used ({error.strerror or error}): another "
            "`envedit paint` may run there; end it, or give another with --port"
        ) from None
    except OverflowError:
        raise ConfigError(f"--port: got {arguments.port}, expected 0 to 65535") from None
    print(f"envedit paint: {server.url}", flush=True)
    print("Ctrl-C ends it.", flush=True)
    if not arguments.no_browser:
        threading.Thread(target=webbrowser.open, args=(server.url,), daemon=True).start()
    serve(server, uvicorn)
    print("envedit paint: ended", flush=True)
    return 0


def settings(server: Any, uvicorn: Any) -> Any:
    """Return how uvicorn serves the page: frames stay on this machine, and are not compressed."""
    from envedit.cli.paint.protocol import MOST_BYTES

    return uvicorn.Config(
        server.app(),
        log_level="warning",
        ws="websockets-sansio",
        ws_max_size=MOST_BYTES,
        ws_per_message_deflate=False,
        timeout_graceful_shutdown=2,
        access_log=False,
    )


def serve(server: Any, uvicorn: Any) -> None:
    """Serve until Ctrl-C, then wait for what is being computed."""
    try:
        uvicorn.Server(settings(server, uvicorn)).run(sockets=[server.socket])
    except KeyboardInterrupt:
        pass
    finally:
        server.worker.stop()
        if server.worker.is_alive():
            server.worker.join(60)
        server.socket.close()


def _parser():
    parser = make_parser(
        "paint",
        "Paint on the rendering in the browser; the environment map follows while you paint.",
        [
            "envedit paint",
            "envedit paint sphere --envmap sky.hdr",
            "envedit paint edit.toml",
            "envedit paint edit_out/painted.toml",
        ],
        "Results and painted.toml, which `envedit run` carries out as well, go to the folder of the results\n"
        "that `envedit run` would write to. Needs the extra paint: pip install '.[paint]' in a checkout.",
    )
    parser.add_argument(
        "name",
        metavar="CONFIG | SCENE",
        nargs="?",
        help="CONFIG.toml, SCENE.xml, SCENE.usd, or the name of a shipped one (default: a page to choose "
        "from)",
    )
    parser.add_argument("--envmap", metavar="MAP", help="map to edit: a file, scene or sunsky")
    parser.add_argument("--camera", metavar="NAME", help="sensor by id, of a USD file by path")
    parser.add_argument("--preset", choices=("draft", "standard"), help="named set of defaults")
    parser.add_argument("--port", type=int, default=PORT, help=f"port (default: {PORT}; 0: any)")
    parser.add_argument("--no-browser", action="store_true", help="only print the address")
    return parser
