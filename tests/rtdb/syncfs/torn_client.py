"""A process of test_torn.py: writes one file, or reads all, so many times; tells how many it saw torn.

torn_client.py ADDRESS MSIZE write PATH TOKEN COUNT
torn_client.py ADDRESS MSIZE read PATH[,PATH...] - COUNT
"""

import random
import sys
import zlib

from rtdb.syncfs import Client

SIZES = (1, 40, 700, 3900)  # bytes of the body: a status has room for 4,000


def revision(n: int, rng: random.Random, large: bool) -> bytes:
    """A JSON object that tells its own checksum; a large one is longer than a message."""
    body = chr(97 + n % 26) * (rng.choice(SIZES) - 1 + (20_000 if large else 0))
    return b'{"n": %d, "crc": %d, "body": "%s"}' % (n, zlib.crc32(body.encode()), body.encode())


def is_torn(data: bytes, last: int) -> tuple[bool, int]:
    """Check what was read: whole, and not older than what was read before."""
    head, _, body = data.partition(b', "body": "')
    numbers = head.removeprefix(b'{"n": ').split(b', "crc": ')
    if len(numbers) != 2 or not data.endswith(b'"}') or zlib.crc32(body[:-2]) != int(numbers[1]):
        return True, last
    return int(numbers[0]) < last, int(numbers[0])


def main() -> None:
    address, msize, what, paths, token, count = sys.argv[1:]
    with Client.connect(address, "" if token == "-" else token, msize=int(msize)) as fs:
        print("ready", flush=True)
        sys.stdin.readline()
        torn, rng = 0, random.Random(paths)
        if what == "write":
            large = not paths.endswith("status")
            for n in range(1, int(count) + 1):
                data = revision(n, rng, large and n % 2 == 0)
                if n % 3 == 0:
                    fs.write(paths, data)  # truncated, written, closed
                else:
                    fs.rewrite(paths, data)  # kept open
        else:
            names = paths.split(",")
            last = dict.fromkeys(names, 0)
            for n in range(int(count)):
                name = names[n % len(names)]
                data = fs.read(name)
                if data:
                    bad, last[name] = is_torn(data, last[name])
                    torn += bad
        print(torn, flush=True)


main()
