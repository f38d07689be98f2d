"""A program that its node starts and restarts: `[[command]]`."""

from __future__ import annotations

import json
import pathlib
import sys
import time
from typing import Any, Callable, Sequence

import pytest

import sinew
from helpers import LONG, until
from sinew import Outcome

PROGRAM = """
import os, time, sinew

with sinew.register(os.environ["SINEW_NAME"]) as me:
    print("the drive is homed")
    me.ready()
    for message in me:
        if message.is_kind("test.who"):
            me.reply(message, "test.me", {"pid": os.getpid()})
        elif message.is_kind("test.crash"):
            os._exit(3)
        elif message.is_kind("test.pause"):
            time.sleep(600)
"""
EXAMPLE = pathlib.Path(__file__).parents[1] / "examples" / "drive.py"


def settings(more: str = "", program: Sequence[str] = ("-c", PROGRAM)) -> str:
    """A command that runs the program with this Python."""
    run = json.dumps([sys.executable, "-u", *program])
    return f"[[command]]\nname = 'knee.drive'\nrun = {run}\nready = 'called'\n{more}"


def pid_of(me: sinew.Endpoint) -> int:
    """Asks the drive for its process. A process that ends takes a question along."""
    until = time.monotonic() + LONG
    while True:
        try:
            return int(me.ask("knee.drive", "test.who", {}, within=5.0).value["pid"])
        except sinew.SinewError:
            assert time.monotonic() < until, "the drive does not answer"


@pytest.mark.parametrize("how", ["test.crash", "test.pause"])
def test_failed_program_is_started_again(start_node: Callable[..., Any], how: str) -> None:
    node = start_node(settings=settings("hang_ms = 500\n"))
    with node.register(requires=["knee.drive"]) as me:
        first = pid_of(me)
        me.send("knee.drive", how, {})
        until = time.monotonic() + LONG
        while pid_of(me) == first:
            assert time.monotonic() < until, "it is not started again"
    assert "the drive is homed" in node.log()
    why = "exit code 3" if how == "test.crash" else "has read nothing"
    assert why in node.log(), node.log()


def test_example_is_started_and_takes_angles(start_node: Callable[..., Any]) -> None:
    node = start_node(settings=settings("while_down = 'drop'\n", [str(EXAMPLE)]))
    with node.register(requires=["knee.drive"]) as me:
        angle = {"degrees": 12.5}
        assert me.send_confirmed("knee.drive", "demo.joint_angle", angle, within=LONG) is Outcome.DELIVERED
        until(lambda: "12.5 degrees" in node.log(), "its output is no line of the log")
        assert me.send_confirmed("knee.drive", "demo.other", {}, within=LONG) is Outcome.REJECTED_UNKNOWN_KIND


def test_idle_program_is_left_alone(start_node: Callable[..., Any]) -> None:
    node = start_node(settings=settings("hang_ms = 100\n"))
    with node.register(requires=["knee.drive"]) as me:
        first = pid_of(me)
        # Ten times its limit: it waits for messages, which is no hang.
        assert me.receive(1.0) is None
        assert pid_of(me) == first


def test_name_of_a_command_is_for_its_program_alone(start_node: Callable[..., Any]) -> None:
    node = start_node(settings=settings())
    with node.register(requires=["knee.drive"]):
        with pytest.raises(sinew.SinewError, match="belongs to a command of this node"):
            node.register("knee.drive").open()


def test_ready_has_no_effect_without_a_supervisor(node: Any) -> None:
    with node.register("knee.drive") as me:
        me.ready()
        with node.register(requires=["knee.drive"]) as other:
            assert other.resolve("knee.drive") == me.tid
