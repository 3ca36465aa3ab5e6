"""Path, Trajectory, search Tree, the Status of a planning call, PlanResult, and the result file format."""

import csv
import io
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from enum import Enum
from pathlib import Path as FilePath
from types import FunctionType, NoneType
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, NoReturn, TypeVar, dataclass_transform

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from numpy.typing import ArrayLike

from robotdiffuse.core.errors import (
    MAX_COORDINATE,
    MAX_DURATION,
    MAX_RATE,
    InputError,
    check_name,
    check_type,
    counted,
    distinct,
    joined,
    located,
    numbers,
    one_line,
    repeated,
    rows,
    shown,
)
from robotdiffuse.core.files import JsonObject, check_output, known_ending, read_json, write_atomically
from robotdiffuse.core.settings import Bound, Natural, Number, converted

Configuration = Float[ndarray, "dof"]
"""Joint positions [rad], [m] for prismatic joints."""
AnyConfiguration = ArrayLike | Mapping[str, float]
"""A configuration as numbers in the order of the joints, as a table of values by joint name, or as the name
of one of the robot's poses."""
Configurations = Float[ndarray, "_ dof"]
"""Configurations as rows, such as waypoints, samples and goals."""
JointValues = Float[ndarray, "dof"]
"""A number for each joint, such as its limit, velocity or effort."""
JointRows = Float[ndarray, "_ dof"]
"""Rows with a number for each joint, such as velocities along a motion."""
Values = Float[ndarray, "_"]
"""A list of numbers, such as times, arc lengths and distances."""
Points = Float[ndarray, "_ 3"]
"""[m]"""
Vector = Float[ndarray, "3"]
"""A point [m] or a direction."""
Rotation = Float[ndarray, "3 3"]
"""A rotation matrix."""
Quaternion = Float[ndarray, "4"]
"""A rotation, w x y z."""
Pose = Float[ndarray, "4 4"]
"""A rigid transform."""
Poses = Float[ndarray, "_ 4 4"]
Spheres = Float[ndarray, "_ 4"]
"""Rows of center x y z and radius [m]."""
NO_SPHERES = np.zeros((0, 4))
Mask = Bool[ndarray, "_"]
if TYPE_CHECKING:  # types of fields that hold arrays and can be set to anything that NumPy converts to them

    class _Given:
        def __get__(self, owner: Any, kind: Any = None) -> ndarray: ...
        def __set__(self, owner: Any, value: ArrayLike) -> None: ...

    class _GivenOrNone:
        def __get__(self, owner: Any, kind: Any = None) -> ndarray | None: ...
        def __set__(self, owner: Any, value: ArrayLike | None) -> None: ...

    GivenVector = _Given
    GivenPose = _Given
    GivenConfigurations = _Given
    GivenArray = _Given
    VectorOrNone = _GivenOrNone
    PoseOrNone = _GivenOrNone
    ArrayOrNone = _GivenOrNone
else:
    GivenVector = Vector
    GivenPose = Pose
    GivenConfigurations = Configurations
    GivenArray = ndarray
    VectorOrNone = Vector | None
    PoseOrNone = Pose | None
    ArrayOrNone = ndarray | None
ROWS = ("positions", "velocities", "accelerations")
"""Names of a trajectory's arrays that have a row for each time and a column for each joint."""
REST = 1e-3
"""The arm counts as resting if its speed is at most this fraction of the greatest speed of the motion."""
SampleRate = Annotated[float, Bound(above=0.0, most=1e5)]
"""Rate at which trajectories are resampled [Hz]."""
ACCELERATION_GAIN = 1.005
"""`resample` averages the rows if a joint's greatest acceleration grows by more than this factor, ..."""
ACCELERATION_SHARE = 0.25
"""... or if the acceleration of a row and that of the cubic that begins or ends there differ by more than
this fraction of the joint's greatest acceleration."""
TIME_TOLERANCE = 1e-9
"""A time at most this long before the start, or after the end, of a trajectory counts as the start or the
end; resampled rows are at least this far apart [s]."""


class Status(Enum):
    """How a planning call ended."""

    SOLVED = "solved"
    TIMEOUT = "timeout"
    """No path was found, or none could be timed, within the time limit."""
    NO_PATH = "no_path"
    """The search ended before the time limit without a path or a valid motion."""
    INVALID_START = "invalid_start"
    """The start is in collision or nearly so, breaks a constraint, or cannot hold the payload; or the arm
    cannot stop from its start velocity."""
    INVALID_GOAL = "invalid_goal"
    """Every goal is in collision or nearly so, breaks a constraint, or cannot hold the payload."""
    UNREACHABLE_GOAL = "unreachable_goal"
    """Inverse kinematics found no configuration for the goal pose."""
    ERROR = "error"
    """`plan_many` only: planning this problem raised an error, or killed its process."""


# When planning ends: at the first verified motion, when more time hardly improves the motion, or at the time
# limit.
FIRST = "first"
CONVERGED = "converged"
TIME_LIMIT = "time_limit"
UNTIL = (FIRST, CONVERGED, TIME_LIMIT)

# What anytime planners minimize: the length of the path in joint space, or the duration of the motion.
LENGTH = "length"
TIME = "time"
OBJECTIVES = (LENGTH, TIME)


Done = Callable[[int, int], None]
"""Called with the number of finished calls, motions or other items, and the number of all."""


def unreported(done: int, total: int) -> None:
    """A `Done` that does nothing."""


T = TypeVar("T")


def no_type_check(kind: type[T]) -> type[T]:
    """Mark a class that checks its arguments itself, so that type checkers at run time leave it alone.

    It replaces `typing.no_type_check`, which fails for subclasses of ABC once Twisted (roslibpy) is imported.
    """
    members = [getattr(member, "__func__", member) for member in vars(kind).values()]
    for marked in (kind, *(member for member in members if isinstance(member, FunctionType))):
        setattr(marked, "__no_type_check__", True)  # noqa: B010  (type checkers do not know the attribute)
    return kind


@dataclass_transform(eq_default=False, frozen_default=True, field_specifiers=(field,))
def frozen_dataclass(kind: type[T]) -> type[T]:
    """`dataclass(frozen=True, eq=False)`. It also tells mypy that constructors take all that can be set to a
    field, such as a list for a GivenVector."""
    return dataclass(frozen=True, eq=False)(kind)


class Value:
    """Base of the dataclasses that are values: the arrays and dictionaries in their fields are read-only.

    Caches use the object's identity as the key, so values must not change. Writable arrays and dictionaries
    are copied, so the caller may still change the originals. A subclass that defines `__post_init__` calls
    this class's `__post_init__` at its end.
    """

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        if "__repr__" not in cls.__dict__:  # else @dataclass adds a __repr__ that prints whole arrays
            cls.__repr__ = Value.__repr__

    def __repr__(self) -> str:
        return one_line(self)

    def __dir__(self) -> list[str]:
        """The attributes, without the caches that modules keep in `__dict__` under their dotted names."""
        return [name for name in super().__dir__() if "." not in name]

    def __post_init__(self) -> None:
        self.__setstate__({entry.name: getattr(self, entry.name) for entry in fields(self)})  # type: ignore

    def __setstate__(self, state: dict[str, Any]) -> None:
        # arrays from a pickle or a deep copy are writable
        self.__dict__.update({name: read_only(value) for name, value in state.items()})


def read_only(value: T) -> T:
    """Returns the value unchanged if all its arrays and dictionaries are read-only, else a copy in which they
    are. Those in tuples and dictionaries count too."""
    if isinstance(value, np.ma.MaskedArray):  # what a mask hides is missing
        return read_only(value.astype(np.float64).filled(np.nan))  # type: ignore[return-value]
    if isinstance(value, ndarray):
        if not _writable(value):
            return value
        frozen = np.array(value)
        frozen.setflags(write=False)
        return frozen  # type: ignore[return-value]
    if isinstance(value, tuple):
        frozen = [read_only(entry) for entry in value]
        if all(a is b for a, b in zip(frozen, value, strict=True)):
            return value
        return value._make(frozen) if hasattr(value, "_make") else tuple(frozen)  # type: ignore
    if isinstance(value, dict) and not isinstance(value, ReadOnlyDict):
        return ReadOnlyDict({key: read_only(entry) for key, entry in value.items()})  # type: ignore
    return value


class ReadOnlyDict(dict[Any, Any]):
    """A read-only dictionary in a field of a `Value`. Its copy, dict(...), can be changed."""

    def _refuse(self, *_: Any, **__: Any) -> NoReturn:
        raise TypeError("this dictionary cannot be changed; change a copy: dict(...)")

    if not TYPE_CHECKING:
        __setitem__ = __delitem__ = __ior__ = update = setdefault = pop = popitem = clear = _refuse

    def __reduce__(self) -> tuple[Any, ...]:
        return read_only, (dict(self),)


def for_kernels(array: ndarray, dtype: type = np.float64) -> ndarray:
    """The array as compiled code takes it: contiguous and writable. Numba gives read-only arrays another
    type, so it would compile all functions again for them."""
    array = np.ascontiguousarray(array, dtype)
    return array if array.flags.writeable else array.copy()


def _writable(array: ndarray) -> bool:
    """Whether the array's memory may be written to, through this array or an array that it is a view of.
    Memory of an owner outside NumPy counts as writable unless the owner is `bytes`."""
    owner: Any = array
    while isinstance(owner, ndarray):
        if owner.flags.writeable:
            return True
        owner = owner.base
    return owner is not None and not isinstance(owner, bytes)


@frozen_dataclass
class Path(Value):
    """Waypoints joined by straight segments in joint space."""

    joint_names: tuple[str, ...]
    """Names of the planned joints, one for each column."""
    positions: Float[ndarray, "n dof"]
    """The waypoints [rad], [m] for prismatic joints."""

    def __repr__(self) -> str:
        if getattr(self.positions, "ndim", 0) != 2:  # a Path is validated on use, not when it is made
            return one_line(self)
        rows, joints = self.positions.shape
        return f"Path({counted(joints, 'joint')}, {counted(rows, 'waypoint')}, {self.length:.3f} rad)"

    @property
    def length(self) -> float:
        """Sum of the Euclidean lengths of the segments in joint space [rad]."""
        return float(step_lengths(self.positions).sum())


class Tree(NamedTuple):
    """A search tree grown from the start or the goals.

    The straight line in joint space from each node to its parent is free of collision.
    """

    nodes: Float[ndarray, "n dof"]
    """[rad], [m] for prismatic joints; roots first."""
    parents: Int[ndarray, "n"]
    """Row of each node's parent, which comes before the node's own row; -1 for roots."""


class State(NamedTuple):
    """The state of a trajectory at one time, as arrays [dof], or at n times, as arrays [n, dof]."""

    positions: Float[ndarray, "*n dof"]
    velocities: Float[ndarray, "*n dof"]
    accelerations: Float[ndarray, "*n dof"]
    jerks: Float[ndarray, "*n dof"]


@frozen_dataclass
class Trajectory(Value):
    """Positions, velocities and accelerations over time.

    Between two rows, the motion is the cubic with the positions and velocities of both rows. The validator
    and certificates check this motion.
    """

    joint_names: tuple[str, ...]
    """Names of the planned joints, one for each column."""
    times: Float[ndarray, "n"]
    """[s], starting at 0, strictly increasing."""
    positions: Float[ndarray, "n dof"]
    """[rad], [m] for prismatic joints."""
    velocities: Float[ndarray, "n dof"]
    """[rad/s] or [m/s]."""
    accelerations: Float[ndarray, "n dof"]
    """[rad/s²] or [m/s²]."""

    def __post_init__(self) -> None:
        """If the names are not a tuple, or the arrays are not float arrays of matching shapes,
        `check_motion_arrays` converts them or raises InputError. Otherwise, the validator judges them."""
        names = self.joint_names
        arrays = {name: getattr(self, name) for name in ("positions", "times", *RATES)}
        q, t, v, a = (
            value.shape if isinstance(value, ndarray) and value.dtype.kind == "f" else ()
            for value in arrays.values()
        )
        if not (isinstance(names, tuple) and q == v == a == (*t, len(names)) and all(q)):
            names, arrays = check_motion_arrays(names, arrays)
            self.__dict__.update(arrays, joint_names=names)
        super().__post_init__()

    def __repr__(self) -> str:
        return (
            f"Trajectory({counted(len(self.joint_names), 'joint')}, "
            f"{counted(len(self.times), 'row')}, {self.duration:.3g} s)"
        )

    @property
    def duration(self) -> float:
        """Time of the last row [s]."""
        return float(self.times[-1])

    @property
    def stops(self) -> Float[ndarray, "k"]:
        """Times [s] at which the whole arm rests between start and end. A wait is one stop, at its middle.

        Only rows are checked: of neighboring rows that are almost at rest, the slowest.
        """
        speed = np.linalg.norm(self.velocities, axis=1)
        resting = speed <= REST * speed.max()
        runs = np.split(np.arange(len(speed)), np.flatnonzero(np.diff(resting)) + 1)
        rounding = 1e-9 * speed.max()
        slowest = [run[speed[run] <= speed[run].min() + rounding] for run in runs[1:-1] if resting[run[0]]]
        return np.array([self.times[rows[[0, -1]]].mean() for rows in slowest])

    @property
    def peak_jerks(self) -> Float[ndarray, "dof"]:
        """The largest jerk of each joint [rad/s³] or [m/s³], with accelerations linear between the rows. If a
        joint accelerates at the start or end, its jerk is infinite, since the acceleration jumps there."""
        steps = np.diff(self.times)[:, None]
        between = np.abs(np.diff(self.accelerations, axis=0) / steps).max(axis=0, initial=0.0)
        return np.where((self.accelerations[[0, -1]] == 0).all(axis=0), between, np.inf)

    def at(self, time: float | int | Float[ndarray, "n"]) -> State:
        """Interpolate the motion at one time or at several times.

        Positions and velocities are those of the cubics between rows. Accelerations are linear between rows,
        and jerks are their slopes; at a row, the jerk is that of the step after the row, at the last row that
        of the step before it. A trajectory of one row has zero jerk.

        Args:
            time: Time, or times [n], from 0 to the duration [s].

        Returns:
            Positions, velocities, accelerations and jerks, each [dof], or [n, dof] for several times.

        Raises:
            InputError: For a time that is no number or outside of the motion.
        """
        times = numbers(time)
        if times is None:
            raise InputError(f"time is {shown(time)}; it must be a number or an array of numbers [s]")
        outside = ~((times >= -TIME_TOLERANCE) & (times <= self.duration + TIME_TOLERANCE))
        if outside.any():
            wrong = float(times[outside].flat[0])
            time_text, _, end = distinct(wrong, 0.0, self.duration)
            raise InputError(f"time is {time_text} s; it must be in [0, {end}]")
        last = len(self.times) - 1
        row = np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, max(last - 1, 0))
        after = np.minimum(row + 1, last)
        h = np.asarray(self.times[after] - self.times[row])[..., None]
        h = np.where(h > 0, h, 1.0)  # 0 for a trajectory of one row
        u = np.clip(np.asarray(times - self.times[row])[..., None] / h, 0.0, 1.0)
        (q0, v0, a0), (q1, v1, a1) = (tuple(getattr(self, name)[i] for name in ROWS) for i in (row, after))
        # Hermite's basis and its derivative
        rise = u * u * (3 - 2 * u)
        slope = 6 * u * (1 - u) / h
        positions = (1 - rise) * q0 + rise * q1 + h * u * (1 - u) * ((1 - u) * v0 - u * v1)
        velocities = slope * (q1 - q0) + (1 - u) * (1 - 3 * u) * v0 + u * (3 * u - 2) * v1
        return State(positions, velocities, (1 - u) * a0 + u * a1, (a1 - a0) / h + 0 * u)

    @property
    def cubic_accelerations(self) -> tuple[Float[ndarray, "m dof"], Float[ndarray, "m dof"]]:
        """Accelerations at the start and at the end of the cubic from each row to the next. Within a cubic,
        the acceleration is linear in time."""
        steps = np.diff(self.times)[:, None]
        v = self.velocities
        mean = np.diff(self.positions, axis=0) / steps
        return (6 * mean - 4 * v[:-1] - 2 * v[1:]) / steps, (2 * v[:-1] + 4 * v[1:] - 6 * mean) / steps

    def resample(self, rate: float | int) -> "Trajectory":
        """Sample the motion at a constant rate, with a last row at its end.

        If the motion stops on its way, it is slowed down by less than a step before each stop, so that a row
        is at the stop.

        At a low rate, the cubics between the new rows may need larger accelerations than this motion has,
        where its acceleration changes quickly. A motion from rest to rest is then averaged: its rows lie on
        the uniform cubic B-spline that has the resampled positions as control points. An averaged motion
        leaves the path by up to acceleration / (6 rate²). It lasts up to three steps longer than this one,
        plus three for each stop. Validate the returned motion: between its rows it may differ from this one.

        Args:
            rate: Rows in a second [Hz], above 0 and at most 100,000.

        Returns:
            The motion with rows 1 / rate apart.

        Raises:
            InputError: For another rate.
        """
        rate = converted("rate", SampleRate, rate)
        if len(self.times) == 1:
            return self
        cuts = np.array([0.0, *self.stops, self.duration])
        lengths = np.diff(cuts)
        steps = np.maximum(np.ceil(lengths[:-1] * rate - TIME_TOLERANCE), 1)
        begins = np.append(0.0, np.cumsum(steps)) / rate  # new times of the start and of the stops
        duration = begins[-1] + lengths[-1]
        count = int(np.ceil((duration - TIME_TOLERANCE) * rate))
        times = np.append(np.arange(max(count, 1)) / rate, duration)
        part = np.searchsorted(begins, times, side="right") - 1
        speed = (lengths / np.diff(begins, append=duration))[part, None]
        state = self.at(cuts[part] + speed[:, 0] * (times - begins[part]))
        velocities = speed * state.velocities
        rows = Trajectory(
            self.joint_names, times, state.positions, velocities, speed**2 * state.accelerations
        )
        ends = np.stack(rows.cubic_accelerations)
        max_acceleration = np.abs(self.cubic_accelerations).max(axis=(0, 1))
        off = np.abs(ends - (rows.accelerations[:-1], rows.accelerations[1:]))
        as_strong = (np.abs(ends) <= ACCELERATION_GAIN * max_acceleration).all()
        if self.velocities[[0, -1]].any() or (
            as_strong and (off <= ACCELERATION_SHARE * max_acceleration).all()
        ):
            return rows
        # a spline rests at a control point that is repeated
        control_points = np.repeat(state.positions, 1 + 2 * np.isin(times, begins[1:]), axis=0)
        return Trajectory(self.joint_names, *spline_rows(control_points, 1 / rate))

    def save(self, file: str | FilePath, rate: float | int | None = None) -> None:
        """Write the motion.

        `robotdiffuse.interop.write_motion` writes the formats of ROS 2, Foxglove and Rerun.

        Args:
            file: A .json or .csv file. The columns of .csv are time, then <joint>_position of all joints,
                then <joint>_velocity of all joints, then <joint>_acceleration of all joints.
            rate: Rows in a second [Hz]; None: the rows of the motion.

        Raises:
            InputError: For another ending, a file that cannot be written, a rate that `resample` refuses, and
                for .json if numbers are not finite.
        """
        path = check_output(file, (".json", ".csv"))
        if rate is not None:
            return self.resample(rate).save(path)
        if path.suffix.lower() == ".json":
            _write_json(path, self.record())
        else:
            write_atomically(path, self._csv())

    def record(self) -> JsonObject:
        """Convert the trajectory to JSON values.

        Returns:
            `joint_names`, `times`, and the rows of positions, velocities and accelerations.
        """
        rows = {name: getattr(self, name).tolist() for name in ("times", *ROWS)}
        return {"joint_names": list(self.joint_names)} | rows

    def _csv(self) -> str:
        stream = io.StringIO()
        writer = csv.writer(stream, lineterminator="\n")
        kinds = ("position", "velocity", "acceleration")
        # a spreadsheet would read a name that begins with one of these characters as a formula
        names = [f"'{name}" if name[0] in "=+-@" else name for name in self.joint_names]
        writer.writerow(["time", *(f"{name}_{kind}" for kind in kinds for name in names)])
        columns = (self.times[:, None], *(getattr(self, rows) for rows in ROWS))
        writer.writerows(np.concatenate(columns, axis=1).tolist())
        return stream.getvalue()


def _write_json(file: FilePath, record: JsonObject) -> None:
    try:
        text = json.dumps(record, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise InputError(f"{file}: JSON holds texts, lists and finite numbers only: {error}") from None
    write_atomically(file, text + "\n")


Rows = tuple[Float[ndarray, "n"], Float[ndarray, "n dof"], Float[ndarray, "n dof"], Float[ndarray, "n dof"]]
"""Times, positions, velocities and accelerations."""


def interpolated(
    at: Float[ndarray, "*at"] | float, times: Values, rows: JointRows
) -> Float[ndarray, "*at dof"]:
    """The rows at the times `at`, interpolated linearly between the rows at `times`; the first row before the
    first time, the last row after the last time."""
    return np.stack([np.interp(at, times, column) for column in rows.T], axis=-1)


def step_lengths(rows: ArrayLike) -> Values:
    """The Euclidean distance from each row to the next."""
    return np.linalg.norm(np.diff(rows, axis=0), axis=1)


def arc_lengths(rows: ArrayLike) -> Values:
    """The sum of the `step_lengths` from the first row to each row."""
    return np.append(0.0, np.cumsum(step_lengths(rows)))


def nearest_first(rows: JointRows, to: Configuration) -> JointRows:
    """The rows, sorted by their Euclidean distance from a configuration."""
    return rows[np.argsort(np.linalg.norm(rows - to, axis=1), kind="stable")]


def spline_rows(
    controls: Float[ndarray, "m dof"],
    step: float,
    window: int = 1,
    velocity: Float[ndarray, "dof"] | float = 0.0,
) -> Rows:
    """The rows of a uniform cubic B-spline that smooths a motion that ends at rest.

    Its control points are moving averages over `window` configurations in `controls`, which are `step` [s]
    apart. Before the first configuration, the arm moved with the constant `velocity`; the rows begin
    (window + 1) / 2 steps before this configuration.

    Velocities and accelerations are weighted means of those of the motion, so they obey the same limits at
    every time; jerks are constant between rows. With a window of 1, the spline leaves the motion's path by at
    most about a sixth of the acceleration times `step` squared; straight lines stay straight.
    """
    lead_in = np.arange(-window - 2, 0)[:, None] * step * np.broadcast_to(velocity, controls.shape[1])
    moved = np.concatenate(
        [
            lead_in,
            controls - controls[0],
            np.repeat(controls[-1:] - controls[0], window + 1, axis=0),
        ]
    )
    q, v, a = spline_states(running_means(moved, window), step)
    q += controls[0]
    q[-1] = controls[-1]
    v[0] = velocity
    v[-1] = 0.0
    a[[0, -1]] = 0.0
    return step * np.arange(len(q)), q, v, a


def running_means(rows: ndarray, window: int) -> ndarray:
    """The mean of every `window` successive rows, from the second row on."""
    total = np.cumsum(rows, axis=0)
    return (total[window:] - total[:-window]) / window


def spline_states(points: JointRows, step: float) -> tuple[JointRows, ...]:
    """Positions, velocities and accelerations of the uniform cubic B-spline with control points `step` [s]
    apart, at all of them but the first and the last."""
    before = points[:-2]
    at = points[1:-1]
    after = points[2:]
    return (before + 4 * at + after) / 6, (after - before) / (2 * step), (after - 2 * at + before) / step**2


RATES = ("velocities", "accelerations")


def array_names(motion: Path | Trajectory) -> tuple[str, ...]:
    """The names of a motion's arrays, the positions first."""
    return ("positions", *(("times", *RATES) if isinstance(motion, Trajectory) else ()))


def check_motion_arrays(
    joint_names: object, arrays: Mapping[str, object], where: str = ""
) -> tuple[tuple[str, ...], dict[str, ndarray]]:
    """The joint names of a motion as a tuple, and its arrays as float64 arrays of equal length.

    Args:
        joint_names: The joint names.
        arrays: The positions first, under any name; then optionally `times`, `velocities`, `accelerations`.
        where: Text before field names in messages, e.g. "trajectory.".

    Raises:
        InputError: Naming the field, for missing or repeated joint names, no rows, wrong shapes, numbers that
            are not finite or too large, and times that span more than MAX_DURATION. Times may begin anywhere
            and need not increase; see `check_increasing`.
    """
    names = joint_names
    if not isinstance(names, list | tuple) or not names or not all(isinstance(n, str) and n for n in names):
        raise InputError(f"{where}joint_names is {shown(names)}; it must be a list of names, not empty")
    twice = repeated(names)
    if twice:
        raise InputError(f"{where}joint_names has {joined(twice)} more than once")
    checked = dict[str, ndarray]()
    count = None
    for name, value in arrays.items():
        if name == "times":
            checked[name] = _times(where + name, value, count)
        else:
            bound = MAX_RATE if name in RATES else MAX_COORDINATE
            checked[name] = rows(where + name, value, count, len(names), bound, ", a column for each joint")
        count = len(checked[name])
    return tuple(names), checked


def check_increasing(times: ndarray) -> None:
    """Raise InputError unless the times, which are finite, strictly increase."""
    backwards = np.flatnonzero(np.diff(times) <= 0)
    if len(backwards):
        i = int(backwards[0])
        time, following = distinct(times[i], times[i + 1])
        raise InputError(f"times do not increase: {time} s in row {i}, {following} s in row {i + 1}")


def _times(name: str, value: object, count: int | None) -> ndarray:
    times = numbers(value)
    if times is None or times.shape != (count,):
        raise InputError(f"{name} is {shown(value)}; it must be {count} finite numbers, one for each row")
    if not np.isfinite(times).all():
        row = int(np.flatnonzero(~np.isfinite(times))[0])
        raise InputError(f"{name}[{row}] is {times[row]}; it must be a finite number")
    with np.errstate(over="ignore"):
        span = float(np.ptp(times))
    if not span <= MAX_DURATION:
        duration, limit = distinct(span, MAX_DURATION)
        raise InputError(f"{name} span {duration} s; a motion must not last longer than {limit} s")
    return times


PROBLEM_ENDINGS = (".yaml", ".yml", ".jsonl")
"""Endings that problem files may have and result files never have."""
NO_PROBLEM = "without its problem"
"""Beginning of the note with the reason why a result was saved without its problem."""
REQUIRED = ("status", "reason", "planner", "robot", "joint_names", "planning_time", "verified", "seed")


@frozen_dataclass
class PlanResult:
    """The answer of a planner. `path` is set if and only if `status` is SOLVED; every such path has passed
    `verify`.

    Fields that describe a motion are None if there is none. They are annotated with Any, so that type
    checkers ask for no assertions in code for solved results.
    """

    status: Status
    """How the call ended."""
    reason: str
    """A sentence: if SOLVED, which part of the planner found the path; otherwise why there is no motion, and
    what to do."""
    planner: str
    """Name of the planner."""
    robot: str
    """Name of the robot."""
    planning_time: float
    """Wall time of plan() until the returned path is validated [s], without loading time. The path's final
    time parameterization follows and does not count, except with waypoints, camera views, moving obstacles
    or a Cartesian line."""
    seed: int
    """Seed of the random numbers."""
    stage: str = ""
    """The part of the planner that produced the path, e.g. 'aorrtc', 'straight_line', 'network'."""
    path: Path | Any = None
    """Waypoints from the start to a goal."""
    trajectory: Trajectory | Any = None
    """The timed motion along the path."""
    min_clearance: float | Any = None
    """Lower bound on all distances along the motion [m]: the smaller of `scene_clearance` and
    `self_clearance`."""
    scene_clearance: float | Any = None
    """Lower bound on the distance to obstacles [m]."""
    self_clearance: float | Any = None
    """Lower bound on the distance between links [m]."""
    notes: tuple[str, ...] = field(default=())
    """Changes to the input or the request, e.g. a start clamped to a limit, or a smaller clearance."""
    goal_index: int | None = None
    """Index from 0 of the goal where the motion ends, among the goals of an `AnyGoal` or the rows of several
    goal configurations; 0 for a single goal, None without a motion."""
    progress: tuple[tuple[float, float], ...] = ()
    """Time [s since the call] and joint-space length [rad] of each path that was shorter than all before; the
    last pair is the returned path."""
    refused: str = ""
    """`Violation.kind` of the last path that the validator rejected; "" if it rejected none."""
    assumption: str = ""
    """Problems with camera views: the assumption about unknown space under which the motion was planned, e.g.
    "points padded by 9 cm". "as seen" assumes that unknown space has no obstacles. "" without views."""
    confidence: float | None = None
    """Problems with camera views: probability that the motion hits no obstacle in unknown space. `verify`
    checks observed obstacles only."""
    swept_probability: float | None = None
    """Sum of the predicted occupancy probabilities of all unknown voxels that the motion sweeps; None unless
    the policy for unknown space is `predicted`."""
    unknown_region: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    """Lower and upper corner, in the base frame [m], of a box around the part of unknown space with the
    largest summed occupancy probability among those that the motion crosses; None if it crosses none."""
    fraction: float | None = None
    """Problems with a Cartesian line: the fraction of the line that the arm can follow from the start, 1 if
    there is a motion. If it is below 1, `reason` says what stops the arm."""
    corner_deviations: tuple[float, ...] = field(default=(), repr=False)
    """For each waypoint of the path, the largest distance at which the motion may pass it, rounding the
    corner [rad, joint-space L2]. Empty without a path, and in results that were read from a file."""
    trees: tuple[Tree, ...] = field(default=(), repr=False)
    """Search trees from the start and from the goals, when the shortest path was found or time ran out. Empty
    unless the planner's setting `keep_trees` is true; result files omit them."""
    problem: Any = field(default=None, repr=False)
    """The `Problem`, which `save` and `rd.show` use; None in results read from files."""

    def __repr__(self) -> str:
        planned = f"{self.planner} in {1e3 * self.planning_time:.3g} ms"
        if self.path is None:
            return f"PlanResult({self.status.value}, {planned}: {self.reason})"
        notes = f", {counted(len(self.notes), 'note')}" if self.notes else ""
        return f"PlanResult({self.status.value}, {planned}: {self.path!r}, {self.trajectory!r}{notes})"

    @property
    def solved(self) -> bool:
        return self.status is Status.SOLVED

    @property
    def path_length(self) -> float | Any:
        return None if self.path is None else self.path.length

    @property
    def duration(self) -> float | Any:
        """Duration of the motion [s]; None without a trajectory."""
        return None if self.trajectory is None else self.trajectory.duration

    @property
    def stops(self) -> int | Any:
        """Number of times that the arm rests between start and goal; None without a trajectory."""
        return None if self.trajectory is None else len(self.trajectory.stops)

    def save(self, file: str | FilePath, problem: JsonObject | None = None) -> None:
        """Write the result.

        Args:
            file: A .json file for the result and its problem, or a .csv file for the trajectory alone.
            problem: The content of a problem file; None: the result's own problem. If its robot is neither
                bundled nor read from a file, or was changed since, the file holds no problem, and a note says
                so.

        Raises:
            InputError: For another ending, a file that cannot be written, .csv without a trajectory, and a
                problem that is no table or has values that JSON cannot hold, such as arrays.
        """
        path = check_output(file, (".json", ".csv"))
        if path.suffix.lower() == ".json":
            notes = self.notes
            if problem is None and self.problem is not None:
                try:
                    problem = self.problem.record()
                except InputError as error:
                    notes = (*notes, f"{NO_PROBLEM}: {error}")
            record = replace(self, notes=notes).record(problem)
            _write_json(path, record)
        elif self.trajectory is None:
            raise InputError(f"{path}: there is no trajectory to write ({self.status.value}); use .json")
        else:
            self.trajectory.save(path)

    def record(self, problem: JsonObject | None = None) -> JsonObject:
        """Convert the result to JSON values.

        Args:
            problem: The content of a problem file, to include.

        Returns:
            The content of a result file.

        Raises:
            InputError: If `problem` is no table.
        """
        check_type("problem", problem, (dict, NoneType), "the content of a problem file, a table")
        path = self.path
        record: JsonObject = {"status": self.status.value}
        record |= {name: getattr(self, name) for name in RECORDED}
        record |= {
            "verified": self.solved,
            "path_length": self.path_length,
            "duration": self.duration,
            "stops": self.stops,
            "joint_names": [] if path is None else list(path.joint_names),
            "waypoints": None if path is None else path.positions.tolist(),
            "times": [],
            **{name: [] for name in ROWS},
        }
        if self.trajectory is not None:
            record |= self.trajectory.record()
        return record if problem is None else record | {"problem": problem}


@frozen_dataclass
class ResultFile:
    """Content of a result file."""

    result: PlanResult
    problem: JsonObject | None
    """The problem as in a problem file, if it was saved too."""


def load_result(file: str | FilePath) -> ResultFile:
    """Read and check a result file.

    Args:
        file: A .json file that `PlanResult.save` or `robotdiffuse plan --out` wrote.

    Returns:
        The result, and the content of its problem file if that was saved too.

    Raises:
        InputError: For another ending, a problem file, a file that cannot be read, and fields that are
            missing, of the wrong type or shape, out of bounds or not finite; for an unknown status, for
            repeated joint names, for times that do not begin at 0 or do not increase, and if `verified`
            contradicts the status.

    Examples:
        >>> problem = rd.Problem(rd.load_robot("panda"), rd.Scene(), "ready", "extended")
        >>> rd.plan(problem, until="first").save("result.json")
        >>> rd.load_result("result.json").result.status.value
        'solved'
    """
    planned = f"it is a problem; `robotdiffuse plan {file} --out result.json` makes a result of it"
    if FilePath(str(file)).suffix.lower() in PROBLEM_ENDINGS:
        raise InputError(f"{file} is not a result file: {planned}")
    known_ending(file, "result file", (".json",))
    record = read_json(file)
    if not isinstance(record, dict):
        raise InputError(f"{file} is not a result file: it must hold one JSON object")
    if "scene" in record and "status" not in record:
        raise InputError(f"{file} is not a result file: {planned}")
    missing = [name for name in REQUIRED if record.get(name) is None]
    if missing:
        raise InputError(f"{file} is not a result file: {', '.join(missing)} missing")
    with located(file):
        problem = record.get("problem")
        check_type("problem", problem, (dict, NoneType), "an object")
        return ResultFile(_result(record), problem)


Corner = tuple[Number, Number, Number]
RECORDED: dict[str, Any] = {
    "reason": str,
    "planner": str,
    "stage": str,
    "robot": str,
    "planning_time": Number,
    "seed": int,
    "min_clearance": Number,
    "scene_clearance": Number,
    "self_clearance": Number,
    "notes": tuple[str, ...],
    "goal_index": Natural,
    "progress": tuple[tuple[Number, Number], ...],
    "refused": str,
    "assumption": str,
    "confidence": Number,
    "swept_probability": Number,
    "unknown_region": tuple[Corner, Corner],
    "fraction": Number,
}
"""Fields that result files hold under the same name, in this order, with their types. A field that the result
lacks is null."""


def _result(record: JsonObject) -> PlanResult:
    statuses = {status.value: status for status in Status}
    check_name("status", record["status"], statuses)
    status = statuses[record["status"]]
    solved = status is Status.SOLVED
    if record["verified"] is not solved:
        raise InputError(f"verified is {shown(record['verified'])}, but status is {shown(status.value)}")
    values = {
        name: converted(name, kind, record[name])
        for name, kind in RECORDED.items()
        if record.get(name) is not None
    }
    if solved:
        names, arrays = check_motion_arrays(record["joint_names"], {"waypoints": record.get("waypoints")})
        values["path"] = Path(names, arrays["waypoints"])
        values["trajectory"] = _trajectory(record) if record.get("times") else None
    return PlanResult(status=status, **values)


def _trajectory(record: JsonObject) -> Trajectory:
    rows_of = {name: record.get(name) for name in ("positions", "times", *RATES)}
    names, arrays = check_motion_arrays(record["joint_names"], rows_of)
    if arrays["times"][0] != 0:
        raise InputError(f"times begin at {arrays['times'][0]:g} s; they must begin at 0")
    check_increasing(arrays["times"])
    return Trajectory(names, **arrays)
