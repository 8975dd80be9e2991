"""Ports to listen on, and servers for them."""

import socket
from pathlib import Path

import uvicorn
from starlette.types import ASGIApp

from capture.errors import UserError

MOST_PORTS = 50  # that are tried, one after the other
GRACE_S = 3  # for requests under way when a server ends


def free_socket(host: str, port: int) -> socket.socket:
    """Return a socket that listens on this host and port, or to one of the next ports; port 0: any.

    Raises:
        UserError: none is free.
    """
    kind = socket.AF_INET6 if ":" in host else socket.AF_INET
    for candidate in range(port, port + MOST_PORTS):
        listener = socket.socket(kind, socket.SOCK_STREAM)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind((host, candidate))
            listener.listen()  # until then another program may bind it, too
            return listener
        except OSError:
            listener.close()
    raise UserError(f"none of the ports {port} to {port + MOST_PORTS - 1} of {host} is free. Give another --port.")


def http_server(app: ASGIApp, certificate: Path | None = None, key: Path | None = None) -> uvicorn.Server:
    """Return a server of an application; with a certificate it speaks https."""
    config = uvicorn.Config(
        app,
        log_level="critical",
        access_log=False,
        lifespan="off",
        ws="none",
        server_header=False,
        timeout_graceful_shutdown=GRACE_S,
        ssl_certfile=certificate,
        ssl_keyfile=key,
    )
    return uvicorn.Server(config)
