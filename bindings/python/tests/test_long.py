"""Minutes: memory over a million messages, and a program that holds the GIL beside a loop in Rust. `pytest --long`."""

from __future__ import annotations

import os
import threading
import time
from typing import Any, List

import pytest

import sinew
from helpers import LONG, received, running

MESSAGES = 1_000_000
BATCH = 100
GROWTH_MAX = 4 << 20
"""Bytes: a leak of 8 bytes for each message would be twice as much."""

pytestmark = pytest.mark.long


@sinew.payload("long.leg")
class Leg:
    degrees: float
    name: str
    joints: List[float]


def resident() -> int:
    with open("/proc/self/statm") as statm:
        return int(statm.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def test_memory_is_flat_over_a_million_messages(node: Any) -> None:
    leg, sizes = Leg(1.5, "left", [0.5, 0.25]), []
    with node.register() as one, node.register() as other:
        for number in range(MESSAGES // BATCH):
            for _ in range(BATCH):
                other.send(one.tid, leg, room_within=LONG)
            for _ in range(BATCH):
                assert received(one).value == leg
            if number % (MESSAGES // BATCH // 10) == 0:
                sizes.append(resident())
    sizes.append(resident())
    assert sizes[-1] - sizes[1] < GROWTH_MAX, f"{[size >> 10 for size in sizes]} KiB"


HOG = """
import sys, sinew
with sinew.register("hog", socket=sys.argv[1]) as me:
    if sys.argv[2] == "member":
        me.join("peer.ticks")
    print("up", flush=True)
    number = 3 ** 200_000
    while True:
        number * number  # some milliseconds with the GIL held
        if sys.argv[2] == "member":
            me.receive(0.0)
"""
SECONDS = 8.0


def lateness(me: sinew.Endpoint, seconds: float) -> List[int]:
    """Returns how late the ticks of the loop were in these seconds, in microseconds, sorted."""
    me.ask("loop", "peer.get_lateness", {}, within=LONG)
    time.sleep(seconds)  # the measured time
    late = me.ask("loop", "peer.get_lateness", {}, within=LONG).value["late_us"]
    assert len(late) > seconds * 500, "the loop does not run at 1 kHz"
    return sorted(late)


def test_program_that_holds_the_gil_does_not_make_a_loop_late(peer: Any) -> None:
    """The same load of the CPU, once by a member of the loop's group and once by a program beside it."""
    with peer.register(requires=["loop"]) as me:
        found = {}
        for turn in range(3):
            for way in ("beside", "member"):
                with running(HOG, peer.socket, way):
                    late = lateness(me, SECONDS)
                found.setdefault(way, []).append((late[len(late) // 2], late[len(late) * 95 // 100]))
        half, most = (
            {way: sorted(each[index] for each in found[way])[1] for way in found} for index in (0, 1)
        )
        # A loop that waited for the receiver would be late by the milliseconds for which it holds the GIL.
        assert half["member"] < half["beside"] + 200, found
        assert most["member"] < 2 * most["beside"] + 500, found


def test_thread_that_holds_the_gil_delays_no_other_program(node: Any) -> None:
    """An own program with a busy thread still takes each message; another one does not notice it."""
    with node.register("busy") as busy, node.register("other") as other, node.register() as me:
        done = threading.Event()

        def hold() -> None:
            number = 3**200_000
            while not done.is_set():
                number * number

        holder = threading.Thread(target=hold)
        holder.start()
        try:
            for number in range(300):
                for endpoint in (busy, other):
                    me.send(endpoint.tid, "long.number", number)
                    assert received(endpoint).value == number
        finally:
            done.set()
            holder.join()
