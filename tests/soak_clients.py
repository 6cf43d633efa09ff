"""Clients that misbehave, each in its own way and from its own address: the standard library only."""

import http.client
import random
import secrets
import socket
import struct
import threading
import time
import zlib
from collections import Counter

# Longest wait of a client that waits for anything; its server may be slow, but must not be gone.
PATIENCE = 60.0


class Target:
    """Where the requests go."""

    def __init__(self, port, map_name, photos):
        self.port = port
        self.map = map_name
        self.photos = photos

    def connect(self, source, receive_buffer=None):
        """A connection from the loopback address `source`, so that the server can tell clients apart."""
        sock = socket.socket()
        if receive_buffer:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer)
        sock.settimeout(PATIENCE)
        sock.bind((source, 0))
        sock.connect(("127.0.0.1", self.port))
        return sock

    def request(self, source, method, path, key=None, body=None, kind="image/jpeg"):
        """One request on a connection of its own; returns the status and the body."""
        connection = http.client.HTTPConnection(
            "127.0.0.1", self.port, timeout=PATIENCE, source_address=(source, 0)
        )
        headers = {"Content-Type": kind}
        if key:
            headers["Authorization"] = f"Bearer {key}"
        try:
            connection.request(method, path, body=body, headers=headers)
            answer = connection.getresponse()
            return answer.status, answer.read()
        finally:
            connection.close()

    def head(self, method, path, key, length=None):
        """The head of a request, as bytes."""
        lines = [f"{method} {path} HTTP/1.1", "Host: soak", f"Authorization: Bearer {key}"]
        if length is not None:
            lines += ["Content-Type: image/jpeg", f"Content-Length: {length}"]
        return "\r\n".join(lines + ["", ""]).encode()

    @property
    def query(self):
        return f"/query?map={self.map}"


class Client(threading.Thread):
    """Misbehaves until it is stopped, and counts what became of it."""

    def __init__(self, target, source, key):
        super().__init__(name=type(self).__name__, daemon=True)
        self.target = target
        self.source = source
        self.key = key
        self.stopped = threading.Event()
        self.outcomes = Counter()

    def run(self):
        while not self.stopped.is_set():
            try:
                self.misbehave()
            # Being thrown out is what such a client must expect.
            except (OSError, http.client.HTTPException) as error:
                self.outcomes[type(error).__name__] += 1
                self.stopped.wait(0.2)

    def misbehave(self):
        raise NotImplementedError

    def post(self, body, kind="image/jpeg", key=None):
        status, _ = self.target.request(
            self.source, "POST", self.target.query, key or self.key, body, kind
        )
        self.outcomes[status] += 1


class Holder(Client):
    """Keeps many connections open and does something to each, again and again."""

    connections = 20
    pause = 1.0
    receive_buffer = None

    def misbehave(self):
        held = []
        try:
            while not self.stopped.is_set():
                if len(held) < self.connections:
                    held.append(self.open())
                    self.outcomes["opened"] += 1
                    # They are opened at a rate, and not in one burst.
                    self.stopped.wait(0.01)
                    continue
                held = [one for one in held if self.keep(one)]
                self.stopped.wait(self.pause)
        finally:
            for one in held:
                one.close()

    def open(self):
        sock = self.target.connect(self.source, self.receive_buffer)
        self.begin(sock)
        sock.setblocking(False)
        return sock

    def begin(self, sock):
        """What is sent at once."""

    def keep(self, sock):
        """Goes on with a connection; false once the server has closed it."""
        try:
            self.go_on(sock)
            return True
        except BlockingIOError:
            return True
        except OSError:
            sock.close()
            self.outcomes["closed by the server"] += 1
            return False

    def go_on(self, sock):
        if sock.recv(1, socket.MSG_PEEK) == b"":
            raise ConnectionError("closed")


class Idle(Holder):
    """Two hundred connections that say nothing."""

    connections = 200


class TricklingHeads(Holder):
    """A byte of a header a second."""

    connections = 50

    def begin(self, sock):
        sock.sendall(b"POST /query HTTP/1.1\r\nHost: soak\r\nX-Slow: ")

    def go_on(self, sock):
        sock.send(b"x")


class SlowWriter(Holder):
    """A byte of a photo every second."""

    def begin(self, sock):
        head = self.target.head("POST", self.target.query, self.key, 2_000_000)
        sock.sendall(head + b"\xff\xd8\xff")

    def go_on(self, sock):
        sock.send(b"x")


class NeverReading(Holder):
    """Asks for the longest answers, one after the other, and reads none."""

    receive_buffer = 4096

    def begin(self, sock):
        sock.sendall(self.target.head("GET", "/openapi.json", self.key))

    def go_on(self, sock):
        sock.send(self.target.head("GET", "/openapi.json", self.key))


class SlowReader(NeverReading):
    """As before, but takes a few bytes a second."""

    def go_on(self, sock):
        if sock.recv(16) == b"":
            raise ConnectionError("closed")


class ExifBomb(Client):
    """A photo whose EXIF block has 65,535 directories that overlap."""

    def misbehave(self):
        self.post(self.bomb, "image/png")
        self.stopped.wait(0.2)

    bomb = None


class ProgressiveBomb(Client):
    """A small progressive JPEG of 64 million pixels and many scans."""

    bomb = None

    def misbehave(self):
        self.post(self.bomb)
        self.stopped.wait(0.2)


class WrongKeys(Client):
    """Guesses keys, as fast as it is answered."""

    def misbehave(self):
        self.post(random.choice(self.target.photos), key=secrets.token_hex(32))
        self.stopped.wait(0.02)


class Oversize(Client):
    """Announces and sends far more than a photo may have."""

    def misbehave(self):
        with self.target.connect(self.source) as sock:
            sock.sendall(self.target.head("POST", self.target.query, self.key, 200_000_000))
            block = bytes(1 << 16)
            for _ in range(200_000_000 >> 16):
                sock.sendall(block)
            self.outcomes["taken whole"] += 1


class HangsUp(Client):
    """Sends a photo, hangs up before the answer, and sends it again."""

    def misbehave(self):
        photo = random.choice(self.target.photos)
        with self.target.connect(self.source) as sock:
            sock.sendall(self.target.head("POST", self.target.query, self.key, len(photo)) + photo)
            self.stopped.wait(random.uniform(0.0, 0.1))
        self.outcomes["hung up"] += 1


KINDS = [
    NeverReading,
    SlowReader,
    SlowWriter,
    TricklingHeads,
    Idle,
    ExifBomb,
    ProgressiveBomb,
    WrongKeys,
    Oversize,
    HangsUp,
]


def arm():
    """Makes the bombs, once."""
    ExifBomb.bomb = png_with_exif(exif_bomb(65_535, 800_000))
    ProgressiveBomb.bomb = progressive_bomb(8000, 8000, 99)


def exif_bomb(directories, region):
    """A TIFF block: each pointer of its first directory names a directory that overlaps the others."""
    first = 8 + 2 + 12 * directories + 4
    pointers = b"".join(
        struct.pack("<HHII", 0x8769, 4, 1, first + at) for at in range(directories)
    )
    head = b"II*\0" + struct.pack("<IH", 8, directories)
    return head + pointers + bytes(4) + b"\xff" * (region + directories)


def png_with_exif(exif):
    """A grey PNG that carries `exif`."""

    def chunk(kind, body):
        check = zlib.crc32(kind + body)
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", check)

    width, height = 160, 120
    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    rows = zlib.compress((b"\0" + b"\x80" * width) * height)
    chunks = chunk(b"IHDR", header) + chunk(b"eXIf", exif) + chunk(b"IDAT", rows)
    return b"\x89PNG\r\n\x1a\n" + chunks + chunk(b"IEND", b"")


def progressive_bomb(width, height, scans):
    """A JPEG whose scans, nearly empty, each visit every block of a large picture."""

    def segment(marker, body):
        return bytes([0xFF, marker]) + struct.pack(">H", len(body) + 2) + body

    blocks = -(-width // 8) * -(-height // 8)
    picture = segment(0xDB, b"\0" + b"\1" * 64)
    picture += segment(0xC2, struct.pack(">BHHB", 8, height, width, 1) + bytes([1, 0x11, 0]))
    # One code of one bit for "no change", one for "the next 16,384 blocks end here", and one of two
    # bits for "this block ends here".
    picture += segment(0xC4, b"\x00" + bytes([1] + [0] * 15) + b"\x00")
    picture += segment(0xC4, b"\x10" + bytes([1, 1] + [0] * 14) + b"\xe0\x00")
    picture += segment(0xDA, bytes([1, 1, 0, 0, 0, 0])) + bits("0" * blocks)
    runs, left = [], blocks
    while left:
        run = min(left, 32_767)
        if run < 16_384:
            runs.append("10" * run)
        else:
            runs.append("0" + format(run - 16_384, "014b"))
        left -= run
    scan = segment(0xDA, bytes([1, 1, 0, 1, 63, 0x10])) + bits("".join(runs))
    return b"\xff\xd8" + picture + scan * scans + b"\xff\xd9"


def bits(text):
    """Entropy-coded bytes: padded with ones, and each 0xFF followed by a zero."""
    text += "1" * (-len(text) % 8)
    coded = int("1" + text, 2).to_bytes(len(text) // 8 + 1, "big")[1:]
    return coded.replace(b"\xff", b"\xff\0")
