"""Where virtual buses live: socket paths, hosting one and connecting to one."""

from __future__ import annotations

import errno
import os
import socket
import tempfile
import time
from pathlib import Path
from stat import S_ISSOCK

from hal.bus.errors import BusError, BusInUseError, BusUnavailableError

PATH_LIMIT = 107
"""Bytes of `sun_path` in `struct sockaddr_un`, without the terminating zero."""
MAX_PACKET = 512 * 16
"""Bytes of the longest packet; longer sequences of frames are sent as several."""
BUFFER_BYTES = 1 << 20
"""Asked of the kernel for each direction of a connection; it may grant less."""
RETRY_S = 0.01

ECHO_OPTION = b"\x01"
"""A client that sends this single byte gets its own frames back, in their place in the bus order."""


def run_directory() -> Path:
    """Directory of the virtual buses: `$COSIM_RUN_DIR`, or `hrp-cosim-<uid>` below the system's temporary directory.

    Created with mode 0700 when absent.

    Raises:
        BusUnavailableError: it cannot be created, or belongs to another user.

    """
    given = os.environ.get("COSIM_RUN_DIR")
    path = Path(given) if given else Path(tempfile.gettempdir()) / f"hrp-cosim-{os.getuid()}"
    try:
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
        owner = path.stat().st_uid
    except OSError as error:
        raise BusUnavailableError(f"run directory {path}: {error.strerror}; set COSIM_RUN_DIR to another") from error
    if owner != os.getuid():
        raise BusUnavailableError(f"run directory {path} belongs to user {owner}; set COSIM_RUN_DIR to another")
    return path


def socket_path(channel: str | os.PathLike[str]) -> Path:
    """Path of a channel's socket: a bare name lies in the run directory, a path (with a slash) is taken as it is.

    Raises:
        BusUnavailableError: the path is longer than a socket's can be.

    """
    name = os.fspath(channel)
    path = Path(name).absolute() if os.sep in name else run_directory() / name
    if len(os.fsencode(path)) > PATH_LIMIT:
        raise BusUnavailableError(f"bus path {path} is longer than {PATH_LIMIT} bytes; choose a shorter one")
    return path


def new_socket() -> socket.socket:
    """Make a socket of the virtual bus's kind, not yet bound or connected."""
    return socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)


def enlarge_buffers(connection: socket.socket) -> None:
    """Ask for room for bursts in both directions."""
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFER_BYTES)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)


def connect(channel: str | os.PathLike[str], timeout_s: float) -> socket.socket:
    """Connect to a virtual bus, waiting up to `timeout_s` [s] for somebody to serve it; the socket does not block.

    Raises:
        BusUnavailableError: nobody serves it in that time.

    """
    path = socket_path(channel)
    deadline = time.monotonic() + timeout_s
    while True:
        client = new_socket()
        # A blocking connect to a listener that never accepts would outlast the timeout.
        client.setblocking(False)
        try:
            client.connect(os.fspath(path))
        except OSError as error:
            client.close()
            if time.monotonic() >= deadline:
                reason = error.strerror or str(error)
                raise BusUnavailableError(
                    f"virtual bus {path}: {reason} after {timeout_s:g} s; start its server (the plant, or"
                    f" `python -m hal.bus {path}`)"
                ) from error
            time.sleep(RETRY_S)
            continue
        enlarge_buffers(client)
        return client


def listen(address: Path) -> socket.socket:
    """Host a virtual bus: bind its path for this user alone, replacing the file a killed host left; does not block.

    Raises:
        BusInUseError: another process serves it.
        BusUnavailableError: the path cannot be bound, or is a file of another kind.

    """
    path = os.fspath(address)
    listener = new_socket()
    try:
        _remove_stale(path)
        listener.bind(path)
        os.chmod(path, 0o600)
        listener.listen(64)
    except OSError as error:
        listener.close()
        if error.errno == errno.EADDRINUSE:
            raise BusInUseError(f"virtual bus {path} is served by another process") from error
        raise BusUnavailableError(f"virtual bus {path} cannot be hosted: {error.strerror}") from error
    except BusError:
        listener.close()
        raise
    listener.setblocking(False)
    return listener


def _remove_stale(path: str) -> None:
    """Remove the socket file a killed host left; refuse to touch a live host's or any other file."""
    probe = new_socket()
    probe.setblocking(False)
    try:
        probe.connect(path)
    except FileNotFoundError:
        return
    except ConnectionRefusedError:
        if not _is_socket(path):
            raise BusUnavailableError(f"virtual bus {path}: a file that is no socket is in the way") from None
        os.unlink(path)
        return
    except BlockingIOError:
        pass
    finally:
        probe.close()
    raise BusInUseError(f"virtual bus {path} is served by another process; stop it or choose another channel")


def _is_socket(path: str) -> bool:
    return S_ISSOCK(os.stat(path).st_mode)
