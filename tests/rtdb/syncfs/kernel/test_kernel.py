"""A real Linux kernel mounts the file server, in both dialects, and its programs do what programs do with files.

Where a test has to be between two edges, it ticks a stepped store itself; the kernel never hurries it.
"""

import json
import re
from collections.abc import Callable
from itertools import pairwise

import pytest

from rtdb.syncfs import OPERATOR, Pace, SeatSpec, Tokens

from .hands import Mount, Served
from .rig import HOST, Guest

pytestmark = pytest.mark.kernel

needs_program = pytest.mark.usefixtures("waits")
BIG = 1_100_000
ONE_CONNECTION = """until grep -q '"connections":1,' server; do usleep 2000; done"""
LINUX, UNIX = "9p2000.L", "9p2000.u"


@pytest.fixture
def tokens() -> Tokens:
    given = Tokens()
    given.give("shell", "shell-t")
    given.give(OPERATOR, "operator-t")
    return given


@pytest.fixture
def seated(serve: Callable[..., Served], tokens: Tokens) -> Served:
    """A stepped server with a seat for a component, `shell`."""
    seat = SeatSpec(component="shell", every=1, latency_cycles=0)
    return serve(pace=Pace(every=1), grace_s=1e9, patience_s=1e9, seats=[seat], tokens=tokens)


# -- names ------------------------------------------------------------------------------------------------------------


def test_ls_lists_what_is_there(tree: Mount) -> None:
    assert tree.names() == ["at", "clock", "server"]
    tree("echo x > f; mkdir d; echo y > d/g")
    assert tree.names() == ["at", "clock", "d", "f", "server"], "names come at once"
    assert tree("ls d").split() == ["g"]
    assert tree("ls -ld d").startswith("drwxr-xr-x")
    assert tree("ls -l f").startswith("-rw-r--r--")
    assert "No such file" in tree.refused("ls nothing")


def test_ls_of_the_root_waits_for_the_edge(mount: Callable[..., Mount], real: Served) -> None:
    """It asks about each file, so about the clock: `ls` at the root is a way to wait, too."""
    tree = mount(real)
    tree("mkdir d")
    assert tree("ls; ls -l | grep clock").split()[:4] == ["at", "clock", "d", "server"]


def test_a_renamed_file_keeps_what_it_holds(tree: Mount, stepped: Served) -> None:
    tree("echo hello > f; echo old > h")
    stepped.tick()
    tree("mv f g")
    assert tree.names() == ["at", "clock", "g", "h", "server"], "a rename shows at once"
    assert tree("cat g") == "hello\n"
    tree("mv g h")
    assert tree.names() == ["at", "clock", "h", "server"], "what stood under the new name goes"
    assert tree("cat h") == "hello\n"


def test_a_file_moves_to_another_directory(tree: Mount, stepped: Served) -> None:
    tree("mkdir d; echo hello > f")
    stepped.tick()
    tree("mv f d/g")  # .u knows no such rename: mv copies then
    stepped.tick()
    assert tree.names() == ["at", "clock", "d", "server"]
    assert tree("cat d/g") == "hello\n"


def test_directories_are_made_renamed_and_removed_when_empty(tree: Mount) -> None:
    tree("mkdir -p d/e/f; mv d/e d/g")
    assert tree("find d").split() == ["d", "d/g", "d/g/f"]
    assert "not empty" in tree.refused("rmdir d/g")
    assert "exists" in tree.refused("mkdir d")
    tree("rmdir d/g/f d/g d")
    assert tree.names() == ["at", "clock", "server"]


def test_rm_removes_at_once(tree: Mount, stepped: Served) -> None:
    tree("echo x > f; mkdir d; echo y > d/g; mkdir d/e")
    stepped.tick()
    tree("rm f")
    assert "No such file" in tree.refused("cat f")
    assert "irectory" in tree.refused("rm d")
    tree("rm -r d")
    assert tree.names() == ["at", "clock", "server"]
    tree("echo z > f")
    assert tree("cat f") == "", "a file of the same name is another one"


def test_what_belongs_to_the_store_is_not_removed_or_moved(tree: Mount) -> None:
    for command in ("rm -f server", "mv server f", "echo x > server", "mkdir at/x", "rmdir at", "echo x > at/x"):
        said = tree.refused(command)
        assert "denied" in said or "not permitted" in said or "Read-only" in said, f"{command}: {said}"
    assert tree.names() == ["at", "clock", "server"]


def test_there_are_no_links_and_no_devices(tree: Mount) -> None:
    tree("echo x > f")
    for command in ("ln -s f g", "ln f g", "mkfifo g", "mknod g c 1 3"):
        said = tree.refused(command)
        assert "not supported" in said or "not permitted" in said, f"{command}: {said}"
    assert tree.names() == ["at", "clock", "f", "server"]


def test_a_thousand_files_are_made_listed_and_read(tree: Mount, stepped: Served) -> None:
    tree("mkdir many; n=0; while [ $n -lt 1000 ]; do echo $n > many/f$n; n=$((n+1)); done")
    assert sorted(tree.names("many")) == sorted(f"f{n}" for n in range(1000))
    stepped.tick()
    read = tree("cat many/*").split()
    assert sorted(map(int, read)) == list(range(1000)), "each file holds its number"


def test_a_name_has_at_most_255_bytes_and_may_hold_anything(tree: Mount, stepped: Served) -> None:
    longest = "n" * 255
    tree(f"echo x > {longest}; echo y > 'a b\tc'; echo z > überall")
    stepped.tick()
    assert tree(f"cat {longest} 'a b\tc' überall") == "x\ny\nz\n"
    assert "too long" in tree.refused(f"echo x > n{longest}")


# -- contents ---------------------------------------------------------------------------------------------------------


def test_what_is_written_shows_from_the_next_edge_on(tree: Mount, stepped: Served) -> None:
    tree("echo hello > f")
    assert tree("cat f") == "", "before its first edge a file is empty"
    stepped.tick()
    assert tree("cat f") == "hello\n"
    tree("echo hi > f")
    assert tree("cat f; stat -c %s f") == "hello\n6\n", "until the next edge the old content stands"
    stepped.tick()
    assert tree("cat f; stat -c %s f") == "hi\n3\n", "and a shorter one has no tail"


def test_two_appends_in_one_cycle_keep_both_lines(tree: Mount, stepped: Served) -> None:
    tree("echo first > f")
    stepped.tick()
    tree("echo second >> f; echo third >> f")
    assert tree("cat f") == "first\n"
    stepped.tick()
    assert tree("cat f") == "first\nsecond\nthird\n"
    tree("(echo fourth; echo fifth) >> f; echo alone >> g")
    stepped.tick()
    assert tree("cat f") == "first\nsecond\nthird\nfourth\nfifth\n"
    assert tree("cat g") == "alone\n", "an append makes the file that is not there"


def test_truncate_cuts_and_extends(tree: Mount, stepped: Served) -> None:
    tree("echo hello > f")
    stepped.tick()
    tree("truncate -s 3 f")
    assert tree("cat f") == "hello\n"
    stepped.tick()
    assert tree("cat f; stat -c %s f") == "hel3\n"
    tree("truncate -s 5 f")
    stepped.tick()
    assert tree("xxd -p f") == "68656c0000\n", "beyond the end there are zeros"
    tree(": > f")
    stepped.tick()
    assert tree("stat -c %s f") == "0\n"


def test_a_piece_is_written_into_the_middle(tree: Mount, stepped: Served) -> None:
    tree("echo 0123456789 > f")
    stepped.tick()
    tree("echo -n abc | dd of=f bs=1 seek=4 conv=notrunc")
    stepped.tick()
    assert tree("cat f") == "0123abc789\n"


def test_chmod_chown_and_touch_show(tree: Mount) -> None:
    tree("echo x > f; mkdir d")
    tree("chmod 600 f; chmod 700 d; chown 1000:1001 f; touch -d '2020-01-02 03:04:05' f")
    assert tree("stat -c '%a %u:%g %Y' f") == "600 1000:1001 1577934245\n"
    assert tree("stat -c '%a' d") == "700\n"


@pytest.mark.parametrize("before", ["old", None])
def test_an_unfinished_file_waits_for_its_close(before: str | None, tree: Mount, stepped: Served) -> None:
    """Whether the shell's `>` truncates a file, or makes it."""
    if before is not None:
        tree(f"echo {before} > f")
        stepped.tick()
    shown = "" if before is None else f"{before}\n"
    job = tree.begin("exec 4>f; echo half >&4; echo open; until [ -e /tmp/close ]; do usleep 2000; done; echo rest >&4")
    job.until("grep -q open $out")
    seen = []
    for _ in range(4):
        stepped.tick()
        seen.append(tree("cat f"))
    tree("touch /tmp/close")
    job.end()
    tree("rm /tmp/close")
    assert seen == [shown] * 4, "edges between two writes show neither of them"
    stepped.tick()
    assert tree("cat f") == "half\nrest\n"


@needs_program
def test_fsync_finishes_a_revision(tree: Mount, stepped: Served) -> None:
    job = tree.begin("(until [ -e /tmp/go ]; do usleep 2000; done; echo; until [ -e /tmp/end ]; do usleep 2000; done)"
                     " | waits synced f")  # fmt: skip
    job.until('[ "$(grep -c open $err)" = 1 ]')
    stepped.tick()
    assert tree("cat f") == "first\n", "fsync is as good as a close"
    tree("touch /tmp/go")
    job.until('[ "$(grep -c open $err)" = 2 ]')
    assert tree("cat f") == "first\n"
    stepped.tick()
    assert tree("cat f") == "first\nsecond\n"
    tree("touch /tmp/end")
    job.end()
    tree("rm /tmp/go /tmp/end")


def test_programs_that_sync_succeed(tree: Mount, stepped: Served, dialect: str) -> None:
    tree("dd if=/bin/busybox of=f bs=1000 count=10 conv=fsync; sync f; sync .; sync")
    stepped.tick()
    assert tree("stat -c %s f") == "10000\n"
    assert stepped.sent("Tfsync" if dialect == LINUX else "Twstat"), "fsync comes to the server"


def test_df_tells_the_memory_of_the_store(tree: Mount, stepped: Served, dialect: str) -> None:
    blocks, used, free = map(int, tree("df -P -k . | tail -n 1").split()[1:4])
    if dialect == LINUX:  # a kernel that speaks .u does not ask
        size, unused = stepped.store.memory
        assert blocks == size // 4096 * 4
        assert 0 < free <= unused // 1024
        assert used == blocks - free
        assert int(tree("df -P -i . | tail -n 1").split()[1]) == 4096


def test_noclobber_opens_exclusively(tree: Mount, stepped: Served, mount: Callable[..., Mount], dialect: str) -> None:
    other = mount(stepped)
    tree("set -C; echo mine > f")
    assert "exist" in other.refused("set -C; echo yours > f")
    stepped.tick()
    assert tree("cat f") == "mine\n", "who came second has changed nothing"
    made = stepped.sent("-> Tlcreate" if dialect == LINUX else "-> Tcreate")
    assert len(made) == 1
    if dialect == LINUX:
        assert int(made[0].split(", ")[2]) & 0o200, "O_EXCL comes to the server"


def test_of_two_that_create_exclusively_one_succeeds(tree: Mount, mount: Callable[..., Mount], stepped: Served) -> None:
    """Two mounts, so that the kernel's own lock of the directory does not decide."""
    others = [tree, mount(stepped)]
    jobs = [one.begin("set -C; for k in 1 2 3 4 5 6 7 8 9 10; do echo x > f$k && echo $k; done") for one in others]
    won = [job.end().output for job in jobs]
    numbers = [int(line) for output in won for line in output.splitlines() if line.isdecimal()]
    assert sorted(numbers) == list(range(1, 11)), "each name is made by exactly one"


@needs_program
def test_locks_are_granted(tree: Mount, stepped: Served, dialect: str) -> None:
    tree("echo x > f; waits locked f")
    if dialect == LINUX:
        assert stepped.sent("Rgetlock")
        assert stepped.sent("Rlock")
    stepped.tick()
    assert tree("cat f") == "locked\n"


def test_a_program_runs_from_the_mount(tree: Mount, stepped: Served) -> None:
    """Pages of programs are read in any order, each by itself."""
    tree("cp /bin/busybox echo; chmod +x echo")
    stepped.tick()
    assert tree("./echo it runs") == "it runs\n"


# -- large files ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("msize", [None, 4096, 1 << 20])
def test_a_copy_of_more_than_a_message_is_identical(
    msize: int | None, mount: Callable[..., Mount], stepped: Served
) -> None:
    tree = mount(stepped, "access=any" + (f",msize={msize}" if msize else ""))
    tree(f"head -c {BIG} /dev/urandom > /tmp/a; cp /tmp/a f")
    assert tree("stat -c %s f") == "0\n", "nothing shows before the edge"
    stepped.tick()
    tree("cmp f /tmp/a")
    tree("dd if=f of=/tmp/b bs=7777; cmp /tmp/a /tmp/b")
    tree("truncate -s 1000000 f; head -c 1000000 /tmp/a > /tmp/b")
    stepped.tick()
    tree("cmp f /tmp/b")
    agreed = next(iter(stepped.sent("Rversion")))
    assert f"({msize or 131_072}," in agreed, "the server takes the size that the kernel offers"


def test_a_file_that_is_too_large_is_refused(tree: Mount, stepped: Served) -> None:
    said = tree.refused("dd if=/dev/zero of=f bs=65536 count=100")
    assert "too large" in said, "EFBIG was expected"
    tree("echo small > g")
    stepped.tick()
    assert tree("cat g") == "small\n", "and the mount still works"


def test_a_file_that_is_rewritten_meanwhile_is_never_torn(mount: Callable[..., Mount], real: Served) -> None:
    """Two contents of different sizes take turns, for the reader through another mount as for the writer."""
    tree, other = mount(real), mount(real)
    tree(f"head -c {BIG} /dev/urandom > /tmp/a; head -c 700001 /dev/urandom > /tmp/b")
    good = {line.split()[0] for line in tree("md5sum /tmp/a /tmp/b").splitlines()}
    tree("cp /tmp/a f; until cmp -s f /tmp/a; do :; done")
    writer = tree.begin("for k in 1 2 3 4 5 6 7 8 9 10; do cp /tmp/b f; cp /tmp/a f; cp /tmp/b f; done")
    loop = f"until [ -s {writer.stem}.code ]; do md5sum < f; done"
    reader = other.begin(loop)
    lines = tree(loop) + reader.end().output
    writer.end()
    seen = [line.split()[0] for line in lines.splitlines()]
    assert len(seen) > 1, "the reader was at work meanwhile"
    assert set(seen) <= good, "each read is one revision, whole"


# -- clocks -----------------------------------------------------------------------------------------------------------


@needs_program
def test_each_stat_of_the_clock_is_one_edge_later(mount: Callable[..., Mount], real: Served) -> None:
    """In real time a kernel that is not scheduled may miss an edge; the same one twice is an error."""
    rows = [json.loads(line) for line in mount(real)("waits counts clock 20").splitlines()]
    steps = [after["clock"] - before["clock"] for before, after in pairwise(rows)]
    assert min(steps) >= 1, "a stat returns at an edge that has not been seen"
    assert steps.count(1) >= 10, "and, nearly always, at the next"
    assert all(row["interval"] == 100_000_000 and row["cycle"] == 10 * row["clock"] for row in rows)


@needs_program
def test_a_barrier_waits_for_the_stat_and_misses_no_edge(
    serve: Callable[..., Served], mount: Callable[..., Mount], tokens: Tokens
) -> None:
    served = serve("barrier", pace=Pace(every=1), grace_s=1e9, patience_s=1e9, tokens=tokens,
                   seats=[SeatSpec(component="shell", every=1, latency_cycles=0)])  # fmt: skip
    tree = mount(served, "access=any,aname=shell-t")
    served.store.run_clock(("shell",))
    counts = [json.loads(line)["clock"] for line in tree("waits counts shell/clock 50").splitlines()]
    assert counts == list(range(counts[0], counts[0] + 50)), "N + 1 each time"
    assert served.store.cycle - counts[-1] <= 1, "there is no edge for which nobody waited"


def test_a_loop_of_a_shell_is_a_component(
    serve: Callable[..., Served], mount: Callable[..., Mount], tokens: Tokens
) -> None:
    served = serve("barrier", pace=Pace(every=1), grace_s=1e9, patience_s=1e9, tokens=tokens,
                   seats=[SeatSpec(component="shell", every=1, latency_cycles=0)])  # fmt: skip
    tree = mount(served, "access=any,aname=shell-t")
    served.store.run_clock(("shell",))
    cycle = 'echo "{\\"n\\": $n}" > shell/status; stat -c . shell/clock; cat shell/status'
    said = tree(f"for n in 1 2 3 4 5; do {cycle}; done")
    assert said == "".join(f'.\n{{"n": {n}}}\n' for n in range(1, 6)), "what is written in a cycle shows in the next"


def test_everything_but_the_clock_answers_while_a_stat_waits(tree: Mount, stepped: Served, dialect: str) -> None:
    tree("mkdir d; echo x > d/f")
    job = tree.begin("exec stat -c %Y clock")
    job.until_blocked()
    tree("ls d; cat server; cat d/f; echo y >> d/f; mv d/f d/g; rm d/g")
    if dialect == LINUX:  # with .u the stat waits in the look-up, while the kernel lets nobody change the directory
        tree("echo x > f; rm f; rmdir d")
    assert len(stepped.service.waiting) == 1
    for _ in range(2):  # .u asks twice, in the look-up too
        stepped.tick()
        tree("cat server")
    assert job.end().code == 0


def test_ctrl_c_ends_a_stat_of_a_clock_that_stands(tree: Mount, stepped: Served) -> None:
    done = tree.ran("timeout -s INT 1 stat clock")
    assert done.code == 128 + 2, "stat is ended by SIGINT"
    traffic = list(stepped.traffic)
    asked = [line for line in traffic if "-> Tstat" in line or ("-> Tgetattr" in line and f", {0x3FFF})" in line)][-1]
    flushed = [line for line in traffic if "-> Tflush" in line]
    assert [line.split()[-1] for line in flushed] == [f"({asked.split()[2]})"], "the kernel takes its question back"
    behind = traffic[traffic.index(flushed[0]) + 1 :]
    assert behind[0].startswith("<- Rflush"), "that is answered at once"
    assert not behind[1:] or behind[1].startswith("->"), "and the question is not, behind that"
    assert len(stepped.service.waiting) == 0
    tree("echo x > f; echo *")
    stepped.tick()
    assert tree("cat f") == "x\n", "the mount still works"


def test_a_kill_ends_it_too(tree: Mount, stepped: Served) -> None:
    for signal in ("TERM", "KILL"):
        job = tree.begin("exec stat clock")
        job.until_blocked()
        job.signal(signal)
        assert job.end().code != 0
        assert len(stepped.service.waiting) == 0
    stepped.tick()
    tree("echo x > f")


@needs_program
def test_a_handled_signal_does_not_end_the_wait(tree: Mount, stepped: Served, dialect: str) -> None:
    """What 9P promises a program that handles signals: its fstat returns at the edge, as if nothing had come."""
    job = tree.begin("exec waits held clock")
    if dialect == UNIX:  # its look-up waits as well
        job.until_blocked()
        stepped.tick()
    job.until("grep -q open $err")
    job.until_blocked()
    job.signal("ALRM")
    job.until_blocked()
    assert len(stepped.service.waiting) == 1
    assert not stepped.sent("Tflush")
    stepped.tick()
    assert job.end().output.splitlines()[0] == "0 0 1", "result, errno, signals"


def test_a_clock_that_stands_answers_after_its_grace(serve: Callable[..., Served], mount: Callable[..., Mount]) -> None:
    tree = mount(serve(pace=Pace(every=1), grace_s=0.2))
    tree("timeout 20 stat clock")


# -- who may write ----------------------------------------------------------------------------------------------------


def test_only_who_has_the_token_writes_a_status(mount: Callable[..., Mount], seated: Served) -> None:
    anybody, shell = mount(seated), mount(seated, "access=any,aname=shell-t")
    assert {"status", "config", "clock", "health"} <= set(anybody.names("shell"))
    shell("""echo '{"v_mps": 1.5}' > shell/status""")
    assert anybody("cat shell/status") == ""
    seated.tick()
    assert json.loads(anybody("cat shell/status")) == {"v_mps": 1.5}, "the other mount sees it from the edge on"
    assert json.loads(shell("cat shell/status")) == {"v_mps": 1.5}
    assert anybody("id -u") == "0\n"
    for command in ("echo {} > shell/status", "echo {} >> shell/status", "truncate -s 0 shell/status",
                    "echo {} > shell/config", "rm -f shell/status", "echo x > shell/more", "mv shell/status f",
                    "mkdir shell/d"):  # fmt: skip
        said = anybody.refused(command)
        assert "ermission denied" in said, f"EACCES was expected of {command}, also for root: {said}"
    seated.tick()
    assert json.loads(anybody("cat shell/status")) == {"v_mps": 1.5}


def test_uname_is_as_good_as_aname(mount: Callable[..., Mount], seated: Served) -> None:
    shell = mount(seated, "access=any,uname=shell-t")
    shell("echo '{}' > shell/status")


def test_an_unknown_token_does_not_mount(guest: Guest, seated: Served, dialect: str) -> None:
    options = f"trans=tcp,port={seated.address.port},version={dialect},aname=guess"
    done = guest.run(f"mkdir -p /mnt/no; mount -t 9p -o {options} {HOST} /mnt/no")
    assert done.code != 0
    assert "ermission denied" in done.output


def test_the_operator_wires_and_does_not_write(mount: Callable[..., Mount], seated: Served) -> None:
    shell, operator = mount(seated, "access=any,aname=shell-t"), mount(seated, "access=any,aname=operator-t")
    wiring = '{"inputs": {"heading": "compass#/heading_rad"}}'
    operator(f"echo '{wiring}' > shell/config")
    seated.tick()
    assert json.loads(shell("cat shell/config")) == json.loads(wiring)
    assert "ermission denied" in operator.refused("echo {} > shell/status")


def test_json_that_is_none_stays_out(mount: Callable[..., Mount], seated: Served) -> None:
    shell = mount(seated, "access=any,aname=shell-t")
    shell("""echo '{"n": 1}' > shell/status""")
    seated.tick()
    shell.ran("echo '{oh' > shell/status")
    seated.tick()
    assert json.loads(shell("cat shell/status")) == {"n": 1}, "the last good one stands"
    assert "refused" in shell("cat shell/health")


def test_a_component_ends_with_its_mount(mount: Callable[..., Mount], seated: Served) -> None:
    anybody, shell = mount(seated), mount(seated, "access=any,aname=shell-t")
    assert "shell" in anybody.names()
    shell.unmount()
    anybody(ONE_CONNECTION)
    seated.tick()
    assert "its connection ended" in anybody("cat shell/health")


@pytest.mark.parametrize("access", ["", "access=user", "access=client"])
def test_other_users_of_the_mount_work_too(access: str, mount: Callable[..., Mount], stepped: Served) -> None:
    """Each user attaches anew then, behind the same token. In .u access=client is the default."""
    tree = mount(stepped, access or "cache=none")
    tree("mkdir free; chmod 777 free; su user -c 'echo mine > free/f'")
    stepped.tick()
    assert tree("su user -c 'cat free/f; ls free'") == "mine\nf\n"
    assert tree("stat -c %u free/f") == "1000\n"


# -- mounts -----------------------------------------------------------------------------------------------------------


def test_the_mount_command_that_is_printed_mounts(guest: Guest, real: Served) -> None:
    command = real.address.mount_command(where="/mnt/fairway").removeprefix("sudo ").replace("127.0.0.1", HOST)
    done = guest.run(
        f"mkdir -p /mnt/fairway; {command} && cd /mnt/fairway && echo hello > f && stat clock >/dev/null && cat f\n"
        "code=$?; cd /; umount /mnt/fairway || exit 1; exit $code"
    )
    assert (done.output, done.code) == ("hello\n", 0)


def test_two_mounts_see_each_other(mount: Callable[..., Mount], stepped: Served) -> None:
    one, two = mount(stepped), mount(stepped)
    one("echo x > f")
    assert two.names() == ["at", "clock", "f", "server"]
    stepped.tick()
    two("cat f; echo y >> f; mv f g")
    stepped.tick()
    assert one("cat g") == "x\ny\n"


def test_a_mount_with_open_files_is_busy_and_goes_when_they_are_closed(
    mount: Callable[..., Mount], stepped: Served
) -> None:
    other, tree = mount(stepped), mount(stepped)
    tree("echo hello > f")
    stepped.tick()
    said = other(
        f"exec 3<{tree.where}/f 4>{tree.where}/g; umount {tree.where} && exit 1; umount -l {tree.where} || exit 2;"
        "ls /mnt/*/f; read -r line <&3; echo $line; echo x >&4"
    )
    assert "busy" in said
    assert "hello\n" in said, "what was open can still be read"
    other(ONE_CONNECTION)
    assert len(stepped.service.sessions) == 1, "fids go with the connection"
    stepped.tick()
    assert other("cat g") == "x\n", "and what was written was closed in time"


def test_a_server_that_ends_leaves_errors_and_no_hanging(mount: Callable[..., Mount], stepped: Served) -> None:
    tree = mount(stepped)
    job = tree.begin("exec stat clock")
    job.until_blocked()
    stepped.stop(ticks=False)
    assert job.end().code != 0
    assert re.search("error|ndpoint|reset|pipe", tree.refused("cat server"))


def test_the_past_is_there_and_cannot_be_written(tree: Mount, stepped: Served) -> None:
    tree("echo first > f")
    for text in ("old", "new"):
        stepped.tick()
        stepped.tick()
        at = stepped.store.cycle
        tree(f"echo {text} > f")
    stepped.tick()
    assert tree(f"cat at/{at}/f f") == "old\nnew\n"
    assert str(at) in tree("ls at").split()
    for command in (f"echo x > at/{at}/f", f"rm -f at/{at}/f", f"echo x > at/{at}/g", f"mkdir at/{at}/d"):
        said = tree.refused(command)
        assert "Read-only" in said or "denied" in said, said
    assert tree(f"cat at/{at}/f") == "old\n"


def test_the_past_shows_what_was_shown(tree: Mount, stepped: Served) -> None:
    """From the first edge of a file on."""
    shown = {}
    for text in ("one", "two", "three"):
        tree(f"echo {text} > {text}; echo {text} > f")
        stepped.tick()
        shown[stepped.store.cycle] = tree("tail -n 9 f one; cat two three 2>&1; true")
    for cycle, then in shown.items():
        assert tree(f"cd at/{cycle}; tail -n 9 f one; cat two three 2>&1; true") == then, f"cycle {cycle}"


def test_the_oldest_dialect_mounts_too(guest: Guest, stepped: Served) -> None:
    tree = Mount(guest, stepped, "version=9p2000,access=any")
    tree("echo hello > f; mkdir d; mv f g")
    stepped.tick()
    assert tree("cat g") == "hello\n"
    assert tree.names() == ["at", "clock", "d", "g", "server"]
    assert "No such file" in tree.refused("cat f")
    tree("rm g; rmdir d")
    tree.unmount()
