"""The C core against a plain model of what the header promises: lists, no rings, no heap, no atomics."""

import contextlib
import copy
from typing import Annotated

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from rtdb import (
    STATIC,
    AgedOut,
    DataTimeBackward,
    Deleted,
    Flag,
    NotOwner,
    NotYet,
    ObjectMissing,
    Record,
    Store,
    StoreFull,
    TooFast,
    schema_of,
)
from rtdb.records import i64, seq

TICK_NS = 10_000_000
MAX_OBJECTS = 8
NAMES = 5
FLAGS = (0, STATIC, int(Flag.IMMEDIATE_DELETE), int(Flag.WITH_PARENT))


class Item(Record):
    n: Annotated[int, i64("", "number")]
    more: Annotated[tuple[int, ...], seq("i64", 3, "", "more numbers")] = ()


SLOT_BYTES = schema_of(Item).size + 64  # as a budget counts them


class Model:
    """One object. `writes`: (item, t_commit, t_data, causes); `edges`: (cycle, write) where the shown write changed."""

    def __init__(self, name, spec, oid, now):
        self.name, self.spec, self.oid, self.inserted = name, spec, oid, now
        self.every, self.phase, self.n_slots, self.flags, self.parent, self.history_ns = spec
        self.writes, self.edges = [], []
        self.shown = [0, 0]  # by the two newest edges
        self.at_tick = 0  # newest write at the latest tick
        self.refused = 0
        self.begun = False  # the slot of the next write was opened
        self.deleted = None  # (cycle, time)
        self.freed = False  # its storage was given back, or a restore undid its insertion

    # -- life ------------------------------------------------------------------------------------------------

    def is_over(self, now):
        """Whether nothing can be read of it any more."""
        if self.freed or not self.deleted:
            return self.freed
        return bool(self.flags & Flag.IMMEDIATE_DELETE) or now - self.deleted[1] >= self.history_ns

    def lived(self, t_ns):
        return self.inserted <= t_ns and not (self.deleted and self.deleted[1] <= t_ns)

    # -- writing ---------------------------------------------------------------------------------------------

    @property
    def newest(self):
        return self.writes[-1][2] if self.writes else None

    def may_write(self):
        kept = self.shown[0] or self.shown[1] or self.at_tick
        return not kept or len(self.writes) + 1 < kept + self.n_slots

    def refusal(self, t_data):
        """The error that a write raises, if it does."""
        if self.deleted or self.freed:
            return Deleted
        if self.writes and t_data < self.newest:
            return DataTimeBackward
        return None if self.may_write() else TooFast

    def write(self, item, now, t_data, causes):
        self.writes.append((item, now, t_data, causes))
        self.begun = False

    def tick(self, cycle):
        self.at_tick = len(self.writes)
        if cycle % self.every != self.phase:
            return
        if self.shown[1] != len(self.writes):
            self.edges.append((cycle, len(self.writes)))
        self.shown = [self.shown[1], len(self.writes)]

    # -- reading: a write (item, times, causes), None, or the error ------------------------------------------

    @property
    def oldest(self):
        """The oldest write that a search looks at: one slot is left to the write under construction."""
        return max(1, len(self.writes) - self.n_slots + 2)

    def read(self, number, now):
        if self.is_over(now):
            return Deleted
        if number < 1 or number > len(self.writes):
            return NotYet
        left = len(self.writes) - self.n_slots + self.begun
        return self.writes[number - 1] if number > left else AgedOut

    def visible(self, cycle, now, newest_cycle):
        if self.is_over(now):
            return Deleted
        if cycle > newest_cycle:
            return NotYet
        if self.deleted and cycle > self.deleted[0]:
            return Deleted
        kept = self.edges[-self.n_slots :]
        older = [write for c, write in kept if c <= cycle]
        if older:
            return self.read(older[-1], now)
        return AgedOut if len(kept) < len(self.edges) else None

    def latest(self, now):
        if self.deleted or self.freed:
            return Deleted
        return self.read(len(self.writes), now) if self.writes else None

    def as_of(self, t_ns, now, stamp):
        """By time of commit (stamp 1) or of data (stamp 2)."""
        if self.is_over(now) or (self.deleted and t_ns >= self.deleted[1]):
            return Deleted
        older = [w for w in range(self.oldest, len(self.writes) + 1) if self.writes[w - 1][stamp] <= t_ns]
        if older:
            return self.read(older[-1], now)
        return AgedOut if self.oldest > 1 else None

    def next(self, after, now):
        if self.is_over(now):
            return Deleted
        if after >= len(self.writes):
            return Deleted if self.deleted else None
        w = max(after + 1, self.oldest)
        return *self.writes[w - 1], w, w - after - 1


def seen(read, *args):
    """What reading gives, in the words of the model."""
    try:
        sample = read(*args)
    except (AgedOut, NotYet) as error:
        return type(error)
    except (Deleted, ObjectMissing):  # a handle that a restore made nothing of
        return Deleted
    if isinstance(sample, tuple):
        sample, lost = sample
        return sample.value, sample.t_commit_ns, sample.t_data_ns, sample.causes, sample.write, lost
    return sample and (sample.value, sample.t_commit_ns, sample.t_data_ns, sample.causes)


indices, ages = st.integers(0, 40), st.integers(-2, 30)


class StoreMachine(RuleBasedStateMachine):
    @initialize()
    def create(self):
        self.store = Store.create(size=1 << 20, max_objects=MAX_OBJECTS)
        self.component = self.store.join("a")
        self.handles, self.models = [], []  # of all objects that there ever were
        self.image, self.items = None, 0

    def teardown(self):
        if hasattr(self, "store"):
            self.store.close()

    @property
    def now(self):
        return self.store.now_ns

    def pick(self, k):
        """An object, dead or alive, the younger ones rather than the old ones."""
        k = len(self.models) - 1 - k % min(len(self.models), 2 * MAX_OBJECTS)
        return self.handles[k], self.models[k]

    def living(self, name):
        return next((k for k, m in enumerate(self.models) if m.name == name and not m.deleted and not m.freed), None)

    def item(self):
        self.items += 1
        return Item(self.items, tuple(range(self.items % 4)))

    # -- which objects there are -----------------------------------------------------------------------------

    @rule(
        name=st.integers(0, NAMES - 1),
        rate=st.sampled_from([(1, 0), (1, 0), (2, 0), (2, 1), (3, 2)]),
        slots=st.integers(4, 7),
        flags=st.sampled_from(FLAGS),
        parent=indices,
    )
    def insert(self, name, rate, slots, flags, parent):
        every, phase = rate
        below, above = None, None
        if self.models:
            handle, model = self.pick(parent)
            if not model.deleted and not model.freed:
                below, above = handle, model
        history_ns = slots * every * TICK_NS
        spec = every, phase, slots, flags, below.oid if below else 0, history_ns
        known = self.living(f"a/o{name}")
        replaces = known is not None and self.models[known].spec != spec
        orphan = above is not None and replaces and self.goes_with(above, known)
        if known is None or replaces:
            for model in self.models:
                model.freed = model.freed or model.is_over(self.now)
        full = sum(not model.freed for model in self.models) == MAX_OBJECTS
        try:
            handle = self.component.insert(
                f"o{name}",
                Item,
                every=every,
                phase=phase,
                history_s=history_ns * 1e-9,
                budget_bytes=slots * SLOT_BYTES,
                flags=flags,
                n_causes=2,
                parent=below,
            )
        except (StoreFull, Deleted) as error:
            assert orphan if isinstance(error, Deleted) else full  # noqa: PT017
            return
        if known is not None and not replaces:
            assert handle == self.handles[known]
            return
        if replaces:
            self.model_delete(known)
        assert not full
        assert not orphan
        assert (handle.n_slots, handle.head) == (slots, 0)
        assert all(handle.oid > model.oid for model in self.models if not model.freed)
        self.handles.append(handle)
        self.models.append(Model(f"a/o{name}", spec, handle.oid, self.now))

    def goes_with(self, model, k):
        """Whether the deletion of k takes a model along, or is its own."""
        while model is not None:
            if model is self.models[k]:
                return True
            if not model.flags & Flag.WITH_PARENT:
                return False
            above = [m for m in self.models if m.oid == model.parent and not m.deleted and not m.freed]
            model = above[0] if above else None
        return False

    def model_delete(self, k):
        self.models[k].deleted = self.store.cycle, self.now
        for i, model in enumerate(self.models):
            goes = model.flags & Flag.WITH_PARENT and model.parent == self.models[k].oid
            if goes and not model.deleted and not model.freed:
                self.model_delete(i)

    @precondition(lambda self: self.models)
    @rule(k=indices)
    def delete(self, k):
        handle, model = self.pick(k)
        gone = model.deleted or model.freed
        try:
            self.store.delete(handle)
        except (Deleted, ObjectMissing):
            assert gone
            return
        assert not gone
        self.model_delete(self.models.index(model))

    @rule(name=st.integers(0, NAMES - 1), typed=st.booleans())
    def find(self, name, typed):
        known = self.living(f"a/o{name}")
        try:
            found = self.store.find(f"a/o{name}", Item if typed else None)
        except ObjectMissing:
            assert known is None
            return
        assert found.handle == self.handles[known].handle

    @rule(age=ages, pattern=st.sampled_from([None, "a/o[012]", "b/*"]))
    def search(self, age, pattern):
        at = self.now - age * TICK_NS // 2
        fits = [m for m in self.models if pattern is None or (pattern == "a/o[012]" and m.name[-1] in "012")]
        alive = [m.oid for m in fits if not m.deleted and not m.freed]
        assert [obj.oid for obj in self.store.objects(pattern)] == alive
        lived = [m.oid for m in fits if m.lived(at) and not m.freed]
        kept = [m.oid for m in fits if m.lived(at) and not m.is_over(self.now)]
        found = [obj.oid for obj in self.store.objects(pattern, at_ns=at)]
        assert set(kept) <= set(found) <= set(lived)
        assert found == sorted(found)

    # -- writing ---------------------------------------------------------------------------------------------

    @precondition(lambda self: self.models)
    @rule(k=indices, delay=st.integers(-2 * TICK_NS, 3 * TICK_NS), times=st.integers(1, 3))
    def write(self, k, delay, times):
        handle, model = self.pick(k)
        for _ in range(times):
            item, t_data, causes = self.item(), self.now - delay, ((self.items, 7),) * (self.items % 3)
            self.written(model, item, t_data, causes, lambda: handle.write(item, t_data, causes))  # noqa: B023

    @precondition(lambda self: self.models)
    @rule(k=indices, sources=st.lists(indices, min_size=1, max_size=2))
    def write_what_follows_from_others(self, k, sources):
        handle, model = self.pick(k)
        inputs = []
        for source in sources:
            with contextlib.suppress(Deleted, ObjectMissing, AgedOut):
                sample = self.pick(source)[0].latest()
                inputs += [sample] if sample else []
        if not inputs:
            return
        times = [sample.t_data_ns for sample in inputs if not sample.source.flags & STATIC]
        t_data = min(times, default=self.now)
        if model.writes:
            t_data = max(t_data, model.newest)
        item = self.item()
        causes = tuple((sample.source.oid, sample.write) for sample in inputs)
        self.written(model, item, t_data, causes, lambda: handle.write(item, inputs=inputs))

    @precondition(lambda self: self.models)
    @rule(k=indices, delay=st.integers(0, TICK_NS), fails=st.booleans())
    def write_in_place(self, k, delay, fails):
        handle, model = self.pick(k)
        item, t_data = self.item(), self.now - delay

        def fill():
            with handle.frame(t_data_ns=t_data) as frame:
                frame.memory[:] = handle.schema.pack(item)
                if fails:
                    raise NotOwner("abandoned")
            return frame.write

        refusal = model.refusal(t_data)
        opens = not model.deleted and not model.freed and model.may_write()
        if fails and opens:
            with contextlib.suppress(NotOwner):
                fill()
        elif refusal is DataTimeBackward and not opens:
            self.written(model, item, model.newest, (), fill)  # it is too fast before it is anything else
        else:
            self.written(model, item, t_data, (), fill)
        model.begun = model.begun or (opens and (fails or refusal is DataTimeBackward))

    def written(self, model, item, t_data, causes, write):
        refusal = model.refusal(t_data)
        try:
            number = write()
        except (TooFast, Deleted, ObjectMissing, DataTimeBackward) as error:
            raised = Deleted if isinstance(error, ObjectMissing) else type(error)
            if refusal is Deleted and raised is DataTimeBackward:
                assert t_data < model.newest
            else:
                assert raised is refusal
            model.refused += raised is TooFast
            return
        assert refusal is None
        model.write(item, self.now, t_data, causes)
        assert number == len(model.writes)

    @rule(times=st.integers(1, 3))
    def tick(self, times):
        for _ in range(times):
            cycle = self.store.tick()
            expected = {}
            for handle, model in zip(self.handles, self.models, strict=True):
                if not model.deleted and not model.freed:
                    model.tick(cycle)
                    if model.edges and model.edges[-1][0] == cycle:
                        expected[handle.handle] = model.edges[-1][1]
            assert {handle: raw[1] for handle, raw in self.store.core.changed()} == expected

    # -- reading ---------------------------------------------------------------------------------------------

    @precondition(lambda self: self.models)
    @rule(k=indices, age=st.integers(-1, 40))
    def any_cut(self, k, age):
        cycle, now = max(0, self.store.cycle - age), self.now
        handle, model = self.pick(k)
        expected = model.visible(cycle, now, self.store.cycle)
        assert seen(self.store.at_cycle(cycle).get, handle) == expected
        assert seen(self.store.at(cycle * TICK_NS + 7).get, handle) == expected

    @rule(age=st.integers(0, 4))
    def a_young_cut_of_all(self, age):
        cycle, now = max(0, self.store.cycle - age), self.now
        for handle, model in zip(self.handles, self.models, strict=True):
            assert seen(self.store.at_cycle(cycle).get, handle) == model.visible(cycle, now, self.store.cycle)

    @precondition(lambda self: self.models)
    @rule(k=indices, back=st.integers(-2, 12))
    def read(self, k, back):
        handle, model = self.pick(k)
        number = max(0, len(model.writes) - back)
        assert seen(handle.read, number) == model.read(number, self.now)
        after = max(0, len(model.writes) - back)
        assert seen(handle.next, after) == model.next(after, self.now)
        assert seen(handle.latest) == model.latest(self.now)

    @precondition(lambda self: self.models)
    @rule(k=indices, age=ages, half=st.integers(0, 1))
    def as_of_a_time(self, k, age, half):
        handle, model = self.pick(k)
        t_ns = self.now - age * TICK_NS // 2 - half
        assert seen(handle.as_of, t_ns) == model.as_of(t_ns, self.now, 1)
        assert seen(handle.as_of_data, t_ns) == model.as_of(t_ns, self.now, 2)

    @precondition(lambda self: self.models)
    @rule(k=indices, begin=st.integers(0, 30), length=st.integers(0, 30))
    def history(self, k, begin, length):
        handle, model = self.pick(k)
        t0, t1 = self.now - begin * TICK_NS, self.now + (length - begin) * TICK_NS
        if model.is_over(self.now):
            return
        rows = handle.history(t0, t1)
        expected = [w for w in range(model.oldest, len(model.writes) + 1) if t0 <= model.writes[w - 1][1] <= t1]
        assert rows["write"].tolist() == expected
        assert rows["value"]["n"].tolist() == [model.writes[w - 1][0].n for w in expected]
        assert rows["t_data_ns"].tolist() == [model.writes[w - 1][2] for w in expected]

    # -- images ----------------------------------------------------------------------------------------------

    @rule()
    def save(self):
        self.image = self.store.save(), self.store.cycle, copy.deepcopy(self.models)

    @precondition(lambda self: self.image)
    @rule()
    def restore(self):
        image, cycle, models = self.image
        self.store.restore(image)
        later = self.models[len(models) :]
        for model in later:
            model.freed = True  # their handles name nothing, and never will
        self.models = copy.deepcopy(models) + later
        assert self.store.cycle == cycle

    @invariant()
    def what_lives_is_as_modelled(self):
        cycle, now = self.store.cycle, self.now
        cut = self.store.snapshot()
        for handle, model in zip(self.handles, self.models, strict=True):
            if not model.deleted and not model.freed:
                shows = seen(cut.get, handle)
                assert shows == model.visible(cycle, now, cycle)
                assert shows is not AgedOut
                assert (handle.head, handle.refused) == (len(model.writes), model.refused)


TestStoreIsItsModel = StoreMachine.TestCase
TestStoreIsItsModel.settings = settings(
    max_examples=300, stateful_step_count=50, deadline=None, suppress_health_check=list(HealthCheck)
)
