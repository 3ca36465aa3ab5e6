"""The commands `robotdiffuse export` and `publish`."""

from robotdiffuse.cli.arguments import Namespace
from robotdiffuse.cli.verify import read_solved
from robotdiffuse.core.errors import InputError, counted
from robotdiffuse.core.types import Trajectory
from robotdiffuse.interop import check_export, write_motion
from robotdiffuse.interop.recorded_motion import publish
from robotdiffuse.problems.problem import Problem
from robotdiffuse.validation.validator import verify_trajectory


def run_export(arguments: Namespace) -> None:
    outputs = [check_export(file, arguments.result) for file in arguments.out]
    problem, trajectory = validated_motion(arguments.result, arguments.rate)
    for file in outputs:
        write_motion(problem, trajectory, file)
        print(f"wrote {file}")


def validated_motion(file: str, rate: float | None = None) -> tuple[Problem, Trajectory]:
    """The problem and the motion of a result file, resampled at `rate` [Hz] if it is given.

    Raises InputError if the file holds no problem or no timed motion, and if the validator rejects the
    motion, because other programs may execute it.
    """

    result, problem = read_solved(file)
    if result.trajectory is None:
        raise InputError(f"{file} holds a path without times; plan again to get a trajectory")
    trajectory = result.trajectory if rate is None else result.trajectory.resample(rate)
    violation = verify_trajectory(problem, trajectory).violation
    if violation is not None:
        rows = "" if rate is None else f" with rows at {rate:g} Hz"
        raise InputError(f"{file} is not exported: its motion{rows} is not valid: {violation.message}")
    return problem, trajectory


def run_publish(arguments: Namespace) -> None:
    host, port = arguments.to
    _, trajectory = validated_motion(arguments.result)
    publish(trajectory, host, port, arguments.topic, arguments.timeout)
    print(f"published {counted(len(trajectory.times), 'row')} on {arguments.topic} at {host}:{port}")
