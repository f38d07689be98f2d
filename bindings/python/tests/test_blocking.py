"""The endpoint for threads, at a real node."""

from __future__ import annotations

import signal
import time
from typing import Any, Callable, List

import numpy
import pytest

import sinew
from helpers import LONG, in_thread, is_refused_in_a_child, received
from sinew import Outcome


@sinew.payload("test.angle", class_="stream")
class Angle:
    degrees: float


@sinew.payload("test.torque")
class Torque:
    newton_metres: float


def test_message_passes_with_its_value_and_age(node: Any) -> None:
    with node.register("drive") as drive, node.register("sensor", requires=["drive"]) as sensor:
        sensor.send("drive", Torque(2.5))
        message = received(drive)
        assert message.value == Torque(2.5) and message.kind == "test.torque"
        assert message.is_kind(Torque) and message.is_kind("test.torque") and not message.is_kind(Angle)
        assert (message.source, message.destination) == (sensor.tid, drive.tid)
        assert message.sequence >= 1 and not message.wants_reply and not message.is_retained
        assert message.age is not None and message.age >= 0.0 and message.age_error == 0.0
        assert message.is_older_than(0.0) and not message.is_older_than(3600.0)
        assert message.message_class is sinew.MessageClass.CONTROL
        assert "test.torque" in repr(message) and drive.node_name == "knee"


def test_dict_without_a_class_passes(node: Any) -> None:
    with node.register() as one:
        one.send(one.tid, "test.free", {"a": [1, 2.5, "x", b"y", None]})
        assert received(one).value == {"a": [1, 2.5, "x", b"y", None]}


def test_newest_value_of_a_stream_is_received(node: Any) -> None:
    with node.register() as one, node.register() as other:
        for degrees in range(10):
            other.send(one.tid, Angle(float(degrees)))
        other.send(one.tid, Torque(1.0))
        # This is behind the others, and has no receiver: when it ends, they have arrived.
        nobody = sinew.Tid.of(one.tid.node, 0x1FFF)
        assert other.send_confirmed(nobody, Torque(1.0)) is Outcome.REJECTED_NO_SUCH_APPLICATION
        assert received(one).value == Torque(1.0)
        last = received(one)
        assert last.value == Angle(9.0) and last.message_class is sinew.MessageClass.STREAM
        assert one.receive(0.0) is None


def test_outcome_is_that_of_the_receiver(node: Any) -> None:
    with node.register() as one, node.register() as other:

        def settle() -> None:
            for outcome in (None, Outcome.REJECTED_BY_HANDLER, Outcome.FAILED):
                message = received(one)
                if outcome is not None:
                    message.settle(outcome)
                del message
            with pytest.raises(KeyError), received(one):
                raise KeyError("it fails")
            malformed = received(one)
            with pytest.raises(sinew.MalformedError):
                malformed.value  # noqa: B018

        done = in_thread(settle)
        outcomes = [other.send_confirmed(one.tid, Torque(1.0), within=LONG) for _ in range(4)]
        outcomes.append(other.send_confirmed(one.tid, "test.torque", {"kp": 1.0}, within=LONG))
        done()
    assert outcomes == [
        Outcome.DELIVERED,
        Outcome.REJECTED_BY_HANDLER,
        Outcome.FAILED,
        Outcome.FAILED,
        Outcome.REJECTED_MALFORMED,
    ]


def test_request_is_replied(node: Any) -> None:
    with node.register() as one, node.register() as other:

        def reply() -> None:
            request = received(one)
            assert request.wants_reply
            one.reply(request, Torque(request.value.newton_metres / 2))
            with pytest.raises(sinew.NotAskedError):
                request.settle()
                one.reply(request, Torque(0.0))

        done = in_thread(reply)
        answer = other.ask(one.tid, Torque(3.0), within=LONG)
        assert answer.value == Torque(1.5)
        done()
        with pytest.raises(sinew.NoReplyError):
            other.ask(one.tid, Torque(3.0), within=0.05)
        with pytest.raises(sinew.NotHandledError) as refused:
            other.ask(sinew.Tid.of(other.tid.node, 0x1FFF), Torque(3.0), within=LONG)
        assert refused.value.outcome is Outcome.REJECTED_NO_SUCH_APPLICATION


def test_name_is_resolved_on_the_node(node: Any) -> None:
    with node.register("drive") as drive:
        assert drive.resolve("drive") == drive.tid
        assert drive.resolve("dive") is None
        with pytest.raises(sinew.UnknownNameError) as unknown:
            drive.send("dive", Torque(1.0))
        assert unknown.value.name == "dive" and isinstance(unknown.value, LookupError)
        with pytest.raises(sinew.RefusedError, match="drive"):
            node.register("drive").open()
    # The name is free.
    node.register("drive").open().close()


def test_missing_requirement_is_named(node: Any) -> None:
    with pytest.raises(sinew.WaitingError) as waiting:
        node.register(requires=["hip"], deadline=0.3).open()
    assert "hip" in waiting.value.missing[0]


def test_members_of_a_group_receive_and_report(node: Any) -> None:
    with node.register() as one, node.register() as other, node.register() as sender:
        for member in (one, other):
            member.join("drives")
        sender.send(sinew.group("drives"), Torque(1.0))
        assert received(one).destination == sinew.group("drives")
        assert received(other).value == Torque(1.0)
        done = in_thread(lambda: [received(each).settle() for each in (one, other)])
        outcomes = sender.send_confirmed_by_each(sinew.group("drives"), Torque(2.0), within=LONG)
        done()
        assert {each.tid for each in outcomes} == {one.tid, other.tid}
        assert all(each.outcome is Outcome.DELIVERED for each in outcomes)
        other.leave("drives")
        sender.send(sinew.group("drives"), Torque(3.0))
        assert received(one).value == Torque(3.0)
        assert other.receive(0.1) is None
        with pytest.raises(sinew.SendError):
            sender.send_confirmed(sinew.group("drives"), Torque(1.0))
        with pytest.raises(sinew.BadNameError):
            one.join("a|b")


def test_parties_meet_at_a_barrier(node: Any) -> None:
    with node.register("hip") as hip, node.register("ankle") as ankle:
        other = in_thread(lambda: ankle.meet("step", ["hip", "ankle"]))
        assert hip.meet("step", ["hip", "ankle"]) == other()
        with pytest.raises(sinew.NotMetError) as missing:
            hip.meet("step", ["hip", "ankle"], within=0.1)
        assert missing.value.missing[0][0] == "ankle"
        with pytest.raises(ValueError, match="'wait' or 'fail'"):
            hip.meet("step", ["hip"], on_loss="panic")


def test_undelivered_messages_are_reported(node: Any) -> None:
    with node.register() as one:
        one.send(sinew.Tid.of(one.tid.node, 0x1FFF), Torque(1.0))
        until = time.monotonic() + LONG
        while (report := one.take_undelivered()) is None:
            assert time.monotonic() < until, "no report"
            one.receive(0.01)
        assert report.count == 1 and report.kind == "test.torque"
        assert report.outcome is Outcome.REJECTED_NO_SUCH_APPLICATION


def test_raw_payload_is_an_array_without_a_copy(node: Any) -> None:
    samples = numpy.arange(50_000, dtype=numpy.float32)
    with node.register() as one:
        one.send(one.tid, "test.samples", samples.tobytes(), class_="bulk")
        message = received(one)
        first, second = message.array("float32", (500, 100)), message.array()
        assert numpy.shares_memory(first, second), "each call would be a copy"
        assert (first.reshape(-1) == samples).all() and first.shape == (500, 100)
        assert not first.flags.writeable
        del message, second
        assert (first.reshape(-1) == samples).all(), "it outlives the message"
        assert not first.flags.owndata


def test_too_long_a_payload_is_refused(node: Any) -> None:
    with node.register() as one, pytest.raises(sinew.TooLongError, match="payload_max"):
        one.send(one.tid, "test.samples", bytes(one.payload_max + 1))


def test_value_without_a_type_is_refused(node: Any) -> None:
    with node.register() as one:
        with pytest.raises(TypeError, match=r"@sinew\.payload"):
            one.send(one.tid, {"degrees": 1.0})
        with pytest.raises(TypeError, match="one value"):
            one.send(one.tid, Torque(1.0), {})


def test_full_ring_is_an_error_without_a_wait(node: Any) -> None:
    with node.register(stall_timeout=0.05) as one:
        node.send_signal(signal.SIGSTOP)
        try:
            for room_within in (0.0, None):
                with pytest.raises(sinew.StalledError, match="no room"):
                    for _ in range(10_000):
                        one.send(one.tid, "test.samples", bytes(10_000), class_="bulk", room_within=room_within)
        finally:
            node.send_signal(signal.SIGCONT)


def test_handlers_are_called_by_type(node: Any) -> None:
    seen: List[Any] = []
    with node.register("drive") as drive, node.register() as sender:
        drive.on(Torque, lambda message: Torque(message.value.newton_metres * 2))
        drive.on("test.text", lambda message: seen.append(message.value))
        drive.serve(0.05)  # ends by itself
        done = in_thread(lambda: drive.serve(LONG))
        assert sender.ask("drive", Torque(2.0), within=LONG).value == Torque(4.0)
        assert sender.send_confirmed("drive", "test.text", "hello", within=LONG) is Outcome.DELIVERED
        assert sender.send_confirmed("drive", Angle(1.0), class_="control", within=LONG) is Outcome.REJECTED_UNKNOWN_KIND
        drive.on("test.text", lambda _: 1 / 0)
        assert sender.send_confirmed("drive", "test.text", "hello", within=LONG) is Outcome.FAILED
        with pytest.raises(ZeroDivisionError):
            done()
        with pytest.raises(TypeError, match="no payload class"):
            drive.on(int, print)
    assert seen == ["hello"]


def test_blocking_call_leaves_the_interpreter_to_others(node: Any) -> None:
    with node.register() as one:
        done = in_thread(lambda: one.receive(0.3))
        turns, until = 0, time.monotonic() + 0.2
        while time.monotonic() < until:
            turns += 1
        assert turns > 1_000, "the interpreter was held"
        assert done() is None


def test_second_thread_on_an_endpoint_is_refused(node: Any) -> None:
    with node.register() as one, node.register() as other:
        done = in_thread(lambda: one.receive(LONG))
        until = time.monotonic() + LONG
        while True:
            assert time.monotonic() < until, "both threads may call it"
            try:
                one.resolve("x")
            except sinew.BusyError:
                break
        with pytest.raises(sinew.BusyError):
            one.close()
        other.send(one.tid, Torque(1.0))
        assert done() is not None


def test_signal_ends_a_blocking_call(node: Any) -> None:
    def interrupt(*_: Any) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGALRM, interrupt)
    try:
        with node.register() as one:
            signal.setitimer(signal.ITIMER_REAL, 0.1)
            with pytest.raises(KeyboardInterrupt):
                one.receive()
            # It works on.
            one.send(one.tid, Torque(1.0))
            assert received(one).value == Torque(1.0)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def test_unregistered_endpoint_is_closed(node: Any) -> None:
    endpoint = node.register().open()
    endpoint.unregister()
    endpoint.close()
    with pytest.raises(sinew.ClosedError, match="register a new one"):
        endpoint.send(endpoint.tid, Torque(1.0))
    with pytest.raises(sinew.ClosedError):
        endpoint.receive(0.0)
    assert list(endpoint) == []


def test_child_of_a_fork_is_refused(node: Any) -> None:
    with node.register() as one:
        assert is_refused_in_a_child(lambda: one.receive(0.0))
        one.send(one.tid, Torque(1.0))
        assert received(one).value == Torque(1.0)


def test_endpoint_continues_after_a_restart_of_its_node(node: Any) -> None:
    with node.register("drive") as drive:
        tid = drive.tid
        drive.join("drives")
        node.stop(signal.SIGKILL)
        with pytest.raises(sinew.DisconnectedError):
            drive.receive(LONG)
        with pytest.raises(ConnectionError):
            drive.send(tid, Torque(1.0), room_within=0.0)
        node.start()
        until = time.monotonic() + LONG
        while drive.registrations == 1:
            assert time.monotonic() < until, "it does not register again"
            drive.receive(0.05)
        with node.register() as other:
            assert other.resolve("drive") == drive.tid
            other.send(sinew.group("drives"), Torque(4.0))
            assert received(drive).value == Torque(4.0)
        node.stop(signal.SIGKILL)
        drive.serve(0.2)  # waits for the node, without an error


def test_socket_without_rings_is_the_same(node: Any) -> None:
    with node.register(socket_only=True) as one, node.register() as other:
        done = in_thread(lambda: received(one).settle(Outcome.REJECTED_BY_HANDLER))
        assert other.send_confirmed(one.tid, Torque(1.0), within=LONG) is Outcome.REJECTED_BY_HANDLER
        done()
        one.send(other.tid, "test.samples", bytes(500_000), class_="bulk")
        assert len(received(other)) == 500_000


def test_end_of_a_node_is_an_event_with_its_cause(start_node: Callable[..., Any]) -> None:
    first, second = start_node("one", address="127.0.0.1"), start_node("two", address="127.0.0.2")
    with first.register(events=["nodes"]) as watcher:
        seen = []
        while not seen or seen[-1].what != "NodeLost":
            event = received(watcher).value
            assert isinstance(event, sinew.NodeEvent)
            seen.append(event)
            if event.what == "NodeFound":
                second.stop(signal.SIGKILL)
        assert (seen[-1].name, seen[-1].why) == ("two", "Crashed")
        assert seen[-1].silent is not None and seen[-1].silent < LONG
