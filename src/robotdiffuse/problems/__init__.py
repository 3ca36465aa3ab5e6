"""Planning problems: what they are, their files, and random ones."""

from robotdiffuse.problems.files import load_problem, problem_record
from robotdiffuse.problems.problem import Problem

Problem.load = staticmethod(load_problem)
Problem.record = problem_record
