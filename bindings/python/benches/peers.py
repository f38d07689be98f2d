"""Sinew beside eclipse-zenoh and iceoryx2 of PyPI: messages of 1000 bytes between two processes of Python.

    pip install eclipse-zenoh iceoryx2
    python bindings/python/benches/peers.py [--node PROGRAM] [--runs 5] [--rounds 5000] [--messages 20000] [CASE...]

Each peer sleeps until it is woken; none polls. A message is `bytes` at the sender and at the receiver. Per run each case
has new processes, and the cases take turns. The table has the medians of the runs, and ratios to the faster of the others.

- Round trip: the other process sends each message back. Microseconds of the median and of the 99th percentile.
- Flood: messages as fast as possible, until the other process has confirmed the last one. No message is lost.

All traffic stays on this host: the node of Sinew and the session of zenoh have no discovery beyond loopback.
"""

from __future__ import annotations

import argparse
import asyncio
import ctypes
import json
import os
import pathlib
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from typing import Any, Dict, List, Optional, Tuple

SIZE = 1000
ECHO, COUNT, LAST, END = 0, 1, 2, 3
"""The first byte: send it back; count it; the last one, send it back; end."""
PORT = 17_447
WARM_UP = 200


def block(order: int) -> bytes:
    return bytes([order]) + bytes(SIZE - 1)


class Sinew:
    """The blocking form."""

    def __init__(self, is_echo: bool) -> None:
        import sinew

        self.me = sinew.register("echo" if is_echo else "client", requires=[] if is_echo else ["echo"]).open()
        self.to = None if is_echo else self.me.resolve("echo")

    def send(self, data: bytes) -> None:
        # It waits for room behind the messages that the other one has not taken yet.
        self.me.send(self.to, "peers.block", data, class_="bulk", room_within=30.0)

    def receive(self) -> bytes:
        message = self.me.receive()
        self.to = message.source
        return message.data

    def warm_up(self) -> None:
        pass


class Zenoh:
    """Peers with a link over TCP on loopback, with express messages that wait in place of being dropped."""

    def __init__(self, is_echo: bool) -> None:
        import zenoh

        own, other = ("pong", "ping") if is_echo else ("ping", "pong")
        config = zenoh.Config()
        config.insert_json5("mode", '"peer"')
        config.insert_json5("scouting/multicast/enabled", "false")
        config.insert_json5("scouting/gossip/enabled", "false")
        address = json.dumps([f"tcp/127.0.0.1:{PORT}"])
        config.insert_json5("listen/endpoints", address if is_echo else "[]")
        config.insert_json5("connect/endpoints", "[]" if is_echo else address)
        self.session = zenoh.open(config)
        self.subscriber = self.session.declare_subscriber(f"peers/{other}", zenoh.handlers.FifoChannel(256))
        self.publisher = self.session.declare_publisher(
            f"peers/{own}", congestion_control=zenoh.CongestionControl.BLOCK, express=True
        )

    def send(self, data: bytes) -> None:
        self.publisher.put(data)

    def receive(self) -> bytes:
        return bytes(self.subscriber.recv().payload)

    def warm_up(self) -> None:
        """Sends until the first echo: each declaration takes a moment to get there."""
        until = time.monotonic() + 20
        while time.monotonic() < until:
            self.send(block(ECHO))
            time.sleep(0.05)  # between two tries, until the deadline
            if self.subscriber.try_recv() is not None:
                break
        time.sleep(0.2)  # echoes of the tries
        while self.subscriber.try_recv() is not None:
            pass


class _Block(ctypes.Structure):
    _fields_ = [("data", ctypes.c_uint8 * SIZE)]


class Iceoryx2:
    """Shared memory, and an event that wakes the other one."""

    def __init__(self, is_echo: bool) -> None:
        import iceoryx2

        iceoryx2.set_log_level(iceoryx2.LogLevel.Error)
        self.node = iceoryx2.NodeBuilder.new().create(iceoryx2.ServiceType.Ipc)
        own, other = ("pong", "ping") if is_echo else ("ping", "pong")

        def name(direction: str) -> Any:
            return iceoryx2.ServiceName.new(f"sinew-peers-{os.environ['PEERS_ID']}-{direction}")

        def data(direction: str) -> Any:
            builder = self.node.service_builder(name(direction)).publish_subscribe(_Block)
            return builder.enable_safe_overflow(False).subscriber_max_buffer_size(256).open_or_create()

        def event(direction: str) -> Any:
            return self.node.service_builder(name(direction)).event().open_or_create()

        strategy = iceoryx2.BackpressureStrategy.RetryUntilDelivered
        self.services = [data(own), data(other), event(own), event(other)]
        self.publisher = self.services[0].publisher_builder().backpressure_strategy(strategy).create()
        self.subscriber = self.services[1].subscriber_builder().create()
        self.notifier = self.services[2].notifier_builder().create()
        self.listener = self.services[3].listener_builder().create()

    def send(self, data: bytes) -> None:
        self.publisher.send_copy(_Block.from_buffer_copy(data))
        self.notifier.notify()

    def receive(self) -> bytes:
        while True:
            sample = self.subscriber.receive()
            if sample is not None:
                data = ctypes.string_at(sample.payload_ptr, SIZE)
                sample.delete()
                return data
            self.listener.blocking_wait()

    def warm_up(self) -> None:
        pass


BLOCKING = {"sinew": Sinew, "zenoh": Zenoh, "iceoryx2": Iceoryx2}
CASES = [*BLOCKING, "sinew_asyncio"]
OTHERS = ("zenoh", "iceoryx2")


def echo(case: str) -> None:
    peer: Any = BLOCKING[case](True)
    print("up", flush=True)
    while True:
        data = peer.receive()
        order = data[0]
        if order in (ECHO, LAST):
            peer.send(data)
        if order == END:
            return


def client(case: str, rounds: int, messages: int) -> Dict[str, Any]:
    peer: Any = BLOCKING[case](False)
    peer.warm_up()
    ping, times = block(ECHO), []
    for number in range(WARM_UP + rounds):
        began = time.perf_counter_ns()
        peer.send(ping)
        assert peer.receive() == ping
        if number >= WARM_UP:
            times.append(time.perf_counter_ns() - began)
    count, last = block(COUNT), block(LAST)
    began = time.perf_counter_ns()
    for _ in range(messages - 1):
        peer.send(count)
    peer.send(last)
    assert peer.receive() == last
    took = time.perf_counter_ns() - began
    peer.send(block(END))
    return summary(times, messages, took)


def summary(times: List[int], messages: int, took_ns: int) -> Dict[str, Any]:
    times.sort()
    return {
        "p50_us": times[len(times) // 2] / 1e3,
        "p99_us": times[len(times) * 99 // 100] / 1e3,
        "per_s": messages / took_ns * 1e9,
    }


async def echo_asyncio() -> None:
    import sinew

    async with sinew.register("echo") as me:
        print("up", flush=True)
        async for message in me:
            data = message.data
            if data[0] in (ECHO, LAST):
                await me.send(message.source, "peers.block", data, class_="bulk", room_within=30.0)
            if data[0] == END:
                return


async def client_asyncio(rounds: int, messages: int) -> Dict[str, Any]:
    import sinew

    async with sinew.register("client", requires=["echo"]) as me:
        to = await me.resolve("echo")
        ping, times = block(ECHO), []

        async def send(data: bytes) -> None:
            await me.send(to, "peers.block", data, class_="bulk", room_within=30.0)

        for number in range(WARM_UP + rounds):
            began = time.perf_counter_ns()
            await send(ping)
            assert (await me.receive()).data == ping
            if number >= WARM_UP:
                times.append(time.perf_counter_ns() - began)
        count, last = block(COUNT), block(LAST)
        began = time.perf_counter_ns()
        for _ in range(messages - 1):
            await send(count)
        await send(last)
        assert (await me.receive()).data == last
        took = time.perf_counter_ns() - began
        await send(block(END))
        return summary(times, messages, took)


def measure(case: str, number: int, rounds: int, messages: int) -> Dict[str, Any]:
    """Runs one case in two new processes."""
    environment = {**os.environ, "PEERS_ID": f"{os.getpid()}-{number}"}
    program = [sys.executable, os.path.abspath(__file__)]
    other = subprocess.Popen([*program, "--echo", case], stdout=subprocess.PIPE, text=True, env=environment)
    try:
        assert other.stdout is not None and other.stdout.readline() == "up\n", f"the echo of {case} does not start"
        arguments = ["--client", case, "--rounds", str(rounds), "--messages", str(messages)]
        ran = subprocess.run([*program, *arguments], stdout=subprocess.PIPE, text=True, env=environment, timeout=300)
        assert ran.returncode == 0, f"the client of {case} has failed"
        other.wait(20)
        result: Dict[str, Any] = json.loads(ran.stdout.splitlines()[-1])
        return result
    finally:
        other.kill()
        other.wait()
        if other.stdout is not None:
            other.stdout.close()


def start_node(program: str, folder: pathlib.Path) -> Tuple[subprocess.Popen[bytes], str]:
    socket = folder / "peers.sock"
    settings = folder / "node.toml"
    settings.write_text(
        f"[node]\nname = 'peers'\nproject = '{folder.name}'\n[lncl]\nsocket = '{socket}'\n"
        "[ndl]\nmulticast = false\nmdns_port = false\n"
    )
    node = subprocess.Popen([program, str(settings)], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
    assert node.stdout is not None and node.stdout.readline() == b"up\n", f"{program} does not start"
    return node, str(socket)


def table(found: Dict[str, List[Dict[str, Any]]]) -> List[str]:
    """Returns the rows: medians, and their ratios to the better of the others."""

    def median(case: str, key: str) -> Optional[float]:
        return statistics.median(each[key] for each in found[case]) if found.get(case) else None

    trips = [value for value in (median(case, "p50_us") for case in OTHERS) if value is not None]
    floods = [value for value in (median(case, "per_s") for case in OTHERS) if value is not None]
    lines = [
        "| case | round trip p50, us | ratio to the faster other | p99, us | flood, messages/s | ratio to the faster other |",
        "| --- | ---: | ---: | ---: | ---: | ---: |",
    ]
    for case, runs in found.items():
        if runs:
            trip, tail, flood = (statistics.median(each[key] for each in runs) for key in ("p50_us", "p99_us", "per_s"))
            ratio = f"{trip / min(trips):.2f}" if trips else "-"
            share = f"{flood / max(floods):.2f}" if floods else "-"
            lines.append(f"| {case} | {trip:.1f} | {ratio} | {tail:.1f} | {flood:,.0f} | {share} |")
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--node", default=shutil.which("sinew-node"), help="the program sinew-node")
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--rounds", type=int, default=5_000)
    parser.add_argument("--messages", type=int, default=20_000)
    parser.add_argument("--echo", help=argparse.SUPPRESS)
    parser.add_argument("--client", help=argparse.SUPPRESS)
    parser.add_argument("cases", nargs="*", metavar="CASE", help=f"of {', '.join(CASES)}; default all")
    given = parser.parse_args()
    if given.echo:
        return asyncio.run(echo_asyncio()) if given.echo == "sinew_asyncio" else echo(given.echo)
    if given.client:
        is_asyncio = given.client == "sinew_asyncio"
        amounts = given.rounds, given.messages
        return print(json.dumps(asyncio.run(client_asyncio(*amounts)) if is_asyncio else client(given.client, *amounts)))
    if given.node is None:
        parser.error("there is no sinew-node in $PATH: install the wheel with the tools, or give --node PROGRAM")
    cases = given.cases or CASES
    if set(cases) - set(CASES):
        parser.error(f"the cases are {', '.join(CASES)}")
    folder = pathlib.Path(tempfile.mkdtemp(prefix="sinew-peers-", dir="/tmp"))
    node, os.environ["SINEW_SOCKET"] = start_node(given.node, folder)
    found: Dict[str, List[Dict[str, Any]]] = {case: [] for case in cases}
    try:
        for number in range(given.runs):
            for case in cases:
                found[case].append(measure(case, number, given.rounds, given.messages))
                print(json.dumps({"case": case, "run": number, **found[case][-1]}), flush=True)
    finally:
        node.terminate()
        node.wait()
        if node.stdout is not None:
            node.stdout.close()
        shutil.rmtree(folder)
    print(f"\n{os.cpu_count()} CPUs, load {os.getloadavg()[0]:.1f}, medians of {given.runs} runs, {SIZE} bytes\n")
    print("\n".join(table(found)))


main()
