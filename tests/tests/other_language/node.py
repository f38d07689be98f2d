"""A node in another language, written from docs/protocol alone: Python 3, standard library only.

usage: node.py PROJECT OWN_ADDRESS GROUP:PORT OWN_APP THEIR_APP KIND COUNT

It says that it is there (ndl.md), lets itself be dialled (gncl.md), publishes its one application (sync.md), sends COUNT confirmed
messages of KIND to THEIR_APP when that is ready, confirms as many that come for OWN_APP, and leaves in order. Each step is a line
of its standard output.
"""

import secrets, select, socket, struct, sys, time, zlib

QUERY, ANSWER, LEAVE = 0x20, 0x21, 0x22
HELLO, WELCOME, REFUSAL, PING, PONG, GOODBYE, ACK, VOID, OUTCOMES = range(0x10, 0x19)
OUTCOME, DIRECTORY = 0x01, 0x30
CONFIRM, ASK, REPLY, IS_OUTCOME = 1, 2, 4, 8
SYNC, GNCL, NDL, EVERY = 2, 3, 4, 0xffffffff
DELIVERED, NO_SUCH_APPLICATION, UNKNOWN_KIND = 0, 16, 18
HEADER = struct.Struct("<2sBBIIBBHQQQQQI")  # and 4 bytes of checksum

project, own_address, group, own_app, their_app, kind_name, count = sys.argv[1:]
count = int(count)
here, = struct.unpack(">I", socket.inet_aton(own_address))
us = here << 32 | 0x1001
incarnation, boot_nonce, period = time.time_ns(), secrets.randbits(64), 0.5


def say(*words):
    print(*words, flush=True)


# MessagePack, as much of it as is needed.

def pack(value):
    if value is None or value is True or value is False:
        return {None: b"\xc0", False: b"\xc2", True: b"\xc3"}[value]
    if isinstance(value, dict):
        return bytes([0x80 + len(value)]) + b"".join(pack(k) + pack(v) for k, v in value.items())
    if isinstance(value, list):
        return b"\xdc" + struct.pack(">H", len(value)) + b"".join(map(pack, value))
    if isinstance(value, str):
        text = value.encode()
        return b"\xd9" + bytes([len(text)]) + text
    return bytes([value]) if value < 0x80 else b"\xcf" + struct.pack(">Q", value)


def unpack(data, at=0):
    """A value, and where the next one begins."""
    first, at = data[at], at + 1

    def number(size):
        return int.from_bytes(data[at:at + size], "big"), at + size

    def several(length, at):
        values = []
        for _ in range(length):
            value, at = unpack(data, at)
            values.append(value)
        return values, at

    if first < 0x80:
        return first, at
    if first >= 0xe0:
        return first - 0x100, at
    if first in (0xc0, 0xc2, 0xc3):
        return {0xc0: None, 0xc2: False, 0xc3: True}[first], at
    if first in (0xcc, 0xcd, 0xce, 0xcf):
        return number(1 << first - 0xcc)
    if first < 0xa0 or 0xdc <= first <= 0xdf:
        length, at = (first & 15, at) if first < 0xa0 else number(4 if first & 1 else 2)
        if first & 0xf0 == 0x90 or first in (0xdc, 0xdd):
            return several(length, at)
        values, at = several(2 * length, at)
        return dict(zip(values[::2], values[1::2])), at
    if first < 0xc0:
        length = first & 31
    elif first in (0xc4, 0xc5, 0xc6):
        length, at = number(1 << first - 0xc4)
        return data[at:at + length], at + length
    else:
        length, at = number(1 << first - 0xd9)
    return data[at:at + length].decode(), at + length


# Frames (frame.md).

def kind_of(name):
    hash_ = 0x811c9dc5
    for byte in name.encode():
        hash_ = (hash_ ^ byte) * 0x01000193 & 0xffffffff
    return hash_ | 0x80000000


def frame(kind, source, destination, payload=b"", flags=0, number=0, sequence=0, correlation=0, guarded=False):
    if guarded:
        sequence |= (zlib.crc32(struct.pack("<2sBBI", b"Sw", 1, 64, len(payload))) & 0xffff) << 48
    head = HEADER.pack(b"Sw", 1, 64, len(payload), kind, 0, flags, number & 0xffff, source, destination, sequence,
                       correlation, time.monotonic_ns(), 0)
    return head + struct.pack("<I", zlib.crc32(payload, zlib.crc32(head))) + payload


class Frame:
    def __init__(self, data, guarded=False):
        magic, version, head, length, self.kind, self.cls, self.flags, self.number, self.source, self.destination, \
            sequence, self.correlation, self.sent, _ = HEADER.unpack(data[:60])
        assert (magic, version, head, length) == (b"Sw", 1, 64, len(data) - 64)
        if guarded:
            assert sequence >> 48 == zlib.crc32(data[:8]) & 0xffff
        self.payload = data[64:]
        assert struct.unpack("<I", data[60:64])[0] == zlib.crc32(self.payload, zlib.crc32(data[:60]))


# Discovery (ndl.md): who asks is answered, and the group is asked each period, so that we are heard.

listener = socket.create_server((own_address, 0))
udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
udp.bind((own_address, 0))
udp.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(own_address))
udp.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 1)
group_address = (group.split(":")[0], int(group.split(":")[1]))
announcement = {"project": project, "node": here, "name": "python", "incarnation": incarnation, "boot_nonce": boot_nonce,
                "gncl_ip": here, "gncl_port": listener.getsockname()[1], "period_us": int(period * 1e6)}
askers = {}  # node: its address


def ask_the_group():
    query = frame(QUERY, here << 32 | NDL, EVERY << 32 | NDL, pack(announcement), ASK, correlation=secrets.randbits(64))
    udp.sendto(query, group_address)


def read_datagram():
    received = time.monotonic_ns()
    data, address = udp.recvfrom(2048)
    query = Frame(data)
    if query.kind != QUERY:
        return  # an answer to our query to the group: whoever gave it asks us, too
    them, _ = unpack(query.payload)
    if them["project"] != project or them["boot_nonce"] == boot_nonce or query.source != them["node"] << 32 | NDL:
        return
    if them["node"] not in askers:
        say("asked by", them["name"])
    askers[them["node"]] = address
    answer = {"announcement": announcement, "query_sent_ns": query.sent, "query_received_ns": received}
    udp.sendto(frame(ANSWER, here << 32 | NDL, query.source, pack(answer), REPLY, correlation=query.correlation), address)


# One link (gncl.md), and the session over it, which outlives it.

class Link:
    def __init__(self, connection):
        self.connection, self.buffer, self.peer, self.guarded, self.has_heard = connection, b"", None, False, False

    def own(self, kind, value=None):
        payload = b"" if value is None else pack(value)
        self.connection.sendall(frame(kind, here << 32 | GNCL, self.peer << 32 | GNCL, payload, guarded=self.guarded))

    def frames(self):
        """The frames that are there; None at the end of the connection."""
        data = self.connection.recv(65536)
        self.buffer += data
        if not data:
            yield None
        while len(self.buffer) >= 64:
            end = 64 + int.from_bytes(self.buffer[4:8], "little")
            if len(self.buffer) < end:
                return
            data, self.buffer = self.buffer[:end], self.buffer[end:]
            yield Frame(data, self.guarded)


link = None
memory = epoch = time.monotonic_ns()
their_epoch, their_next, untold = 0, 1, 0
next_number, kept = 1, []  # what the peer has not acknowledged: (number, everything that its frame is made of)
change, held, until = -1, [], 0  # whom the peer holds back; the number before which it has room
version, sequence = 0, 0
sent, told, confirmed = 0, 0, 0
destination = None


def send(kind, source, to, payload=b"", flags=0, correlation=0):
    """A message of the session: numbered, and kept until it is acknowledged (SESSION-1, SESSION-2)."""
    global next_number, sequence
    sequence += 1
    kept.append((next_number, (kind, source, to, payload, flags, next_number, sequence, correlation)))
    next_number += 1
    if link and link.has_heard:
        link.connection.sendall(frame(*kept[-1][1], guarded=link.guarded))


def acknowledge():
    global untold
    untold = 0
    link.own(ACK, {"memory": memory, "epoch": epoch, "of": their_epoch, "next": their_next})


def introduced(hello):
    """The dialler's HELLO: answered by WELCOME, then each side says what it takes next (GNCL-2, SESSION-3)."""
    global change
    them, _ = unpack(hello.payload)
    assert hello.kind == HELLO and them["project"] == project and them["peer"] == here
    link.peer = them["node"]
    ours = {"project": project, "node": here, "name": "python", "incarnation": incarnation, "peer": link.peer, "dial": 0,
            "payload_max": 65536, "features": ["guard", "outcomes"]}
    link.own(WELCOME, ours)
    link.guarded = "guard" in them["features"]
    change = -1
    say("linked with", them["name"])
    acknowledge()


def heard(ack):
    """Who the peer says that it is, what it has, whom it holds back, and for how much it has room (SESSION-5, CREDIT-2, CREDIT-5)."""
    global their_epoch, their_next, change, held, until
    if ack["epoch"] > their_epoch:
        their_epoch, their_next = ack["epoch"], 1
    has_before = ack["next"] if ack["of"] == epoch else 1
    kept[:] = [one for one in kept if one[0] >= has_before]
    # Our frames are too short for the bytes to count.
    until = max(until, has_before + ack.get("room", [1024])[0])
    if ack.get("change", 0) > change:
        change, held = ack.get("change", 0), ack.get("held", [])
    if not link.has_heard:
        link.has_heard = True
        for _, message in kept:
            link.connection.sendall(frame(*message, guarded=link.guarded))
        publish()


def publish():
    """The directory of this node: when the link comes up, and every 2 s (SYNC-2)."""
    global version
    version += 1
    entries = [{"name": own_app, "app": us & 0xffffffff, "ready": True, "requires": []}]
    send(DIRECTORY, here << 32 | SYNC, link.peer << 32 | SYNC,
         pack({"incarnation": incarnation, "version": version, "entries": entries, "groups": []}))


def take(message):
    """A message of the session: the next one, and no other (SESSION-4)."""
    global their_next, untold, destination, told, confirmed
    assert message.number == their_next & 0xffff, (message.number, their_next)
    their_next, untold = their_next + 1, untold + 1
    if message.kind == DIRECTORY:
        for entry in unpack(message.payload)[0]["entries"]:
            if entry["name"] == their_app and entry["ready"] and destination is None:
                destination = link.peer << 32 | entry["app"]
                say("found", their_app)
    elif message.kind == OUTCOME:
        told += 1
        say("outcome", message.correlation, message.payload[0])
    elif message.kind == OUTCOMES:
        for _, _, correlation, outcome in struct.iter_unpack("<IIQB", message.payload):
            told += 1
            say("outcome", correlation, outcome)
    elif message.flags & CONFIRM:
        if message.destination != us:
            outcome = NO_SUCH_APPLICATION
        elif message.kind != kind_of(kind_name):
            outcome = UNKNOWN_KIND
        else:
            outcome, confirmed = DELIVERED, confirmed + 1
            say("got", unpack(message.payload)[0]["number"])
        send(OUTCOME, message.destination, message.source, bytes([outcome]), IS_OUTCOME, message.correlation)


def obey(message):
    if message is None or message.kind == REFUSAL:
        sys.exit("the connection ended: " + ("" if message is None else unpack(message.payload)[0]["sentence"]))
    if link.peer is None:
        introduced(message)
    elif message.kind == PING:
        link.own(PONG)
    elif message.kind == ACK:
        heard(unpack(message.payload)[0])
    elif message.kind == GOODBYE:
        acknowledge()
        sys.exit("the peer leaves")
    elif message.kind != PONG:
        take(message)


def is_done():
    return told >= count and confirmed >= count and not kept


asked = published = acknowledged = -10.0
while not is_done():
    ready, _, _ = select.select([udp, listener] + ([link.connection] if link else []), [], [], 0.05)
    if udp in ready:
        read_datagram()
    if link and link.connection in ready:
        for message in link.frames():
            obey(message)
    if listener in ready:
        # The dialler would not dial if it had a link (GNCL-5).
        link = Link(listener.accept()[0])
        link.connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    now = time.monotonic()
    if now - asked >= period:
        asked = now
        ask_the_group()
    if link and link.has_heard:
        if now - published >= 2:
            published = now
            publish()
        if untold >= 32 or untold and now - acknowledged >= 1:
            acknowledged = now
            acknowledge()
        is_held = destination and destination & 0xffffffff in held  # class Control is 0
        if destination and sent < count and next_number < until and not is_held:
            sent += 1
            send(kind_of(kind_name), us, destination, pack({"number": sent}), CONFIRM, sent)

# In order (NDL-4.4, GNCL-10): what the peer has sent is acknowledged, then it is said to all that we leave.
acknowledge()
for node, address in askers.items():
    udp.sendto(frame(LEAVE, here << 32 | NDL, node << 32 | NDL, pack(announcement)), address)
link.own(GOODBYE)
link.connection.settimeout(5)
while link.connection.recv(65536):
    pass
say("left")
