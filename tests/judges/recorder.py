"""Writes every frame of an interface to a pcapng file until SIGTERM: recorder.py IF FILE

Nanosecond stamps and directions, as `ecaxis run --record` writes them. Exits with 1 if the kernel
dropped frames: a recording with holes proves nothing.
"""

import signal
import socket
import struct
import sys

SO_RCVBUFFORCE = 33
SO_TIMESTAMPNS = 35
SOL_PACKET = 263
PACKET_STATISTICS = 6
ETH_P_ALL = 3
OUTGOING = 4


def block(kind, body):
    body += bytes(-len(body) % 4)
    size = struct.pack("<I", len(body) + 12)
    return struct.pack("<I", kind) + size + body + size


def option(code, value):
    return struct.pack("<HH", code, len(value)) + value + bytes(-len(value) % 4)


def head():
    section = block(0x0A0D0D0A, struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1))
    # Ethernet, no limit; if_tsresol: 10^-9 s.
    interface = block(1, struct.pack("<HHI", 1, 0, 0) + option(9, b"\x09") + option(0, b""))
    return section + interface


def packet(stamp, frame, outbound):
    body = struct.pack("<IIIII", 0, stamp >> 32, stamp & 0xFFFFFFFF, len(frame), len(frame))
    body += frame + bytes(-len(frame) % 4)
    flags = struct.pack("<I", 2 if outbound else 1)
    return block(6, body + option(2, flags) + option(0, b""))


def main():
    nic, path = sys.argv[1:]
    sock = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(ETH_P_ALL))
    sock.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, 128 << 20)
    sock.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
    sock.bind((nic, ETH_P_ALL))
    sock.settimeout(0.1)
    running = True

    def stop(*_):
        nonlocal running
        running = False

    signal.signal(signal.SIGTERM, stop)
    with open(path, "wb", buffering=1 << 20) as file:
        file.write(head())
        print("recording", flush=True)
        while True:
            try:
                frame, extra, _, source = sock.recvmsg(2048, 64)
            except TimeoutError:
                if running:
                    continue
                break
            stamp = next(
                s * 10**9 + ns
                for level, kind, data in extra
                if kind == SO_TIMESTAMPNS
                for s, ns in [struct.unpack("qq", data[:16])]
            )
            file.write(packet(stamp, frame, source[2] == OUTGOING))
    _, drops = struct.unpack("II", sock.getsockopt(SOL_PACKET, PACKET_STATISTICS, 8))
    if drops:
        print(f"{drops} frames were not recorded", file=sys.stderr)
        sys.exit(1)


if __name__ == "__main__":
    main()
