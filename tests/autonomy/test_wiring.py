"""Stack files, and the swap of one module: what is wrong is said in one line, before anything runs."""

import json
from pathlib import Path
from typing import Any

import pytest

from autonomy import ModuleError
from autonomy.follow import Follow
from autonomy.guard import Guard
from autonomy.loading import load_module, make_module
from autonomy.wiring import Stack, Wire, load_stack

REFERENCE = Path(__file__).resolve().parents[2] / "autonomy" / "stacks" / "reference.json"

STUDENT = """\
from autonomy import Input, Module, Output, Param
from hal.signals import STOP, DriveCommand, FollowState, Pose


class Dodge(Module):
    pose = Input(Pose)
    drive = Output(DriveCommand, safe=STOP)
    state = Output(FollowState, safe=FollowState())
    gap_m = Param(1.0, unit="m")
    brave = Param(False)
    tries = Param(3)
    side = Param("left")

    def step(self):
        self.drive = STOP
        self.state = FollowState()


class Unfinished(Module):
    pose = Input(Pose)


class Angry(Module):
    def __init__(self):
        raise OSError("no licence")

    def step(self):
        pass


class NotAModule:
    pass
"""


@pytest.fixture
def student(tmp_path: Path) -> Path:
    file = tmp_path / "dodge.py"
    file.write_text(STUDENT)
    return file


def said(error: pytest.ExceptionInfo[ModuleError]) -> str:
    """Give the message, which must be one line."""
    text = str(error.value)
    assert text
    assert "\n" not in text
    return text


def write(tmp_path: Path, stack: Any) -> Path:
    file = tmp_path / "mine.json"
    file.write_text(stack if isinstance(stack, str) else json.dumps(stack))
    return file


def entry(**changed: Any) -> dict[str, Any]:
    full = {"module": "autonomy.follow:Follow", "every": 4, "phase": 2, "inputs": {"pose": "localise/pose"}}
    return {key: value for key, value in (full | changed).items() if value is not None}


ACTUATORS = {"inputs": {"drive": "guard/drive"}}


def test_reference_stack_names_its_modules_in_their_order_and_the_command() -> None:
    stack = load_stack(REFERENCE)
    assert [wire.component for wire in stack.wires] == ["localise", "follow", "guard"]
    assert stack.command == "guard/drive"
    assert [type(make_module(wire)).__name__ for wire in stack.wires] == ["Localise", "Follow", "Guard"]


BAD_STACKS = {
    "not JSON": ("{", ["not JSON"]),
    "not text": ("\x00\xff", ["not JSON"]),
    "a list": ([], ["actuators"]),
    "no actuators": ({"follow": entry()}, ["actuators"]),
    "actuators without inputs": ({"actuators": {}}, ["actuators", "drive"]),
    "actuators without drive": ({"actuators": {"inputs": {"speed": "a/b"}}}, ["actuators", "drive"]),
    "actuators that obey a number": ({"actuators": {"inputs": {"drive": 3}}}, ["actuators", "drive"]),
    "actuators' inputs are a list": ({"actuators": {"inputs": ["drive"]}}, ["actuators", "drive"]),
    "entry is text": ({"actuators": ACTUATORS, "follow": "autonomy.follow:Follow"}, ["follow", "autonomy.follow"]),
    "entry is a list": ({"actuators": ACTUATORS, "follow": ["module"]}, ["follow"]),
    "misspelt key": ({"actuators": ACTUATORS, "follow": entry(evry=4)}, ["follow", "evry", "every"]),
    "no module": ({"actuators": ACTUATORS, "follow": entry(module=None)}, ["follow", "'module'", "missing"]),
    "no inputs": ({"actuators": ACTUATORS, "follow": entry(inputs=None)}, ["follow", "'inputs'", "missing"]),
    "module is a number": ({"actuators": ACTUATORS, "follow": entry(module=7)}, ["follow", "module", "7"]),
    "inputs are a list": ({"actuators": ACTUATORS, "follow": entry(inputs=["pose"])}, ["follow", "inputs"]),
    "pointer is a number": ({"actuators": ACTUATORS, "follow": entry(inputs={"pose": 1})}, ["follow", "inputs"]),
    "params are a list": ({"actuators": ACTUATORS, "follow": entry(params=[1])}, ["follow", "params"]),
    "phase too large": ({"actuators": ACTUATORS, "follow": entry(phase=4)}, ["follow", "every=4", "phase=4"]),
    "negative phase": ({"actuators": ACTUATORS, "follow": entry(phase=-1)}, ["follow", "phase=-1"]),
    "never": ({"actuators": ACTUATORS, "follow": entry(every=0, phase=0)}, ["follow", "every=0"]),
    "fraction of a tick": ({"actuators": ACTUATORS, "follow": entry(every=2.5)}, ["follow", "every=2.5"]),
    "truth as a number": ({"actuators": ACTUATORS, "follow": entry(every=True, phase=0)}, ["follow", "every=True"]),
}


@pytest.mark.parametrize("case", BAD_STACKS)
def test_bad_stack_file_is_one_line_with_file_component_and_cause(tmp_path: Path, case: str) -> None:
    stack, words = BAD_STACKS[case]
    file = write(tmp_path, stack)
    with pytest.raises(ModuleError) as error:
        load_stack(file)
    for word in (str(file), *words):
        assert word in said(error)


def test_stack_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(ModuleError, match="no stack file") as error:
        load_stack(tmp_path / "mine.json")
    assert str(tmp_path / "mine.json") in said(error)


# -- modules -----------------------------------------------------------------------------------------------------


def test_swapped_module_inherits_period_phase_and_inputs(student: Path) -> None:
    before = load_stack(REFERENCE)
    after = before.use("guard", f"{student}:Dodge")
    old, new = before.wires[2], after.wires[2]
    assert (new.component, new.every, new.phase, new.inputs) == (old.component, old.every, old.phase, old.inputs)
    assert new.module == f"{student}:Dodge"
    assert after.wires[:2] == before.wires[:2]
    assert after.command == before.command
    assert before.wires[2].module == "autonomy.guard:Guard"


def test_swapped_module_does_not_get_parameters_of_the_one_before(student: Path) -> None:
    stack = Stack((Wire("follow", "autonomy.follow:Follow", 4, 2, {}, {"lookahead_s": 1.0}),), "follow/drive")
    assert stack.use("follow", f"{student}:Dodge").wires[0].params == {}


def test_swap_of_a_component_that_the_stack_lacks_names_those_it_has(student: Path) -> None:
    with pytest.raises(ModuleError) as error:
        load_stack(REFERENCE).use("folow", f"{student}:Dodge")
    assert "folow" in said(error)
    assert "localise, follow, guard" in said(error)


def test_module_is_loaded_from_a_file_and_from_a_package(student: Path) -> None:
    assert load_module(f"{student}:Dodge").__name__ == "Dodge"
    assert load_module("autonomy.follow:Follow") is Follow


def test_two_files_of_the_same_name_do_not_mix(tmp_path: Path) -> None:
    for folder, docstring in (("a", "first"), ("b", "second")):
        (tmp_path / folder).mkdir()
        text = f'from autonomy import Module\nclass M(Module):\n    """{docstring}"""\n    def step(self): pass\n'
        (tmp_path / folder / "m.py").write_text(text)
    loaded = [load_module(f"{tmp_path / folder / 'm.py'}:M") for folder in ("a", "b")]
    assert [cls.__doc__ for cls in loaded] == ["first", "second"]


def test_missing_class_is_named_with_what_the_file_has(student: Path) -> None:
    for name in ("Doge", "NotAModule", "Module", ""):
        with pytest.raises(ModuleError, match=f"no Module named {name}") as error:
            load_module(f"{student}:{name}")
        assert str(student) in said(error)
        assert "it has Dodge, Unfinished, Angry" in said(error)


BAD_SPECS = {
    "no class": ("dodge", "FILE.py:Class"),
    "no file": ("nowhere/dodge.py:Dodge", "no file nowhere/dodge.py"),
    "no package": ("autonomy.dodge:Dodge", "No module named 'autonomy.dodge'"),
    "nothing": ("", "FILE.py:Class"),
    "no place": (":Dodge", "FILE.py:Class"),
}


@pytest.mark.parametrize("case", BAD_SPECS)
def test_module_that_cannot_be_found_is_named(case: str) -> None:
    spec, words = BAD_SPECS[case]
    with pytest.raises(ModuleError) as error:
        load_module(spec)
    assert words in said(error)


BAD_FILES = {
    "syntax": ("def step(self:\n", ["SyntaxError", "line 1"]),
    "import": ("import cv3\n", ["ModuleNotFoundError", "No module named 'cv3'"]),
    "raises": ("1 / 0\n", ["ZeroDivisionError", "division by zero"]),
    "exits": ("import sys\nsys.exit(0)\n", ["SystemExit"]),
}


@pytest.mark.parametrize("case", BAD_FILES)
def test_file_that_cannot_be_loaded_is_named_with_the_cause(tmp_path: Path, case: str) -> None:
    text, causes = BAD_FILES[case]
    file = tmp_path / "broken.py"
    file.write_text(text)
    with pytest.raises(ModuleError) as error:
        load_module(f"{file}:Dodge")
    for word in (str(file), *causes):
        assert word in said(error)


def test_class_that_cannot_be_made_is_named_with_the_cause(student: Path) -> None:
    for name, cause in (("Unfinished", "step"), ("Angry", "OSError: no licence")):
        with pytest.raises(ModuleError) as error:
            make_module(Wire("follow", f"{student}:{name}", 4, 2, {"pose": "localise/pose"} if name != "Angry" else {}))
        assert f"{student}:{name}" in said(error)
        assert cause in said(error)


# -- inputs and parameters ---------------------------------------------------------------------------------------


def test_input_that_is_not_wired_is_named() -> None:
    with pytest.raises(ModuleError, match="guard: input pose of Guard is not wired"):
        make_module(Wire("guard", "autonomy.guard:Guard", 4, 3, {"drive_in": "follow/drive"}))


def test_wired_input_that_the_module_lacks_is_named_with_those_it_has() -> None:
    inputs = {"drive_in": "follow/drive", "pose": "localise/pose", "poes": "localise/pose"}
    with pytest.raises(ModuleError, match="guard: Guard has no input poes; it has ") as error:
        make_module(Wire("guard", "autonomy.guard:Guard", 4, 3, inputs))
    assert all(name in said(error) for name in Guard.inputs)


def test_unknown_parameter_is_named_with_those_that_there_are(student: Path) -> None:
    with pytest.raises(ModuleError, match="follow: Dodge has no parameter gap; it has gap_m, brave, tries, side"):
        make_module(Wire("follow", f"{student}:Dodge", 4, 2, {"pose": "localise/pose"}, {"gap": 1.0}))


@pytest.mark.parametrize(
    ("name", "value", "wanted"),
    [
        ("gap_m", "wide", "float [m]"),
        ("gap_m", True, "float [m]"),
        ("gap_m", None, "float [m]"),
        ("tries", 2.5, "int"),
        ("tries", True, "int"),
        ("brave", 1, "bool"),
        ("side", 1, "str"),
    ],
)
def test_parameter_of_the_wrong_type_is_named_with_the_wanted_one(
    student: Path, name: str, value: Any, wanted: str
) -> None:
    with pytest.raises(ModuleError) as error:
        make_module(Wire("follow", f"{student}:Dodge", 4, 2, {"pose": "localise/pose"}, {name: value}))
    assert f"parameter {name} is a {wanted}" in said(error)
    assert repr(value) in said(error)


def test_parameters_of_the_right_type_are_set(student: Path) -> None:
    params = {"gap_m": 2, "brave": True, "tries": 5, "side": "right"}
    module: Any = make_module(Wire("follow", f"{student}:Dodge", 4, 2, {"pose": "localise/pose"}, params))
    assert (module.gap_m, module.brave, module.tries, module.side) == (2.0, True, 5, "right")
    assert type(module.gap_m) is float
