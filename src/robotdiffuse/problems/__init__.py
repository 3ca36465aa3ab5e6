"""Planning problems: what they are, their files, and random ones."""

from robotdiffuse.problems.files import load_problem
from robotdiffuse.problems.problem import Problem

Problem.load = staticmethod(load_problem)
