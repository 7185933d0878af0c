from __future__ import annotations

import pytest

from hal.emergency import emergency_text


@pytest.mark.parametrize(
    ("code", "text"),
    [
        (0x8130, "HEARTBEAT_LOST"),
        (0x8611, "FOLLOWING_ERROR"),
        (0x3210, "voltage inside the device"),
        (0x8AFF, "monitoring"),
        (0x5530, "device hardware"),
        (0xFF07, "of the maker"),
        (0x0001, "error reset or no error"),
        (0xA000, "of no class of CiA 301"),
    ],
)
def test_codes_in_words(code: int, text: str) -> None:
    assert emergency_text(code) == text


def test_a_lost_sync_is_communication() -> None:
    assert "communication" in emergency_text(0x8100).lower()
