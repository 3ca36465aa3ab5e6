"""Loading takes no time of a call: on a clock that only the tests move."""

import subprocess
import sys

import pytest
from numba import njit
from numba.core.compiler_lock import global_compiler_lock

import robotdiffuse as rd
from helpers.clock import Clock, stop_clock
from robotdiffuse.core.kernels import inner_kernel, kernel
from robotdiffuse.core.loading import compile_seconds, compiled, loading, loading_seconds
from robotdiffuse.planning.context import PlanningContext
from robotdiffuse.robots.kinematic_tree import once_per_robot

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
    robot = rd.load_robot("panda")
    middle = (robot.lower + robot.upper) / 2
    context = PlanningContext("test", rd.Problem(robot, rd.Scene(), middle, middle))
    before = context.elapsed
    clock.now += 1.0
    with loading(), loading():
        clock.now += 5.0
        assert context.elapsed - before == pytest.approx(1.0)
    with global_compiler_lock:  # which Numba holds while it compiles or reads its cache
        clock.now += 5.0
    _built(clock)(context.problem.robot)
    assert context.elapsed - before == pytest.approx(1.0)


def _built(clock: Clock):
    @once_per_robot
    def build(robot: rd.Robot) -> None:
        clock.now += 5.0

    return build


def test_compile_time_is_all_of_the_block_that_compiles(monkeypatch: pytest.MonkeyPatch) -> None:
    """The note once gave 17.6 s of 95 s."""
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
    """`rd.plan` in a fresh process timed out while it loaded: each load here takes far longer than the
    limit."""
    done = subprocess.run([sys.executable, "-c", FIRST_CALLS], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert [line.split()[0] for line in done.stdout.splitlines()] == ["solved"] * 7, done.stdout


def test_python_cannot_call_an_inner_kernel() -> None:
    """Without code for Python, the call would end the process."""

    @inner_kernel()
    def plus_one(x):
        return x + 1

    @kernel()
    def twice(x):
        return 2 * plus_one(x)

    assert twice(3) == 8
    with pytest.raises(TypeError, match="plus_one is an inner kernel"):
        plus_one(3)
