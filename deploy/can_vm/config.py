"""What the machine is: interfaces, QEMU's command line."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

QEMU = "qemu-system-x86_64"
VCAN = tuple(f"vcan{index}" for index in range(4))
PAIRS = (("can0", "can1"), ("can2", "can3"), ("can4", "can5"))
"""The two interfaces of each emulated bus."""
HOST_TAG = "host"
CONSOLE_LINES = 12
"""Lines of the guest's console that an error message shows."""


class Port(StrEnum):
    """A virtio-serial port of the guest, `/dev/vport…` named as this."""

    STDOUT = "stdout"
    STDERR = "stderr"
    CONTROL = "control"


@dataclass(frozen=True, slots=True)
class MachineConfig:
    """Size and limits of the machine.

    Attributes:
        cpus: virtual processors; more than the host's cores only slows it down.
        memory_mb: upper bound; the host gives what the guest touches.
        boot_timeout_s: limit from power on until the command starts.
        off_timeout_s: limit from the command's end until QEMU has ended (the guest writes its files back).
        bitrate: of the emulated controllers in bit/s.
        restart_ms: time after which the driver takes a controller out of bus-off.
        accelerator: QEMU's `-accel`; emulation works everywhere, `kvm` where the host has it is many times faster.
        txqueuelen: frames an interface queues; Linux's default of 10 is less than one cycle's.

    """

    cpus: int = 2
    memory_mb: int = 4096
    boot_timeout_s: float = 180.0
    off_timeout_s: float = 30.0
    bitrate: int = 1_000_000
    restart_ms: int = 100
    accelerator: str = "tcg,thread=multi"
    txqueuelen: int = 1000


def qemu_command(config: MachineConfig, kernel: Path, initramfs: Path, ports: Mapping[Port, int]) -> list[str]:
    """Compose QEMU's command line; its standard output is the guest's console.

    `ports` gives for each port the number of an open socket that QEMU inherits.
    """
    command = [QEMU, "-nodefaults", "-no-user-config", "-no-reboot", "-display", "none"]
    command += ["-chardev", "file,id=console,path=/dev/stdout", "-serial", "chardev:console"]
    # Without LA57 the kernel walks page tables of four levels instead of five, which emulation is glad of.
    command += ["-machine", "pc", "-accel", config.accelerator, "-cpu", "max,la57=off"]
    command += ["-smp", str(config.cpus), "-m", str(config.memory_mb)]
    command += ["-kernel", str(kernel), "-initrd", str(initramfs)]
    command += ["-append", "console=ttyS0 quiet panic=-1 mitigations=off nokaslr tsc=reliable no_timer_check"]
    share = f"local,path=/,mount_tag={HOST_TAG},security_model=none,multidevs=remap"
    command += ["-virtfs", share, "-device", "virtio-rng-pci", "-device", "virtio-serial-pci"]
    for port, number in ports.items():
        command += ["-chardev", f"socket,id={port},fd={number}"]
        command += ["-device", f"virtserialport,chardev={port},name={port}"]
    for index, pair in enumerate(PAIRS):
        command += ["-object", f"can-bus,id=bus{index}"]
        for _ in pair:
            command += ["-device", f"kvaser_pci,canbus=bus{index}"]
    return command
