"""The C programs of these tests under the sanitizers of the compiler."""

import pytest
from c_programs import ADDRESS, GUARDED, THREAD, build, run, same_addresses

pytestmark = pytest.mark.proof


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    """What to put before a command of a build with the address sanitizer."""
    before = same_addresses(tmp_path_factory.mktemp("address"), *ADDRESS)
    if before is None:
        pytest.skip("the compiler has no address sanitizer that runs here")
    return before


@pytest.fixture(scope="module")
def thread(tmp_path_factory):
    """What to put before a command of a build with the thread sanitizer."""
    before = same_addresses(tmp_path_factory.mktemp("thread"), *THREAD)
    if before is None:
        pytest.skip("the compiler has no thread sanitizer that runs here")
    return before


@pytest.fixture(scope="module")
def damaged(address, tmp_path_factory):
    return build(tmp_path_factory.mktemp("damaged"), "fuzz_attach.c", *ADDRESS, *GUARDED)


@pytest.fixture(scope="module")
def threads(thread, tmp_path_factory):
    return build(tmp_path_factory.mktemp("threads"), "threads.c", *THREAD)


def assert_clean(done):
    assert done.returncode == 0, done.stdout + done.stderr[-10_000:]
    assert "Sanitizer" not in done.stderr
    assert "runtime error" not in done.stderr


def test_the_protocol_touches_nothing_else(address, tmp_path):
    assert_clean(run(build(tmp_path, "protocol_steps.c", *ADDRESS, units=False), before=address))


@pytest.mark.parametrize(("what", "times"), [("cut", 20_000), ("torn", 20_000)])
def test_two_processes_that_race_touch_nothing_else(what, times, address, tmp_path, unique):
    assert_clean(run(build(tmp_path, "cut_race.c", *ADDRESS), what, unique(), times, before=address))


def test_changes_of_the_directory_that_are_killed_touch_nothing_else(address, tmp_path, unique):
    assert_clean(run(build(tmp_path, "kill_steps.c", "-DFW_TEST_KILLS", *ADDRESS), "steps", unique(), before=address))


def test_processes_that_are_killed_touch_nothing_else(address, tmp_path, unique):
    assert_clean(run(build(tmp_path, "kills.c", *ADDRESS), unique(), 40, 3, before=address))


@pytest.mark.parametrize(("mode", "args"), [("words", (3, 64)), ("random", (20_001, 600)), ("restore", (20_001, 1500))])
def test_damaged_segments_lead_nowhere_else(mode, args, address, damaged, unique):
    assert_clean(run(damaged, mode, unique(), *args, before=address))


def test_threads_on_the_protocol_do_not_race(thread, threads):
    assert_clean(run(threads, "protocol", 3000, before=thread))


def test_the_clock_thread_and_its_process_do_not_race(thread, threads, unique):
    assert_clean(run(threads, "clock", unique(), before=thread))
