"""Starts and ends of Python: exits with live endpoints, SIGKILL, restarts, forks, and threads."""

from __future__ import annotations

import asyncio
import gc
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from typing import Any, List

import pytest

import sinew
from helpers import LONG, in_thread, received, running, until_gone
from sinew import Outcome


@sinew.payload("life.number")
class Number:
    value: int


def run(program: str, socket: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-W", "error", "-c", program, socket, *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=LONG)


LIVE = """
import asyncio, atexit, sys, threading, sinew
socket, way = sys.argv[1:]
atexit.register(lambda: print("atexit", flush=True))
first = sinew.register("first", socket=socket).open()
gains = sinew.parameters(type("Gains", (), {"on": sinew.parameter(False)}))()
second = sinew.register("second", socket=socket, parameters=gains).open()
first.send(second.tid, "life.text", "waits")
held = second.receive(10.0)
assert held is not None
async def leave():
    me = await sinew.register("third", socket=socket)
    asyncio.create_task(me.receive())
    await asyncio.sleep(0.01)  # the task waits by then
asyncio.run(leave())
if way == "thread":
    threading.Thread(target=first.receive, daemon=True).start()
if way == "raise":
    raise SystemExit(7)
if way == "atexit":
    atexit.register(lambda: first.send(second.tid, "life.text", "last"))
"""


@pytest.mark.parametrize(("way", "code"), [("return", 0), ("thread", 0), ("raise", 7), ("atexit", 0)])
def test_interpreter_ends_with_live_endpoints(node: Any, way: str, code: int) -> None:
    ended = run(LIVE, node.socket, way)
    assert (ended.returncode, ended.stdout) == (code, "atexit\n"), ended.stderr
    assert ended.stderr == ""
    with node.register() as me:
        for name in ("first", "second", "third"):
            until_gone(me, name)


ECHO = """
import sys, sinew
with sinew.register("echo", socket=sys.argv[1], direct="always") as me:
    print("up", flush=True)
    for message in me:
        me.send(message.source, "life.number", {"value": message.value["value"]})
"""

RECEIVER = """
import sys, sinew
with sinew.register("receiver", socket=sys.argv[1]) as me:
    print("up", flush=True)
    for message in me:
        pass
"""


def test_killed_program_is_started_again_under_its_name(node: Any) -> None:
    with node.register("sender") as sender:
        for _ in range(3):
            with running(RECEIVER, node.socket) as process:
                assert sender.send_confirmed("receiver", Number(1), within=LONG) is Outcome.DELIVERED
                address = sender.resolve("receiver")
                assert address is not None
                process.send_signal(signal.SIGKILL)
                process.wait(LONG)
                until_gone(sender, "receiver")
                assert sender.send_confirmed(address, Number(2), within=LONG) is Outcome.REJECTED_NO_SUCH_APPLICATION
                with pytest.raises(sinew.UnknownNameError):
                    sender.send("receiver", Number(3))


def test_stopped_program_takes_its_messages_when_it_continues(node: Any) -> None:
    with running(RECEIVER, node.socket) as process, node.register("sender") as sender:
        process.send_signal(signal.SIGSTOP)
        outcome = in_thread(lambda: sender.send_confirmed("receiver", Number(1), within=LONG))
        with node.register("other") as other:
            assert other.resolve("receiver") is not None, "it is registered all the same"
        process.send_signal(signal.SIGCONT)
        assert outcome() is Outcome.DELIVERED


def test_eight_threads_each_have_an_endpoint(node: Any) -> None:
    threads, turns, failures = 8, 200, []

    def work(own: int) -> None:
        try:
            with node.register(f"thread.{own}") as me:
                barrier.wait(LONG)
                to = me.resolve(f"thread.{(own + 1) % threads}")
                assert to is not None
                for turn in range(turns):
                    me.send(to, Number(turn))
                    assert received(me).value == Number(turn)
                barrier.wait(LONG)
        except BaseException as failure:
            failures.append((own, failure))
            barrier.abort()

    barrier = threading.Barrier(threads)
    all_of_them = [threading.Thread(target=work, args=(own,)) for own in range(threads)]
    for thread in all_of_them:
        thread.start()
    for thread in all_of_them:
        thread.join(2 * LONG)
    assert not failures and not any(thread.is_alive() for thread in all_of_them)


def test_each_thread_may_have_an_event_loop(node: Any) -> None:
    results: List[Any] = []

    async def main(own: int) -> None:
        async with node.register(f"loop.{own}") as me:
            await me.send(me.tid, Number(own))
            results.append((await me.receive()).value)

    all_of_them = [threading.Thread(target=lambda own=own: asyncio.run(main(own))) for own in range(8)]
    for thread in all_of_them:
        thread.start()
    for thread in all_of_them:
        thread.join(LONG)
    assert sorted(each.value for each in results) == list(range(8))


def test_threads_without_a_lock_get_each_message_once(node: Any) -> None:
    """Of two threads that call one endpoint at once, one gets an error, and nothing is lost."""
    count = 500
    with node.register() as one, node.register() as other:
        seen, done = [], threading.Event()

        def receive() -> None:
            while not done.is_set():
                try:
                    message = one.receive(0.01)
                except sinew.BusyError:
                    time.sleep(0.001)  # the other one has the endpoint
                    continue
                if message is not None:
                    seen.append(message.value.value)

        receivers = [threading.Thread(target=receive) for _ in range(2)]
        for receiver in receivers:
            receiver.start()
        for number in range(count):
            other.send(one.tid, Number(number), room_within=LONG)
        until = time.monotonic() + LONG
        while len(seen) < count and time.monotonic() < until:
            time.sleep(0.01)  # until all have arrived, or the deadline
        done.set()
        for receiver in receivers:
            receiver.join(LONG)
    assert sorted(seen) == list(range(count))


def child_of_a_fork(socket: str, parents: Any, answers: Any) -> None:
    try:
        parents.receive(0.0)
    except sinew.ForkedError:
        answers.put("refused")
    with sinew.register("child", socket=socket) as me:
        me.send("parent", Number(os.getpid()))
    parents.close()  # it is a copy: the address is the parent's


def test_child_of_a_fork_registers_an_endpoint_of_its_own(node: Any) -> None:
    context = multiprocessing.get_context("fork")
    with node.register("parent") as parent:
        answers = context.Queue()
        child = context.Process(target=child_of_a_fork, args=(node.socket, parent, answers))
        child.start()
        assert answers.get(timeout=LONG) == "refused"
        assert received(parent).value == Number(child.pid or 0)
        child.join(LONG)
        assert child.exitcode == 0
        # The end of the child has closed nothing of the parent's.
        parent.send(parent.tid, Number(1))
        assert received(parent).value == Number(1)


def test_exit_of_a_forked_child_leaves_the_address_to_the_parent(node: Any) -> None:
    with node.register("parent") as parent, node.register() as other:
        child = os.fork()
        if child == 0:
            os._exit(0)
        os.waitpid(child, 0)
        assert other.resolve("parent") == parent.tid
        other.send(parent.tid, Number(2))
        assert received(parent).value == Number(2)


def test_end_of_copies_in_a_forked_child_has_no_effect(node: Any) -> None:
    endpoint, other = node.register("parent").open(), node.register().open()
    try:
        other.send(endpoint.tid, Number(1))
        received(endpoint)
        outcome = in_thread(lambda: other.send_confirmed(endpoint.tid, Number(2), within=LONG))
        message = received(endpoint)
        child = os.fork()
        if child == 0:
            try:
                message.settle(Outcome.FAILED)
            except sinew.ForkedError:
                del message, endpoint
                gc.collect()
                os._exit(42)
            finally:
                os._exit(1)
        _, status = os.waitpid(child, 0)
        assert os.waitstatus_to_exitcode(status) == 42
        # The message is in the hand of the parent.
        message.settle(Outcome.REJECTED_BY_HANDLER)
        assert outcome() is Outcome.REJECTED_BY_HANDLER
        assert endpoint.receive(0.05) is None and endpoint.registrations == 1
    finally:
        endpoint.close()
        other.close()


def test_end_of_a_waiting_call_in_a_forked_child_leaves_that_of_the_parent(node: Any) -> None:
    async def main() -> Any:
        async with node.register() as one, node.register() as other:
            asking = asyncio.create_task(one.ask(other.tid, Number(1), within=LONG))
            request = await other.receive()
            child = os.fork()
            if child == 0:
                waiter = one._reader.waiter
                if waiter is not None:
                    # As the end of its event loop does.
                    waiter._operation.cancel()
                    os._exit(42)
                os._exit(1)
            _, status = os.waitpid(child, 0)
            assert os.waitstatus_to_exitcode(status) == 42
            await other.reply(request, Number(2))
            return (await asyncio.wait_for(asking, LONG / 2)).value

    assert asyncio.run(main()) == Number(2)


def test_direct_link_carries_all_that_a_node_carries(node: Any) -> None:
    with node.register("one", direct="always") as one, node.register("other", direct="always") as other:
        for turn in range(2_000):
            other.send(one.tid, Number(turn))
            message = received(one)
            assert message.value == Number(turn) and message.source == other.tid
        # More than a ring holds: each waits for room, and arrives in order.
        blocks = 500
        sender = threading.Thread(
            target=lambda: [
                other.send(one.tid, "life.block", bytes([turn % 256]) * 20_000, class_="bulk", room_within=LONG)
                for turn in range(blocks)
            ]
        )
        sender.start()
        for turn in range(blocks):
            assert received(one).data == bytes([turn % 256]) * 20_000
        sender.join(LONG)
    with pytest.raises(ValueError, match='direct is "sometimes"'):
        node.register("one", direct="sometimes").open()


def test_direct_link_ends_with_its_peer(node: Any) -> None:
    with running(ECHO, node.socket) as process, node.register("one", direct="always") as one:
        to = one.resolve("echo")
        assert to is not None
        for turn in range(500):
            one.send(to, Number(turn))
            assert received(one).value == Number(turn)
        process.send_signal(signal.SIGKILL)
        process.wait(LONG)
        until_gone(one, "echo")
        assert one.send_confirmed(to, Number(1), within=LONG) is Outcome.REJECTED_NO_SUCH_APPLICATION


async def wait_for_all(me: sinew.AsyncEndpoint, tasks: List[asyncio.Task[Any]]) -> None:
    for task in tasks:
        task.cancel()
    ended = await asyncio.gather(*tasks, return_exceptions=True)
    assert all(isinstance(each, asyncio.CancelledError) for each in ended), ended


def test_tasks_may_be_cancelled_at_any_moment(node: Any) -> None:
    async def main() -> int:
        async with node.register("one") as one, node.register("other") as other:
            for turn in range(100):
                tasks = [
                    asyncio.create_task(one.receive()),
                    asyncio.create_task(one.send_confirmed(other.tid, Number(turn), within=LONG)),
                    asyncio.create_task(one.ask(other.tid, Number(turn), within=LONG)),
                    asyncio.create_task(one.resolve("nobody")),
                ]
                for _ in range(turn % 7):
                    await asyncio.sleep(0)
                await wait_for_all(one, [task for task in tasks if not task.done()])
            while await other.receive(0.05) is not None:
                pass
            await other.send(one.tid, Number(7))
            message = await one.receive(LONG)
            assert message is not None
            return message.value.value

    assert asyncio.run(main()) == 7
