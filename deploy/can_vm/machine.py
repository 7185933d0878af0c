"""Run a command in the machine: boot, stream its output, hand on its exit code, switch off."""

from __future__ import annotations

import os
import selectors
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

from deploy.can_vm.config import CONSOLE_LINES, MachineConfig, Port, qemu_command
from deploy.can_vm.errors import MachineBootError, MachineTimeoutError
from deploy.can_vm.guest import boot_files, command_script, guest_environment, interface_commands
from deploy.can_vm.packages import default_cache, prepare

Sink = Callable[[bytes], object]
CHUNK = 65536
CONSOLE = "console"
PANIC = "Kernel panic"


@dataclass(frozen=True, slots=True)
class Completed:
    """A command that ended in the machine; `boot_s` and `run_s` are wall time before and during it."""

    code: int
    stdout: str
    stderr: str
    boot_s: float
    run_s: float


def run_in_machine(
    command: Sequence[str],
    *,
    timeout_s: float = 600.0,
    env: Mapping[str, str] | None = None,
    directory: Path | None = None,
    cache: Path | None = None,
    config: MachineConfig | None = None,
    stdout: Sink | None = None,
    stderr: Sink | None = None,
) -> Completed:
    """Boot the machine, run a command in the host's file tree and switch the machine off.

    `timeout_s` counts from the command's start. Output goes to the sinks as it comes, and into the result.

    Raises:
        MachineUnavailableError: a package is missing and cannot be installed.
        MachineBootError: the guest does not come up, or breaks down.
        MachineTimeoutError: the command was stopped after `timeout_s`.

    """
    config = config or MachineConfig()
    parts = prepare(cache or default_cache())
    environment = guest_environment(os.environ, Path(sys.prefix), env or {})
    script = command_script(command, directory or Path.cwd(), environment)
    image = boot_files(parts.busybox.read_bytes(), parts.modules, parts.order, interface_commands(config), script)
    with tempfile.TemporaryDirectory(prefix="can-vm-") as folder:
        initramfs = Path(folder, "initramfs")
        initramfs.write_bytes(image)
        with _powered(config, parts.kernel, initramfs) as session:
            session.sinks = {Port.STDOUT: stdout, Port.STDERR: stderr}
            return session.run(timeout_s)


@contextmanager
def _powered(config: MachineConfig, kernel: Path, initramfs: Path) -> Iterator[_Session]:
    """QEMU and our ends of its ports; whatever happens, QEMU is gone at the end."""
    pairs = {port: socket.socketpair() for port in Port}
    theirs = {port: pair[1].fileno() for port, pair in pairs.items()}
    try:
        process = subprocess.Popen(
            qemu_command(config, kernel, initramfs, theirs),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            pass_fds=tuple(theirs.values()),
            process_group=0,
        )
    except OSError as error:
        raise MachineBootError(f"cannot start QEMU: {error}") from error
    finally:
        for _, other in pairs.values():
            other.close()
    try:
        yield _Session(config, process, {port: pair[0] for port, pair in pairs.items()})
    finally:
        process.kill()
        process.wait()
        for ours, _ in pairs.values():
            ours.close()


@dataclass(slots=True)
class _Session:
    """One life of the machine."""

    config: MachineConfig
    process: subprocess.Popen[bytes]
    ports: dict[Port, socket.socket]
    sinks: dict[Port, Sink | None] = field(default_factory=dict)
    texts: dict[str, bytearray] = field(default_factory=lambda: {name: bytearray() for name in (*Port, CONSOLE)})

    def run(self, timeout_s: float) -> Completed:
        with selectors.DefaultSelector() as selector:
            for port, end in self.ports.items():
                selector.register(end, selectors.EVENT_READ, port)
            assert self.process.stdout is not None
            selector.register(self.process.stdout, selectors.EVENT_READ, CONSOLE)
            return self._follow(selector, timeout_s)

    def _follow(self, selector: selectors.BaseSelector, timeout_s: float) -> Completed:
        start = time.monotonic()
        if not self._pump(selector, self._is_ready, self.config.boot_timeout_s):
            raise MachineBootError(
                f"the CAN machine did not boot in {self.config.boot_timeout_s:g} s; {self._console()}"
            )
        booted = time.monotonic()
        try:
            in_time = self._pump(selector, lambda: self._code() is not None, timeout_s)
        except KeyboardInterrupt:
            self._stop(selector)
            raise
        ended = time.monotonic()
        if not in_time:
            self._stop(selector)
            raise MachineTimeoutError(f"the command did not end within {timeout_s:g} s in the CAN machine; stopped")
        code = self._code()
        self._pump(selector, lambda: False, self.config.off_timeout_s)
        assert code is not None
        out, err = (self.texts[port].decode(errors="replace") for port in (Port.STDOUT, Port.STDERR))
        return Completed(code, out, err, booted - start, ended - booted)

    def _pump(self, selector: selectors.BaseSelector, done: Callable[[], bool], timeout_s: float) -> bool:
        """Pass on what comes until `done`, the limit, or QEMU's end; False at the limit."""
        deadline = time.monotonic() + timeout_s
        while not done():
            left = deadline - time.monotonic()
            if left <= 0:
                return False
            for key, _ in selector.select(left):
                try:
                    data = os.read(key.fd, CHUNK)
                except ConnectionResetError:  # QEMU ended with something of ours unread
                    data = b""
                if not data:
                    selector.unregister(key.fileobj)
                    continue
                self.texts[key.data] += data
                if (sink := self.sinks.get(key.data)) is not None:
                    sink(data)
            if not selector.get_map():
                if self._code() is None:
                    raise MachineBootError(f"the CAN machine broke down; {self._console()}")
                return True
        return True

    def _stop(self, selector: selectors.BaseSelector) -> None:
        """End the command by SIGTERM and let the guest write its files back."""
        with suppress(BrokenPipeError):  # then it is off already
            self.ports[Port.CONTROL].send(b"stop\n")
        self._pump(selector, lambda: self._code() is not None, self.config.off_timeout_s)

    def _is_ready(self) -> bool:
        return self.texts[Port.CONTROL].startswith(b"ready\n")

    def _code(self) -> int | None:
        for line in bytes(self.texts[Port.CONTROL]).split(b"\n")[:-1]:
            word, _, number = line.partition(b" ")
            if word == b"exit":
                return int(number)
        return None

    def _console(self) -> str:
        return last_words(self.texts[CONSOLE].decode(errors="replace"))


def last_words(console: str) -> str:
    """Quote the end of the guest's console for an error message, and the line that names a panic wherever it is."""
    lines = [line.rstrip() for line in console.splitlines() if line.strip()]
    shown = lines[-CONSOLE_LINES:]
    shown = [line for line in lines[:-CONSOLE_LINES] if PANIC in line][:1] + shown
    return "\n  ".join(["its console said last:", *shown]) if shown else "its console said nothing"
