"""A CANopen drive of another maker: CiA 301 and CiA 402 by hand, nothing of the project's."""

from __future__ import annotations

import struct

from tests.hal.foreign_objects import COMMAND, Abort, Dictionary, Habits

BOOT_UP, STOPPED, OPERATIONAL, PRE_OPERATIONAL = 0x00, 0x04, 0x05, 0x7F
SWITCH_ON_DISABLED, READY, SWITCHED_ON, ENABLED, QUICK_STOP, FAULT = 0x40, 0x21, 0x23, 0x27, 0x07, 0x08
REMOTE = 0x0200
COUNTS_PER_SYNC = 2000
"""Largest step of the position loop."""
COUNTS_PER_MILLE = 2
"""Step at a SYNC for 1 ‰ of torque."""

Frame = tuple[int, bytes]


class ForeignSlave:
    """One drive. Frames and the time [s] go in; frames come out, in order."""

    def __init__(self, node: int, habits: Habits | None = None, now: float = 0.0) -> None:
        self.node = node
        self.habits = habits = habits or Habits()
        self.objects = Dictionary(node, habits)
        self.nmt = BOOT_UP
        self.power = FAULT if habits.faults else habits.power
        self.commands: list[int] = []
        """Controlwords that differed from the one before."""
        self.enabled_once = False
        self._resets_left = habits.faults
        self._master_lost = False
        self._stale_reads = 0
        self._told = self.power
        self._controlword = 0
        self._ready_at: float | None = now + habits.reset_s
        self._beat_at = self._master_until = float("inf")
        self._received: dict[int, bytes] = {}
        self._outbox: list[tuple[float, Frame]] = []
        self._now = now

    def receive(self, can_id: int, data: bytes, now: float) -> list[Frame]:
        """Hear one frame."""
        self._now = now
        if can_id == 0x000 and len(data) == 2 and data[1] in (0, self.node):
            self._command(data[0])
        elif self._ready_at is not None:
            pass  # it is on its way to reset, and deaf
        elif can_id == 0x600 + self.node and self.nmt != STOPPED and self.habits.answers:
            self._say(0x580 + self.node, self._serve(data), self.habits.answer_s)
        elif can_id == 0x080 and self.nmt == OPERATIONAL:
            self._sync()
        elif can_id - 0x700 == self.objects[0x1016, 1] >> 16 & 0x7F:
            self._master_until = now + (self.objects[0x1016, 1] & 0xFFFF) * 1e-3
        elif self.nmt == OPERATIONAL:
            self._receive_pdo(can_id, data)
        return self.tick(now)

    def tick(self, now: float) -> list[Frame]:
        """Let time pass."""
        self._now = now
        if self._ready_at is not None and now >= self._ready_at:
            self._ready_at = None
            self.nmt = OPERATIONAL if self.habits.starts_itself else PRE_OPERATIONAL
            if self.habits.boots:
                self._say(0x700 + self.node, bytes([BOOT_UP]))
        period = self.objects[0x1017, 0] * 1e-3
        if period and self._ready_at is None and self.habits.beats:
            self._beat_at = min(self._beat_at, now + period)
            if now >= self._beat_at:
                self._beat_at += period
                self._say(0x700 + self.node, bytes([self.nmt]))
        if now > self._master_until:
            self._master_until = float("inf")
            self._say(0x080 + self.node, struct.pack("<HB5x", 0x8130, 0x11))
            self.power, self._master_lost = FAULT, True
        due = [frame for at, frame in self._outbox if at <= now]
        self._outbox = [(at, frame) for at, frame in self._outbox if at > now]
        return due

    def reset(self, *, node: bool = True) -> None:
        """Restart, by command or because the supply failed for a moment."""
        self.objects.reset(0xFFFF if node else 0x1FFF)
        if node:
            self.power = SWITCH_ON_DISABLED
        self._ready_at = self._now + self.habits.reset_s
        self._beat_at = self._master_until = float("inf")
        self._received.clear()
        self._master_lost = False
        self.nmt = BOOT_UP

    def _say(self, can_id: int, data: bytes, delay: float = 0.0) -> None:
        self._outbox.append((self._now + delay, (can_id, data)))

    def _command(self, command: int) -> None:
        states = {0x01: OPERATIONAL, 0x02: STOPPED, 0x80: PRE_OPERATIONAL}
        if command in states and self._ready_at is None:
            self.nmt = states[command]
        elif command in (0x81, 0x82):
            self.reset(node=command == 0x81)

    # ---- SDO, CiA 301 section 7.2.4: expedited transfers

    def _serve(self, request: bytes) -> bytes:
        command, index, subindex = struct.unpack_from("<BHB", request)
        try:
            if command >> 5 == 2:
                if index == 0x6041:
                    self._report()
                data = self.objects.upload(index, subindex)
                answer = struct.pack("<BHB", 0x43 | (4 - len(data)) << 2, index, subindex) + data.ljust(4, b"\0")
            elif command >> 5 == 1 and command & 2:
                length = 4 - (command >> 2 & 3) if command & 1 else 4
                if self.objects.download(index, subindex, request[4 : 4 + length]) and index >= 0x6000:
                    self._act(by_pdo=False)
                answer = struct.pack("<BHBI", 0x60, index, subindex, 0)
            else:
                raise Abort(COMMAND)
        except Abort as abort:
            answer = struct.pack("<BHBI", 0x80, index, subindex, abort.code)
        return answer

    def _report(self) -> None:
        """Update the statusword, which may lag behind."""
        if self.power != self._told:
            self._stale_reads += 1
            if self._stale_reads > self.habits.lag:
                self._told, self._stale_reads = self.power, 0
        self.objects[0x6041, 0] = self._told | REMOTE

    # ---- PDO, CiA 301 section 7.2.2

    def _receive_pdo(self, can_id: int, data: bytes) -> None:
        for number in range(self.habits.pdo_records):
            pdo = self.objects.pdo(0x1400 + number)
            if pdo is None or pdo[0] != can_id:
                continue
            if pdo[1] <= 240:
                self._received[number] = data
            else:
                self._take(pdo[2], data)

    def _take(self, mapped: list[tuple[int, int]], data: bytes) -> None:
        for address in mapped:
            item = self.objects.items[address]
            item.value, data = int.from_bytes(data[: item.size], "little", signed=item.signed), data[item.size :]
        self._act(by_pdo=True)

    def _sync(self) -> None:
        if self.habits.samples_first:
            self._send_pdos()
        for number, data in self._received.items():
            pdo = self.objects.pdo(0x1400 + number)
            if pdo is not None:
                self._take(pdo[2], data)
        self._received.clear()
        if self.habits.obeys == "sync":
            self._step_power()
        if self.habits.mode_when == "sync":
            self.objects[0x6061, 0] = self.objects[0x6060, 0]
        self._move()
        if not self.habits.samples_first:
            self._send_pdos()

    def _send_pdos(self) -> None:
        self._told = self.power
        self._report()
        for number in range(self.habits.pdo_records):
            pdo = self.objects.pdo(0x1800 + number)
            if pdo is None or pdo[1] > 240 or (pdo[1] == 0 and not self.habits.tells_changes):
                continue
            self._say(pdo[0], b"".join(self.objects.upload(*address) for address in pdo[2]))

    # ---- the drive, CiA 402

    def _act(self, *, by_pdo: bool) -> None:
        if self.habits.obeys == "any" or (self.habits.obeys == "pdo" and by_pdo):
            self._step_power()
        mode = self.objects[0x6060, 0]
        if self.habits.mode_when == "at once" or (self.habits.mode_when == "enabled" and self.power == ENABLED):
            self.objects[0x6061, 0] = mode

    def _step_power(self) -> None:
        word, before = self.objects[0x6040, 0], self._controlword
        self._controlword = word
        if word != before:
            self.commands.append(word)
        if self.power == FAULT:
            if word & 0x80 and not before & 0x80 and not self._master_lost:
                self._resets_left -= 1
                if self._resets_left <= 0 <= self.habits.faults:
                    self.power, self.objects[0x603F, 0] = SWITCH_ON_DISABLED, 0
            return
        if not word & 0x02:
            self.power = SWITCH_ON_DISABLED
        elif not word & 0x04:
            self.power = QUICK_STOP if self.power == ENABLED else SWITCH_ON_DISABLED
        elif not word & 0x01:
            self.power = READY
        elif self.power in (READY, SWITCHED_ON, ENABLED):
            self.power = ENABLED if word & 0x08 and self.power != READY else SWITCHED_ON
        self.enabled_once |= self.power == ENABLED

    def _move(self) -> None:
        position, step, torque = self.objects[0x6064, 0], 0, 0
        if self.power == ENABLED and self.objects[0x6061, 0] == 8:
            step = max(-COUNTS_PER_SYNC, min(COUNTS_PER_SYNC, self.objects[0x607A, 0] - position))
        elif self.power == ENABLED and self.objects[0x6061, 0] == 10:
            torque = self.objects[0x6071, 0]
            step = COUNTS_PER_MILLE * torque
        self.objects[0x6064, 0] = position + step
        self.objects[0x6077, 0] = torque
