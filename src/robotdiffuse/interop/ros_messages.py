"""The motion in the messages of a topic, from a bag or an MCAP file."""

from typing import Any

from robotdiffuse.core.errors import InputError
from robotdiffuse.interop.plain_messages import motion_of
from robotdiffuse.interop.recorded_motion import Recorded, recorded
from robotdiffuse.interop.ros_types import JOINT_STATE, header_seconds, plain


def motion_in(kind: str, messages: list[tuple[int, Any]], where: str) -> Recorded:
    """Of messages and the times [ns] at which they were logged: the only one, or a series of joint states."""
    if not messages:
        raise InputError(f"{where} holds no messages")
    if kind != JOINT_STATE:
        if len(messages) > 1:
            raise InputError(f"{where} holds {len(messages)} motions; one is validated at a time")
        return motion_of(plain(messages[0][1]), where)
    states = [plain(message) for _, message in messages]
    names, logged = states[0]["name"], messages[0][0]
    stamps = [header_seconds(state["header"]["stamp"]) for state in states]
    if not any(stamps):
        stamps = [1e-9 * (at - logged) for at, _ in messages]
    rows: dict[str, list[list[float]]] = {"position": [], "velocity": []}
    for i, state in enumerate(states):
        if sorted(state["name"]) != sorted(names):
            raise InputError(f"{where}: joint state {i} is of other joints than the first")
        order = [state["name"].index(name) for name in names]
        for what, column in rows.items():
            column.append([state[what][k] for k in order] if len(state[what]) == len(names) else [])
    velocities = rows["velocity"] if all(rows["velocity"]) else None
    first = stamps[0]
    try:
        return recorded(names, rows["position"], [stamp - first for stamp in stamps], velocities)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
