from __future__ import annotations

from deploy.can_vm.config import CONSOLE_LINES
from deploy.can_vm.machine import last_words


def test_a_silent_console_is_called_so() -> None:
    assert last_words(" \r\n\n") == "its console said nothing"


def test_only_the_last_lines_are_quoted() -> None:
    text = last_words("".join(f"line {number}\r\n" for number in range(50)))
    assert text.splitlines()[1:] == [f"  line {number}" for number in range(50 - CONSOLE_LINES, 50)]


def test_the_line_that_names_a_panic_is_quoted_though_a_trace_follows() -> None:
    text = last_words("early\n[1.0] Kernel panic - not syncing: crash\n" + "trace\n" * 50)
    assert text.splitlines()[1] == "  [1.0] Kernel panic - not syncing: crash"
    assert len(text.splitlines()) == CONSOLE_LINES + 2
    assert last_words("Kernel panic: short\n").count("panic") == 1
