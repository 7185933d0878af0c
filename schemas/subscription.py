"""What arrives from Zenoh: one message after the other, the newest alone, or all that has piled up."""

from __future__ import annotations

import queue
import struct
import threading
from dataclasses import dataclass
from typing import Final

import zenoh
from zenoh.handlers import Handler

STAMP: Final = struct.Struct("<qq")
"""Attachment of a message: its sequence and time [ns], to be read without parsing it."""


@dataclass(frozen=True, slots=True)
class Sample:
    """A message as it arrived."""

    topic: str
    """Leaf of the key: `state`, `bus/can0`, …"""
    data: bytes
    sequence: int
    time_ns: int


class Subscription:
    """Messages of one key expression, oldest first; with `newest`, only the last that arrived."""

    def __init__(self, *, newest: bool) -> None:
        self._newest = newest
        self._queue: queue.SimpleQueue[zenoh.Sample | None] = queue.SimpleQueue()
        self._slot: zenoh.Sample | None = None
        self._fresh = threading.Lock()
        self._fresh.acquire()
        self.root_length = 0
        """Length of the key in front of the topic."""

    def receive(self, timeout_s: float) -> bytes | None:
        """Next message's bytes; None after the timeout, and at once when a peer is lost meanwhile."""
        sample = self._take(timeout_s)
        return None if sample is None else sample.payload.to_bytes()

    def receive_sample(self, timeout_s: float) -> Sample | None:
        """As `receive`, with topic, sequence and time, which are read without parsing the message."""
        sample = self._take(timeout_s)
        if sample is None:
            return None
        return _unwrap(sample, self.root_length)

    def deliver(self, sample: zenoh.Sample | None) -> None:
        """Take in a sample (network thread); None only wakes the reader."""
        if not self._newest:
            self._queue.put(sample)
            return
        if sample is not None:
            self._slot = sample
        try:
            self._fresh.release()
        except RuntimeError:
            return  # already released: the reader has not yet come, and will find the newer sample

    def _take(self, timeout_s: float) -> zenoh.Sample | None:
        if not self._newest:
            try:
                return self._queue.get(timeout=timeout_s)
            except queue.Empty:
                return None
        self._fresh.acquire(timeout=timeout_s)
        sample, self._slot = self._slot, None
        return sample


class Backlog:
    """Messages of one key expression kept outside Python until they are taken, for a reader that is in no hurry."""

    def __init__(self, subscriber: zenoh.Subscriber[Handler[zenoh.Sample]], root_length: int) -> None:
        self._subscriber = subscriber
        self._root_length = root_length

    def take(self) -> list[Sample]:
        """All that has arrived since the last call, oldest first; never waits."""
        samples = []
        while (sample := self._subscriber.try_recv()) is not None:
            samples.append(_unwrap(sample, self._root_length))
        return samples


def _unwrap(sample: zenoh.Sample, root_length: int) -> Sample:
    attachment = sample.attachment
    sequence, time_ns = STAMP.unpack(attachment.to_bytes()) if attachment is not None else (0, 0)
    return Sample(str(sample.key_expr)[root_length:], sample.payload.to_bytes(), sequence, time_ns)
