"""A node in another language, written from docs/protocol alone: Python 3, standard library only.

usage: node.py PROJECT OWN_ADDRESS GROUP:PORT OWN_APP THEIR_APP KIND COUNT [VALUE_KIND VALUE]

It says that it is there (ndl.md), lets itself be dialled (gncl.md), publishes its one application (sync.md), sends COUNT confirmed
messages of KIND to THEIR_APP when that is ready, confirms as many that come for OWN_APP, and leaves in order. Each step is a line
of its standard output. With VALUE_KIND it has a connection for each class, sends VALUE as a value of class Stream by datagram until that is
acknowledged, and stays until a value has come by datagram.
"""

import secrets, select, socket, struct, sys, time, zlib

QUERY, ANSWER, LEAVE = 0x20, 0x21, 0x22
HELLO, WELCOME, REFUSAL, PING, PONG, GOODBYE, ACK, VOID, OUTCOMES, DATAGRAMS = range(0x10, 0x1a)
OUTCOME_RUNS = 0x1b
OUTCOME, DIRECTORY = 0x01, 0x30
CONFIRM, ASK, REPLY, IS_OUTCOME = 1, 2, 4, 8
SYNC, GNCL, NDL, EVERY = 2, 3, 4, 0xffffffff
DELIVERED, NO_SUCH_APPLICATION, UNKNOWN_KIND = 0, 16, 18
HEADER = struct.Struct("<2sBBIIBBHQQQQQI")  # and 4 bytes of checksum

project, own_address, group, own_app, their_app, kind_name, count = sys.argv[1:8]
value_kind, value = sys.argv[8:] or (None, None)
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


def frame(kind, source, destination, payload=b"", flags=0, number=0, sequence=0, correlation=0, guarded=False, cls=0):
    if guarded:
        sequence |= (zlib.crc32(struct.pack("<2sBBI", b"Sw", 1, 64, len(payload))) & 0xffff) << 48
    head = HEADER.pack(b"Sw", 1, 64, len(payload), kind, cls, flags, number & 0xffff, source, destination, sequence,
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
requesters = {}  # node: its address


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
    if them["node"] not in requesters:
        say("asked by", them["name"])
    requesters[them["node"]] = address
    answer = {"announcement": announcement, "query_sent_ns": query.sent, "query_received_ns": received}
    udp.sendto(frame(ANSWER, here << 32 | NDL, query.source, pack(answer), REPLY, correlation=query.correlation), address)



# A link (gncl.md): a connection, or one for each class, each with a session, which outlives it.

class Session:
    def __init__(self):
        self.link = None
        self.memory = self.epoch = time.monotonic_ns()
        self.their_epoch, self.their_next, self.untold, self.acknowledged = 0, 1, 0, -10.0
        self.next_number, self.kept = 1, []  # what the peer has not acknowledged: (number, everything that its frame is made of)
        self.change, self.held, self.until = -1, [], 0  # whom the peer holds back; the number before which it has room

    def send(self, kind, source, to, payload=b"", flags=0, correlation=0):
        """A message of the session: numbered, and kept until it is acknowledged (SESSION-1, SESSION-2)."""
        global sequence
        sequence += 1
        self.kept.append((self.next_number, (kind, source, to, payload, flags, self.next_number, sequence, correlation)))
        self.next_number += 1
        if self.link and self.link.has_heard:
            self.link.write(*self.kept[-1][1])

    def acknowledge(self):
        self.untold = 0
        self.link.own(ACK, {"memory": self.memory, "epoch": self.epoch, "of": self.their_epoch, "next": self.their_next})

    def heard(self, ack):
        """Who the peer says that it is, what it has, whom it holds back, and for how much it has room (SESSION-5, CREDIT-2, CREDIT-5)."""
        if ack["epoch"] > self.their_epoch:
            self.their_epoch, self.their_next = ack["epoch"], 1
        has_before = ack["next"] if ack["of"] == self.epoch else 1
        self.kept = [one for one in self.kept if one[0] >= has_before]
        # Our frames are too short for the bytes to count.
        self.until = max(self.until, has_before + ack.get("room", [1024])[0])
        if ack.get("change", 0) > self.change:
            self.change, self.held = ack.get("change", 0), ack.get("held", [])
        if not self.link.has_heard:
            self.link.has_heard = True
            for _, message in self.kept:
                self.link.write(*message)
            if self is control:
                publish()
            elif self is sessions["stream"]:
                stream_by_datagram.announce(self.link)


class Link:
    def __init__(self, connection):
        self.connection, self.buffer, self.guarded, self.has_heard, self.session = connection, b"", False, False, None

    def write(self, *parts):
        self.connection.sendall(frame(*parts, guarded=self.guarded))

    def own(self, kind, value=None):
        self.write(kind, here << 32 | GNCL, peer << 32 | GNCL, b"" if value is None else pack(value))

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


# Values of class Stream by datagram (gncl.md, Datagrams).

class Datagrams:
    """One socket beside the connection for Stream; PREFIX and the acknowledgement as the page has them."""
    PREFIX, ACKNOWLEDGEMENT, RANGE = struct.Struct("<BBHIQII"), struct.Struct("<IIQB3x"), struct.Struct("<QI")
    IS_ACK, IS_VALUE, IS_PROBE = 1, 2, 4
    PROBED = 1200  # bytes of a probe: our value is shorter (DATAGRAM-7)

    def __init__(self):
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind((own_address, 0))
        self.key, self.their_address, self.their_key = secrets.randbits(64), None, None
        self.newest, self.got = {}, 0  # by flow; and how many were newer than all before them
        self.probe = time.monotonic_ns()  # the number of a probe, and behind it of our value (DATAGRAM-3)
        self.number, self.is_open, self.is_acknowledged, self.due, self.wait = self.probe + 1, False, False, 0.0, 0.02

    def announce(self, link):
        """Where we read, to be said behind the first ACK (DATAGRAM-2)."""
        link.own(DATAGRAMS, {"port": self.socket.getsockname()[1], "key": self.key})

    def announced(self, link, said):
        address = socket.inet_ntoa(struct.pack(">I", said["address"])) if said.get("address", 0) else link.connection.getpeername()[0]
        self.their_address, self.their_key = (address, said["port"]), said["key"]

    def say(self, what, acknowledgement=b"", probe=b"", value=b""):
        stamp = time.monotonic_ns() // 1000 & 0xffffffff
        start = self.PREFIX.pack(1, what, 0, here, self.their_key, stamp, 0)[:20]
        checksum = zlib.crc32(acknowledgement + probe, zlib.crc32(start))
        self.socket.sendto(start + struct.pack("<I", checksum) + acknowledgement + probe + value, self.their_address)

    def is_new(self, message):
        """Whether this is newer than all before it of its flow, whichever way it came (DATAGRAM-3)."""
        flow = message.source, message.destination, message.kind
        is_new = message.correlation > self.newest.get(flow, 0)
        self.newest[flow] = max(message.correlation, self.newest.get(flow, 0))
        return is_new

    def read(self):
        data, _ = self.socket.recvfrom(2048)
        if len(data) < 24:
            return
        version, what, tag, node, key, stamp, checksum = self.PREFIX.unpack(data[:24])
        if (version, tag, node, key) != (1, 0, peer, self.key) or self.their_key is None:
            return  # DATAGRAM-1
        end = 24
        if what & self.IS_ACK:
            ranges_at = end + self.ACKNOWLEDGEMENT.size
            count = self.ACKNOWLEDGEMENT.unpack(data[end:ranges_at])[3]
            end = ranges_at + count * self.RANGE.size
            ranges = list(self.RANGE.iter_unpack(data[ranges_at:end]))
        of_probe = data[end:end + 8] if what & self.IS_PROBE else b""
        assert checksum == zlib.crc32(data[24:end] + of_probe, zlib.crc32(data[:20]))
        if what & self.IS_ACK:
            has = lambda number: any(first <= number <= first + behind for first, behind in ranges)
            self.is_open = self.is_open or has(self.probe)
            if has(self.number) and not self.is_acknowledged:
                self.is_acknowledged = True
                say("value acknowledged")
        came = list(struct.unpack("<Q", of_probe)) if of_probe else []
        if what & self.IS_VALUE:
            message = Frame(data[end:])
            assert (message.cls, message.flags) == (1, 0) and message.source >> 32 == peer
            came = [message.correlation]
            if self.is_new(message):
                self.got += 1
                say("value", unpack(message.payload)[0]["number"], "by datagram")
        if what & (self.IS_VALUE | self.IS_PROBE):
            ranges = b"".join(self.RANGE.pack(number, 0) for number in came)
            self.say(self.IS_ACK, self.ACKNOWLEDGEMENT.pack(stamp, 0, self.got, len(came)) + ranges)

    def tick(self, now):
        """Probes until one is acknowledged, then sends our value until it is acknowledged (DATAGRAM-4, DATAGRAM-5)."""
        if self.their_key is None or destination is None or self.is_acknowledged or now < self.due:
            return
        self.due, self.wait = now + self.wait, min(2 * self.wait, 0.25)
        if self.is_open:
            payload = pack({"number": int(value)})
            self.say(self.IS_VALUE, value=frame(kind_of(value_kind), us, destination, payload, correlation=self.number, cls=1))
        else:
            self.say(self.IS_PROBE, probe=struct.pack("<Q", self.probe), value=bytes(self.PROBED - 32))


by_class = value_kind is not None
stream_by_datagram = Datagrams() if by_class else None
sessions = {lane: Session() for lane in (("control", "stream", "bulk") if by_class else ("control",))}
control = sessions["control"]
links, peer = [], None
version, sequence = 0, 0
sent, told, confirmed = 0, 0, 0
destination = None


def introduced(link, hello):
    """The dialler's HELLO: answered by WELCOME, then each side says what it takes next (GNCL-2, GNCL-14, SESSION-3)."""
    global peer
    them, _ = unpack(hello.payload)
    assert hello.kind == HELLO and them["project"] == project and them["peer"] == here
    peer, lane = them["node"], them.get("lane", "control")
    features = ["guard", "outcomes"] + (["classes", "datagrams-2", "outcome-runs"] if by_class else [])
    ours = {"project": project, "node": here, "name": "python", "incarnation": incarnation, "peer": peer, "dial": 0,
            "payload_max": 65536, "features": features, "lane": lane, "link": them.get("link", 0)}
    link.own(WELCOME, ours)
    link.guarded = "guard" in them["features"]
    link.session = sessions[lane]
    link.session.link, link.session.change = link, -1
    say("linked with", them["name"], "for", lane)
    link.session.acknowledge()


def publish():
    """The directory of this node: when the link comes up, and every 2 s (SYNC-2)."""
    global version
    version += 1
    entries = [{"name": own_app, "app": us & 0xffffffff, "ready": True, "requires": []}]
    control.send(DIRECTORY, here << 32 | SYNC, peer << 32 | SYNC,
                 pack({"incarnation": incarnation, "version": version, "entries": entries, "groups": []}))


def take(session, message):
    """A message of the session: the next one, and no other (SESSION-4)."""
    global destination, told, confirmed
    assert message.number == session.their_next & 0xffff, (message.number, session.their_next)
    session.their_next, session.untold = session.their_next + 1, session.untold + 1
    if message.kind == DIRECTORY:
        for entry in unpack(message.payload)[0]["entries"]:
            if entry["name"] == their_app and entry["ready"] and destination is None:
                destination = peer << 32 | entry["app"]
                say("found", their_app)
    elif message.kind == OUTCOME:
        told += 1
        say("outcome", message.correlation, message.payload[0])
    elif message.kind == OUTCOMES:
        for _, _, correlation, outcome in struct.iter_unpack("<IIQB", message.payload):
            told += 1
            say("outcome", correlation, outcome)
    elif message.kind == OUTCOME_RUNS:
        for _, _, first, outcome, count in struct.iter_unpack("<IIQBB", message.payload):
            for correlation in range(first, first + count):
                told += 1
                say("outcome", correlation, outcome)
    elif by_class and message.cls == 1 and message.kind == kind_of(value_kind):
        if stream_by_datagram.is_new(message):
            say("value", unpack(message.payload)[0]["number"], "by the connection")
    elif message.flags & CONFIRM:
        if message.destination != us:
            outcome = NO_SUCH_APPLICATION
        elif message.kind != kind_of(kind_name):
            outcome = UNKNOWN_KIND
        else:
            outcome, confirmed = DELIVERED, confirmed + 1
            say("got", unpack(message.payload)[0]["number"])
        control.send(OUTCOME, message.destination, message.source, bytes([outcome]), IS_OUTCOME, message.correlation)


def obey(link, message):
    if message is None or message.kind == REFUSAL:
        sys.exit("the connection ended: " + ("" if message is None else unpack(message.payload)[0]["sentence"]))
    if link.session is None:
        introduced(link, message)
    elif message.kind == PING:
        link.own(PONG)
    elif message.kind == ACK:
        link.session.heard(unpack(message.payload)[0])
    elif message.kind == DATAGRAMS:
        stream_by_datagram.announced(link, unpack(message.payload)[0])
    elif message.kind == GOODBYE:
        link.session.acknowledge()
        sys.exit("the peer leaves")
    elif message.kind != PONG:
        take(link.session, message)


def is_done():
    has_values = not by_class or stream_by_datagram.is_acknowledged and stream_by_datagram.got > 0
    return told >= count and confirmed >= count and not control.kept and has_values


asked = published = -10.0
while not is_done():
    sockets = [udp, listener] + [link.connection for link in links] + ([stream_by_datagram.socket] if by_class else [])
    ready, _, _ = select.select(sockets, [], [], 0.02)
    if udp in ready:
        read_datagram()
    if by_class and stream_by_datagram.socket in ready:
        stream_by_datagram.read()
    for link in links:
        if link.connection in ready:
            for message in link.frames():
                obey(link, message)
    if listener in ready:
        # The dialler would not dial if it had a link (GNCL-5).
        links.append(Link(listener.accept()[0]))
        links[-1].connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    now = time.monotonic()
    if now - asked >= period:
        asked = now
        ask_the_group()
    if by_class:
        stream_by_datagram.tick(now)
    for session in sessions.values():
        if session.link and session.link.has_heard and (session.untold >= 32 or session.untold and now - session.acknowledged >= 1):
            session.acknowledged = now
            session.acknowledge()
    if control.link and control.link.has_heard:
        if now - published >= 2:
            published = now
            publish()
        is_held = destination and destination & 0xffffffff in control.held  # class Control is 0
        if destination and sent < count and control.next_number < control.until and not is_held:
            sent += 1
            control.send(kind_of(kind_name), us, destination, pack({"number": sent}), CONFIRM, sent)

# In order (NDL-4.4, GNCL-10): what the peer has sent is acknowledged, then it is said to all that we leave.
for link in links:
    link.session.acknowledge()
for node, address in requesters.items():
    udp.sendto(frame(LEAVE, here << 32 | NDL, node << 32 | NDL, pack(announcement)), address)
for link in links:
    link.own(GOODBYE)
for link in links:
    link.connection.settimeout(5)
    while link.connection.recv(65536):
        pass
say("left")
