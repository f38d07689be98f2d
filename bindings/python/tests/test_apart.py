"""A Python process is an application apart: its pause is a stall of that application, and of nothing else."""

from __future__ import annotations

import os
import pathlib
import subprocess
import sys
from typing import Any

import pytest

import sinew
from helpers import LONG, received, running, until_gone
from sinew import Outcome

HOG = """
import sys, sinew
with sinew.register("hog", socket=sys.argv[1]) as me:
    print("up", flush=True)
    assert me.receive(60.0) is not None
    pow(7, int(sys.argv[2]))  # one call that holds the GIL
    print("over", flush=True)
    for message in me:
        with message:
            if message.value == "end":
                break
"""
POWER = 5_000_000
"""Enough for a second on any machine."""


def test_pause_of_the_interpreter_stalls_no_other(node: Any) -> None:
    with running(HOG, node.socket, str(POWER)) as hog:
        with node.register("one") as one, node.register("other") as other:
            assert one.send_confirmed("hog", "apart.text", "go", within=LONG) is not Outcome.FAILED
            # It pauses now. Its own messages wait, and all others pass.
            assert one.send_confirmed("hog", "apart.text", "late", within=0.1) in (Outcome.UNKNOWN, Outcome.EXPIRED)
            for number in range(200):
                one.send(other.tid, "apart.number", number)
                assert received(other).value == number
            assert one.resolve("hog") is not None, "it is still registered"
            assert hog.stdout is not None and hog.stdout.readline() == "over\n"
            assert one.send_confirmed("hog", "apart.text", "end", within=LONG) is Outcome.DELIVERED
        assert hog.wait(LONG) == 0


def test_end_of_the_process_fails_the_message_in_hand(node: Any) -> None:
    program = """
import os, sys, sinew
with sinew.register("dies", socket=sys.argv[1]) as me:
    print("up", flush=True)
    message = me.receive(60.0)
    os._exit(1)
"""
    with running(program, node.socket), node.register() as one:
        assert one.send_confirmed("dies", "apart.text", "now", within=LONG) is Outcome.FAILED
        until_gone(one, "dies")


def test_socket_is_found_by_its_variable(node: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SINEW_SOCKET", node.socket)
    with sinew.register() as me:
        assert me.node_name == "knee"
    monkeypatch.delenv("SINEW_SOCKET")
    with pytest.raises(sinew.NoNodeError, match="SINEW_SOCKET"):
        sinew.register()


def test_first_program_of_the_readme_is_the_example() -> None:
    folder = pathlib.Path(__file__).parents[1]
    program = (folder / "examples" / "knee.py").read_text()
    assert f"```python\n{program}```" in (folder / "README.md").read_text()
    assert len(program.splitlines()) == 15, "the README counts them"


def test_example_runs(node: Any) -> None:
    example = pathlib.Path(__file__).parents[1] / "examples" / "hello.py"
    environment = {**os.environ, "SINEW_SOCKET": node.socket}
    command = [sys.executable, "-W", "error", str(example)]
    ran = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=2 * LONG)
    assert ran.returncode == 0, ran.stderr
    assert "the drive is at 4.5 degrees" in ran.stdout and "REJECTED_UNKNOWN_KIND: " in ran.stdout, ran.stdout
