"""The endpoint for asyncio, at a real node."""

from __future__ import annotations

import asyncio
import gc
import os
import signal
import time
from typing import Any, Awaitable, Callable, List

import pytest

import sinew
from helpers import LONG
from sinew import Outcome, _aio, _wait


@sinew.payload("test.aio.count")
class Count:
    number: int


def run(main: Callable[[], Awaitable[Any]]) -> Any:
    async def limited() -> Any:
        return await asyncio.wait_for(main(), 60.0)

    return asyncio.run(limited(), debug=True)


async def until_free(node: Any, name: str) -> sinew.AsyncEndpoint:
    """Registers as soon as the name is free."""
    until = time.monotonic() + LONG
    while True:
        try:
            endpoint: sinew.AsyncEndpoint = await node.register(name)
            return endpoint
        except sinew.RefusedError:
            assert time.monotonic() < until, "the name is still taken"
            await asyncio.sleep(0.02)  # between two tries, until the deadline


def test_messages_pass_between_tasks(node: Any) -> None:
    async def main() -> None:
        async with node.register("drive") as drive, node.register() as sensor:

            async def answer() -> None:
                async for message in drive:
                    await drive.reply(message, Count(message.value.number + 1))
                    if message.value.number == 99:
                        return

            answering = asyncio.create_task(answer())
            to = await sensor.resolve("drive")
            for number in range(100):
                reply = await sensor.ask(to, Count(number), within=LONG)
                assert reply.value == Count(number + 1)
            await answering

    run(main)


def test_receive_gives_way_to_other_calls(node: Any) -> None:
    async def main() -> None:
        async with node.register("one") as one, node.register("other") as other:
            seen: List[int] = []

            async def listen() -> None:
                async for message in one:
                    seen.append(message.value.number)

            listening = asyncio.create_task(listen())
            await asyncio.sleep(0)
            # All of these wait for answers while `receive` waits, too.
            for number in range(20):
                assert await one.resolve("other", LONG) == other.tid
                await other.send(one.tid, Count(number))
            await one.join("all")
            outcomes = await asyncio.gather(*(other.send_confirmed(one.tid, Count(n), within=LONG) for n in range(20, 30)))
            assert outcomes == [Outcome.DELIVERED] * 10
            assert seen == list(range(30))
            listening.cancel()
            with pytest.raises(asyncio.CancelledError):
                await listening

    run(main)


def test_cancelled_receive_loses_no_message(node: Any) -> None:
    async def main() -> None:
        async with node.register() as one, node.register() as other:
            seen: List[int] = []
            number, cancelled = 0, 0
            while number < 300:
                receiving = asyncio.create_task(one.receive())
                for _ in range(number % 4):
                    await asyncio.sleep(0)
                await other.send(one.tid, Count(number))
                number += 1
                for _ in range(number % 7):
                    await asyncio.sleep(0)
                receiving.cancel()
                try:
                    seen.append((await receiving).value.number)
                except asyncio.CancelledError:
                    cancelled += 1
            while (message := await one.receive(0.5)) is not None:
                seen.append(message.value.number)
            assert seen == list(range(300))
            assert cancelled > 0, "none was cancelled, so this shows nothing"

    run(main)


def test_message_of_a_cancelled_receive_is_for_the_next_one(node: Any) -> None:
    async def main() -> None:
        async with node.register() as one, node.register() as other:
            first, second = asyncio.create_task(one.receive()), asyncio.create_task(one.receive())
            while (waiter := one._receiving) is None:
                await asyncio.sleep(0)
            await other.send(one.tid, Count(1))
            while not waiter.ended.done():
                await asyncio.sleep(0)
            first.cancel()  # it has the message, and has not run since
            assert (await asyncio.wait_for(second, LONG)).value == Count(1)
            assert first.cancelled()

    run(main)


def test_calls_that_need_not_wait_let_other_tasks_run(node: Any) -> None:
    async def main() -> None:
        async with node.register() as one:
            turns = 0

            async def turn() -> None:
                nonlocal turns
                while True:
                    turns += 1
                    await asyncio.sleep(0)

            turning = asyncio.create_task(turn())
            for number in range(8 * _aio.CALLS_MAX):
                await one.send(one.tid, Count(number))
            turning.cancel()
            assert turns >= 7, "the sends have stopped the event loop"

    run(main)


def test_close_ends_a_call_that_waits(node: Any) -> None:
    async def main() -> None:
        for call in (lambda me: me.receive(), lambda me: me.ask(me.tid, Count(1), within=LONG)):
            endpoint = await until_free(node, "drive")
            waiting = asyncio.create_task(call(endpoint))
            while endpoint._reader.waiter is None:
                await asyncio.sleep(0)
            endpoint.close()
            with pytest.raises(sinew.ClosedError):
                await waiting
        await (await until_free(node, "drive")).unregister()

    run(main)


def test_receive_ends_at_its_deadline(node: Any) -> None:
    async def main() -> None:
        async with node.register() as one:
            assert await one.receive(0.0) is None
            assert await one.receive(0.05) is None
            with pytest.raises(asyncio.TimeoutError):
                await asyncio.wait_for(one.receive(), 0.05)
            await one.send(one.tid, Count(1))
            assert (await one.receive(LONG)).value == Count(1)

    run(main)


def test_cancelled_request_leaves_the_endpoint_usable(node: Any) -> None:
    async def main() -> None:
        async with node.register() as one, node.register() as other:
            asking = asyncio.create_task(one.ask(other.tid, Count(1), within=LONG))
            request = await other.receive()
            asking.cancel()
            with pytest.raises(asyncio.CancelledError):
                await asking
            # Nothing waits for this reply any more.
            await other.reply(request, Count(2))
            await other.send(one.tid, Count(3))
            assert (await one.receive(LONG)).value == Count(3)
            assert await one.receive(0.1) is None

    run(main)


def test_idle_endpoint_is_not_polled(node: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    steps: List[float] = []
    step = _wait.Waiter._step

    def counted(waiter: Any) -> None:
        steps.append(time.monotonic())
        step(waiter)

    monkeypatch.setattr(_wait.Waiter, "_step", counted)

    async def main() -> None:
        async with node.register() as one:
            receiving = asyncio.create_task(one.receive())
            await asyncio.sleep(0.2)
            steps.clear()
            await asyncio.sleep(1.0)
            assert len(steps) <= 2, "it is polled although nothing arrives"
            await_one = asyncio.create_task(one.send(one.tid, Count(1)))
            assert (await receiving).value == Count(1)
            await await_one

    run(main)


def test_event_loop_runs_while_operations_wait(node: Any) -> None:
    async def main() -> None:
        async with node.register("one") as one, node.register() as silent:
            turns = 0

            async def turn() -> None:
                nonlocal turns
                while True:
                    turns += 1
                    await asyncio.sleep(0)

            turning = asyncio.create_task(turn())
            assert await one.send_confirmed(silent.tid, Count(1), within=0.2) is Outcome.UNKNOWN
            with pytest.raises(sinew.WaitingError):
                await node.register(requires=["nothing"], deadline=0.2)
            with pytest.raises(sinew.NotMetError):
                await one.meet("step", ["one", "hip"], within=0.2)
            turning.cancel()
            assert turns > 500, "the event loop was blocked"

    run(main)


def test_cancelled_registration_leaves_no_name(node: Any) -> None:
    async def main() -> None:
        async def begin() -> Any:
            return await node.register("drive", requires=["nothing"])

        registering = asyncio.create_task(begin())
        await asyncio.sleep(0.1)
        registering.cancel()
        with pytest.raises(asyncio.CancelledError):
            await registering
        await (await until_free(node, "drive")).unregister()

    run(main)


def test_handlers_may_be_coroutines(node: Any) -> None:
    async def main() -> None:
        async with node.register("drive") as drive, node.register() as sender:

            async def double(message: sinew.Message) -> Count:
                await asyncio.sleep(0.01)
                return Count(2 * message.value.number)

            drive.on(Count, double)
            drive.on("test.aio.text", lambda message: ("test.aio.text", message.value.upper()))
            serving = asyncio.create_task(drive.serve())
            assert (await sender.ask("drive", Count(21), within=LONG)).value == Count(42)
            assert (await sender.ask("drive", "test.aio.text", "on", within=LONG)).value == "ON"
            assert await sender.send_confirmed("drive", "test.aio.other", {}, within=LONG) is Outcome.REJECTED_UNKNOWN_KIND

            def fail(_: sinew.Message) -> None:
                raise KeyError("it fails")

            drive.on(Count, fail)
            assert await sender.send_confirmed("drive", Count(1), within=LONG) is Outcome.FAILED
            with pytest.raises(KeyError):
                await serving

    run(main)


def test_iteration_continues_after_a_restart_of_the_node(node: Any) -> None:
    async def main() -> None:
        async with node.register("drive") as drive:
            seen: List[int] = []

            async def listen() -> None:
                async for message in drive:
                    seen.append(message.value.number)

            listening = asyncio.create_task(listen())
            await asyncio.sleep(0.05)
            node.stop(signal.SIGKILL)
            await asyncio.sleep(0.3)
            node.start()
            async with node.register() as other:
                until = time.monotonic() + LONG
                while await other.resolve("drive") is None:
                    assert time.monotonic() < until, "it does not register again"
                    await asyncio.sleep(0.02)
                assert await other.send_confirmed("drive", Count(7), within=LONG) is Outcome.DELIVERED
            assert seen == [7]
            listening.cancel()
            await asyncio.gather(listening, return_exceptions=True)
            assert drive.registrations == 2

    run(main)


def test_endpoints_leave_no_descriptor_and_no_thread(node: Any) -> None:
    async def main() -> None:
        async def once() -> None:
            async with node.register() as one:
                await one.send(one.tid, Count(1))
                assert (await one.receive()).value == Count(1)

        await once()
        gc.collect()
        descriptors, threads = len(os.listdir("/proc/self/fd")), len(os.listdir("/proc/self/task"))
        for _ in range(30):
            await once()
        gc.collect()
        assert len(os.listdir("/proc/self/fd")) <= descriptors
        assert len(os.listdir("/proc/self/task")) <= threads

    run(main)


def test_flood_arrives_in_order(node: Any) -> None:
    async def main() -> None:
        async with node.register() as one, node.register(stall_timeout=LONG) as other:

            async def send() -> None:
                for number in range(3_000):
                    await other.send(one.tid, Count(number))
                    if number % 50 == 0:
                        await asyncio.sleep(0)

            sending = asyncio.create_task(send())
            for number in range(3_000):
                message = await one.receive(LONG)
                assert message is not None and message.value == Count(number)
            await sending

    run(main)


def test_registration_serves_both_forms(node: Any) -> None:
    with node.register("blocking") as endpoint:
        assert isinstance(endpoint, sinew.Endpoint)

    async def main() -> None:
        endpoint = await node.register("awaited")
        assert isinstance(endpoint, sinew.AsyncEndpoint) and endpoint.payload_max > 0
        assert endpoint.take_undelivered() is None
        await endpoint.unregister()
        with pytest.raises(sinew.ClosedError):
            await endpoint.receive()

    run(main)
