"""Planning problems: their classes, their files, and families of random problems."""

from robotdiffuse.problems.files import load_problem, problem_record
from robotdiffuse.problems.problem import Problem

Problem.load = staticmethod(load_problem)
Problem.record = problem_record
