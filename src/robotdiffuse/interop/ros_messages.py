"""Reads the motion in the messages of a topic, from a bag or an MCAP file."""

from typing import Any

from robotdiffuse.core.errors import InputError
from robotdiffuse.interop.plain_messages import motion_from_record
from robotdiffuse.interop.recorded_motion import RecordedMotion, checked_motion
from robotdiffuse.interop.ros_types import JOINT_STATE, header_seconds, to_plain


def motion_from_messages(kind: str, messages: list[tuple[int, Any]], where: str) -> RecordedMotion:
    """The motion in messages with their log times [ns]: a single message, or a series of joint states.

    Raises InputError, naming `where`, for no or several motions, and for damaged ones.
    """
    if not messages:
        raise InputError(f"{where} holds no messages")
    if kind != JOINT_STATE:
        if len(messages) > 1:
            raise InputError(f"{where} holds {len(messages)} motions; one is validated at a time")
        return motion_from_record(to_plain(messages[0][1]), where)
    states = [to_plain(message) for _, message in messages]
    names, logged = states[0]["name"], messages[0][0]
    stamps = [header_seconds(state["header"]["stamp"]) for state in states]
    if not any(stamps):
        stamps = [1e-9 * (at - logged) for at, _ in messages]
    rows: dict[str, list[list[float]]] = {"position": [], "velocity": []}
    for i, state in enumerate(states):
        if sorted(state["name"]) != sorted(names):
            raise InputError(f"{where}: joint state {i} has other joints than the first")
        column_of = {name: k for k, name in enumerate(state["name"])}
        order = [column_of[name] for name in names]
        for what, column in rows.items():
            column.append([state[what][k] for k in order] if len(state[what]) == len(names) else [])
    velocities = rows["velocity"] if all(rows["velocity"]) else None
    first = stamps[0]
    try:
        return checked_motion(names, rows["position"], [stamp - first for stamp in stamps], velocities)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
