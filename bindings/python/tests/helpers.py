"""Parts that several tests have: waits with a deadline, threads, and programs beside the test."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import threading
import time
from typing import Any, Callable, Iterator, List

import sinew

LONG = 20.0
"""Seconds for each wait: enough on any machine, and less than those of the watchdog."""


def received(endpoint: sinew.Endpoint) -> sinew.Message:
    """Returns the next message of an endpoint."""
    message = endpoint.receive(LONG)
    assert message is not None, "no message arrived"
    return message


def until(claim: Callable[[], bool], otherwise: str) -> None:
    """Waits until a claim is true."""
    deadline = time.monotonic() + LONG
    while not claim():
        assert time.monotonic() < deadline, otherwise
        time.sleep(0.001)  # between two looks, until the deadline


def until_gone(endpoint: sinew.Endpoint, name: str) -> None:
    """Waits until no application has the name."""
    until(lambda: endpoint.resolve(name) is None, f"{name} is still taken")


def in_thread(work: Callable[[], Any]) -> Callable[[], Any]:
    """Runs `work` beside the test. Returns a function that waits for its result."""
    results: List[Any] = []

    def run() -> None:
        try:
            results.append(work())
        except BaseException as error:
            results.append(error)

    thread = threading.Thread(target=run)
    thread.start()

    def join() -> Any:
        thread.join(LONG)
        assert results, "the thread has not ended"
        if isinstance(results[0], BaseException):
            raise results[0]
        return results[0]

    return join


@contextlib.contextmanager
def running(program: str, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    """A program in a process of its own. It has printed its first line, `up`, and is killed at the end."""
    command = [sys.executable, "-c", program, *arguments]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        assert process.stdout.readline() == "up\n"
        yield process
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


def is_refused_in_a_child(call: Callable[[], Any]) -> bool:
    """Whether a call raises `ForkedError` in the child of a fork."""
    refused = 42
    child = os.fork()
    if child == 0:
        try:
            call()
        except sinew.ForkedError:
            os._exit(refused)
        finally:
            os._exit(1)
    _, status = os.waitpid(child, 0)
    return os.waitstatus_to_exitcode(status) == refused
