"""Every hard case of experiments/hard_cases.py, with shorter motions, holds; and the page says what
its table says.
"""

import csv
from pathlib import Path

import extended
import hard_cases
import numpy as np
import pytest

EXPERIMENTS = Path(__file__).parents[2] / "experiments"


# README.md beside the script says why.
KNOWN_TO_FAIL = "gauss, 10,000 periods: trend of the energy"


@pytest.mark.slow
@pytest.mark.parametrize("case", hard_cases.CASES)
def test_it_holds(case):
    if not extended.is_extended():
        pytest.skip("long double is double here")
    rows = list(hard_cases.CASES[case](quick=True))
    assert rows
    assert [row for row in rows if row.verdict != "holds" and KNOWN_TO_FAIL not in row.what] == []


def test_extended_precision_is():
    """Energy after half a second of a chaotic motion, in long double, and the same with other
    steps.
    """
    pendulum, start = (0.2, 0.2, 0.1, 0.1, 9.8), (2.9, 3.1, 0.0, 0.0)
    one, other = (
        extended.motion(pendulum, start, [0.5], longest=step)[0] for step in (0.005, 0.002)
    )
    assert one.dtype == np.longdouble
    assert np.max(np.abs(one - other)) < 1e-14


def test_the_page_shows_the_table():
    with (EXPERIMENTS / "hard_cases.csv").open() as file:
        rows = [hard_cases.Row(**row | {"case": int(row["case"])}) for row in csv.DictReader(file)]
    assert hard_cases.page(rows) in (EXPERIMENTS / "README.md").read_text()
    assert {row.case for row in rows} == set(hard_cases.CASES)
    assert len([row for row in rows if row.verdict != "holds"]) == 1
