"""Arguments of the wrong type raise a one-line InputError, for every public function.

The calls run in a separate process: in this one, beartype, which the tests enable, would raise an error first.
"""

from helpers.commands import python

CALLS = """
import os, sys
import numpy as np
import robotdiffuse as rd

panda = rd.load_robot("panda")
middle = (panda.lower + panda.upper) / 2
problem = rd.Problem(panda, rd.Scene([]), middle, middle)
path = rd.Path(panda.joint_names, np.array([middle]))
of_lists, of_none = rd.Path(panda.joint_names, [[0.0] * 7]), rd.Path(None, path.positions)
still = rd.Trajectory(panda.joint_names, None, path.positions, path.positions, path.positions)
motion = rd.Trajectory(panda.joint_names, np.arange(2.0), *3 * [np.zeros((2, 7))])
calls = {
    "plan": rd.plan,
    "plan: time_limit": lambda wrong: rd.plan(problem, time_limit=wrong),
    "plan: seed": lambda wrong: rd.plan(problem, seed=wrong),
    "plan: until": lambda wrong: rd.plan(problem, until=wrong),
    "plan: velocity_scaling": lambda wrong: rd.plan(problem, velocity_scaling=wrong),
    "plan_many": rd.plan_many,
    "plan_many: problem": lambda wrong: rd.plan_many([wrong]),
    "plan_many: workers": lambda wrong: rd.plan_many([], workers=0 if wrong is None else wrong),
    "load_planner": rd.load_planner,
    "load_planner: settings": lambda wrong: rd.load_planner("rrt_connect", wrong),
    "load_planner: weights": lambda wrong: rd.load_planner("diffusion", weights=wrong),
    "verify": lambda wrong: rd.verify(wrong, path),
    "verify: path": lambda wrong: rd.verify(problem, wrong),
    "verify: settings": lambda wrong: rd.verify(problem, path, wrong),
    "certify": lambda wrong: rd.certify(wrong, path),
    "certify: motion": lambda wrong: rd.certify(problem, wrong),
    "load_robot": rd.load_robot,
    "load_robot: locked": lambda wrong: rd.load_robot("panda", {"panda_joint1": wrong}),
    "load_problem": rd.load_problem,
    "load_problem: index": lambda wrong: rd.load_problem("x.yaml", wrong),
    "load_result": rd.load_result,
    "load_certificate": rd.load_certificate,
    "next_view": lambda wrong: rd.next_view(problem, wrong),
    "Replanner": rd.Replanner,
    "show": rd.show,
    "RopDataset": rd.RopDataset,
    "trajectory.at": motion.at,
    "trajectory.resample": motion.resample,
}
for name, call in calls.items():
    for wrong in (None, -1.5, "x", b"x", [], {"a": 1}, np.zeros(2), rd.plan, of_lists, of_none, still):
        try:
            call(wrong)
            print(name, repr(wrong), "is taken")
        except rd.InputError as error:
            if len(str(error).splitlines()) != 1:
                print(name, repr(wrong), "is more than a line")
        except Exception as error:
            print(name, repr(wrong), type(error).__name__, error)
try:
    rd.plan("shelf.yaml")
except rd.InputError as error:
    print(error)
"""


def test_arguments_of_the_wrong_type_are_one_line() -> None:
    ended = python(CALLS)
    rightly = ["plan_many []", *(f"load_planner: {what} None" for what in ("settings", "weights"))]
    at = "trajectory.at []", "trajectory.at array([0., 0.])"
    taken = [f"{call} is taken" for call in (*rightly, "load_robot: locked -1.5", *at)]
    right = "problem is 'shelf.yaml'; it must be a Problem: rd.load_problem('shelf.yaml') reads one from a file"
    assert (ended.stdout.splitlines(), ended.stderr) == ([*taken, right], "")
