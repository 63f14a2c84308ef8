"""The C core against a plain model of what the header promises: lists, no rings, no atomics."""

import copy
from typing import Annotated

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import Bundle, RuleBasedStateMachine, initialize, invariant, rule

from rtdb import AgedOut, NotYet, Record, Store, TooFast
from rtdb.records import i64, seq

TICK_NS = 10_000_000


class Item(Record):
    n: Annotated[int, i64("", "number")]
    more: Annotated[tuple[int, ...], seq("i64", 3, "", "more numbers")] = ()


class Model:
    """One object. `writes`: (item, t_commit, t_data, causes); `edges`: (cycle, write) where the shown write changed."""

    def __init__(self, n_slots, every, phase):
        self.n_slots, self.every, self.phase = n_slots, every, phase
        self.writes, self.edges = [], []
        self.shown = [0, 0]  # by the two newest edges
        self.at_tick = 0  # newest write at the latest tick
        self.refused = 0

    def may_write(self):
        kept = self.shown[0] or self.shown[1] or self.at_tick
        return not kept or len(self.writes) + 1 < kept + self.n_slots

    def tick(self, cycle):
        self.at_tick = len(self.writes)
        if cycle % self.every != self.phase:
            return
        if self.shown[1] != len(self.writes):
            self.edges.append((cycle, len(self.writes)))
        self.shown = [self.shown[1], len(self.writes)]

    def write(self, number):
        """A write by its number, or the exception that reading it raises."""
        if number < 1 or number > len(self.writes):
            return NotYet
        return self.writes[number - 1] if len(self.writes) < number + self.n_slots else AgedOut

    def at(self, cycle):
        kept = self.edges[-self.n_slots :]
        older = [write for c, write in kept if c <= cycle]
        if older:
            return self.write(older[-1])
        return AgedOut if len(kept) < len(self.edges) else None


def seen(read, *args):
    """What reading gives, in the words of the model."""
    try:
        sample = read(*args)
    except (AgedOut, NotYet) as error:
        return type(error)
    return sample and (sample.value, sample.t_commit_ns, sample.t_data_ns, sample.causes)


class StoreMachine(RuleBasedStateMachine):
    objects = Bundle("objects")

    @initialize()
    def create(self):
        self.store = Store.create(size=1 << 20)
        self.component = self.store.join("a")
        self.writers, self.models, self.image = [], [], None

    def teardown(self):
        if hasattr(self, "store"):
            self.store.close()

    def pick(self, k):
        """One of the objects that are there now: a restore takes the youngest away."""
        return (self.writers[k % len(self.writers)], self.models[k % len(self.writers)]) if self.writers else None

    @rule(every=st.integers(1, 4), phase=st.integers(0, 3), slots=st.integers(4, 9))
    def insert(self, every, phase, slots):
        if len(self.writers) == 8:
            return
        history_s = (slots - 4) * every * TICK_NS * 1e-9 + 1e-9
        writer = self.component.insert(
            f"o{len(self.writers)}", Item, every=every, phase=phase, history_s=history_s, n_causes=2
        )
        assert (writer.n_slots, writer.head) == (slots, 0)
        self.writers.append(writer)
        self.models.append(Model(slots, every, phase % every))

    @rule(
        k=st.integers(0, 7),
        more=st.lists(st.integers(-(2**63), 2**63 - 1), max_size=3),
        times=st.integers(1, 3),
        delay=st.integers(-2 * TICK_NS, 5 * TICK_NS),
        causes=st.lists(st.tuples(st.integers(1, 9), st.integers(1, 99)), max_size=2),
    )
    def write(self, k, more, times, delay, causes):
        picked = self.pick(k)
        for _ in range(times if picked else 0):
            writer, model = picked
            item, now = Item(len(model.writes), tuple(more)), self.store.now_ns
            try:
                number = writer.write(item, now - delay, tuple(causes))
            except TooFast:
                number = None
                model.refused += 1
            assert (number is not None) == model.may_write()
            if number is not None:
                newest = model.writes[-1][2] if model.writes else 0
                model.writes.append((item, now, max(newest, now - delay), tuple(causes)))
                assert number == len(model.writes)

    @rule(times=st.integers(1, 4))
    def tick(self, times):
        for _ in range(times):
            cycle = self.store.tick()
            for model in self.models:
                model.tick(cycle)
            changed = {index: raw[1] for index, raw in self.store.core.changed()}
            assert changed == {
                k: m.edges[-1][1] for k, m in enumerate(self.models) if m.edges and m.edges[-1][0] == cycle
            }

    @rule(age=st.integers(-1, 60))
    def cut(self, age):
        cycle = max(0, self.store.cycle - age)
        for writer, model in zip(self.writers, self.models, strict=True):
            expected = NotYet if cycle > self.store.cycle else model.at(cycle)
            assert seen(self.store.at_cycle(cycle).get, writer) == expected
            if cycle <= self.store.cycle:
                assert seen(self.store.at(cycle * TICK_NS + 7).get, writer) == expected

    @rule(k=st.integers(0, 7), back=st.integers(-2, 12))
    def read(self, k, back):
        if picked := self.pick(k):
            writer, model = picked
            number = max(0, len(model.writes) - back)
            assert seen(writer.read, number) == model.write(number)

    @rule(k=st.integers(0, 7), begin=st.integers(0, 30), length=st.integers(0, 30))
    def history(self, k, begin, length):
        if picked := self.pick(k):
            writer, model = picked
            t0 = self.store.now_ns - begin * TICK_NS
            rows = writer.history(t0, t0 + length * TICK_NS)
            first = max(1, len(model.writes) - model.n_slots + 2)
            expected = [
                w for w in range(first, len(model.writes) + 1) if t0 <= model.writes[w - 1][1] <= t0 + length * TICK_NS
            ]
            assert rows["write"].tolist() == expected
            assert rows["value"]["n"].tolist() == [model.writes[w - 1][0].n for w in expected]
            assert rows["t_data_ns"].tolist() == [model.writes[w - 1][2] for w in expected]

    @rule()
    def save(self):
        self.image = self.store.save(), self.store.cycle, copy.deepcopy(self.models)

    @rule()
    def restore(self):
        if self.image:
            image, cycle, models = self.image
            self.store.restore(image)
            self.models = copy.deepcopy(models)
            del self.writers[len(models) :]
            assert self.store.cycle == cycle

    @invariant()
    def the_current_cut_and_the_newest_write_are_as_modelled(self):
        cut = self.store.snapshot()
        for writer, model in zip(self.writers, self.models, strict=True):
            assert seen(cut.get, writer) == model.at(cut.cycle)
            assert seen(cut.get, writer) is not AgedOut
            assert seen(writer.latest) == (model.writes[-1] if model.writes else None)
            assert (writer.head, writer.refused) == (len(model.writes), model.refused)


TestStoreIsItsModel = StoreMachine.TestCase
TestStoreIsItsModel.settings = settings(
    max_examples=80, stateful_step_count=40, deadline=None, suppress_health_check=list(HealthCheck)
)
