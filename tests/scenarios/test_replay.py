"""Replay: what a recording holds is in the rerun file, and a viewer shows it."""

import math
import time
from contextlib import closing, suppress
from ctypes.util import find_library
from datetime import timedelta
from http.client import HTTPConnection
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest
from rerun.chunk import RrdReader
from rerun.experimental import ViewerClient

from hal.signals import (
    ActorsTruth,
    ActuatorCommand,
    ActuatorState,
    CartTruth,
    Clearance,
    Course,
    DriveCommand,
    FaultEvent,
    FixQuality,
    FollowState,
    GpsFix,
    GuardState,
    Hold,
    LocalPlane,
    ObstacleKind,
    Pose,
    SafetyState,
    Scan,
    Scene,
    Site,
    SystemState,
)
from rtdb import STATIC, Record, Store
from rtdb.recorder import Recorder
from rtdb.recording import Recording
from rtdb.records import f8, flag
from scenarios.metrics import METRICS, Evidence
from scenarios.replay import BELIEVED, MEASURED, RED, TRUE, WANTED, LiveView, Viewer, ViewerFailed, convert

TICK_NS = 10_000_000
CYCLES = 2000
RADIUS_M, SPEED_MPS = 12.0, 2.5
PLANE = LocalPlane.at(math.radians(39.1829), math.radians(-86.5243))
CAR_M = (14.0, 14.0)


class Bump(Record, frozen=True):
    """A record that only a student knows."""

    shake_mps2: Annotated[float, f8("m/s2", "how hard it shakes")] = 0.0
    loud: Annotated[bool, flag("it can be heard")] = False


def truth_at(cycle: int) -> CartTruth:
    """A left-hand circle about (0, 12)."""
    yaw = SPEED_MPS * cycle * TICK_NS * 1e-9 / RADIUS_M
    return CartTruth(
        x_m=RADIUS_M * math.sin(yaw),
        y_m=RADIUS_M * (1 - math.cos(yaw)),
        yaw_rad=yaw,
        speed_mps=SPEED_MPS,
        steer_rad=math.atan(1.66 / RADIUS_M),
    )


def scan_at(truth: CartTruth) -> Scan:
    """Rays against a circle around the car; exact enough for a picture."""
    angles = np.linspace(-math.pi / 2, math.pi / 2, 181)
    mount = 1.9
    px, py = truth.x_m + mount * math.cos(truth.yaw_rad), truth.y_m + mount * math.sin(truth.yaw_rad)
    dx, dy = CAR_M[0] - px, CAR_M[1] - py
    along = dx * np.cos(angles + truth.yaw_rad) + dy * np.sin(angles + truth.yaw_rad)
    beside2 = dx * dx + dy * dy - along * along
    hit = (along > 0) & (beside2 < 4.0)
    ranges = np.where(hit, along - np.sqrt(np.maximum(4.0 - beside2, 0.0)), 20.0)
    return Scan(-math.pi / 2, math.pi / 180, 20.0, mount, tuple(np.minimum(ranges, 20.0).tolist()))


class Synthetic:
    """Two stores with everything that a replay knows, and something that it does not."""

    def __init__(self, *, world: bool = True) -> None:
        self.cart = Store.create(None, tick_ns=TICK_NS, t0_ns=10**18)
        self.world = Store.create(None, tick_ns=TICK_NS, t0_ns=10**18)
        mission = self.cart.join("mission")
        mission.insert("site", Site, history_s=0.1, flags=STATIC).write(
            Site("here", PLANE.lat_rad, PLANE.lon_rad, 235.0)
        )
        points = [PLANE.to_geo(RADIUS_M * math.sin(a), RADIUS_M * (1 - math.cos(a))) for a in (1.0, 2.0, 3.0, 4.0)]
        course = Course(tuple(p[0] for p in points), tuple(p[1] for p in points), (3.0,) * 4, SPEED_MPS)
        mission.insert("course", Course, history_s=0.1, flags=STATIC).write(course)
        self.writers: dict[str, Any] = {}
        owners: dict[str, Any] = {}
        for name, cls in (
            ("localise/pose", Pose),
            ("gps/fix", GpsFix),
            ("synlaser/scan", Scan),
            ("safety/state", SafetyState),
            ("guard/state", GuardState),
            ("follow/state", FollowState),
            ("follow/drive", DriveCommand),
            ("actuators/command", ActuatorCommand),
            ("actuators/state", ActuatorState),
            ("student/bump", Bump),
        ):
            component, _, obj = name.partition("/")
            owner = owners.setdefault(component, None) or self.cart.join(component)
            owners[component] = owner
            self.writers[name] = owner.insert(obj, cls, history_s=0.1)
        if world:
            truth = self.world.join("world")
            scene = Scene(
                kind=(ObstacleKind.CAR, ObstacleKind.ISLAND),
                x_m=(CAR_M[0], -8.0),
                y_m=(CAR_M[1], 26.0),
                z_m=(0.75, 0.08),
                yaw_rad=(0.4, 0.0),
                length_m=(4.5, 6.0),
                width_m=(1.8, 2.0),
                height_m=(1.5, 0.15),
                boundary_x_m=(-25.0, 25.0, 25.0, -25.0),
                boundary_y_m=(-8.0, -8.0, 32.0, 32.0),
            )
            truth.insert("scene", Scene, history_s=0.1, flags=STATIC).write(scene)
            for obj, kind in (
                ("cart", CartTruth),
                ("actors", ActorsTruth),
                ("clearance", Clearance),
                ("fault", FaultEvent),
            ):
                self.writers[f"world/{obj}"] = truth.insert(obj, kind, history_s=0.1)
        self.n = 0

    @property
    def stores(self) -> list[Store]:
        return [self.cart, self.world]

    def _write(self, name: str, record: Record, t_data_ns: int | None = None) -> None:
        if name in self.writers:
            self.writers[name].write(record, t_data_ns)

    def step(self) -> None:
        """Write what the next tick shows, and tick."""
        n, t_ns, truth = self.n, self.cart.now_ns, truth_at(self.n)
        self._write("world/cart", truth)
        away = 0.3 + 0.0002 * n
        self._write(
            "localise/pose",
            Pose(
                truth.x_m + away, truth.y_m, truth.yaw_rad, SPEED_MPS, 0.2, (0.2, 0.1, 0, 0.1, 0.1, 0, 0, 0, 0.01), 0.5
            ),
        )
        self._write("follow/drive", DriveCommand(SPEED_MPS, truth.steer_rad))
        self._write("actuators/command", ActuatorCommand(SPEED_MPS, truth.steer_rad, 0.0, True), t_ns - 40_000_000)
        self._write("actuators/state", ActuatorState(truth.steer_rad))
        self._write("student/bump", Bump(math.sin(n / 50), n % 400 > 300))
        if n % 20 == 0:
            lat_rad, lon_rad = PLANE.to_geo(truth.x_m + 0.8, truth.y_m - 0.5)
            self._write("gps/fix", GpsFix(3, FixQuality.DIFFERENTIAL, lat_rad, lon_rad, sigma_east_m=1.0))
        if n % 10 == 0:
            self._write("synlaser/scan", scan_at(truth))
            walked = n * TICK_NS * 1e-9
            self._write("world/actors", ActorsTruth((ObstacleKind.PERSON,), (-10.0 + walked,), (10.0,), (0.0,)))
            self._write("world/clearance", Clearance(max(0.0, 5.0 - 0.2 * walked)))
            self._write("follow/state", FollowState(min(3, n // 450), False, 0.1 * math.sin(n / 100)))
            self._write("guard/state", GuardState(Hold.OBSTACLE if 800 <= n < 1000 else Hold.NONE))
            self._write("safety/state", SafetyState(SystemState.ENABLED if n > 100 else SystemState.READY))
        if n in (1200, 1500):
            self._write("world/fault", FaultEvent("gps-outage", n == 1200))
        self.cart.tick()
        self.world.tick()
        self.n += 1

    def record(self, path: Path) -> Recording:
        with Recorder(path, self.stores, {"scenario": "test/circle", "seed": "7"}) as recorder:
            for _ in range(CYCLES):
                self.step()
                recorder.record()
        for store in self.stores:
            store.close()
        return Recording(path)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return Synthetic().record(tmp_path_factory.mktemp("replay") / "run.mcap")


@pytest.fixture(scope="module")
def rrd(recording: Recording) -> Path:
    return convert(recording, RESULT, recording.path.with_name("run.rrd"))


RESULT = {
    "verdict": "FAIL",
    "reason": "",
    "duration_s": 20.0,
    "criteria": [
        {
            "metric": "stop_distance_m",
            "op": "<=",
            "limit": 2.0,
            "unit": "m",
            "value": "inf",
            "at_s": None,
            "verdict": "FAIL",
        }
    ],
    "metrics": {"stop_distance_m": "inf", "pose_error_max_m": 0.7},
}


def columns(path: Path, entity: str) -> dict[str, list[Any]]:
    """All columns of an entity, over its chunks."""
    found: dict[str, list[Any]] = {}
    for chunk in RrdReader(str(path)).stream():
        if str(chunk.entity_path) == entity:
            for name, values in chunk.to_record_batch().to_pydict().items():
                found.setdefault(name, []).extend(values)
    return found


def rows(path: Path) -> dict[str, int]:
    """Rows of each entity."""
    counted: dict[str, int] = {}
    for chunk in RrdReader(str(path)).stream():
        name = str(chunk.entity_path)
        counted[name] = counted.get(name, 0) + chunk.num_rows
    return counted


def test_everything_that_was_recorded_is_an_entity(rrd: Path) -> None:
    wanted = {
        "/summary",
        "/scene/course/line",
        "/scene/course/waypoints",
        "/scene/obstacles",
        "/scene/boundary",
        "/scene/world/actors",
        "/scene/world/cart",
        "/scene/world/cart/front_left_steer",
        "/scene/world/cart_line",
        "/scene/localise/pose/cart",
        "/scene/localise/pose/ellipse",
        "/scene/localise/pose_line",
        "/scene/gps/fix",
        "/scene/synlaser/scan",
        "/scene/synlaser/scan/rays",
        "/signals/localise/pose/error_m",
        "/signals/actuators/command/latency_s",
        "/states/safety/state/state",
        "/states/world/fault/gps-outage",
    }
    assert wanted <= rows(rrd).keys()


def test_each_write_is_one_row(rrd: Path, recording: Recording) -> None:
    counted = rows(rrd)
    for topic, entity in (
        ("world/cart", "/scene/world/cart"),
        ("world/cart", "/signals/world/cart/speed_mps"),
        ("localise/pose", "/scene/localise/pose/cart"),
        ("gps/fix", "/signals/gps/fix/sigma_east_m"),
        ("synlaser/scan", "/signals/synlaser/scan/max_m"),
        ("world/actors", "/scene/world/actors"),
    ):
        assert counted[entity] == len(recording.channels[topic].raw), entity


def test_states_are_rows_only_where_they_change(rrd: Path) -> None:
    assert [s for row in columns(rrd, "/states/guard/state/hold")["StateChange:state"] for s in row or ()] == [
        "NONE",
        "OBSTACLE",
        "NONE",
    ]


def test_signals_of_an_unknown_record_are_shown_under_its_component(rrd: Path, recording: Recording) -> None:
    counted = rows(rrd)
    assert counted["/signals/student/bump/shake_mps2"] == len(recording.channels["student/bump"].raw)
    assert counted["/states/student/bump/loud"] > 2


def test_last_pose_of_the_cart_is_that_of_the_recording(rrd: Path, recording: Recording) -> None:
    last = recording.read("world/cart", CartTruth)[-1]
    shown = columns(rrd, "/scene/world/cart")
    x, y, z = shown["Transform3D:translation"][-1][0]
    qx, qy, qz, qw = shown["Transform3D:quaternion"][-1][0]
    assert (x, y, z) == pytest.approx((last.value.x_m, last.value.y_m, 0.0), abs=1e-4)
    assert (qx, qy, qz, qw) == pytest.approx(
        (0, 0, math.sin(last.value.yaw_rad / 2), math.cos(last.value.yaw_rad / 2)), abs=1e-5
    )
    assert shown["cycle"][-1] == last.cycle
    assert shown["time"][-1] == timedelta(microseconds=last.cycle * TICK_NS / 1000)


def test_errors_and_latencies_are_those_of_the_metrics(rrd: Path, recording: Recording) -> None:
    evidence = Evidence(recording)
    for metric, entity in (
        ("pose_error_max_m", "/signals/localise/pose/error_m"),
        ("latency_max_s", "/signals/actuators/command/latency_s"),
    ):
        measured = METRICS[metric].measure(evidence)
        assert measured is not None
        assert max(row[0] for row in columns(rrd, entity)["Scalars:scalars"] if row) == pytest.approx(measured.value)


def test_fixes_lie_where_the_receiver_said(rrd: Path) -> None:
    x, y, _ = columns(rrd, "/scene/gps/fix")["Points3D:positions"][-1][0]
    truth = truth_at(CYCLES - 20)
    assert (x, y) == pytest.approx((truth.x_m + 0.8, truth.y_m - 0.5), abs=0.01)


def test_ellipse_has_two_sigma(rrd: Path) -> None:
    """Mapping the unit circle gives points at Mahalanobis distance 2."""
    matrix = np.array(columns(rrd, "/scene/localise/pose/ellipse")["Transform3D:mat3x3"][-1][0]).reshape(3, 3).T[:2, :2]
    covariance = np.array([[0.2, 0.1], [0.1, 0.1]])
    for angle in (0.0, 1.0, 2.0):
        point = matrix @ [math.cos(angle), math.sin(angle)]
        assert math.sqrt(point @ np.linalg.solve(covariance, point)) == pytest.approx(2.0, abs=1e-4)


def test_summary_has_the_verdict_and_the_metrics(rrd: Path) -> None:
    text = columns(rrd, "/summary")["TextDocument:text"][0][0]
    assert text.startswith("# FAIL: test/circle, seed 7")
    assert "| stop_distance_m | never | <= 2 m |  | FAIL |" in text
    assert "| pose_error_max_m | 0.7 m |" in text


def test_drive_without_a_world_shows_the_cart_where_it_believes_to_be(tmp_path: Path) -> None:
    real = Synthetic(world=False).record(tmp_path / "real.mcap")
    counted = rows(convert(real, None, tmp_path / "real.rrd"))
    assert counted["/scene/localise/pose"] == len(real.channels["localise/pose"].raw)
    assert not [name for name in counted if "world" in name or name.endswith("/error_m")]


@pytest.mark.filterwarnings("ignore:RRD file has no footer")
def test_running_drive_shows_what_its_recording_shows(tmp_path: Path, rrd: Path) -> None:
    """Row for row, although it came in batches; trails and states do not begin anew in each."""
    live, run = tmp_path / "live.rrd", Synthetic()
    with LiveView(run.stores, "live", Viewer(options=["--save", str(live)])) as view:
        for n in range(CYCLES):
            run.step()
            view.record()
            if n % 331 == 0:
                view.flush()
        view.flush()
        wanted = {
            name: n
            for name, n in rows(rrd).items()
            if name.startswith(("/signals", "/states", "/scene/gps", "/scene/world/actors"))
        }
        got: dict[str, int] = {}
        deadline = time.monotonic() + 20.0  # the process that writes the file gets it through a socket
        while got != wanted and time.monotonic() < deadline:
            with suppress(RuntimeError):  # the last message of the file is half written
                got = {name: n for name, n in rows(live).items() if name in wanted}
    assert got == wanted


def test_viewer_that_is_closed_during_a_drive_does_not_stop_it(tmp_path: Path) -> None:
    run, viewer = Synthetic(), Viewer(options=["--save", str(tmp_path / "live.rrd")])
    with LiveView(run.stores, "live", viewer) as view:
        for _ in range(200):
            run.step()
            view.record()
        view.flush()
        viewer.close()
        run.step()
        view.record()
        view.flush()


def test_without_a_display_a_browser_is_served_on_loopback_and_all_of_it_ends(
    rrd: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SSH_CONNECTION", "there")
    with Viewer(rrd) as viewer:
        page, sink = urlsplit(viewer.address), urlsplit(viewer.sink)
        assert page.hostname == sink.hostname == "127.0.0.1"
        with closing(HTTPConnection(page.netloc, timeout=10)) as connection:
            connection.request("GET", "/")
            assert b"<canvas" in connection.getresponse().read()
    for address in (page, sink):
        with closing(HTTPConnection(address.netloc, timeout=1)) as connection, pytest.raises(ConnectionRefusedError):
            connection.connect()


def test_viewer_that_cannot_start_says_why() -> None:
    with pytest.raises(ViewerFailed, match="no-such-option"):
        Viewer(options=["--no-such-option"])


# -- a real viewer, without a screen ----------------------------------------------------------------------------------

SCENE_COLOURS = {"course": WANTED, "true line": TRUE, "believed line": BELIEVED, "fixes": MEASURED, "boundary": RED}


@pytest.fixture
def software_vulkan(monkeypatch: pytest.MonkeyPatch) -> None:
    driver = next(Path("/usr/share/vulkan/icd.d").glob("lvp_icd*.json"), None)
    if driver is None or find_library("vulkan") is None:
        pytest.skip("no software Vulkan driver (lavapipe): install mesa-vulkan-drivers libvulkan1")
    monkeypatch.setenv("VK_ICD_FILENAMES", str(driver))


def missing(png: bytes) -> list[str]:
    """Parts of the scene of whose colour there are not even 30 pixels."""
    picture = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    distance = {
        part: np.abs(picture[:, :, ::-1].astype(int) - colour).max(axis=2) for part, colour in SCENE_COLOURS.items()
    }
    return [part for part, far in distance.items() if (far < 30).sum() < 30]


@pytest.mark.usefixtures("software_vulkan")
def test_viewer_shows_the_scene_without_complaint(rrd: Path, tmp_path: Path) -> None:
    with Viewer(options=["--headless", "--hide-welcome-screen"]) as viewer:
        client = ViewerClient.connect(viewer.sink)
        assert not client.open(str(rrd.resolve())).loading
        client.set_time("cycle", sequence=CYCLES // 2, play_state="paused")
        deadline = time.monotonic() + 60.0
        gone = ["everything"]
        while gone and time.monotonic() < deadline:  # the first pictures show a fading welcome and half-loaded views
            views = {view.name: view for view in client.get_state().views}
            if "Course" in views:
                gone = missing(client.take_screenshot(views["Course"].view_id))
        (tmp_path / "viewer.png").write_bytes(client.take_screenshot())
        assert not gone, f"not in {tmp_path / 'viewer.png'}"
        assert {"Course", "Behind the cart", "States", "Summary", "Speed, m/s"} <= views.keys()
        assert not [report for view in client.get_state().views for report in view.reports]
