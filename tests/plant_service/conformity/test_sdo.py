"""CiA 301 section 7.2.4: SDO protocols and abort codes (table 22), byte by byte."""

from __future__ import annotations

from pathlib import Path

import pytest

from hal.profile.objects import eds_path
from plant_service.device import DriveDevice

NAME = b"cosim CiA 402 drive"
UPLOADS = {
    "4 bytes": ("40 00 10 00 00 00 00 00", "43 00 10 00 92 01 02 00"),
    "2 bytes": ("40 41 60 00 00 00 00 00", "4b 41 60 00 50 02 00 00"),
    "1 byte": ("40 01 10 00 00 00 00 00", "4f 01 10 00 00 00 00 00"),
    "a record's sub 0": ("40 18 10 00 00 00 00 00", "4f 18 10 00 04 00 00 00"),
    "segmented": ("40 08 10 00 00 00 00 00", "41 08 10 00 13 00 00 00"),
    "a string of one": ("40 09 10 00 00 00 00 00", "4f 09 10 00 31 00 00 00"),
}
DOWNLOADS = {
    "4 bytes": ("23 7a 60 00 10 27 00 00", "60 7a 60 00 00 00 00 00"),
    "2 bytes": ("2b 17 10 00 64 00 00 00", "60 17 10 00 00 00 00 00"),
    "1 byte": ("2f 60 60 00 08 00 00 00", "60 60 60 00 00 00 00 00"),
    "size not indicated": ("22 17 10 00 64 00 00 00", "60 17 10 00 00 00 00 00"),
    "begin of segments": ("21 7a 60 00 04 00 00 00", "60 7a 60 00 00 00 00 00"),
    "begin of segments, size not indicated": ("20 7a 60 00 00 00 00 00", "60 7a 60 00 00 00 00 00"),
}
ABORTS = {
    "0602 0000 no object, upload": ("40 00 30 00 00 00 00 00", "80 00 30 00 00 00 02 06"),
    "0602 0000 no object, download": ("23 00 30 00 00 00 00 00", "80 00 30 00 00 00 02 06"),
    "0602 0000 a data type is no object": ("40 05 00 00 00 00 00 00", "80 05 00 00 00 00 02 06"),
    "0602 0000 store parameters": ("23 10 10 01 73 61 76 65", "80 10 10 01 00 00 02 06"),
    "0602 0000 restore parameters": ("23 11 10 01 6c 6f 61 64", "80 11 10 01 00 00 02 06"),
    "0609 0011 no sub-index of a record": ("40 18 10 05 00 00 00 00", "80 18 10 05 11 00 09 06"),
    "0609 0011 no sub-index of a variable": ("40 40 60 01 00 00 00 00", "80 40 60 01 11 00 09 06"),
    "0609 0011 no sub-index, download": ("2b 40 60 01 00 00 00 00", "80 40 60 01 11 00 09 06"),
    "0609 0011 sub 4 of an RPDO is reserved": ("40 00 14 04 00 00 00 00", "80 00 14 04 11 00 09 06"),
    "0609 0011 sub 4 of a TPDO is reserved": ("2f 00 18 04 00 00 00 00", "80 00 18 04 11 00 09 06"),
    "0601 0002 read-only": ("2b 41 60 00 00 00 00 00", "80 41 60 00 02 00 01 06"),
    "0601 0002 read-only, begin of segments": ("21 41 60 00 02 00 00 00", "80 41 60 00 02 00 01 06"),
    "0601 0002 constant sub 0": ("2f 18 10 00 04 00 00 00", "80 18 10 00 02 00 01 06"),
    "0601 0002 read-only goes before the length": ("23 41 60 00 00 00 00 00", "80 41 60 00 02 00 01 06"),
    "0607 0012 4 bytes into 2": ("23 17 10 00 64 00 00 00", "80 17 10 00 12 00 07 06"),
    "0607 0012 2 bytes into 1": ("2b 60 60 00 08 00 00 00", "80 60 60 00 12 00 07 06"),
    "0607 0012 5 bytes announced for 4": ("21 7a 60 00 05 00 00 00", "80 7a 60 00 12 00 07 06"),
    "0607 0013 1 byte into 2": ("2f 17 10 00 64 00 00 00", "80 17 10 00 13 00 07 06"),
    "0607 0013 3 bytes into 4": ("27 7a 60 00 01 00 00 00", "80 7a 60 00 13 00 07 06"),
    "0607 0013 3 bytes announced for 4": ("21 7a 60 00 03 00 00 00", "80 7a 60 00 13 00 07 06"),
    "0609 0030 value invalid": ("2f 60 60 00 09 00 00 00", "80 60 60 00 30 00 09 06"),
    "0609 0031 value too high": ("2f c2 60 02 40 00 00 00", "80 c2 60 02 31 00 09 06"),
    "0609 0032 value too low": ("23 8f 60 01 00 00 00 00", "80 8f 60 01 32 00 09 06"),
    "0800 0022 not in this state of the device": ("2f 00 1a 00 00 00 00 00", "80 00 1a 00 22 00 00 08"),
    "0800 0024 no data": ("40 03 10 01 00 00 00 00", "80 03 10 01 24 00 00 08"),
    "0504 0001 client command 7": ("e0 00 10 00 00 00 00 00", "80 00 10 00 01 00 04 05"),
    "0504 0001 upload segment without an upload": ("60 00 00 00 00 00 00 00", "80 00 00 00 01 00 04 05"),
    "0504 0001 download segment without a download": ("00 01 02 03 04 05 06 07", "80 00 00 00 01 00 04 05"),
    "0504 0001 block download": ("c6 7a 60 00 04 00 00 00", "80 7a 60 00 01 00 04 05"),
    "0504 0001 block upload": ("a4 08 10 00 7f 00 00 00", "80 08 10 00 01 00 04 05"),
    "0504 0001 block upload of more than the threshold": ("a4 08 10 00 7f 12 00 00", "80 08 10 00 01 00 04 05"),
    "0504 0001 start of a block upload": ("a3 00 00 00 00 00 00 00", "80 00 00 00 01 00 04 05"),
    "0602 0000 block upload of no object": ("a4 00 30 00 7f 00 00 00", "80 00 30 00 00 00 02 06"),
}


@pytest.mark.parametrize(("request_", "answer"), UPLOADS.values(), ids=list(UPLOADS))
def test_upload(wire, request_, answer):
    assert wire.sdo(request_) == answer


@pytest.mark.parametrize(("request_", "answer"), DOWNLOADS.values(), ids=list(DOWNLOADS))
def test_download(wire, request_, answer):
    assert wire.sdo(request_) == answer


@pytest.mark.parametrize(("request_", "answer"), ABORTS.values(), ids=list(ABORTS))
def test_abort(wire, request_, answer):
    assert wire.sdo(request_) == answer


def test_write_only(wire, tmp_path):
    """0601 0001. The drive has no such object: one is made write-only."""
    eds = tmp_path / "write_only.eds"
    text = Path(eds_path()).read_text(encoding="ascii")
    section = text.index("[2005]")
    eds.write_text(text[:section] + text[section:].replace("AccessType=rw", "AccessType=wo", 1), encoding="ascii")
    wire.bench.device = DriveDevice(5, wire.axis, eds=eds)
    wire.bench.device.tick(0)
    wire.set("2b 05 20 00 64 00 00 00")
    assert wire.sdo("40 05 20 00 00 00 00 00") == "80 05 20 00 01 00 01 06"


def test_refused_downloads_change_nothing(wire):
    before = wire.sdo("40 17 10 00 00 00 00 00")
    for request in ("23 17 10 00 64 00 00 00", "2f 17 10 00 64 00 00 00", "21 17 10 00 03 00 00 00"):
        assert wire.sdo(request).startswith("80 17 10 00")
    assert wire.sdo("40 17 10 00 00 00 00 00") == before


class TestSegmentedUpload:
    def test_three_segments_with_alternating_toggle(self, wire):
        assert wire.sdo("40 08 10 00 00 00 00 00") == "41 08 10 00 13 00 00 00"
        assert wire.sdo("60 00 00 00 00 00 00 00") == "00 63 6f 73 69 6d 20 43"
        assert wire.sdo("70 00 00 00 00 00 00 00") == "10 69 41 20 34 30 32 20"
        assert wire.sdo("60 00 00 00 00 00 00 00") == "05 64 72 69 76 65 00 00"  # 2 of 7 unused, last
        assert bytes.fromhex("636f73696d2043 69412034303220 6472697665") == NAME

    @pytest.mark.parametrize("wrong", ["70", "60"], ids=["first toggle is 0", "second toggle is 1"])
    def test_toggle_that_does_not_alternate(self, wire, wrong):
        wire.sdo("40 08 10 00 00 00 00 00")
        if wrong == "60":
            wire.sdo("60 00 00 00 00 00 00 00")
        assert wire.sdo(f"{wrong} 00 00 00 00 00 00 00") == "80 08 10 00 00 00 03 05"
        assert wire.sdo("60 00 00 00 00 00 00 00") == "80 00 00 00 01 00 04 05"

    def test_a_segment_too_many(self, wire):
        for request in ("40 08 10 00", "60 00 00 00", "70 00 00 00", "60 00 00 00"):
            wire.sdo(f"{request} 00 00 00 00")
        assert wire.sdo("70 00 00 00 00 00 00 00") == "80 00 00 00 01 00 04 05"

    def test_the_clients_abort_is_not_answered_and_ends_it(self, wire):
        wire.sdo("40 08 10 00 00 00 00 00")
        assert wire.sdo("80 08 10 00 00 00 04 05") == ""  # 0504 0000: the client waited too long
        assert wire.sdo("60 00 00 00 00 00 00 00") == "80 00 00 00 01 00 04 05"

    def test_a_new_request_ends_it(self, wire):
        wire.sdo("40 08 10 00 00 00 00 00")
        wire.sdo("40 00 10 00 00 00 00 00")
        assert wire.sdo("60 00 00 00 00 00 00 00") == "80 00 00 00 01 00 04 05"

    def test_the_server_waits_for_a_slow_client(self, wire):
        """The standard gives no time: the client's own timeout ends a transfer, by an abort."""
        wire.sdo("40 08 10 00 00 00 00 00")
        assert wire.wait(10_000) == []
        assert wire.sdo("60 00 00 00 00 00 00 00") == "00 63 6f 73 69 6d 20 43"


class TestSegmentedDownload:
    BEGIN = "21 7a 60 00 04 00 00 00"

    def target(self, wire) -> str:
        return wire.sdo("40 7a 60 00 00 00 00 00")

    def test_one_segment(self, wire):
        wire.sdo(self.BEGIN)
        assert wire.sdo("07 10 27 00 00 00 00 00") == "20 00 00 00 00 00 00 00"  # 3 of 7 unused, last
        assert self.target(wire) == "43 7a 60 00 10 27 00 00"

    def test_two_segments_with_alternating_toggle(self, wire):
        wire.sdo(self.BEGIN)
        assert wire.sdo("0a 10 27 00 00 00 00 00") == "20 00 00 00 00 00 00 00"  # 5 unused, more to come
        assert self.target_is_untouched(wire)
        wire.sdo(self.BEGIN)
        wire.sdo("0a 10 27 00 00 00 00 00")
        assert wire.sdo("1b 00 00 00 00 00 00 00") == "30 00 00 00 00 00 00 00"
        assert self.target(wire) == "43 7a 60 00 10 27 00 00"

    def target_is_untouched(self, wire) -> bool:
        return self.target(wire) == "43 7a 60 00 00 00 00 00"

    def test_size_not_announced(self, wire):
        wire.sdo("20 7a 60 00 00 00 00 00")
        assert wire.sdo("07 10 27 00 00 00 00 00") == "20 00 00 00 00 00 00 00"
        assert self.target(wire) == "43 7a 60 00 10 27 00 00"

    @pytest.mark.parametrize(("segment", "abort"), [("05", "12 00 07 06"), ("09", "13 00 07 06")])
    def test_size_not_announced_and_wrong(self, wire, segment, abort):
        wire.sdo("20 7a 60 00 00 00 00 00")
        assert wire.sdo(f"{segment} 10 27 00 00 00 00 00") == f"80 7a 60 00 {abort}"
        assert self.target_is_untouched(wire)

    @pytest.mark.parametrize(("segment", "abort"), [("00", "12 00 07 06"), ("0b", "13 00 07 06")], ids=["more", "less"])
    def test_other_than_announced(self, wire, segment, abort):
        """0607 0012 and 0607 0013 tell more than 0607 0010, length does not match, which the drive never uses."""
        wire.sdo(self.BEGIN)
        assert wire.sdo(f"{segment} 10 27 00 00 00 00 00") == f"80 7a 60 00 {abort}"
        assert self.target_is_untouched(wire)

    def test_toggle_that_does_not_alternate(self, wire):
        wire.sdo(self.BEGIN)
        assert wire.sdo("17 10 27 00 00 00 00 00") == "80 7a 60 00 00 00 03 05"
        assert self.target_is_untouched(wire)

    def test_segment_of_an_upload(self, wire):
        wire.sdo(self.BEGIN)
        assert wire.sdo("60 00 00 00 00 00 00 00") == "80 7a 60 00 01 00 04 05"

    def test_values_are_checked_at_the_end(self, wire):
        wire.sdo("21 60 60 00 01 00 00 00")
        assert wire.sdo("0d 09 00 00 00 00 00 00") == "80 60 60 00 30 00 09 06"


@pytest.mark.parametrize("length", range(8))
def test_requests_shorter_than_8_bytes_are_ignored(wire, length):
    assert wire.sdo("40 00 10 00 00 00 00 00"[: 3 * length]) == ""


def test_another_nodes_request_is_not_answered(wire):
    assert wire.send("606 40 00 10 00 00 00 00 00") == []
