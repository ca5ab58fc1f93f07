"""``envedit paint``: paint on the rendering in the browser; the sky follows while one paints."""

from __future__ import annotations

import argparse
import sys
import threading
import webbrowser
from typing import Any

PORT = 8765


def main(argv: list[str] | None = None) -> int:
    """Serve the page until Ctrl-C; returns the exit code."""
    from envedit.core.errors import EnveditError

    arguments = _parser().parse_args(argv)
    try:
        import starlette  # noqa: F401
        import uvicorn
        import websockets  # noqa: F401
    except ImportError as error:
        how = "run pip install '.[paint]' in the checkout"
        print(f"envedit: paint needs the package {error.name}: {how}", file=sys.stderr)
        return 4
    from envedit.cli.paint import project
    from envedit.cli.paint.server import HOST, Server

    try:
        opened = None
        if arguments.name is not None:
            opened = project.opened(
                arguments.name, arguments.envmap or "", arguments.preset, arguments.camera or ""
            )
        elif arguments.envmap:
            opened = project.opened("sphere", arguments.envmap, arguments.preset)
        if opened is not None:
            with opened.alone():  # an error here if another server has it; the worker holds it
                pass
    except EnveditError as error:
        print(f"envedit: {error}", file=sys.stderr)
        return error.exit_code
    try:
        server = Server(opened, arguments.port)
    except OSError as error:
        reason = error.strerror or error
        print(
            f"envedit: port {arguments.port} on {HOST}: cannot be used ({reason}): another `envedit paint` "
            "may run there; end it, or give another with --port",
            file=sys.stderr,
        )
        return 2
    except OverflowError:
        print(f"envedit: --port: got {arguments.port}, expected 0 to 65535", file=sys.stderr)
        return 2
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
    parser = argparse.ArgumentParser(
        prog="envedit paint",
        description="Paint on the rendering in the browser; the environment map follows while you paint.",
        epilog="examples:\n  envedit paint\n  envedit paint sphere --envmap sky.hdr\n"
        "  envedit paint edit.toml\n  envedit paint edit_out/painted.toml\n\n"
        "Results and painted.toml, which `envedit run` carries out as well, go to the folder of the results\n"
        "that `envedit run` would write to. Needs the extra paint: pip install '.[paint]' in a checkout.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
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


if __name__ == "__main__":
    sys.exit(main())
