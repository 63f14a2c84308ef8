"""What inputs are wired to: numbers in records, JSON, ranges; and wiring that changes while the system runs."""

import json
import math
from pathlib import Path
from typing import Any, ClassVar

import pytest

from autonomy import Input, Module, ModuleError, Output, Param
from autonomy.host import Host
from autonomy.loading import load_module, make_module
from autonomy.module import HOLD_STEPS
from autonomy.pointer import field_at
from autonomy.wiring import Stack, Wire, check_stack, required, stack_with
from hal.signals import DriveCommand, GpsFix, ModuleState, ModuleStatus, Odometry, Pose, Scan
from rtdb import Sample, Store, Writer, schema_of
from rtdb.json_object import json_schema

TICK_NS = 10_000_000
STACKS = Path(__file__).resolve().parents[2] / "autonomy" / "stacks"


class Reads(Module):
    """Remembers the number that it reads."""

    speed_mps = Input(float, unit="m/s")
    drive = Output(DriveCommand, safe=DriveCommand(steer_rad=0.125))

    def reset(self) -> None:
        self.seen: list[float] = []

    def step(self) -> None:
        self.seen.append(self.speed_mps)
        self.drive = DriveCommand()


class ReadsIfThere(Module):
    """The same, and goes on without."""

    speed_mps = Input(float, unit="m/s", low=-1.0, high=3.0, optional=True, max_age_s=0.05)
    drive = Output(DriveCommand, safe=DriveCommand())

    def reset(self) -> None:
        self.seen: list[float | None] = []

    def step(self) -> None:
        self.seen.append(self.speed_mps)
        self.drive = DriveCommand()


class Careful(Module):
    """Works with slow commands only."""

    drive_in = Input(DriveCommand, narrow={"speed_mps": (0.0, 2.0)})
    drive = Output(DriveCommand, safe=DriveCommand(), narrow={"speed_mps": (0.0, 1.0), "steer_rad": (-0.2, 0.2)})

    def step(self) -> None:
        self.drive = DriveCommand(speed_mps=self.drive_in.speed_mps / 2)


class Follows(Module):
    """Reads a whole record."""

    odometry = Input(Odometry, optional=True)
    drive_in = Input(DriveCommand)
    drive = Output(DriveCommand, safe=DriveCommand())

    def step(self) -> None:
        self.drive = self.drive_in


class KnowsItsPlace(Module):
    """Says itself what it reads."""

    pose = Input(Pose, pointer="source/pose")
    hdop = Input(float, unit="1", pointer="source/gps#/hdop", optional=True)
    gain = Param(1.0, unit="1")
    drive = Output(DriveCommand, safe=DriveCommand())

    def step(self) -> None:
        self.drive = DriveCommand(speed_mps=self.gain * self.pose.x_m)


class Counts(Module):
    """Has a memory, and randomness in it."""

    pose = Input(Pose)
    drive = Output(DriveCommand, safe=DriveCommand())
    made: ClassVar[list[float]] = []

    def reset(self) -> None:
        self.n, self.walk = 0, [0.0]

    def step(self) -> None:
        self.n += 1
        self.walk = [*self.walk[-3:], self.walk[-1] + float(self.rng.normal()) * 1e-3]
        self.drive = DriveCommand(self.n * 1e-3, self.walk[-1])


class Rig:
    """A source that writes what a test says, and one module."""

    def __init__(self, cls: type[Module], inputs: dict[str, str], *, connect: bool = True, **wire: Any) -> None:
        self.store = Store.create(tick_ns=TICK_NS)
        self.source = self.store.join("source")
        self.pose = self.source.insert("pose", Pose)
        self.gps = self.source.insert("gps", GpsFix)
        self.scan = self.source.insert("scan", Scan)
        self.fast = self.source.insert("drive", DriveCommand)
        self.json: Writer[Any] = self.source.insert("json", json_schema(300))
        module = f"{cls.__module__}:{cls.__qualname__}"
        self.wire = Wire("mine", module, wire.pop("every", 1), wire.pop("phase", 0), inputs, **wire)
        self.host = Host(self.store, self.wire, 0)
        if connect:
            self.host.connect()

    @property
    def module(self) -> Any:
        return self.host.module

    def tick(self, **written: Any) -> int:
        for name, value in written.items():
            getattr(self, name).write(value)
        cycle = self.store.tick()
        self.host.step(cycle)
        return cycle

    def shown(self, name: str, cls: type[Any] | None = None) -> Sample[Any] | None:
        return self.store.find(f"mine/{name}", cls).visible(self.store.cycle)

    @property
    def status(self) -> ModuleStatus:
        sample = self.shown("status", ModuleStatus)
        assert sample is not None
        found: ModuleStatus = sample.value
        return found

    def configure(self, **changed: Any) -> None:
        config: Writer[Any] = Writer(self.store, self.store.core.find("mine/config"))
        config.write(self.wire.entry() | changed)


def refused(cls: type[Module], inputs: dict[str, str]) -> str:
    """Why an input cannot be wired so; one line that names it."""
    rig = Rig(cls, inputs, connect=False)
    with pytest.raises(ModuleError) as error:
        rig.host.connect()
    text = str(error.value)
    assert "\n" not in text
    (name, pointer), *_ = inputs.items()
    assert text.startswith(f"mine.{name} = {pointer}: ")
    return text


# -- numbers ----------------------------------------------------------------------------------------------------------


def test_number_of_a_record_is_read_from_the_cut() -> None:
    rig = Rig(Reads, {"speed_mps": "source/pose#/speed_mps"})
    for k in range(4):
        rig.tick(pose=Pose(speed_mps=float(k)))
    assert rig.module.seen == [0.0, 1.0, 2.0, 3.0]
    sample = rig.shown("drive", DriveCommand)
    assert sample is not None
    assert sample.causes == ((rig.pose.oid, 3),)


def test_number_of_a_list_is_read_by_its_index() -> None:
    class_ = type("Metres", (Reads,), {"speed_mps": Input(float, unit="m"), "__module__": __name__})
    globals()["Metres"] = class_
    rig = Rig(class_, {"speed_mps": "source/scan#/range_m/1"})
    rig.tick(scan=Scan(range_m=(5.0, 6.0)))
    rig.tick(scan=Scan(range_m=(5.0, 7.0)))
    assert rig.module.seen == [6.0, 7.0]
    rig.tick(scan=Scan(range_m=(5.0,)))
    rig.tick()
    assert "there is no element '1' in /range_m, a list of 1" in rig.status.reason


WRONG_NUMBERS = {
    "source/pose#/yaw_rad": "/yaw_rad is in rad, this input is in m/s",
    "source/pose#/speed": "Pose has no /speed; there is /x_m, /y_m, /yaw_rad, /speed_mps",
    "source/pose": "a number [m/s] is wired to a field: source/pose#/FIELD",
    "source/pose#": "the whole object is no number",
    "source/pose#speed_mps": "is no number; point at one: #/FIELD",
    "source/gps#/course_valid": "/course_valid is no number",
    "source/gps#/quality": "/quality is no number",
    "source/gps#/hdop": "/hdop is in 1, this input is in m/s",
    "source/scan#/range_m": "/range_m is a list of 181; point at one number: /range_m/0",
    "source/scan#/range_m/first": "range_m is a list of 181, from 0 on",
    "source/pose#/covariance/9": "covariance is a list of 9, from 0 on",
    "source/pose#/speed_mps/0": "Pose has no /speed_mps/0; there is nothing below that",
    "source/poes#/speed_mps": "cannot find source/poes: it is not there",
}


@pytest.mark.parametrize("pointer", WRONG_NUMBERS)
def test_number_that_cannot_be_had_is_named_in_one_line(pointer: str) -> None:
    assert WRONG_NUMBERS[pointer] in refused(Reads, {"speed_mps": pointer})


def test_number_whose_writer_may_leave_the_range_is_refused() -> None:
    inputs = {"speed_mps": "source/drive#/speed_mps"}
    said = refused(ReadsIfThere, inputs)
    assert "/speed_mps may be -1.5 to 5.5 m/s, this input takes -1 to 3; narrow the output, or widen the input" in said


def test_input_without_a_unit_is_refused() -> None:
    with pytest.raises(ModuleError, match=r'Nameless.speed: a number needs a unit: Input\(float, unit="m"\)'):

        class Nameless(Reads):
            speed = Input(float, unit="")


def test_record_is_wired_to_a_whole_object() -> None:
    assert "a DriveCommand is wired to a whole object: source/drive" in refused(
        Follows, {"drive_in": "source/drive#/speed_mps"}
    )
    assert field_at(schema_of(Pose), "/covariance/8").unit == "m2, m rad, rad2"


# -- JSON -------------------------------------------------------------------------------------------------------------


def test_number_of_a_json_object_is_read_with_the_unit_of_its_key() -> None:
    rig = Rig(Reads, {"speed_mps": "source/json#/wanted/speed_mps"})
    rig.tick(json={"wanted": {"speed_mps": 1.5}})
    rig.tick(json={"wanted": {"speed_mps": 2}})
    assert rig.module.seen == [1.5, 2.0]


@pytest.mark.parametrize(
    ("document", "why"),
    [
        ({}, "there is no key 'speed_mps'"),
        ({"speed_mps": True}, "got a bool True"),
        ({"speed_mps": "2"}, "got a string '2'"),
        ({"speed_mps": None}, "got null"),
    ],
)
def test_json_that_does_not_fit_counts_as_absent(document: dict[str, Any], why: str) -> None:
    rig = Rig(Reads, {"speed_mps": "source/json#/speed_mps"})
    rig.tick(json={"speed_mps": 1.0})
    rig.tick(json=document)
    for _ in range(HOLD_STEPS + 2):
        rig.tick()
    assert rig.module.seen == [1.0]
    assert rig.status.state is ModuleState.STALE
    assert "input speed_mps (source/json#/speed_mps) cannot be used: " in rig.status.reason
    assert why in rig.status.reason
    sample = rig.shown("drive", DriveCommand)
    assert sample is not None
    assert sample.value == DriveCommand(steer_rad=0.125)
    rig.tick(json={"speed_mps": 3.0})
    assert rig.module.seen == [1.0, 3.0]


def test_text_that_is_no_json_counts_as_absent() -> None:
    """Another program says that it writes JSON, and does not."""
    rig = Rig(Reads, {"speed_mps": "source/json#/speed_mps"})
    rig.tick(json={"speed_mps": 1.0})
    rig.store.core.write(rig.json.handle, b"{oops".ljust(rig.json.size, b"\0"), rig.store.now_ns, ())
    for _ in range(2):
        rig.tick()
    assert rig.status.state is ModuleState.STALE
    assert rig.status.reason.startswith("input speed_mps (source/json#/speed_mps) cannot be read: not JSON")
    rig.tick(json={"speed_mps": 2.0})
    assert rig.module.seen == [1.0, 2.0]


def test_unit_of_a_json_key_that_is_another_one_is_said_at_each_read() -> None:
    rig = Rig(Reads, {"speed_mps": "source/json#/speed_kmh"})
    rig.tick(json={"speed_kmh": 7.2})
    rig.tick()
    assert rig.module.__dict__.get("seen") is None, "never called"
    assert "m/s is expected, the key says km/h" in rig.status.reason


def test_optional_number_out_of_range_or_stale_reads_none() -> None:
    rig = Rig(ReadsIfThere, {"speed_mps": "source/json#/speed_mps"})
    for speed_mps in (2.0, 4.0, -1.0):
        rig.tick(json={"speed_mps": speed_mps})
    for _ in range(7):
        rig.tick()
    assert rig.module.seen == [2.0, None, -1.0, *[-1.0] * 4, None, None, None]  # 0.05 s since it was written


def test_record_is_read_from_json_by_the_names_of_its_fields() -> None:
    rig = Rig(Follows, {"drive_in": "source/json"})
    rig.tick(json={"speed_mps": 1.5, "steer_rad": 0.25, "comment": "hello"})
    rig.tick(json={"speed_mps": 9.0})
    sample = rig.shown("drive", DriveCommand)
    assert sample is not None
    assert sample.value == DriveCommand(1.5, 0.25)
    rig.tick()
    assert "/speed_mps: a number in [-1.5, 5.5] m/s is expected, got 9.0" in rig.status.reason


def test_record_that_is_no_plain_numbers_is_not_read_from_json() -> None:
    rig = Rig(KnowsItsPlace, {"pose": "source/json"}, connect=False)
    with pytest.raises(ModuleError, match="a Pose cannot be read from JSON: covariance is no plain number"):
        rig.host.connect()


# -- ranges -----------------------------------------------------------------------------------------------------------


def test_input_that_takes_less_than_its_writer_gives_is_refused() -> None:
    said = refused(Careful, {"drive_in": "source/drive"})
    assert "its DriveCommand may have speed_mps from -1.5 to 5.5 m/s, this input takes 0 to 2" in said


def test_narrowed_output_fits_a_narrow_input() -> None:
    rig = Rig(Careful, {"drive_in": "source/drive"}, connect=False)
    after = Host(rig.store, Wire("next", f"{__name__}:Careful", 1, 0, {"drive_in": "mine/drive"}), 0)
    after.connect()
    stored = rig.store.find("mine/drive", DriveCommand).stored
    ranges = {f.name: (f.spec.low, f.spec.high) for f in stored.fields}
    assert ranges == {"speed_mps": (0.0, 1.0), "steer_rad": (-0.2, 0.2), "decel_mps2": (0.0, 1.5)}


@pytest.mark.parametrize(
    ("narrow", "why"),
    [
        ({"speed": (0.0, 1.0)}, "DriveCommand has no number speed; it has speed_mps, steer_rad, decel_mps2"),
        ({"speed_mps": (0.0, 9.0)}, "speed_mps from 0 to 9 is not within DriveCommand's own range, -1.5 to 5.5 m/s"),
        ({"speed_mps": (2.0, 1.0)}, "is not within"),
        ({"speed_mps": (math.nan, 1.0)}, "is not within"),
    ],
)
def test_range_that_is_none_of_the_records_is_refused_when_the_class_is_made(
    narrow: dict[str, tuple[float, float]], why: str
) -> None:
    for port in (Output(DriveCommand, safe=DriveCommand(), narrow=narrow), Input(DriveCommand, narrow=narrow)):
        with pytest.raises(ModuleError) as error:
            type("Wide", (Follows,), {"port": port})
        assert str(error.value).startswith("Wide.port: ")
        assert why in str(error.value)


class Unsafe(Follows):
    """Its safe value is one that it may not give."""

    drive = Output(DriveCommand, safe=DriveCommand(), narrow={"speed_mps": (1.0, 2.0)})


def test_safe_value_out_of_range_is_refused_before_anything_moves() -> None:
    wire = Wire("mine", f"{__name__}:Unsafe", 1, 0, {"drive_in": "source/drive"})
    with pytest.raises(ModuleError, match=r"mine: the safe value of drive speed_mps=0 is outside 1 to 2 m/s"):
        make_module(wire)


# -- wiring -----------------------------------------------------------------------------------------------------------


def test_port_says_itself_what_it_reads_unless_the_wiring_does() -> None:
    rig = Rig(KnowsItsPlace, {})
    rig.tick(pose=Pose(x_m=0.5), gps=GpsFix(hdop=1.25))
    rig.tick()
    sample = rig.shown("drive", DriveCommand)
    assert sample is not None
    assert sample.value.speed_mps == 0.5
    assert rig.module.hdop == 1.25
    assert rig.wire.objects() == {"pose": "source/pose", "hdop": "source/gps"}
    elsewhere = Wire("mine", rig.wire.module, 1, 0, {"pose": "other/pose"})
    assert elsewhere.objects() == {"pose": "other/pose", "hdop": "source/gps"}


def follows(component: str, of: str) -> Wire:
    return Wire(component, f"{__name__}:Follows", 1, 0, {"drive_in": f"{of}/drive"})


def test_modules_that_wait_for_each_other_are_refused() -> None:
    with pytest.raises(ModuleError) as error:
        check_stack(Stack((follows("a", "b"), follows("b", "a")), "a/drive"))
    assert str(error.value) == "a needs b, b needs a: nobody can begin; make one of these inputs optional"
    with pytest.raises(ModuleError, match="a needs c, c needs b, b needs a: nobody can begin"):
        check_stack(Stack((follows("x", "a"), follows("a", "c"), follows("b", "a"), follows("c", "b")), "x/drive"))
    with pytest.raises(ModuleError, match="a needs a: nobody can begin"):
        check_stack(Stack((follows("a", "a"),), "a/drive"))


def test_loop_through_an_optional_input_can_begin() -> None:
    first = Wire("a", f"{__name__}:ReadsIfThere", 1, 0, {"speed_mps": "b/drive#/speed_mps"})
    stack = Stack((first, follows("b", "a")), "b/drive")
    check_stack(stack)
    assert required(stack) == {"a", "b"}
    assert required(Stack((first, follows("b", "a"), follows("c", "b")), "b/drive")) == {"a", "b"}


def test_stack_that_waits_for_itself_is_refused_before_anything_starts(tmp_path: Path) -> None:
    stack: dict[str, Any] = {"a": follows("a", "b").entry(), "b": follows("b", "a").entry()}
    file = tmp_path / "round.json"
    file.write_text(json.dumps(stack | {"actuators": {"inputs": {"drive": "a/drive"}}}))
    with pytest.raises(ModuleError, match="nobody can begin"):
        stack_with(file, [])


def test_student_file_is_loaded_once_however_its_path_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "mine.py").write_text("from autonomy import Module\nclass M(Module):\n    def step(self): pass\n")
    monkeypatch.chdir(tmp_path)
    assert load_module("mine.py:M") is load_module("mine.py:M") is load_module(f"{tmp_path}/mine.py:M")


# -- rewiring ---------------------------------------------------------------------------------------------------------


def test_wiring_that_is_written_while_it_runs_is_taken_at_the_next_edge() -> None:
    rig = Rig(KnowsItsPlace, {})
    other = rig.source.insert("other", Pose)
    other.write(Pose(x_m=3.0))
    rig.tick(pose=Pose(x_m=1.0))
    rig.configure(inputs={"pose": "source/other"}, params={"gain": 0.5})
    speeds = []
    for _ in range(3):
        rig.tick(pose=Pose(x_m=1.0))
        sample = rig.shown("drive", DriveCommand)
        assert sample is not None
        speeds.append(sample.value.speed_mps)
    assert speeds == [1.0, 1.5, 1.5]
    assert rig.status.state is ModuleState.RUNNING
    assert rig.status.reason == "wired anew in cycle 2"
    rig.configure()
    rig.tick()
    rig.tick()
    assert rig.module.gain == 1.0, "the default again"


WRONG_WIRING: dict[str, tuple[dict[str, Any], str]] = {
    "missing pointer": ({"inputs": {"pose": "source/poes"}}, "mine.pose = source/poes: cannot find source/poes"),
    "another record": ({"inputs": {"pose": "source/gps"}}, "mine.pose = source/gps: "),
    "another unit": ({"inputs": {"hdop": "source/pose#/x_m"}}, "/x_m is in m, this input is in 1"),
    "no such input": ({"inputs": {"poes": "source/pose"}}, "KnowsItsPlace has no input poes"),
    "no such parameter": ({"params": {"gian": 1.0}}, "KnowsItsPlace has no parameter gian"),
    "parameter of another type": ({"params": {"gain": "high"}}, "parameter gain is a float"),
    "another pace": ({"every": 2}, "mine: every stays as it is while the system runs"),
    "another module": ({"module": "autonomy.guard:Guard"}, "mine: module stays as it is"),
    "another latency": ({"latency_cycles": 3}, "latency_cycles stays as it is"),
    "unknown key": ({"evry": 2}, "unknown key evry"),
    "nonsense": ({"inputs": 7}, "inputs are"),
}


@pytest.mark.parametrize("case", WRONG_WIRING)
def test_broken_wiring_is_refused_and_the_old_one_stays(case: str) -> None:
    changed, why = WRONG_WIRING[case]
    rig = Rig(KnowsItsPlace, {})
    rig.tick(pose=Pose(x_m=1.0))
    rig.configure(**changed)
    for k in range(4):
        rig.tick(pose=Pose(x_m=1.0 + 0.5 * k))
    sample = rig.shown("drive", DriveCommand)
    assert sample is not None
    assert sample.value.speed_mps == 2.0, "it goes on"
    assert rig.status.state is ModuleState.RUNNING
    assert rig.status.reason.startswith("wiring refused: ")
    assert why in rig.status.reason


def test_configuration_says_how_it_is_wired() -> None:
    rig = Rig(KnowsItsPlace, {"pose": "source/pose"}, params={"gain": 2.0}, latency_cycles=1)
    rig.tick()
    sample = rig.shown("config")
    assert sample is not None
    assert sample.value == {
        "module": f"{__name__}:KnowsItsPlace",
        "every": 1,
        "phase": 0,
        "inputs": {"pose": "source/pose"},
        "params": {"gain": 2.0},
        "latency_cycles": 1,
    }


# -- memory -----------------------------------------------------------------------------------------------------------


def test_module_goes_on_exactly_from_what_it_remembered() -> None:
    import pickle

    rig = Rig(Counts, {"pose": "source/pose"})
    for _ in range(5):
        rig.tick(pose=Pose())
    kept = pickle.dumps(rig.module.memory())
    again = make_module(rig.wire)
    again.restore(pickle.loads(kept))

    def commands(module: Any) -> list[DriveCommand]:
        out = []
        for _ in range(4):
            module.step()
            out.append(module._out[Counts.outputs["drive"]])
        return out

    first, second = commands(rig.module), commands(again)
    assert first == second
    assert first[0].speed_mps == pytest.approx(6e-3)
    assert len({command.steer_rad for command in first}) == 4


# -- show -------------------------------------------------------------------------------------------------------------


class Shows(Module):
    """Shows what the test says."""

    pose = Input(Pose)
    drive = Output(DriveCommand, safe=DriveCommand())
    what: ClassVar[dict[str, Any]] = {}

    def step(self) -> None:
        self.drive = DriveCommand()
        for name, value in self.what.items():
            self.show(name, value)


def shown_of(**what: Any) -> dict[str, Any] | None:
    Shows.what = what
    rig = Rig(Shows, {"pose": "source/pose"})
    rig.tick(pose=Pose())
    rig.tick()
    sample = rig.shown("show")
    return None if sample is None else dict(sample.value)


def test_numbers_texts_and_points_are_shown_as_they_are() -> None:
    import numpy as np

    assert shown_of(gap_m=1.5, n=3, ok=True, why="free", none=None) == {
        "gap_m": 1.5, "n": 3, "ok": True, "why": "free", "none": None,
    }  # fmt: skip
    assert shown_of(line=[(0.0, 1.0), (2.0, 3.0)]) == {"line": [[0.0, 1.0], [2.0, 3.0]]}
    assert shown_of(line=np.array([[0.0, 1.0], [2.0, 3.0]]), x=np.float32(0.5)) == {"line": [[0, 1], [2, 3]], "x": 0.5}
    assert shown_of() is None


def test_what_does_not_fit_is_left_out_and_named() -> None:
    found = shown_of(small=1.0, large=[(0.1 * k, 0.2 * k) for k in range(200)], last=2.0)
    assert found == {"small": 1.0, "left_out": "large", "last": 2.0}


def test_other_things_are_shown_as_text() -> None:
    assert shown_of(pose={"x": 1}, far=math.inf, deep=[[[[1]]]]) == {
        "pose": "{'x': 1}", "far": "inf", "deep": [[["[1]"]]],
    }  # fmt: skip
