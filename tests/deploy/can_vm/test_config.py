from __future__ import annotations

from pathlib import Path

from deploy.can_vm.config import PAIRS, MachineConfig, Port, qemu_command

PORTS = {Port.STDOUT: 5, Port.STDERR: 6, Port.CONTROL: 7}


def command(config: MachineConfig | None = None) -> list[str]:
    return qemu_command(config or MachineConfig(), Path("/k/vmlinuz"), Path("/t/initramfs"), PORTS)


def values(option: str) -> list[str]:
    words = command()
    return [words[index + 1] for index, word in enumerate(words) if word == option]


def test_each_pair_of_controllers_shares_one_bus() -> None:
    buses = [value.split("id=")[1] for value in values("-object") if value.startswith("can-bus")]
    cards = [value.split("canbus=")[1] for value in values("-device") if value.startswith("kvaser_pci")]
    assert len(buses) == len(set(buses)) == len(PAIRS)
    assert cards == [bus for bus, pair in zip(buses, PAIRS, strict=True) for _ in pair]


def test_every_port_has_its_socket_and_name() -> None:
    sockets = [value for value in values("-chardev") if value.startswith("socket")]
    assert sockets == ["socket,id=stdout,fd=5", "socket,id=stderr,fd=6", "socket,id=control,fd=7"]
    serial = [value for value in values("-device") if value.startswith("virtserialport")]
    assert [value.rsplit("name=")[1] for value in serial] == list(Port)


def test_size_and_accelerator_are_those_of_the_configuration() -> None:
    words = " ".join(command(MachineConfig(cpus=3, memory_mb=1024, accelerator="kvm")))
    assert "-smp 3 -m 1024" in words
    assert "-accel kvm " in words


def test_a_panic_ends_qemu_instead_of_booting_again() -> None:
    assert "-no-reboot" in command()
    assert "panic=-1" in values("-append")[0]


def test_the_machine_has_no_network() -> None:
    assert "-nodefaults" in command()
    assert not {"-nic", "-netdev", "-net"} & set(command())
