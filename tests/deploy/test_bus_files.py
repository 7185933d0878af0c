"""Files of other CAN tools: what python-can writes and reads, and what candump writes."""

from __future__ import annotations

import gzip
from dataclasses import replace
from pathlib import Path

import can
import pytest

from deploy.bus_files import FORMATS, ChannelMap, FrameFileError, read_frames, suffix_of, write_frames
from deploy.bus_frames import BusFrame, from_zero, in_time
from deploy.errors import UsageError
from hal.profile.frames import CAN_EFF_FLAG, CAN_ERR_FLAG, CAN_RTR_FLAG, pack
from schemas.load import load_robot
from tests.deploy.bus_logs import SCENARIOS, recorded

ARM9 = load_robot("arm9").description
ALL = ChannelMap(ARM9, {})
BUSES = tuple(bus.name for bus in ARM9.buses)
REMOTE = BusFrame(2_000, "arm9-0", (CAN_RTR_FLAG | 0x701).to_bytes(4, "little") + bytes((3, *bytes(11))), sent=False)
EXTENDED = BusFrame(1_000, "arm9-1", pack(CAN_EFF_FLAG | 0x18FF1234, b"\x01\x02"), sent=False)
ERROR = BusFrame(3_000, "arm9-2", pack(CAN_ERR_FLAG | 0x004, bytes.fromhex("0010000000000060")), sent=False)


@pytest.mark.parametrize("name", ["x.log", "x.asc", "x.blf", "x.trc", "x.log.gz", "x.asc.gz"])
@pytest.mark.parametrize("robot", SCENARIOS)
def test_all_frames_come_back_with_bus_time_and_sender(tmp_path: Path, robot: str, name: str) -> None:
    description = recorded(robot).run.robot.description
    channels = ChannelMap(description, {})
    frames = list(from_zero(in_time(description, recorded(robot).frames), description.period_ns))
    path = tmp_path / name
    assert write_frames(path, frames, channels, [bus.name for bus in description.buses]) == len(frames)
    back = list(read_frames(path, channels))
    assert [(each.bus, each.frame, each.sent) for each in back] == [(e.bus, e.frame, e.sent) for e in frames]
    lead_ns = frames[0].time_ns - back[0].time_ns
    if not name.startswith(("x.asc", "x.trc")):  # these begin with the first frame
        assert lead_ns == 0
    assert all(abs(one.time_ns - other.time_ns + lead_ns) <= 500 for one, other in zip(back, frames, strict=True))


@pytest.mark.parametrize("name", ["x.csv", "x.csv.gz"])
def test_a_format_without_channels_holds_one_bus(tmp_path: Path, name: str) -> None:
    frames = [each for each in in_time(ARM9, recorded("arm9").frames) if each.bus == "arm9-1"]
    one = ChannelMap(ARM9, {}, "arm9-1")
    write_frames(tmp_path / name, from_zero(frames, ARM9.period_ns), one, ["arm9-1"])
    assert [each.frame for each in read_frames(tmp_path / name, one)] == [each.frame for each in frames]
    with pytest.raises(UsageError, match="does not tell the frames' channel; say which bus"):
        next(read_frames(tmp_path / name, ALL))
    with pytest.raises(UsageError, match="holds no channels; choose one of arm9-0, arm9-1, arm9-2 by --bus"):
        write_frames(tmp_path / name, [], ALL, BUSES)


@pytest.mark.parametrize("name", ["x.log", "x.log.gz"])
def test_candumps_format_keeps_remote_29_bit_and_error_frames(tmp_path: Path, name: str) -> None:
    frames = [EXTENDED, REMOTE, ERROR]
    write_frames(tmp_path / name, frames, ALL, BUSES)
    assert list(read_frames(tmp_path / name, ALL)) == frames


def test_the_lines_are_candumps(tmp_path: Path) -> None:
    sync = BusFrame(1_234_567_000, "arm9-0", pack(0x080, b""), sent=True)
    report = BusFrame(1_234_618_000, "arm9-0", pack(0x181, bytes.fromhex("3712e803")), sent=False)
    write_frames(tmp_path / "x.log", [sync, report, replace(ERROR, time_ns=1_234_700_000)], ALL, BUSES)
    assert (tmp_path / "x.log").read_text().splitlines() == [
        "(1.234567) arm9-0 080# T",
        "(1.234618) arm9-0 181#3712E803 R",
        "(1.234700) arm9-2 20000004#0010000000000060",
    ]


def test_a_capture_of_candump_is_read(tmp_path: Path) -> None:
    path = tmp_path / "candump.log"
    path.write_text(
        "(1700000000.000001) can0 080#\n(1700000000.000052) can0 181#3712E8030000F6FF\n"
        "(1700000000.000100) can0 201#0F0008FFFFFFFF\n(1700000000.000200) can0 20000040#0000000000000000\n"
        "(1700000000.000300) can1 184#3712000000000000\n(1700000000.000400) can0 701#R\n"
    )
    channels = ChannelMap(ARM9, {"arm9-0": "can0"})
    found = list(read_frames(path, channels))
    assert [each.can_id for each in found] == [0x080, 0x181, 0x201, CAN_ERR_FLAG | 0x040, CAN_RTR_FLAG | 0x701]
    assert [each.sent for each in found] == [True, False, True, False, False]
    assert {each.bus for each in found} == {"arm9-0"}
    assert found[1].data == bytes.fromhex("3712e8030000f6ff")
    assert abs(found[1].time_ns - 1_700_000_000_000_052_000) < 1000


def test_channels_are_those_given_or_of_the_description() -> None:
    real = ARM9.model_copy(
        update={"buses": tuple(bus.model_copy(update={"channel": f"can{i}"}) for i, bus in enumerate(ARM9.buses))}
    )
    described = ChannelMap(real, {})
    assert [described.bus(each) for each in ("can1", "arm9-1", 2, "can7", 0, 4, None)] == [
        "arm9-1", "arm9-1", "arm9-1", None, None, None, None,
    ]  # fmt: skip
    given = ChannelMap(real, {"arm9-2": "vcan0", "arm9-1": "4"})
    assert [given.bus(each) for each in ("vcan0", 4, "can0", 1)] == ["arm9-2", "arm9-1", None, None]
    assert (given.channel("arm9-2"), given.channel("arm9-0")) == ("vcan0", "arm9-0")
    assert ChannelMap(real, {}, "arm9-0").bus(None) == "arm9-0"


def test_an_unknown_channel_is_told_with_the_way_out(tmp_path: Path) -> None:
    (tmp_path / "x.log").write_text("(0.0) slcan3 080#\n")
    with pytest.raises(UsageError, match=r"channel slcan3 is no bus of robot arm9 .*--channel arm9-0=slcan3"):
        list(read_frames(tmp_path / "x.log", ALL))


def test_names_that_interfaces_cannot_have_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="at most 15 characters; give --channel arm9-0=NAME"):
        write_frames(tmp_path / "x.log", [], ChannelMap(ARM9, {"arm9-0": "a-very-long-channel"}), ["arm9-0"])


@pytest.mark.parametrize("name", ["x.foo", "x", "x.blf.gz", "x.gz", "x.txt", "x.mf4"])
def test_unknown_formats_are_refused_with_those_that_work(name: str) -> None:
    with pytest.raises(UsageError, match=f"known are {', '.join(FORMATS)}"):
        suffix_of(Path(name))


def test_suffixes_may_be_in_capitals() -> None:
    assert suffix_of(Path("run.0.ASC")) == ".asc"


@pytest.mark.parametrize("frame", [REMOTE, ERROR])
def test_a_format_that_would_lose_a_frame_is_refused(tmp_path: Path, frame: BusFrame) -> None:
    with pytest.raises(FrameFileError, match=r"writes no (remote|error) frames to \.trc"):
        write_frames(tmp_path / "x.trc", [frame], ALL, BUSES)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("x.log", b"(1.0) can0 zzz#00\n"),
        ("x.log", b"nonsense\n"),
        ("x.log", b"\xff\xfe\x00"),
        ("x.log.gz", b"not compressed"),
        ("x.blf", b"LOGGnonsense"),
        ("x.blf", b""),
        ("x.trc", b"1) nonsense\n"),
        ("x.csv", b"timestamp\n1,2\n"),
    ],
)
def test_damaged_files_are_told(tmp_path: Path, name: str, content: bytes) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(FrameFileError, match=f"{name}: (not a readable|cannot be read)"):
        list(read_frames(path, ChannelMap(ARM9, {"arm9-0": "can0"}, "arm9-0")))


def test_can_fd_frames_are_not_of_a_robot(tmp_path: Path) -> None:
    with can.Logger(tmp_path / "x.blf") as writer:
        writer.on_message_received(can.Message(is_fd=True, arbitration_id=1, data=bytes(12), channel=0))
    with pytest.raises(FrameFileError, match="no CAN FD"):
        list(read_frames(tmp_path / "x.blf", ALL))


def test_no_such_file_and_no_such_directory(tmp_path: Path) -> None:
    with pytest.raises(FrameFileError, match="no such file"):
        list(read_frames(tmp_path / "x.log", ALL))
    (tmp_path / "file").touch()
    with pytest.raises(FrameFileError, match="cannot be written"):
        write_frames(tmp_path / "file" / "x.log", [], ALL, BUSES)


def test_what_was_there_is_replaced(tmp_path: Path) -> None:
    path = tmp_path / "x.log.gz"
    for _ in range(2):
        write_frames(path, [EXTENDED], ALL, BUSES)
    assert gzip.decompress(path.read_bytes()).count(b"\n") == 1


@pytest.mark.parametrize("suffix", [".asc", ".blf", ".trc"])
def test_numbers_of_channels_count_from_one_and_may_be_given(tmp_path: Path, suffix: str) -> None:
    path, given = tmp_path / f"x{suffix}", ChannelMap(ARM9, {"arm9-1": "4"})
    write_frames(path, [EXTENDED], given, ["arm9-1"])
    assert [each.bus for each in read_frames(path, given)] == ["arm9-1"]
    with pytest.raises(UsageError, match="channel 4 is no bus of robot arm9"):
        list(read_frames(path, ALL))
    write_frames(path, [EXTENDED], ALL, BUSES)
    assert list(read_frames(path, ChannelMap(ARM9, {"arm9-0": "1"}))) == []
    assert [each.bus for each in read_frames(path, ChannelMap(ARM9, {"arm9-0": "2"}))] == ["arm9-0"]
