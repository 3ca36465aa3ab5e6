"""Held-out problems: which ones count as hard, in a cache file that can be continued."""

from pathlib import Path

import numpy as np
import pytest

import robotdiffuse as rd
from helpers.refusals import refuses
from robotdiffuse.problems.files import Case, CaseFile, held_out_problem, line_length


class Referee:
    """A validator that accepts the straight line of every third problem, and a search that fails on every fifth."""

    def __init__(self) -> None:
        self.validated: list[rd.Problem] = []
        self.searched: list[rd.Problem] = []
        self.numbers = {held_out_problem("rop", i).start.tobytes(): i for i in range(12)}

    def validator(self, problem: rd.Problem, path: rd.Path) -> bool:
        self.validated.append(problem)
        assert len(path.positions) == 2
        return self.numbers[problem.start.tobytes()] % 3 == 0

    def search(self, problem: rd.Problem) -> float | None:
        self.searched.append(problem)
        number = self.numbers[problem.start.tobytes()]
        return None if number % 5 == 0 else float(number)


def names(cases: list[Case]) -> list[str]:
    return [case.name for case in cases]


@pytest.mark.parametrize("kept", [True, False])
def test_one_rule(tmp_path: Path, kept: bool) -> None:
    referee = Referee()
    cases = CaseFile(tmp_path / "a" / "rop.jsonl" if kept else None)
    hard = cases.held_out("rop", 4, referee.validator, referee.search)
    assert names(hard) == ["rop/1", "rop/2", "rop/4", "rop/7"] and [case.reference for case in hard] == [1.0, 2.0, 4.0, 7.0]
    assert all(case.hard and not case.trivial and case.family == "rop" for case in hard)
    every = cases.held_out("rop", 8, referee.validator)
    assert [case.trivial for case in every] == [i % 3 == 0 for i in range(8)]
    assert [case.hard for case in every] == [i in (1, 2, 4, 7) for i in range(8)]
    gen3 = rd.load_robot("gen3")
    turned = rd.Problem(gen3, rd.Scene([]), [0, 0.3, 0, 1.2, 0, 0.8, 3.0], [0, 0.3, 0, 1.2, 0, 0.8, -3.0])
    length = line_length(turned, lambda problem, path: rd.verify(problem, path).valid)
    assert length == pytest.approx(2 * np.pi - 6), "it was refused as a jump"
    assert every[5].reference is None and every[6].reference == pytest.approx(line_length(every[6].problem, referee.validator))
    for i, case in enumerate(every):
        assert np.array_equal(case.problem.start, held_out_problem("rop", i).start)


def test_goes_on_with_what_is_known(tmp_path: Path) -> None:
    file = tmp_path / "rop.jsonl"
    first, second, third = (Referee() for _ in range(3))
    CaseFile(file).held_out("rop", 5, first.validator)
    assert len(first.validated) == 5 and not first.searched
    hard = CaseFile(file).held_out("rop", 4, second.validator, second.search)
    assert names(hard) == ["rop/1", "rop/2", "rop/4", "rop/7"]
    assert len(second.validated) == 3, "numbers 5, 6 and 7"
    assert len(second.searched) == 5, "numbers 1, 2, 4, 5 and 7"
    assert names(CaseFile(file).held_out("rop", 4, third.validator, third.search)) == names(hard)
    assert not third.validated and not third.searched
    assert names(CaseFile(file).cases(hard=True)) == names(hard)


def test_line_that_was_cut_off_is_made_again(tmp_path: Path) -> None:
    file = tmp_path / "rop.jsonl"
    referee = Referee()
    whole = CaseFile(file).held_out("rop", 3, referee.validator)
    text = file.read_text()
    file.write_text(text[:-20])
    assert names(CaseFile(file).held_out("rop", 3, referee.validator)) == names(whole) and file.read_text() == text
    assert len(referee.validated) == 4


def test_damaged_lines_are_named_and_two_of_one_name_refused(tmp_path: Path) -> None:
    file = tmp_path / "rop.jsonl"
    for line, message in (("[1, 2]", "line 1 is not a JSON object"), ('{"drawn": 3}', "line 1 has drawn")):
        file.write_text(line + "\n")
        refuses(message, CaseFile, file)
    case = Case("a", "mine", held_out_problem("rop", 0), False)
    refuses("two problems are called a", CaseFile(None).fill, [case, case])
