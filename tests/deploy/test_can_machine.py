from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from deploy.can_vm import PAIRS, VCAN, Completed, MachineBootError, MachineTimeoutError, run_in_machine

pytestmark = [pytest.mark.can_machine, pytest.mark.timeout(900)]
CODE = 7
GUEST = f"""
import can, json, os, subprocess, sys, time

def output(*command):
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=True).stdout

def cross(source, target, count):
    with can.Bus(source, interface="socketcan") as near, can.Bus(target, interface="socketcan") as far:
        sent = [can.Message(arbitration_id=0x100 + i, data=bytes([i] * 8), is_extended_id=False) for i in range(count)]
        for message in sent:
            near.send(message, timeout=1.0)
        got = [far.recv(5.0) for _ in sent]
    return [[m.arbitration_id, m.data.hex()] for m in got if m] == [[m.arbitration_id, m.data.hex()] for m in sent]

def dumped():
    with subprocess.Popen(["candump", "-L", "-n", "1", "vcan1"], stdout=subprocess.PIPE, text=True) as candump:
        while candump.poll() is None:
            subprocess.run(["cansend", "vcan1", "181#0102030405060708"], check=True)
            time.sleep(0.2)
        return candump.stdout.read().split()[1:]

ways = [("vcan0", "vcan0"), *{PAIRS!r}, *((b, a) for a, b in {PAIRS!r})]
results = dict(
    links=json.loads(output("ip", "-details", "-json", "link")),
    crossed=[[a, b, cross(a, b, 16)] for a, b in ways],
    dumped=dumped(),
    release=os.uname().release,
    cwd=os.getcwd(),
    arguments=sys.argv[1:],
    python=sys.executable,
    modules=[__import__(name).__file__ for name in ("schemas", "hal", "deploy")],
    variables={{name: os.environ.get(name) for name in ("TOLD", "OMP_NUM_THREADS", "VIRTUAL_ENV")}},
    stdin=sys.stdin.read(),
)
with open("written", "w") as file:
    file.write("x" * 100_000)
print(json.dumps(results))
print("to the error output", file=sys.stderr)
subprocess.Popen(["sleep", "1000"])
sys.exit({CODE})
"""

Machine = Callable[..., Completed]


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("can machine")


@pytest.fixture(scope="module")
def completed(can_machine: None, place: Path) -> Completed:
    """One boot serves all that only looks."""
    return run_in_machine(
        ["python", "-c", GUEST, "a b", "$HOME 'c'"], directory=place, env={"TOLD": "a 'b' $c"}, timeout_s=400.0
    )


@pytest.fixture(scope="module")
def seen(completed: Completed) -> dict[str, Any]:
    assert completed.stdout, completed.stderr
    return dict(json.loads(completed.stdout))


def test_exit_code_and_both_outputs_come_through(completed: Completed) -> None:
    assert completed.code == CODE, completed.stderr
    assert completed.stderr == "to the error output\n"
    assert completed.stdout.endswith("}\n")


def test_all_interfaces_are_up(seen: dict[str, Any]) -> None:
    links = {link["ifname"]: link for link in seen["links"]}
    controllers = [name for pair in PAIRS for name in pair]
    assert {"lo", *VCAN, *controllers} == set(links)
    assert all("UP" in link["flags"] for link in links.values())
    for name in controllers:
        info = links[name]["linkinfo"]["info_data"]
        assert links[name]["operstate"] == "UP"
        assert info["bittiming"]["bitrate"] == 1_000_000
        assert info["restart_ms"] == 100
        assert info["state"] == "ERROR-ACTIVE"


def test_frames_cross_every_interface_both_ways(seen: dict[str, Any]) -> None:
    assert len(seen["crossed"]) == 1 + 2 * len(PAIRS)
    assert all(arrived for _, _, arrived in seen["crossed"]), seen["crossed"]


def test_candump_shows_what_cansend_sends(seen: dict[str, Any]) -> None:
    assert seen["dumped"] == ["vcan1", "181#0102030405060708"]


def test_the_command_sees_the_callers_place_and_files(seen: dict[str, Any], place: Path) -> None:
    root = Path(__file__).parents[2]
    assert seen["cwd"] == str(place)
    assert seen["arguments"] == ["a b", "$HOME 'c'"]
    assert [Path(name).parents[1] for name in seen["modules"]] == [root] * 3
    assert (place / "written").read_text() == "x" * 100_000


def test_the_command_runs_in_our_environment_on_another_kernel(seen: dict[str, Any]) -> None:
    assert seen["variables"]["TOLD"] == "a 'b' $c"
    assert seen["variables"]["OMP_NUM_THREADS"] == "1"
    assert Path(seen["python"]).parent == Path(seen["variables"]["VIRTUAL_ENV"], "bin")
    assert seen["release"] != os.uname().release
    assert seen["stdin"] == ""


def test_a_command_that_does_not_end_is_stopped_and_its_files_kept(can_machine: None, place: Path) -> None:
    script = "trap 'echo stopped >trapped; exit 0' TERM; echo begun; while true; do sleep 0.1; done"
    heard = bytearray()
    with pytest.raises(MachineTimeoutError, match="within 3 s"):
        run_in_machine(["sh", "-c", script], directory=place, timeout_s=3.0, stdout=heard.extend)
    assert bytes(heard) == b"begun\n"
    assert (place / "trapped").read_text() == "stopped\n"


def test_a_kernel_panic_is_told_with_the_consoles_last_lines(can_machine: None) -> None:
    with pytest.raises(MachineBootError, match="Kernel panic - not syncing: sysrq"):
        run_in_machine(["sh", "-c", "echo c >/proc/sysrq-trigger"], timeout_s=60.0)
