from __future__ import annotations

import json
import threading
import time
from pathlib import Path

import can
import pytest

from deploy.bus_frames import BusFrame
from deploy.bus_monitor import Monitor, Only, channel_options, choose_buses, live_channels, live_frames
from deploy.errors import UsageError
from hal.bus.hub import serve_in_thread
from hal.profile.frames import pack
from schemas.load import load_robot

ARM9 = load_robot("arm9").description
BUSES = ("arm9-0", "arm9-1", "arm9-2")
SYNC = BusFrame(5_000_000, "arm9-0", pack(0x080, b""), sent=True)
REPORT = BusFrame(5_051_000, "arm9-1", pack(0x186, bytes.fromhex("3712000000000000")), sent=False)
HEARTBEAT = BusFrame(6_000_000, "arm9-2", pack(0x709, b"\x05"), sent=False)
FRAMES = (SYNC, REPORT, HEARTBEAT)


def only(*words: str) -> Only:
    return Only.of(ARM9, BUSES, words)


def test_a_line_has_time_bus_identifier_who_what_and_content() -> None:
    assert list(Monitor(ARM9, BUSES, origin_ns=0).lines(FRAMES)) == [
        "  0.005000 arm9-0 080 all            SYNC",
        "  0.005051 arm9-1 186 elbow_pitch    TPDO1        operation enabled, +0.000000 rad, +0.00 N·m",
        "  0.006000 arm9-2 709 wrist_roll     heartbeat    operational",
    ]


def test_times_count_from_the_first_frame_and_one_bus_needs_no_name() -> None:
    assert list(Monitor(ARM9, ("arm9-1",)).lines([REPORT, REPORT], 1)) == [
        "  0.000000 186 elbow_pitch   TPDO1        operation enabled, +0.000000 rad, +0.00 N·m"
    ]


def test_json_has_si_values_and_raw_data() -> None:
    (line,) = Monitor(ARM9, BUSES, only("elbow_pitch"), as_json=True).lines(FRAMES)
    assert json.loads(line) == {
        "time_s": 0.005051, "bus": "arm9-1", "id": 0x186, "data": "3712000000000000", "who": "elbow_pitch",
        "what": "TPDO1", "content": "operation enabled, +0.000000 rad, +0.00 N·m",
        "values": {
            "state": "operation enabled", "position_rad": 0.0, "torque_nm": 0.0, "flags": "remote follows_command",
        },
    }  # fmt: skip


@pytest.mark.parametrize(
    ("words", "found"),
    [
        ((), [0, 1, 2]),
        (("elbow_pitch",), [1]),
        (("Heartbeat", "0x080"), [0, 2]),
        (("tpdo1", "709"), [1, 2]),
        (("EMCY",), []),
        (("SDO",), []),
        (("hal",), []),
    ],
)
def test_only_chooses_by_joint_kind_and_identifier(words: tuple[str, ...], found: list[int]) -> None:
    lines = list(Monitor(ARM9, BUSES).lines(FRAMES))
    assert list(Monitor(ARM9, BUSES, only(*words), origin_ns=SYNC.time_ns).lines(FRAMES)) == [lines[i] for i in found]


def test_a_word_that_no_frame_has_is_refused() -> None:
    with pytest.raises(
        UsageError, match=r"--only elbow: no joint, sensor, kind of frame or .* there are all, controller"
    ):
        only("elbow")


class TestOptions:
    def test_buses_stand_in_the_robots_order(self) -> None:
        assert choose_buses(ARM9, None) == BUSES
        assert choose_buses(ARM9, "arm9-2, arm9-0") == ("arm9-0", "arm9-2")

    def test_an_unknown_bus_is_told_with_those_there_are(self) -> None:
        with pytest.raises(UsageError, match="--bus can0: robot arm9 has arm9-0, arm9-1, arm9-2"):
            choose_buses(ARM9, "can0")

    def test_channels(self) -> None:
        assert channel_options(ARM9, BUSES, ["arm9-1=vcan1", "arm9-0=pcan:USB1"]) == {
            "arm9-1": "vcan1", "arm9-0": "pcan:USB1",
        }  # fmt: skip
        assert channel_options(ARM9, ("arm9-1",), ["can0"]) == {"arm9-1": "can0"}

    @pytest.mark.parametrize(
        ("given", "message"),
        [
            (["can0"], "of which bus"),
            (["nosuch=can0"], "robot arm9 has"),
            (["arm9-0=can0", "arm9-0=can1"], "given twice"),
            (["arm9-0="], "no channel"),
        ],
    )
    def test_channels_that_make_no_sense(self, given: list[str], message: str) -> None:
        with pytest.raises(UsageError, match=message):
            channel_options(ARM9, BUSES, given)

    def test_bare_names_lie_in_the_runs_directory_which_nothing_else_needs(self) -> None:
        def never() -> str:
            raise AssertionError

        given = {"arm9-0": ("socketcan", "can0"), "arm9-1": ("cosim", "/there/bus")}
        assert live_channels(ARM9, ("arm9-0", "arm9-1"), given, never) == given
        assert live_channels(ARM9, ("arm9-2",), {}, lambda: "/run") == {"arm9-2": ("cosim", "/run/arm9-2")}


class TestLive:
    def test_frames_of_several_buses_until_all_have_gone(self, tmp_path: Path) -> None:
        channels = {bus: ("cosim", str(tmp_path / bus)) for bus in BUSES[:2]}
        told: list[str] = []
        found: list[BusFrame] = []
        with serve_in_thread(*(path for _, path in channels.values())) as hubs:
            reader = threading.Thread(target=lambda: found.extend(live_frames(ARM9, channels, told.append)))
            reader.start()
            deadline = time.monotonic() + 5.0
            while any(hub.clients < 1 for hub in hubs) and time.monotonic() < deadline:
                time.sleep(0.005)
            for bus, number in (("arm9-0", 0x080), ("arm9-1", 0x184)):
                with can.Bus(interface="cosim", channel=channels[bus][1]) as port:
                    port.send(can.Message(arbitration_id=number, is_extended_id=False, data=b""))
            while len(found) < 2 and time.monotonic() < deadline:
                time.sleep(0.005)
        reader.join(5.0)
        assert not reader.is_alive()
        assert sorted((each.bus, each.can_id, each.sent) for each in found) == [
            ("arm9-0", 0x080, True), ("arm9-1", 0x184, False),
        ]  # fmt: skip
        assert sorted(line.split(":")[0] for line in told) == ["bus arm9-0", "bus arm9-1"]

    def test_leaving_early_leaves_no_thread(self, tmp_path: Path) -> None:
        path = str(tmp_path / "bus")
        before = threading.active_count()
        with serve_in_thread(path) as hubs:
            frames = live_frames(ARM9, {"arm9-0": ("cosim", path)}, print)

            def send() -> None:
                while not hubs[0].clients:
                    time.sleep(0.005)
                with can.Bus(interface="cosim", channel=path) as port:
                    port.send(can.Message(arbitration_id=0x181, is_extended_id=False, data=b"\x01"))

            sender = threading.Thread(target=send)
            sender.start()
            assert next(frames).data == b"\x01"
            frames.close()  # type: ignore[attr-defined]  # a generator
            sender.join()
        assert threading.active_count() == before

    def test_a_bus_that_nobody_hosts_is_told(self, tmp_path: Path) -> None:
        with pytest.raises(UsageError, match="bus arm9-0, cosim:"):
            next(live_frames(ARM9, {"arm9-0": ("cosim", str(tmp_path / "none"))}, print))
