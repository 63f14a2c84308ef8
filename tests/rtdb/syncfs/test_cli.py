"""`fairway serve` and `fairway fs`: real processes, as people type them."""

import errno
import json
import os
import re
import signal
import socket
import stat
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from rtdb import Store
from rtdb.syncfs import Client, FsError
from rtdb.syncfs.addresses import Address
from rtdb.syncfs.codec import LINUX, TYPES

ROOT = Path(__file__).resolve().parents[3]
FAIRWAY = [sys.executable, "-m", "scenarios"]


@pytest.fixture
def env(tmp_path: Path) -> dict[str, str]:
    return os.environ | {"PYTHONPATH": str(ROOT), "XDG_RUNTIME_DIR": str(tmp_path), "FAIRWAY_TOKEN": ""}


@pytest.fixture
def fairway(env: dict[str, str]) -> Callable[..., "subprocess.CompletedProcess[str]"]:
    def run(*words: str, given: str = "") -> "subprocess.CompletedProcess[str]":
        return subprocess.run([*FAIRWAY, *words], env=env, text=True, input=given, capture_output=True, check=False)

    return run


@pytest.fixture
def serve(
    env: dict[str, str], unique: Callable[[], str]
) -> Iterator[Callable[..., "tuple[subprocess.Popen[str], list[str]]"]]:
    """Starts a server; gives its process and the lines that it has said. It ends before the names are looked at."""
    running: list[subprocess.Popen[str]] = []

    def start(*words: str) -> "tuple[subprocess.Popen[str], list[str]]":
        pipe = subprocess.PIPE
        process = subprocess.Popen([*FAIRWAY, "serve", *words], env=env, text=True, stdout=pipe, stderr=pipe)
        running.append(process)
        assert process.stdout is not None
        lines = [process.stdout.readline()]
        while "without a mount" not in lines[-1]:
            assert lines[-1], process.communicate()[1]
            lines.append(process.stdout.readline())
        return process, lines

    yield start
    for process in running:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        process.communicate()


def test_serve_makes_the_store_says_how_to_mount_it_and_leaves_nothing_behind(serve, unique, tmp_path):
    db = unique()
    process, lines = serve("--db", db, "--component", "shell", "--token", "shell=secret", "--operator")
    said = "".join(lines)
    assert f"serving store {db!r}, made" in said
    path = tmp_path / "fairway" / f"{db}.9p"
    assert f"sudo mount -t 9p -o trans=unix,msize=131072,version=9p2000.L,cache=none,access=any {path} /mnt" in said
    assert re.search(r"as shell:\n .*,aname=secret ", said)
    assert re.search(r"as operator:\n .*,aname=operator-[0-9a-f]{12} ", said)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert stat.S_IMODE(path.parent.stat().st_mode) == 0o700
    process.send_signal(signal.SIGINT)
    process.communicate()
    assert process.returncode == 0
    assert not path.exists()
    assert not Path(f"/dev/shm/fairway-{os.getuid()}-{db}").exists()


def test_files_without_a_mount(serve, fairway, unique):
    db = unique()
    serve("--db", db, "--component", "shell", "--token", "shell=secret")
    at = ("--db", db)
    assert fairway("fs", "write", "/notes.txt", "one line", *at).returncode == 0
    assert fairway("fs", "write", "/more", *at, given="two\nlines\n").returncode == 0
    first = fairway("fs", "stat", "/clock", *at).stdout
    assert re.fullmatch(r"/clock 320 bytes mode 444 mtime \d+\.\d{9} version (\d+)\n", first)
    fairway("fs", "stat", "/clock", *at)
    assert fairway("fs", "cat", "/notes.txt", "/more", *at).stdout == "one line\ntwo\nlines\n"
    assert fairway("fs", "ls", *at).stdout.split() == ["at", "clock", "more", "notes.txt", "server"]
    assert "/notes.txt 9 bytes mode 644" in fairway("fs", "ls", "-l", *at).stdout
    assert json.loads(fairway("fs", "cat", "/server", *at).stdout)["connections"] == 1
    wrote = fairway("fs", "write", "/shell/status", '{"speed_mps": 1.5}', *at, "--token", "secret")
    assert wrote.returncode == 0, wrote.stderr


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("cat", "/nothing"), "/nothing: No such file or directory"),
        (("cat", "/at"), "/at: Is a directory"),
        (("write", "/clock", "1"), "/clock: Permission denied"),
        (("write", "/at/0/x", "1"), "/at/0/x: "),
        (("ls", "/", "--token", "guess"), "knows no such token"),
        (("write", "/shell/status", "no JSON", "--token", "secret"), "/shell/status: Invalid argument; /shell/health"),
    ],
)
def test_what_cannot_be_done_is_one_line(serve, fairway, unique, words, said):
    db = unique()
    serve("--db", db, "--component", "shell", "--token", "shell=secret")
    done = fairway("fs", *words, "--db", db)
    assert done.returncode == 2
    assert said in done.stderr
    assert done.stderr.count("\n") == 1


def test_a_server_that_is_not_there_is_one_line(fairway, unique):
    done = fairway("fs", "ls", "--db", unique())
    assert done.returncode == 2
    assert "is a server there?" in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--listen", "tcp:192.0.2.7:5640"), "can be reached from other machines; say --anywhere"),
        (("--listen", "nowhere"), "an address is unix:PATH or tcp:HOST:PORT"),
        (("--listen", "tcp:127.0.0.1:99999"), "an address is unix:PATH or tcp:HOST:PORT"),
        (("--listen", "unix:/nowhere/at/all"), "/nowhere/at/all"),
        (("--listen", "unix:" + "x" * 200), "at most 107 bytes"),
    ],
)
def test_an_address_that_cannot_be_is_one_line(fairway, unique, words, said):
    done = fairway("serve", "--db", unique(), *words)
    assert done.returncode == 2
    assert said in done.stderr
    assert done.stderr.count("\n") == 1, done.stderr


def test_a_component_whose_edges_are_too_seldom_is_refused(fairway, unique):
    done = fairway("serve", "--db", unique(), "--component", "slow:51")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "slow: an edge every 0.51 s is too seldom" in done.stderr
    assert "at most every 50 ticks" in done.stderr


@pytest.mark.parametrize(
    "words",
    [("--component", "a:0"), ("--component", "a:4:4"), ("--component", ":1"), ("--token", "b=x"), ("--clock", "sun")],
)
def test_an_option_that_cannot_be_is_refused(fairway, unique, words):
    done = fairway("serve", "--db", unique(), *words)
    assert done.returncode == 2
    assert words[0] in done.stderr


def test_a_second_server_of_a_store_is_refused_and_harms_nobody(serve, fairway, unique):
    db = unique()
    serve("--db", db)
    for words in ((), ("--listen", "tcp:127.0.0.1:0")):
        done = fairway("serve", "--db", db, *words)
        assert done.returncode == 2
        assert done.stderr.count("\n") == 1, done.stderr
    assert fairway("fs", "ls", "--db", db).returncode == 0


def test_a_socket_that_a_killed_server_left_is_taken_over_with_its_files(serve, fairway, unique):
    db = unique()
    with Store.create(db, clock="real", size=32 << 20) as store:
        store.run_clock()
        process, _ = serve("--db", db)
        assert fairway("fs", "write", "/kept", "before", "--db", db).returncode == 0
        process.kill()
        process.communicate()
        serve("--db", db)
        fairway("fs", "stat", "/clock", "--db", db)
        assert fairway("fs", "cat", "/kept", "--db", db).stdout == "before\n"


def test_lines_answer_each_line_with_one(serve, fairway, unique):
    db = unique()
    serve("--db", db)
    script = ["write /a hello", "wait /clock", "cat /a", "ls /", "cat /b", "dance", "bye", "never reached"]
    done = fairway("fs", "lines", "--db", db, given="\n".join(script) + "\n")
    ok, number, content, names, missing, unknown = done.stdout.splitlines()
    assert (ok, content, names) == ("ok", "hello", "a at clock server")
    assert int(number) > 0
    assert missing == "error: /b: No such file or directory"
    assert unknown.startswith("error: dance is none of wait, cat, ls, write")


def test_trace_prints_every_message(serve, fairway, unique):
    db = unique()
    process, _ = serve("--db", db, "--trace", "--listen", "tcp:127.0.0.1:0")
    assert process.stdout is not None
    address = re.search(r"--at (\S+)", process.stdout.readline())
    assert address is not None
    assert fairway("fs", "cat", "/clock", "--at", address[1]).returncode == 0
    process.send_signal(signal.SIGTERM)
    traffic = process.communicate()[1].splitlines()
    names = [line.split()[1] for line in traffic if line.startswith(("->", "<-"))]
    assert names == [
        "Tversion", "Rversion", "Tattach", "Rattach", "Twalk", "Rwalk", "Tlopen", "Rlopen", "Tread", "Rread",
    ]  # fmt: skip


def test_a_trace_that_nobody_reads_any_more_harms_nobody(serve, unique, tmp_path):
    address = f"unix:{tmp_path}/t"
    process, _ = serve("--db", unique(), "--trace", "--listen", address)
    process.stderr.close()  # as `fairway serve --trace 2>&1 | head` does
    with Client.connect(address) as client:
        client.write("/f", b"content")
        assert "f" in client.ls()
    with Client.connect(address) as another:
        assert "f" in another.ls()
    process.stderr = None
    process.send_signal(signal.SIGTERM)
    assert process.wait() == 0


def test_a_barrier_store_waits_for_its_components(serve, unique, tmp_path):
    db, address = unique(), f"unix:{tmp_path}/b"
    serve("--db", db, "--clock", "barrier", "--listen", address, "--component", "a:1", "--component", "b:1",
          "--token", "a=a", "--token", "b=b")  # fmt: skip
    with Client.connect(address, "a") as a, Client.connect(address, "b") as b, Store.attach(db) as store:
        a.write_json("/a/status", {"n": 1})
        begun = store.cycle
        clocks = [(a, a._kept("/a/clock", -1)), (b, b._kept("/b/clock", -1))]
        for n in range(1, 6):  # the requests of both are under way before either is answered
            for client, fid in clocks:
                client._sock.sendall(LINUX.encode[TYPES["Tgetattr"]](1, fid, 0x3FFF))
            for client, _ in clocks:
                client._receive()
            assert store.cycle == begun + n
        assert b.read_json("/a/status") == {"n": 1}


def test_mount_commands_name_their_transport():
    assert "trans=unix" in Address.parse("unix:/x/y").mount_command()
    assert "trans=tcp,port=77," in Address.parse("tcp:127.0.0.1:77").mount_command("t")
    assert Address.parse("tcp::77").host == "127.0.0.1"
    assert Address.parse("tcp:[::1]:77").is_local
    with pytest.raises(FsError):
        Address.parse("udp:127.0.0.1:1")


def test_an_ordinary_file_in_the_place_of_the_socket_is_kept(fairway, unique, tmp_path):
    precious = tmp_path / "precious.txt"
    precious.write_text("mine")
    done = fairway("serve", "--db", unique(), "--listen", f"unix:{precious}")
    assert done.returncode == 2
    assert "is no socket" in done.stderr
    assert precious.read_text() == "mine"


def test_a_server_ends_with_its_store(serve, unique):
    db = unique()
    with Store.create(db, clock="real", size=32 << 20) as store:
        store.run_clock()
        process, _ = serve("--db", db)
    assert "has ended, and so does its file server" in process.communicate()[1]
    assert process.returncode == 0


def test_a_client_that_ran_into_its_time_limit_is_closed(serve, unique, tmp_path):
    address = f"unix:{tmp_path}/s"
    serve("--db", unique(), "--clock", "barrier", "--listen", address, "--component", "never")
    client = Client.connect(address, timeout_s=60.0)
    assert client._sock.gettimeout() == 60.0
    client._sock.settimeout(0.01)  # a limit that short might hit the connecting itself
    with pytest.raises(FsError) as caught:
        client.wait()
    assert caught.value.errno == errno.ETIMEDOUT
    with pytest.raises(FsError):
        client.ls()


@pytest.mark.parametrize("answer", [b"\3\0\0\0\0\0\0zzzz", b"\x08\0\0\0\1\0\0z", b"HTTP/1.1 400 Bad Request\r\n\r\n"])
def test_a_client_of_something_else_is_told_so(answer):
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()

        def once():
            connection, _ = other.accept()
            with connection:
                connection.recv(100)
                connection.sendall(answer)

        thread = threading.Thread(target=once)
        thread.start()
        with pytest.raises(FsError, match="no 9P server") as caught:
            Client.connect(f"tcp:127.0.0.1:{other.getsockname()[1]}")
        thread.join()
    assert caught.value.errno == errno.EPROTO


def test_a_name_longer_than_a_message_can_say_is_refused_and_the_connection_goes_on(serve, unique, tmp_path):
    address = f"unix:{tmp_path}/s"
    serve("--db", unique(), "--listen", address)
    with Client.connect(address) as client:
        with pytest.raises(FsError) as caught:
            client.read("/" + "x" * 70_000)
        assert caught.value.errno == errno.ENAMETOOLONG
        assert "clock" in client.ls()
