"""Fixed work that tells how fast a machine is just now, so that figures of different or noisy machines compare."""

from __future__ import annotations

import multiprocessing
import socket

import numpy as np

from benchmarks.measure import Timing, measure

LOOP = 10_000
PRODUCTS = 50
PING = b"x" * 144
"""As many bytes as the frames of nine drives."""


def yardsticks(n: int) -> list[Timing]:
    """Time the interpreter, small arrays, and a round trip between two processes."""
    return [
        measure(f"Python loop, {LOOP} additions", _add, n // 4),
        measure(f"numpy, {PRODUCTS} products of 9 × 9", _multiply, n // 4),
        ping_pong(n),
    ]


def ping_pong(n: int, warm_up: int = 50) -> Timing:
    """Round trip of 144 bytes to another process over a Unix socket."""
    here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    echo = multiprocessing.get_context("spawn").Process(target=_echo, args=(there, n + warm_up), daemon=True)
    echo.start()
    there.close()

    def call() -> None:
        here.send(PING)
        here.recv(len(PING))

    with here:
        timing = measure("Unix socket round trip, 144 B", call, n, warm_up)
    echo.join()
    return timing


def _echo(peer: socket.socket, n: int) -> None:
    with peer:
        for _ in range(n):
            peer.send(peer.recv(len(PING)))


def _add() -> int:
    total = 0
    for number in range(LOOP):
        total += number
    return total


_MATRIX = np.eye(9) + 0.01 * np.arange(81.0).reshape(9, 9)


def _multiply() -> object:
    product = _MATRIX
    for _ in range(PRODUCTS):
        product = _MATRIX @ _MATRIX
    return product
