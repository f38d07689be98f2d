"""Real nodes for the tests: the programs `sinew-node` and `sinew-python-peer` of the workspace.

Build them first: `cargo build -p sinew-node && cargo build -p sinew-python --examples`.
"""

from __future__ import annotations

import os
import pathlib
import shutil
import signal
import subprocess
import tempfile
import time
from typing import Any, Callable, Iterator, List, Optional

import pytest

import sinew

ROOT = pathlib.Path(__file__).resolve().parents[3]
WATCHDOG = 30.0
"""Seconds after which a test has failed. No test needs so long."""


def program(name: str) -> str:
    """Returns the path of a program of the workspace, as the last build left it."""
    target = pathlib.Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target"))
    for path in (target / "debug" / name, target / "debug" / "examples" / name):
        if path.exists():
            return str(path)
    build = "cargo build -p sinew-node && cargo build -p sinew-python --examples"
    raise FileNotFoundError(f"{name} is not in {target}/debug; build it: {build}")


class Node:
    """A node in a process of its own."""

    def __init__(self, folder: pathlib.Path, name: str, program_name: str, settings: str, address: str) -> None:
        self.name = name
        self.socket = str(folder / f"{name}.sock")
        self._program = program(program_name)
        self._file = folder / f"{name}.toml"
        self._log = folder / f"{name}.log"
        self._file.write_text(
            f"[node]\nname = '{name}'\nproject = '{folder.name}'\naddress = '{address}'\n"
            f"[lncl]\nsocket = '{self.socket}'\n"
            f"[ndl]\nmdns_port = false\n{settings}"
        )
        self._process: Optional[subprocess.Popen[bytes]] = None
        self.start()

    def start(self) -> None:
        """Starts it, and waits until it accepts registrations. A recording has begun by then."""
        self._log.write_bytes(b"")
        log = self._log.open("ab")
        self._process = subprocess.Popen([self._program, str(self._file)], stdout=log, stderr=log)
        log.close()
        until = time.monotonic() + WATCHDOG
        while True:
            try:
                sinew.register(socket=self.socket, deadline=5.0).open().close()
                if self._is_up():
                    return
                time.sleep(0.02)  # until it prints that it is up, or the deadline
                assert time.monotonic() < until, f"{self.name} does not come up\n{self.log()}"
            except sinew.SinewError as error:
                if self._process.poll() is not None or time.monotonic() > until:
                    raise AssertionError(f"{self.name} does not run: {error}\n{self.log()}") from None
                time.sleep(0.02)  # between two tries, until the deadline

    def _is_up(self) -> bool:
        """The peer in Rust prints nothing, and records nothing."""
        return not self._program.endswith("sinew-node") or "up" in self.log().splitlines()

    def log(self) -> str:
        return self._log.read_text(errors="replace")

    def send_signal(self, number: int) -> None:
        assert self._process is not None
        self._process.send_signal(number)

    def stop(self, number: int = signal.SIGTERM) -> None:
        """Ends it and waits for that."""
        if self._process is None:
            return
        self._process.send_signal(signal.SIGCONT)
        self._process.send_signal(number)
        try:
            self._process.wait(WATCHDOG)
        finally:
            self._process.kill()
            self._process.wait()
            self._process = None

    def register(self, name: Optional[str] = None, **options: Any) -> sinew.Registration:
        return sinew.register(name, socket=self.socket, **options)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--long", action="store_true", help="also the tests that take minutes")


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "long: takes minutes, and runs with --long alone")


def pytest_collection_modifyitems(config: pytest.Config, items: List[pytest.Item]) -> None:
    if config.getoption("--long"):
        return
    for item in items:
        if item.get_closest_marker("long"):
            item.add_marker(pytest.mark.skip(reason="it takes minutes: --long"))


@pytest.fixture
def start_node() -> Iterator[Callable[..., Node]]:
    """Starts nodes of one project, and ends them after the test."""
    # Short: the path of a socket has at most 107 bytes.
    folder = pathlib.Path(tempfile.mkdtemp(prefix="sinew-py-", dir="/tmp"))
    nodes: List[Node] = []

    def start(
        name: str = "knee", program_name: str = "sinew-node", settings: str = "", address: str = "127.0.0.1"
    ) -> Node:
        nodes.append(Node(folder, name, program_name, settings, address))
        return nodes[-1]

    yield start
    for node in nodes:
        node.stop()
    shutil.rmtree(folder)


@pytest.fixture
def node(start_node: Callable[..., Node]) -> Node:
    """A node without applications of its own."""
    return start_node()


@pytest.fixture
def peer(start_node: Callable[..., Node]) -> Node:
    """A node with the application `knee` in Rust."""
    return start_node(program_name="sinew-python-peer")


@pytest.fixture(autouse=True)
def watchdog(request: pytest.FixtureRequest) -> Iterator[None]:
    """Ends a test that hangs, with its stack."""
    import faulthandler

    is_long = request.node.get_closest_marker("long") is not None
    faulthandler.dump_traceback_later((40 if is_long else 4) * WATCHDOG, exit=True)
    yield
    faulthandler.cancel_dump_traceback_later()
