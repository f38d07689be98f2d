"""Each outcome of a confirmed message, from its own cause, at real nodes."""

from __future__ import annotations

import signal
import threading
import time
from typing import Any, Callable, List

import sinew
from helpers import LONG, in_thread, received, until
from sinew import Outcome


@sinew.payload("outcome.short", expires_after=0.01)
class Short:
    number: int = 0


@sinew.payload("outcome.torque")
class Torque:
    newton_metres: float = 1.0


def test_settled_outcome_reaches_the_sender(node: Any) -> None:
    outcomes = [each for each in Outcome if each.is_rejected or each.value < 3]
    with node.register() as one, node.register() as other:

        def settle() -> None:
            for outcome in outcomes:
                received(one).settle(outcome)

        done = in_thread(settle)
        assert [other.send_confirmed(one.tid, Torque(), within=LONG) for _ in outcomes] == outcomes
        done()


def test_message_that_waits_too_long_expires(node: Any) -> None:
    with node.register() as one, node.register() as other:
        found: List[Outcome] = []
        sender = threading.Thread(target=lambda: found.append(other.send_confirmed(one.tid, Short(), within=LONG)))
        sender.start()
        until = time.monotonic() + LONG
        while sender.is_alive():
            assert time.monotonic() < until, "it does not expire"
            time.sleep(0.05)  # several times as long as the message may wait
            assert one.receive(0.0) is None
        assert found == [Outcome.EXPIRED]


def test_message_in_hand_at_the_deadline_is_unknown(node: Any) -> None:
    with node.register() as one, node.register() as other:
        in_hand = in_thread(lambda: received(one))
        assert other.send_confirmed(one.tid, Torque(), within=0.5) is Outcome.UNKNOWN
        assert in_hand().value == Torque(), "it was received"


def test_queue_of_a_receiver_that_takes_nothing_is_full(node: Any) -> None:
    with node.register(inbox_capacity=1) as one, node.register() as other:
        for _ in range(20_000):
            try:
                other.send(one.tid, "outcome.block", bytes(1_000), room_within=0.0)
            except sinew.StalledError:
                pass
            report = other.take_undelivered()
            if report is not None:
                assert report.outcome is Outcome.REJECTED_QUEUE_FULL, report
                break
        else:
            raise AssertionError("20,000 messages have found room")
        assert other.send_confirmed(one.tid, Torque(), within=LONG) is Outcome.REJECTED_QUEUE_FULL


def test_address_without_an_application_or_node_is_refused(node: Any) -> None:
    with node.register() as one:
        gone = node.register().open()
        address = gone.tid
        gone.unregister()
        assert one.send_confirmed(address, Torque(), within=LONG) is Outcome.REJECTED_NO_SUCH_APPLICATION
        stranger = sinew.Tid.of(0x7F00_0063, 0x1000)
        assert one.send_confirmed(stranger, Torque(), within=LONG) is Outcome.REJECTED_NO_SUCH_NODE


def test_loss_of_the_receiving_node_is_an_outcome(start_node: Callable[..., Any]) -> None:
    first, second = start_node("one", address="127.0.0.1"), start_node("two", address="127.0.0.2")
    with first.register("sender") as sender, second.register("receiver", reconnect=False) as receiver:
        until(lambda: sender.resolve("receiver") is not None, "the nodes do not find each other")
        to = receiver.tid
        second.send_signal(signal.SIGSTOP)
        found = in_thread(lambda: sender.send_confirmed(to, Torque(), within=LONG))
        second.stop(signal.SIGKILL)
        # It was sent to a node that stood still: nothing tells whether it was handled.
        assert found() in (Outcome.UNKNOWN, Outcome.PEER_LOST)
        until(
            lambda: sender.send_confirmed(to, Torque(), within=LONG) is Outcome.REJECTED_NO_SUCH_NODE,
            "the loss is not noticed",
        )
