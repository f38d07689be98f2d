"""Protected commands between two endpoints, and the output behind a guard."""

from __future__ import annotations

import asyncio
import threading
import time
from typing import Any, List

import pytest

import sinew
from helpers import LONG, is_refused_in_a_child

# No machine is too slow for that, and the end of the commands is noticed within a second.
TORQUE = sinew.Protected("test.torque_command", within=1.0, age_max=4.0, good_min=3)


class Drive:
    """A drive with a guarded output: its torque."""

    def __init__(self, endpoint: sinew.Endpoint, source: sinew.Tid) -> None:
        self.torque = 0.0
        self.causes: List[str] = []
        self.is_safe = threading.Event()
        self.endpoint = endpoint
        self.guard = endpoint.guard(source, TORQUE, self.make_safe)

    def make_safe(self, cause: str) -> None:
        self.torque = 0.0
        self.causes.append(cause)
        self.is_safe.set()

    def take(self, within: float) -> None:
        """Receives for this time, arms the output when it may be, and applies the commands."""
        until = time.monotonic() + within
        while (left := until - time.monotonic()) > 0:
            message = self.endpoint.receive(min(left, 0.02))
            if not self.guard.is_live:
                try:
                    self.guard.arm()
                    self.is_safe.clear()
                except sinew.NotGoodError:
                    continue
            if message is not None:
                self.apply(message.value)

    def apply(self, torque: float) -> None:
        def command() -> None:
            self.torque = torque

        self.guard.apply(command)


def test_output_is_live_only_with_good_commands(node: Any) -> None:
    with node.register("control") as control, node.register("drive") as endpoint:
        drive = Drive(endpoint, control.tid)
        assert not drive.guard.is_live and "not armed" in (drive.guard.cause or "")
        with pytest.raises(sinew.NotGoodError):
            drive.guard.arm()
        until = time.monotonic() + LONG
        while drive.torque != 2.5:
            assert time.monotonic() < until, f"{drive.guard.cause}, {drive.guard.tally}"
            control.send_protected(endpoint.tid, TORQUE, 2.5)
            control.receive(0.0)  # takes the echo
            drive.take(0.05)
        assert drive.guard.is_live and drive.guard.tally.good >= 3
        # No command arrives any more, and nothing calls the guard.
        assert drive.is_safe.wait(LONG), "the output stays live"
        assert drive.torque == 0.0 and "no good message" in drive.causes[-1]
        assert not drive.guard.is_live and drive.guard.apply(lambda: 1) is None
        assert drive.guard.tally.trips >= 1


def test_unprotected_command_does_not_pass_a_guard(node: Any) -> None:
    with node.register("control") as control, node.register("drive") as endpoint:
        drive = Drive(endpoint, control.tid)
        control.send(endpoint.tid, TORQUE.name, 2.5)
        assert endpoint.receive(0.2) is None
        assert drive.guard.tally.bad == 1
        with pytest.raises(sinew.GuardError, match="guarded already"):
            endpoint.guard(control.tid, TORQUE, print)
        with pytest.raises(sinew.SendError):
            control.send_protected(sinew.group("drives"), TORQUE, 2.5)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_output_in_use_is_not_waited_for(node: Any) -> None:
    seen: List[Any] = []

    guards: List[sinew.Guard] = []

    def uses_its_own_guard(_: str) -> None:
        if not guards:
            raise RuntimeError("called again when the guard is known")
        (guard,) = guards
        for call in (lambda: guard.cause, guard.arm, lambda: guard.apply(print), lambda: endpoint.receive(0.0)):
            with pytest.raises(sinew.BusyError, match="only trip and release"):
                call()
        guard.trip()
        seen.append("called")

    with node.register("control") as control, node.register("drive") as endpoint:
        guard = endpoint.guard(control.tid, TORQUE, uses_its_own_guard)
        guards.append(guard)
        until = time.monotonic() + LONG
        while not seen:
            assert time.monotonic() < until, "the safe function waits for itself"
            assert guard.cause is not None
        del guard


def test_tripped_output_stays_safe(node: Any) -> None:
    with node.register("control") as control, node.register("drive") as endpoint:
        drive = Drive(endpoint, control.tid)
        drive.guard.trip()
        drive.guard.release()
        assert not drive.guard.is_live


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_failing_safe_function_is_called_again(node: Any) -> None:
    calls: List[str] = []
    done = threading.Event()

    def fails_twice(cause: str) -> None:
        calls.append(cause)
        if len(calls) < 3:
            raise RuntimeError("not yet")
        done.set()

    with node.register("control") as control, node.register("drive") as endpoint:
        guard = endpoint.guard(control.tid, TORQUE, fails_twice)
        guard.trip()
        assert done.wait(LONG), calls


def test_guard_works_from_asyncio(node: Any) -> None:
    async def main() -> None:
        async with node.register("control") as control, node.register("drive") as drive:
            is_safe = threading.Event()
            guard = await drive.guard(control.tid, TORQUE, lambda _: is_safe.set())

            async def listen(endpoint: sinew.AsyncEndpoint) -> None:
                async for _ in endpoint:
                    pass

            listening = [asyncio.create_task(listen(each)) for each in (control, drive)]
            until = time.monotonic() + LONG
            while not guard.is_live:
                assert time.monotonic() < until, f"{guard.cause}, {guard.tally}"
                await control.send_protected(drive.tid, TORQUE, {"nm": 1.0})
                await asyncio.sleep(0.02)
                try:
                    guard.arm()
                except sinew.NotGoodError:
                    continue
            is_safe.clear()
            loop = asyncio.get_running_loop()
            assert await loop.run_in_executor(None, is_safe.wait, LONG)
            for each in listening:
                each.cancel()
            await asyncio.gather(*listening, return_exceptions=True)

    asyncio.run(main())


def test_child_of_a_process_with_guards_cannot_guard(node: Any) -> None:
    """The thread that makes outputs safe is not in the child."""
    with node.register() as one:
        guard = one.guard(one.tid, TORQUE, lambda _: None)

        def guard_in_the_child() -> None:
            own = node.register().open()
            own.guard(own.tid, TORQUE, lambda _: None)

        assert is_refused_in_a_child(guard_in_the_child)
        assert not guard.is_live


def test_limits_that_nothing_can_keep_are_refused(node: Any) -> None:
    with node.register() as one:
        for wrong in (
            sinew.Protected("test.x", within=0.0, age_max=1.0),
            sinew.Protected("test.x", within=1.0, age_max=0.0),
            sinew.Protected("test.x", within=1.0, age_max=1.0, good_min=0),
            sinew.Protected("", within=1.0, age_max=1.0),
        ):
            with pytest.raises(ValueError):
                one.guard(one.tid, wrong, print)
    assert sinew.Protected.of_period("test.x", 0.005).within == pytest.approx(0.015)
