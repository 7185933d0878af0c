"""CiA 301 section 7.2.4: requests and answers written out by hand."""

from __future__ import annotations

import pytest


@pytest.mark.parametrize(
    ("request_", "answer"),
    [
        pytest.param("40 00 10 00 00 00 00 00", "43 00 10 00 92 01 02 00", id="device type 0x00020192, 4 bytes"),
        pytest.param("40 41 60 00 00 00 00 00", "4b 41 60 00 50 02 00 00", id="statusword, 2 bytes"),
        pytest.param("40 01 10 00 00 00 00 00", "4f 01 10 00 00 00 00 00", id="error register, 1 byte"),
        pytest.param("2b 17 10 00 64 00 00 00", "60 17 10 00 00 00 00 00", id="heartbeat 100 ms, 2 bytes"),
        pytest.param("22 17 10 00 64 00 00 00", "60 17 10 00 00 00 00 00", id="length not given: the object's"),
        pytest.param("a0 00 10 00 7f 04 00 00", "43 00 10 00 92 01 02 00", id="block upload, threshold of 4 bytes"),
        pytest.param("a0 00 10 00 7f 03 00 00", "80 00 10 00 01 00 04 05", id="block upload, threshold of 3 bytes"),
        pytest.param("a0 00 10 00 7f 00 00 00", "80 00 10 00 01 00 04 05", id="block upload, no threshold"),
        pytest.param("40 00 30 00 00 00 00 00", "80 00 30 00 00 00 02 06", id="no such object"),
        pytest.param("23 00 30 00 00 00 00 00", "80 00 30 00 00 00 02 06", id="no such object, download"),
        pytest.param("40 18 10 05 00 00 00 00", "80 18 10 05 11 00 09 06", id="no such sub-index"),
        pytest.param("40 40 60 01 00 00 00 00", "80 40 60 01 11 00 09 06", id="sub-index of a variable"),
        pytest.param("2b 41 60 00 00 00 00 00", "80 41 60 00 02 00 01 06", id="read-only"),
        pytest.param("2f 18 10 00 04 00 00 00", "80 18 10 00 02 00 01 06", id="constant"),
        pytest.param("23 17 10 00 64 00 00 00", "80 17 10 00 12 00 07 06", id="4 bytes into 2"),
        pytest.param("2f 17 10 00 64 00 00 00", "80 17 10 00 13 00 07 06", id="1 byte into 2"),
        pytest.param("21 17 10 00 03 00 00 00", "80 17 10 00 12 00 07 06", id="3 bytes announced for 2"),
        pytest.param("2f 60 60 00 09 00 00 00", "80 60 60 00 30 00 09 06", id="mode 9 is not supported"),
        pytest.param("e0 00 10 00 00 00 00 00", "80 00 10 00 01 00 04 05", id="command 7 does not exist"),
        pytest.param("c2 17 10 00 02 00 00 00", "80 17 10 00 01 00 04 05", id="block download"),
        pytest.param("60 00 00 00 00 00 00 00", "80 00 00 00 01 00 04 05", id="segment without a transfer"),
        pytest.param("2f 03 10 00 01 00 00 00", "80 03 10 00 30 00 09 06", id="history is cleared by 0 only"),
        pytest.param("40 03 10 01 00 00 00 00", "80 03 10 01 24 00 00 08", id="no error in the history"),
        pytest.param("80 17 10 00 00 00 00 08", "", id="an abort is not answered"),
        pytest.param("40 00 10 00 00 00 00", "", id="nor are 7 bytes"),
    ],
)
def test_request(bench, request_, answer):
    assert bench.sdo(request_) == answer


def test_segmented_upload_of_the_device_name(bench):
    # "cosim CiA 402 drive": 19 bytes = 7 + 7 + 5
    assert bench.sdo("40 08 10 00 00 00 00 00") == "41 08 10 00 13 00 00 00"
    assert bench.sdo("60 00 00 00 00 00 00 00") == "00 " + b"cosim C".hex(" ")
    assert bench.sdo("70 00 00 00 00 00 00 00") == "10 " + b"iA 402 ".hex(" ")
    assert bench.sdo("60 00 00 00 00 00 00 00") == "05 " + (b"drive" + b"\0\0").hex(" ")
    assert bench.sdo("70 00 00 00 00 00 00 00") == "80 00 00 00 01 00 04 05"


def test_repeated_toggle_aborts_the_upload(bench):
    bench.sdo("40 08 10 00 00 00 00 00")
    bench.sdo("60 00 00 00 00 00 00 00")
    assert bench.sdo("60 00 00 00 00 00 00 00") == "80 08 10 00 00 00 03 05"


def test_segmented_download_longer_than_announced(bench):
    assert bench.sdo("21 7a 60 00 04 00 00 00") == "60 7a 60 00 00 00 00 00"
    assert bench.sdo("00 10 27 00 00 00 00 00") == "80 7a 60 00 12 00 07 06"


def test_segmented_download_of_the_right_length(bench):
    bench.sdo("21 7a 60 00 04 00 00 00")
    assert bench.sdo("07 10 27 00 00 00 00 00") == "20 00 00 00 00 00 00 00"  # 3 of 7 unused, last
    assert bench.read(0x607A) == 10000


def test_segmented_download_that_ends_early(bench):
    bench.sdo("21 7a 60 00 04 00 00 00")
    assert bench.sdo("0b 10 27 00 00 00 00 00") == "80 7a 60 00 13 00 07 06"


def test_segment_of_the_other_direction(bench):
    bench.sdo("21 7a 60 00 04 00 00 00")
    assert bench.sdo("60 00 00 00 00 00 00 00") == "80 7a 60 00 01 00 04 05"


def test_stopped_node_does_not_answer(bench):
    bench.send(0x000, b"\x02\x05")
    assert bench.sdo("40 00 10 00 00 00 00 00") == ""
