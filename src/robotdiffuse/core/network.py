"""Addresses on which servers listen."""

import socket
from ipaddress import ip_address
from urllib.parse import urlsplit

from robotdiffuse.core.errors import InputError

BACKLOG = 128
"""Number of connections that may wait to be accepted."""


def is_loopback(host: str) -> bool:
    """Whether a host name or address is a loopback address, which only this machine can reach."""
    try:
        return host == "localhost" or ip_address(host).is_loopback
    except ValueError:
        return False


def url_part(url: str, name: str) -> str:
    """A part of a URL, such as "netloc"; an empty string for an invalid URL."""
    try:
        return getattr(urlsplit(url), name) or ""
    except ValueError:
        return ""


def named_host(header: str) -> str:
    """The host in a Host header, without the port."""
    return url_part(f"//{header}", "hostname")


def listening(host: str, port: int) -> socket.socket:
    """A socket that listens on a port of an address; for port 0, on any free port. Raises InputError if that
    is not possible."""
    listener = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
        listener.listen(BACKLOG)
    except (OSError, UnicodeError, OverflowError) as error:
        listener.close()
        why = getattr(error, "strerror", None) or str(error)
        raise InputError(
            f"cannot listen on {host}, port {port}: {why}; choose others with --host and --port"
        ) from None
    return listener
