"""The program of a command: registers the name that its node gives it, and confirms each message."""

import os
import signal
import socket
import struct
import sys
import zlib

REGISTER, REGISTERED, OUTCOME = 0x40, 0x41, 0x01
CONFIRM, OUTCOME_FLAG = 1, 8
HEADER = struct.Struct("<2sBBIIBBHQQQQQI")


def frame(kind, flags, source, destination, correlation, payload):
    head = HEADER.pack(b"Sw", 1, 64, len(payload), kind, 0, flags, 0, source, destination, 0, correlation, 0, 0)
    return head + struct.pack("<I", zlib.crc32(head + payload)) + payload


def read_exactly(node, count):
    data = b""
    while len(data) < count:
        piece = node.recv(count - len(data))
        if not piece:
            sys.exit("the node closed the connection")
        data += piece
    return data


def read_frame(node):
    head = read_exactly(node, 64)
    _, _, _, length, kind, _, flags, _, source, destination, _, correlation, _, _ = HEADER.unpack(head[:60])
    return kind, flags, source, destination, correlation, read_exactly(node, length)


def stop(number, stack):
    print("python was told to stop", flush=True)
    sys.exit(0)


signal.signal(signal.SIGTERM, stop)
name = os.environ["SINEW_NAME"].encode()
node = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
node.connect(os.environ["SINEW_SOCKET"])
# A map of one entry, and a text of at most 31 bytes.
node.sendall(frame(REGISTER, 0, 0, 1, 0, b"\x81\xa4name" + bytes([0xA0 + len(name)]) + name))
kind, _, _, me, _, payload = read_frame(node)
assert kind == REGISTERED, payload
print("python is registered as", name.decode(), flush=True)
while True:
    kind, flags, source, _, correlation, payload = read_frame(node)
    if flags & CONFIRM and kind >= 0x80000000:
        node.sendall(frame(OUTCOME, OUTCOME_FLAG, me, source, correlation, b"\x00"))
