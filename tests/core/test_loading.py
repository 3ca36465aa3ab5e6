"""Loading does not count as time of a call, but preparing a scene does; Ctrl-C ends programs."""

import signal
from dataclasses import replace

import numpy as np
import pytest
from numba import njit
from numba.core.compiler_lock import global_compiler_lock

import robotdiffuse as rd
from helpers.commands import python
from helpers.panda import LEFT, PANDA, RIGHT
from helpers.waiting import stop_clock
from robotdiffuse.collision import exact_meshes, kernel_arrays
from robotdiffuse.core.deadline import LONG, OutOfTimeError, check_time, check_timing, deadline
from robotdiffuse.core.interrupts import delay_interrupts
from robotdiffuse.core.kernels import inner_kernel, kernel
from robotdiffuse.core.loading import compile_seconds, compiled, loading, loading_seconds
from robotdiffuse.planning.context import PlanningContext
from robotdiffuse.planning.search.rrt import RRTConnect
from robotdiffuse.robots.kinematic_tree import once_per_robot
from robotdiffuse.trajectories import speed_limits


def test_a_delayed_signal_survives_an_error() -> None:
    """Regression: if the block raised, Ctrl-C was lost."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # background jobs ignore it
    with pytest.raises(KeyboardInterrupt), delay_interrupts():
        signal.raise_signal(signal.SIGINT)
        raise ValueError
    signal.signal(signal.SIGINT, before)


FIRST_CALLS = """
import sys, time
import numpy as np
import robotdiffuse as rd
import robotdiffuse.core.kernels  # its listener must hear of Numba's work before the one below
from numba.core import event
from robotdiffuse.perception.ray_caster import looking_at, ray_cast

FINGERS = ["panda_leftfinger", "panda_rightfinger"]
late, real = [0.0], time.perf_counter
time.perf_counter = lambda: real() + late[0]

def takes_long():
    late[0] += 1000.0

class Slow(event.Listener):
    def on_start(self, event): takes_long()
    def on_end(self, event): pass

class SlowImports:
    def find_spec(self, *_):
        takes_long()

robot, q = rd.load_robot("panda"), np.array([-0.4, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])
goal, way = q + [1.4, 0, 0, 0, 0, 0, 0], q + [0.7, -0.3, 0, 0, 0, 0, 0]
box = rd.Box(center=[0.45, 0.3, 0.3], size=[0.1, 0.1, 0.6])
cloud = rd.PointCloud([[0.45, 0.3, 0.3], [0.45, 0.3, 0.4]], 0.02)
pose = rd.PoseGoal(robot.tip, robot.fk(goal, robot.tip))
ball = rd.MovingObstacle(rd.Sphere([0.5, -0.9, 0.5], 0.08), velocity=[0.0, 0.1, 0.0])
upright = rd.AxisCone(robot.tip, [0, 0, 1], [0, 0, -1], 0.6)
camera = looking_at(np.array([-0.5, 1.1, 1.2]), np.array([0.6, 0.0, 0.5]))
view = ray_cast(rd.Scene([box]), camera, (60, 60, 40, 30), (80, 60))
holding = robot.attach(rd.Box(center=[0, 0, 0.15], size=[0.05, 0.05, 0.1], name="cup"), "panda_hand", FINGERS)
calls = [
    rd.Problem(robot, rd.Scene([box]), q, goal),
    rd.Problem(robot, rd.Scene([box, cloud]), q, pose, waypoints=(way,), blend=0.1),
    rd.Problem(robot, rd.Scene([box]), q, goal, moving=(ball,)),
    rd.Problem(robot, rd.Scene([box]), q, goal, start_velocity=[0.2, 0, 0, 0, 0, 0, 0]),
    rd.Problem(robot, rd.Scene([box]), q, goal, constraints=(upright,)),
    rd.Problem(robot, rd.Scene(), q, goal, views=[view]),
    rd.Problem(holding, rd.Scene([box, cloud]), q, goal),
]
event.register("numba:compiler_lock", Slow())
sys.meta_path.insert(0, SlowImports())
for problem in calls:
    result = rd.plan(problem, time_limit=300.0, until="first")
    print(result.status.value, result.reason)
assert late[0] > 0, "nothing was loaded"
"""


def test_loading_takes_no_time_of_the_call(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = stop_clock(monkeypatch)
    middle = (PANDA.lower + PANDA.upper) / 2
    context = PlanningContext("test", rd.Problem(PANDA, rd.Scene(), middle, middle))
    before = context.elapsed
    clock.now += 1.0
    with loading(), loading():
        clock.now += 5.0
        assert context.elapsed - before == pytest.approx(1.0)
    with global_compiler_lock:  # which Numba holds while it compiles or reads its cache
        clock.now += 5.0

    @once_per_robot
    def build(_: rd.Robot) -> None:
        clock.now += 5.0

    build(PANDA)
    assert context.elapsed - before == pytest.approx(1.0)


def test_compile_time_is_all_of_the_block_that_compiles(monkeypatch: pytest.MonkeyPatch) -> None:
    """Regression: the note gave 17.6 s of 95 s."""
    clock = stop_clock(monkeypatch)
    count = len(compiled)
    before = compile_seconds()
    loaded = loading_seconds()
    with global_compiler_lock:
        clock.now += 3.0
        njit(lambda x: x + 1)(1)
        clock.now += 2.0
    with loading():
        clock.now += 7.0
    assert len(compiled) > count
    assert compile_seconds() - before == pytest.approx(5.0)
    assert loading_seconds() - loaded == pytest.approx(12.0)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_first_calls_load_outside_their_time() -> None:
    """Regression: `rd.plan` in a fresh process timed out while it loaded. Here each load takes far longer than the limit."""
    printed = python(FIRST_CALLS).stdout
    assert [line.split()[0] for line in printed.splitlines()] == ["solved"] * 7, printed


def test_python_cannot_call_an_inner_kernel() -> None:
    """Inner kernels have no wrapper for Python; without this check, a call would end the process."""

    @inner_kernel()
    def plus_one(x):
        return x + 1

    @kernel()
    def twice(x):
        return 2 * plus_one(x)

    assert twice(3) == 8
    with pytest.raises(TypeError, match="plus_one is an inner kernel"):
        plus_one(3)


def wall(sides: int = 20) -> rd.Mesh:
    """A wall across the straight path, of two triangles for each square."""
    x, z = np.meshgrid(np.linspace(0.3, 0.6, sides), np.linspace(0.0, 0.5, sides))
    at = (np.arange(sides - 1)[:, None] * sides + np.arange(sides - 1)).ravel()
    faces = np.concatenate([np.stack([at, at + 1, at + sides], 1), np.stack([at + 1, at + sides + 1, at + sides], 1)])
    return rd.Mesh(np.stack([x.ravel(), 0 * x.ravel(), z.ravel()], axis=1), faces, name="wall")


def problem(*shapes: rd.Mesh | rd.PointCloud) -> rd.Problem:
    return rd.Problem(PANDA, rd.Scene(list(shapes)), LEFT, RIGHT)


def test_steps_are_begun_while_there_is_time_and_long_ones_if_it_is_enough() -> None:
    check_time("anything", 1e9)
    with deadline(lambda: 1.0):
        check_time("a short step")
        check_time("a long step", 0.9)
        with pytest.raises(OutOfTimeError, match=r"a longer step, which takes about 1\.1 s"):
            check_time("a longer step", 1.1)
    with deadline(lambda: 1e-3):
        check_time("a short step", 0.1)
    with deadline(lambda: -1e-3), pytest.raises(OutOfTimeError, match=r"^a short step$"):
        check_time("a short step")
    check_time("anything", 1e9)
    # timing is begun a little late too
    with deadline(lambda: -0.5 * LONG):
        check_timing("a step")
        with pytest.raises(OutOfTimeError, match=r"rows, which takes about 0\.3 s"):
            check_timing("rows", 1.5 * LONG)
    with deadline(lambda: -1.5 * LONG), pytest.raises(OutOfTimeError, match=r"^a step$"):
        check_timing("a step")


@pytest.mark.parametrize("more", [{}, {"jerk": 100.0}, {"velocity_scaling": 0.01}])
def test_a_motion_whose_timing_takes_too_long_is_a_time_out(more: dict, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(speed_limits, "SECONDS_PER_ROW", 1e3)
    result = RRTConnect().plan(problem(), 20.0, **more)
    assert result.status is rd.Status.TIMEOUT
    assert "time limit is too short for timing: there was no time for the" in result.reason
    assert "rows of a motion of" in result.reason


def test_a_motion_too_long_to_be_validated_ends_the_search() -> None:
    """Regression: the search used up its time limit, and the reason did not name the validation."""
    joints = tuple(replace(joint, velocity=1e-6) for joint in PANDA.joints)
    result = RRTConnect().plan(rd.Problem(replace(PANDA, joints=joints), rd.Scene(), LEFT, RIGHT), 600.0)
    assert result.status is rd.Status.NO_PATH
    assert "the motion takes 1.8" in result.reason


def test_a_grid_of_too_many_points_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernel_arrays, "GRID_SECONDS_PER_POINT", 1e3)
    result = RRTConnect().plan(problem(wall()), time_limit=20.0)
    assert result.status is rd.Status.TIMEOUT
    assert "time limit is too short to prepare the scene" in result.reason
    assert "the grid of" in result.reason


def test_meshes_end_with_the_time() -> None:
    meshes = [wall(sides) for sides in (3, 4, 5)]
    with deadline(iter([1.0, 1.0, -1.0]).__next__), pytest.raises(OutOfTimeError, match="1 of 3 meshes"):
        kernel_arrays.compile_scene_for(PANDA, rd.Scene(meshes))


@pytest.mark.parametrize("cloud", [False, True])
def test_a_tree_of_the_validator_that_takes_too_long_is_refused(cloud: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """The start collides, so the exact meshes are needed to say where."""
    vertices = wall().vertices - wall().vertices.mean(axis=0) + PANDA.fk(LEFT)[:3, 3]
    asked = problem(rd.PointCloud(vertices, 0.01) if cloud else rd.Mesh(vertices, wall().faces))
    monkeypatch.setattr(exact_meshes, "TREE_SECONDS_PER_ELEMENT", 1e3)
    refused = RRTConnect().plan(asked, time_limit=20.0)
    assert refused.status is rd.Status.TIMEOUT
    assert "the validator's tree over the" in refused.reason
    monkeypatch.undo()
    assert RRTConnect().plan(asked, time_limit=20.0).status is rd.Status.INVALID_START


EXITS = """
import atexit, sys, threading, time
from robotdiffuse.core.interrupts import exit_fast
def late():
    time.sleep(0.2)
    print("thread", flush=True)
def run():
    atexit.register(print, "handler", flush=True)
    threading.Thread(target=late).start()
    {}
exit_fast(run)
"""


@pytest.mark.parametrize(("end", "status"), [("return 3", 3), ("sys.exit(4)", 4), ("raise ValueError", 1), ("sys.exit()", 0)])
def test_an_exit_waits_for_threads_and_handlers(end: str, status: int) -> None:
    ended = python(EXITS.format(end), status)
    assert ended.stdout.split() == ["thread", "handler"]
    assert ("ValueError" in ended.stderr) == (status == 1)


SWALLOWING = """
import ctypes, signal, time
from robotdiffuse.core.interrupts import exit_on_interrupt
with exit_on_interrupt(lambda: print("tidy", flush=True)):
    try:
        ctypes.CFUNCTYPE(None)(lambda: signal.raise_signal(signal.SIGINT))()
        time.sleep(0.1)
    except BaseException:
        pass
    print("lives", flush=True)
"""


def test_ctrl_c_is_not_lost_in_callbacks_and_stays_ignored_if_it_is() -> None:
    """Regression: `robot add` ran on for minutes after Ctrl-C was pressed while compiled code was loaded."""
    # background jobs of a shell ignore SIGINT
    ended = python("import signal; signal.signal(signal.SIGINT, signal.default_int_handler)" + SWALLOWING, 130)
    assert (ended.stdout, ended.stderr) == ("tidy\n", "robotdiffuse: stopped\n")
    assert python("import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)" + SWALLOWING).stdout == "lives\n"
