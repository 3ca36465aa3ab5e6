"""Allowed contacts of links with obstacles, from the allowed collision matrix of a MoveIt planning scene.

Message: https://docs.ros.org/en/noetic/api/moveit_msgs/html/msg/AllowedCollisionMatrix.html
"""

from collections.abc import Collection, Iterable
from typing import Any

from robotdiffuse.core.errors import InputError
from robotdiffuse.problems.files.moveit.values import list_of, mapping_of

MATRIX, OCTOMAP = "allowed_collision_matrix", "<octomap>"
"""Names in planning scenes: of the matrix, and in it of the octomap."""


def matrix_contacts(
    matrix: object, obstacles: Iterable[str], links: Collection[str]
) -> dict[str, tuple[str, ...]]:
    """For each obstacle, the links that may touch it; obstacles without any are left out.

    An entry for a pair decides; without one, the defaults of its names do: contact is allowed if either has a
    default and none forbids. Pairs of links, and names that are neither links nor obstacles, are ignored.
    Raises InputError for a matrix that is not square.
    """
    matrix = mapping_of(MATRIX, matrix)

    def part(name: str) -> list[Any]:
        return list_of(f"{MATRIX}.{name}", matrix.get(name))

    names, rows = list(map(str, part("entry_names"))), list(map(_enabled, part("entry_values")))
    if any(len(one) != len(names) for one in (rows, *rows)):
        raise InputError(f"{MATRIX} has {len(names)} entry_names; entry_values must be square, of this size")
    defaults = dict(
        zip(map(str, part("default_entry_names")), map(bool, part("default_entry_values")), strict=False)
    )
    index = {name: i for i, name in enumerate(names)}

    def allowed(link: str, obstacle: str) -> bool:
        if link in index and obstacle in index:
            return rows[index[link]][index[obstacle]]
        given = [defaults[name] for name in (link, obstacle) if name in defaults]
        return bool(given) and all(given)

    found = {
        obstacle: tuple(
            link for link in links if allowed(link, OCTOMAP if obstacle == "octomap" else obstacle)
        )
        for obstacle in obstacles
    }
    return {obstacle: touching for obstacle, touching in found.items() if touching}


def _enabled(row: object) -> list[bool]:
    """A row of the matrix, which may be a list or a message AllowedCollisionEntry."""
    if isinstance(row, dict):
        row = row.get("enabled")
    return [bool(value) for value in list_of(f"{MATRIX}.entry_values", row)]
