"""Held-out problems of the families, with reference lengths, drawn once and remembered.

    python benchmarks/problems.py --cases FOLDER [--families rop,shelf] [--problems 500]

A problem counts if RRT-Connect solves it within 10 s; what it cannot solve costs all of that time, which
makes drawing slow. FOLDER keeps one file per family and is read by the benchmarks; drawing stops and goes on
at any line.
"""

import argparse
from pathlib import Path as File
from typing import NamedTuple

from rich.console import Console

from robotdiffuse.core.errors import InputError
from robotdiffuse.evaluation.problem_sets import SEARCH_TIME, case_file, search, validator
from robotdiffuse.problems.families import FAMILIES
from robotdiffuse.problems.held_out import SEED, Case, goal_of
from robotdiffuse.robots import load_robot

__all__ = ["PANDA", "SEARCH_TIME", "SEED", "Case", "draw_cases", "families_of", "goal_of"]

PANDA = load_robot("panda")


class Drawn(NamedTuple):
    hard: list[Case]
    """Not trivial, and solvable."""
    cases: list[Case]
    """Up to the last hard one, in the order of drawing: trivial ones too."""
    unsolved: int
    """Problems that were left out."""


def draw_cases(family: str, count: int, folder: File | None = None) -> Drawn:
    """Solvable problems, `count` hard ones among them; a folder keeps what is known of them."""
    kept = case_file(folder, family)
    with Console(stderr=True).status(f"problems of {family}") as status:
        hard = kept.held_out(family, count, validator, search, status.update)
    drawn = kept.held_out(family, 1 + int(hard[-1].name.partition("/")[2]), validator)
    cases = [case for case in drawn if case.trivial or case.hard]
    return Drawn(hard, cases, len(drawn) - len(cases))


def families_of(text: str) -> list[str]:
    """Names parted by commas, for a command line; InputError for one that is unknown."""
    names = text.split(",")
    for name in names:
        if name not in FAMILIES:
            raise InputError(f"--families has {name!r}; known: {', '.join(FAMILIES)}")
    return names


def main() -> None:
    parser = argparse.ArgumentParser(description="Draw held-out problems for the benchmarks.")
    parser.add_argument("--cases", type=File, required=True, help="folder that keeps what is known of them")
    parser.add_argument("--families", type=families_of, default=list(FAMILIES), help="all of them")
    parser.add_argument("--problems", type=int, default=500, help="non-trivial ones of each (500)")
    arguments = parser.parse_args()
    for family in arguments.families:
        drawn = draw_cases(family, arguments.problems, arguments.cases)
        print(f"{family}: {len(drawn.hard)} not trivial of {len(drawn.cases) + drawn.unsolved} drawn")


if __name__ == "__main__":
    main()
