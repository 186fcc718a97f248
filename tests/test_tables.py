"""The tables of the experiments: times are times, and digits end where they are known."""

import csv
import math
from pathlib import Path

import pytest
from digits import round_up, show

TABLES = sorted((Path(__file__).parent.parent / "experiments").glob("*.csv"))


@pytest.mark.parametrize("path", TABLES, ids=lambda path: path.name)
def test_no_time_and_no_error_is_negative(path):
    """A time that is a difference of two may be: each is measured by itself."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert rows
    words = (
        "second",
        "first",
        "call",
        "_s",
        "fastest",
        "slowest",
        "total",
        "rate",
        "memory",
        "error",
    )
    for name in rows[0]:
        if any(word in name for word in words) and name != "error_bound":
            values = [float(row[name]) for row in rows]
            assert [value for value in values if value < 0] == [], name


def test_a_first_call_is_not_shorter_than_what_it_compiles():
    """It compiles and runs once: it takes longer than the fastest warm call, up to noise."""
    with next(path for path in TABLES if path.name == "cost_growth.csv").open(newline="") as file:
        assert all(
            float(row["first_call_s"]) > 0.8 * float(row["seconds"]) for row in csv.DictReader(file)
        )


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [
        (64.34284189640, 1e-10, "64.3428418964"),
        (2.31933, 0.049, "2.32"),
        (2.31933, 0.1, "2.3"),
        (-1e-14, 1e-12, "0.000000000000"),
        (27.6883863266, 1e-7, "27.6883863"),
        (1234.5, 30.0, "1230"),
        (300, 0.0, "300"),
    ],
)
def test_digits_end_where_the_error_begins(value, error, text):
    assert show(value, error) == text
    assert error == 0 or abs(float(text) - value) <= 0.5 * 10.0 ** math.floor(
        math.log10(round_up(error))
    )


def test_a_bound_goes_up_to_one_digit():
    assert [round_up(x) for x in (1e-10, 1.01e-10, 9.5e-3, 0.05, 0.0)] == [
        1e-10,
        2e-10,
        1e-2,
        0.05,
        0.0,
    ]
