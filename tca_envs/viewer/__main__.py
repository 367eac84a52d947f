"""Command line of the viewer: python -m tca_envs.viewer."""

import argparse
import socket
import sys
import threading
import warnings

from tca_envs import registry


def main(arguments: list[str] | None = None) -> int:
    """Serve the page until interrupted; returns the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m tca_envs.viewer", description="Serve a web page with the arm live in 3-D, its heating and its tasks."
    )
    parser.add_argument(
        "--host", default="127.0.0.1", help="address to bind to; by default this machine alone can see the page (%(default)s)"
    )
    parser.add_argument("--port", type=int, default=8080, help="port to bind to, 0 for any free one (%(default)s)")
    parser.add_argument(
        "--task",
        default="reach",
        help="what to begin with; module:name is a task that importing the module registers (%(default)s)",
    )
    options = parser.parse_args(arguments)
    if not 0 <= options.port <= 65535:
        parser.error(f"--port {options.port}: expected a number from 0 to 65535")
    if not options.host:  # which would be every address
        parser.error("--host '': expected an address")
    try:
        # viser goes on to the next port where one is taken, and never comes back where the address is not this machine's.
        family = socket.AF_INET6 if ":" in options.host else socket.AF_INET
        socket.create_server((options.host, options.port), family=family).close()
    except OSError as error:
        parser.error(f"--host {options.host} --port {options.port}: expected this machine's address and a free port ({error})")
    try:
        from tca_envs.viewer.server import Viewer
    except ImportError as error:
        parser.error(str(error))
    try:
        registry.entry(options.task)
    except (ValueError, ImportError) as error:
        parser.error(f"--task {options.task}: {error}")
    # A visitor who leaves while the arm is drawn is no reason to worry anyone.
    warnings.filterwarnings("ignore", "Queued a .* on a closed connection", UserWarning)
    viewer = Viewer(options.host, options.port, options.task)
    try:
        threading.Event().wait()
    except KeyboardInterrupt:
        viewer.stop()
    return 0


if __name__ == "__main__":
    sys.exit(main())
