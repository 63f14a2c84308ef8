"""protocol.h under a model checker for C11 atomics, as it stands and with mistakes in it.

x86 keeps stores in order, so a missing fence breaks nothing on the machine that most of us have. Relacy plays the
orders that C11 allows, on any machine. What it does not find is not proved to be absent; that it would find what small
mistakes in the protocol break is shown by making the mistakes. The models are described in protocol_relacy.cpp.
"""

import os
import subprocess
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

import rtdb

pytestmark = pytest.mark.proof

CORE = Path(rtdb.__file__).parent / "core"
MODELS = Path(__file__).with_name("protocol_relacy.cpp")
EXECUTIONS = 200_000
MUTANT_EXECUTIONS = 100_000  # the hardest one needs 17,691
COMPILER = [os.environ.get("CXX", "c++"), "-std=c++11", "-w"]


def build(folder, *flags, core=CORE):
    program = folder / "protocol_relacy"
    # a fortified longjmp refuses to change stacks, which is how Relacy changes threads
    compiler = [*COMPILER, "-U_FORTIFY_SOURCE", *flags, f"-I{core}"]
    subprocess.run([*compiler, str(MODELS), "-o", str(program)], check=True)
    return program


def run(program, model, executions):
    return subprocess.run(
        [str(program), model, str(executions)], capture_output=True, text=True, timeout=120, check=False
    )


@pytest.fixture(scope="module")
def checker():
    """Skip where the models cannot be compiled."""
    try:
        subprocess.run([*COMPILER, "--version"], capture_output=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("no C++ compiler: apt-get install g++")
    text = "#include <relacy/relacy.hpp>\n"
    found = subprocess.run([*COMPILER, "-E", "-x", "c++", "-"], input=text, capture_output=True, text=True, check=False)
    if found.returncode:
        pytest.skip("relacy-dev is not installed: apt-get install relacy-dev")


@pytest.fixture(scope="module")
def real(checker, tmp_path_factory):
    return build(tmp_path_factory.mktemp("real"), "-O1")


@pytest.mark.parametrize("model", ["ring", "cut", "ticks", "wait", "life"])
def test_no_order_that_c11_allows_breaks_the_protocol(model, real):
    done = run(real, model, EXECUTIONS)
    assert (done.returncode, done.stdout) == (0, "whole\n"), done.stdout[:2000] + done.stderr


# What is wrong, the model that shows it, and its text in protocol.h with the mistake in its place. Every memory order
# and every fence of protocol.h is here, but two orders:
# - "seq = 2w" need not be a release while the fence of writer 4 stands before it. The mutant takes both away.
# - That publish loads the epoch with acquire keeps the base of the next tick out of the pass of this one. To get there,
#   a load would have to see the future, and Relacy does not play that.
MUTANTS = {
    # ring: a read that is called whole is exactly write w
    "no fence in the writer before the payload": ("ring", {"FW_FENCE(release); /* with reader 3 */": ""}),
    "no fence in the reader after the payload": ("ring", {"FW_FENCE(acquire); /* with writer 2 */": ""}),
    "seq is looked at relaxed": ("ring", {"FW_LOAD(slot->seq, acquire)": "FW_LOAD(slot->seq, relaxed)"}),
    "seq is published relaxed, and no fence before it": (
        "ring",
        {
            "FW_STORE(slot->seq, 2 * w, release)": "FW_STORE(slot->seq, 2 * w, relaxed)",
            "FW_FENCE(seq_cst); /* with tick 2 */": "",
        },
    ),
    "head is published relaxed": ("ring", {"FW_STORE(ring->head, w, release)": "FW_STORE(ring->head, w, relaxed)"}),
    # cut: an effect never without its cause
    "a plain pass": ("cut", {"#ifndef FW_MUTANT_NAIVE_PASS": "#if 0"}),
    "no fence in the writer before the epoch": ("cut", {"FW_FENCE(seq_cst); /* with tick 2 */": ""}),
    "no fence in the tick": ("cut", {"FW_FENCE(seq_cst); /* with writer 4 */": ""}),
    "the tick may see head before ep": (
        "cut",
        {"FW_STORE(ring->head, w, release)": "FW_STORE(ring->head, w, relaxed)"},
    ),
    "the tick looks at head relaxed": ("cut", {"FW_LOAD(ring->head, acquire)": "FW_LOAD(ring->head, relaxed)"}),
    "ep is set relaxed": ("cut", {"FW_STORE(ring->ep, epoch, release)": "FW_STORE(ring->ep, epoch, relaxed)"}),
    "the tick looks at ep relaxed": ("cut", {"FW_LOAD(ring->ep, acquire)": "FW_LOAD(ring->ep, relaxed)"}),
    # ticks: a cut never changes its mind, and the two newest can be read
    "the epoch is set relaxed": ("ticks", {"FW_STORE(clock->epoch, c, release)": "FW_STORE(clock->epoch, c, relaxed)"}),
    "may_write looks at the epoch relaxed": (
        "ticks",
        {"FW_LOAD(clock->epoch, acquire); /* with tick 1 */": "FW_LOAD(clock->epoch, relaxed);"},
    ),
    "now is set relaxed": ("ticks", {"FW_STORE(cuts->now, value, release)": "FW_STORE(cuts->now, value, relaxed)"}),
    "may_write looks at now relaxed": ("ticks", {"FW_LOAD(cuts->now, acquire)": "FW_LOAD(cuts->now, relaxed)"}),
    "a tick in progress keeps no slot": ("ticks", {"keep = FW_LOAD(ring->base, relaxed);": ";"}),
    "no fence in the append": ("ticks", {"FW_FENCE(release); /* with look-up 3 */": ""}),
    "the append's fence comes before the tail moves": (
        "ticks",
        {
            "FW_FENCE(release); /* with look-up 3 */": "",
            "if (k >= n) FW_STORE(cuts->tail": "FW_FENCE(release); if (k >= n) FW_STORE(cuts->tail",
        },
    ),
    "no fence in the look-up": ("ticks", {"FW_FENCE(acquire); /* 3: with the append */": ""}),
    "the tail stays": ("ticks", {"if (k >= n) FW_STORE(cuts->tail, k - n + 1, relaxed);": ""}),
    "no second look at the tail": ("ticks", {"if (lo && lo - 1 < tail_now) return -ESTALE;": ""}),
    "no look whether older entries were there": ("ticks", {"if (lo == tail && tail_now) return -ESTALE;": ""}),
    "the log's head is set relaxed": (
        "ticks",
        {"FW_STORE(cuts->head, k + 1, release)": "FW_STORE(cuts->head, k + 1, relaxed)"},
    ),
    "the log's head is looked at relaxed": ("ticks", {"FW_LOAD(cuts->head, acquire)": "FW_LOAD(cuts->head, relaxed)"}),
    "the cycle is set relaxed": ("ticks", {"FW_STORE(clock->cycle, c, release)": "FW_STORE(clock->cycle, c, relaxed)"}),
    # wait: nobody sleeps for ever
    "no fence in announce": ("wait", {"FW_FENCE(seq_cst); /* with notify 1 */": ""}),
    "no fence in notify": ("wait", {"FW_FENCE(seq_cst); /* with announce */": ""}),
    "notify wakes and does not change the word": ("wait", {"FW_FETCH_ADD(*word, 2) + 2": "FW_LOAD(*word, relaxed)"}),
    "notify wakes before it changes the word": (
        "wait",
        {"uint32_t seen = FW_FETCH_ADD": "FW_WAKE(word); uint32_t seen = FW_FETCH_ADD", "    FW_WAKE(word);\n": ""},
    ),
    "bit 0 is cleared whoever announced since": (
        "wait",
        {"if (seen & 1) (void)FW_EXCHANGE_IF(*word, seen, seen & ~1u);": "FW_STORE(*word, seen & ~1u, relaxed);"},
    ),
    "bit 0 is cleared before the wake, by a notifier that dies": (
        "wait",
        {"FW_WAKE(word);\n": "", "seen & ~1u);\n": "seen & ~1u); FW_WAKE(word);\n"},
    ),
    "announce sets bit 0 and no more": (
        "wait",
        {"seen, (seen + 2) | 1)": "seen, seen | 1)", "return (seen + 2) | 1": "return seen | 1"},
    ),
    # life: the next object's bytes are never taken for this one's
    "no fence when a life ends": ("life", {"FW_FENCE(release); /* with fw_life_still": "/*"}),
    "the fence comes before the life ends": (
        "life",
        {
            "FW_FENCE(release); /* with fw_life_still": "/*",
            "FW_STORE(*life, even, relaxed);": "FW_FENCE(release); FW_STORE(*life, even, relaxed);",
        },
    ),
    "no second look at the life": ("life", {"FW_LOAD(*life, relaxed) == odd ? 0 : -EIDRM": "(void)life, (void)odd, 0"}),
    "no fence between the payload and the life": ("life", {"FW_FENCE(acquire); /* with writer 2 */": ""}),
    "no fence between the cut log and the life": ("life", {"FW_FENCE(acquire); /* 3: with the append */": ""}),
}


def build_mutant(mistake, folder):
    model, replacements = MUTANTS[mistake]
    text = (CORE / "protocol.h").read_text()
    for right, wrong in replacements.items():
        assert text.count(right) == 1, f"protocol.h has changed: {right!r}"
        text = text.replace(right, wrong)
    (folder / "protocol.h").write_text(text)
    return build(folder, "-O0", f"-DMODEL={model}", core=folder)


@pytest.fixture(scope="module")
def mutants(checker, tmp_path_factory):
    """The programs of all mistakes, to come; they are compiled on all cores while the tests take the first ones."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        yield {mistake: pool.submit(build_mutant, mistake, tmp_path_factory.mktemp("mutant")) for mistake in MUTANTS}
        pool.shutdown(cancel_futures=True)


@pytest.mark.parametrize("mistake", MUTANTS)
def test_the_model_checker_finds_a_mistake_in_the_protocol(mistake, mutants):
    model, _ = MUTANTS[mistake]
    done = run(mutants[mistake].result(), model, MUTANT_EXECUTIONS)
    verdict = "DEADLOCK" if model == "wait" else "USER ASSERT FAILED"
    assert done.returncode == 1, f"not found in {MUTANT_EXECUTIONS} executions"
    assert done.stdout.startswith(verdict), done.stdout[:2000] + done.stderr
