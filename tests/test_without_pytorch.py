"""Planning without PyTorch: every planner but MPNet and MPiNets, views, certificates."""

from helpers.commands import python

BLOCKED = """
import sys, time
time.perf_counter = time.process_time  # limits do not depend on what else runs
sys.modules["torch"] = None  # importing it raises ImportError
import numpy as np
import robotdiffuse as rd
from robotdiffuse.cli import main
from robotdiffuse.perception.ray_caster import looking_at, ray_cast

robot = rd.load_robot("panda")
start, goal = (np.array([turn, 0.3, 0.0, -1.9, 0.0, 2.2, 0.785]) for turn in (0.9, -0.9))
scene = rd.Scene([rd.Sphere([0.5, 0.0, 0.4], 0.15)])
problem = rd.Problem(robot, scene, start, rd.JointGoal(goal[None]))
print(rd.plan(problem, time_limit=10.0).solved, "onnxruntime" in sys.modules)
for name in ("robotdiffuse", "diffusion", "mpd", "edmp"):
    result = rd.load_planner(name).plan(problem, time_limit=60.0)
    print(name, result.solved, rd.verify(problem, result.path).valid)
    assert result.solved, result.reason
print("certified", rd.certify(problem, result.trajectory) is not None)

T = looking_at(np.array([-1.2, 0.4, 1.0]), np.array([0.4, 0.0, 0.3]))
view = ray_cast(scene, T, (120.0, 120.0, 79.5, 59.5), (160, 120), robot, start)
seen = rd.Problem(robot, rd.Scene(), start, rd.JointGoal(goal[None]), views=[view], unknown="predicted")
result = rd.plan(seen, time_limit=60.0)
print(result.solved, result.assumption != "", 0 < result.confidence <= 1)
for name in ("mpnet", "mpinets"):
    try:
        rd.load_planner(name).plan(problem)
    except rd.InputError as error:
        print(error)
print(main(["train", "encoder", "--out", "nowhere"]))
"""


def test_without_pytorch_all_but_its_planners_and_training_works() -> None:
    said = python(BLOCKED).stdout.splitlines()
    assert said[0] == "True False", "the default planner loads no network"
    assert said[1:6] == [*[f"{name} True True" for name in ("robotdiffuse", "diffusion", "mpd", "edmp")], "certified True"]
    assert said[6] == "True True True", "a scene that a camera saw, with predicted unknown space"
    for name, line in zip(("mpnet", "mpinets"), said[7:9], strict=True):
        assert line == f'the planner {name} needs torch, not installed: pip install "robotdiffuse[train]"'
    assert said[9] == "2"


WITHOUT_EXTRAS = """
import inspect, sys
sys.modules["torch"] = sys.modules["mcap"] = None  # importing them raises ImportError
import robotdiffuse as rd
from robotdiffuse import *
print(set(rd.__all__) <= {name for name, _ in inspect.getmembers(rd)}, isinstance(rd.Scene(), RopDataset))
for use in (lambda: RopDataset("rop"), lambda: read_depth_views("views.mcap", rd.load_robot("panda"))):
    try:
        use()
    except rd.InputError as error:
        print(error)
"""


def test_names_that_need_an_extra_are_there_without_it_and_say_so_when_they_are_called() -> None:
    """Regression: `from robotdiffuse import *` and `help(robotdiffuse)` raised in a core install."""
    said = python(WITHOUT_EXTRAS).stdout.splitlines()
    assert said[0] == "True False"
    assert said[1] == 'rd.RopDataset: this needs torch, not installed: pip install "robotdiffuse[train]"'
    assert said[2].startswith("rd.read_depth_views: this needs mcap, ")
