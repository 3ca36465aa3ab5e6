"""Problem files: reading and writing problems in YAML and JSON, and reading those of MoveIt."""

from robotdiffuse.problems.files.problem import ProblemEntry as ProblemEntry
from robotdiffuse.problems.files.problem import load_motion_bench_maker as load_motion_bench_maker
from robotdiffuse.problems.files.problem import load_problem as load_problem
from robotdiffuse.problems.files.problem import load_problems as load_problems
from robotdiffuse.problems.files.problem import problem_from_record as problem_from_record
from robotdiffuse.problems.files.problem import problem_record as problem_record
from robotdiffuse.problems.files.problem import save_problem as save_problem
