"""The file of an atlas: true ones are read, and each damage is refused in one line that names its
place.
"""

import csv
import io
import json
import os
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import dpend
from dpend import Status
from dpend.places import LARGEST_FILE, read_text
from dpend.records import parse_json

PUBLISHED = Path(__file__).parents[2] / "experiments" / "atlas"


@pytest.fixture(scope="module")
def atlas():
    """The short orbits of the published catalogue: five families."""
    return dpend.load_atlas(PUBLISHED / "brake_orbits.csv").where(period=(0, 1.2))


@pytest.fixture(scope="module")
def files(atlas, tmp_path_factory):
    """Its text in both formats."""
    folder = tmp_path_factory.mktemp("atlas")
    texts = {}
    for ending in ("csv", "json"):
        atlas.save(folder / f"true.{ending}")
        texts[ending] = (folder / f"true.{ending}").read_text()
    return texts


def of_json(change):
    """A damage to what a JSON file says."""

    def damage(files):
        record = json.loads(files["json"])
        change(record)
        return "json", json.dumps(record)

    return damage


def of_orbit(number, **cells):
    def change(record):
        row = record["orbits"][number - 1]
        for key, value in cells.items():
            row[key] = value(row) if callable(value) else value

    return of_json(change)


def of_head(*path, value):
    """Something in the head set, or deleted."""

    def change(record):
        for key in path[:-1]:
            record = record[key]
        if value is Ellipsis:
            del record[path[-1]]
        else:
            record[path[-1]] = value

    return of_json(change)


def of_csv(change):
    """A damage to the cells of a CSV file, the header being row 0."""

    def damage(files):
        head, _, rest = files["csv"].partition("\n")
        rows = list(csv.reader(io.StringIO(rest)))
        change(rows)
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows(rows)
        return "csv", f"{head}\n{text.getvalue()}"

    return damage


def of_cell(number, column, value):
    def change(rows):
        row = (
            next(row for row in rows if row[0] == number)
            if isinstance(number, str)
            else rows[number]
        )
        place = rows[0].index(column)
        row[place] = value(row[place]) if callable(value) else value

    return of_csv(change)


def of_column(column, value):
    """Another unit throughout."""

    def change(rows):
        place = rows[0].index(column)
        for row in rows[1:]:
            row[place] = value(row[place])

    return of_csv(change)


def of_text(ending, change):
    return lambda files: (ending, change(files[ending]))


def swapped(one, other):
    def change(rows):
        i, j = rows[0].index(one), rows[0].index(other)
        rows[0][i], rows[0][j] = rows[0][j], rows[0][i]

    return of_csv(change)


def radians(cell):
    return repr(float(np.radians(float(cell))))


def line(text, number):
    return text.split("\n")[number - 1]


# Each with what the message has to name.
DAMAGES = {
    # --- cells of a CSV file
    "NaN in a column": (of_cell(17, "energy_J", "nan"), r"row 17 in line 19: energy_J is nan"),
    "infinity in a column": (of_cell(17, "period_s", "inf"), r"row 17 in line 19: period_s is inf"),
    "text in a column": (
        of_cell(3, "kappa", "large"),
        r"row 3 in line 5: kappa must be a finite "
        r"number, is 'large'",
    ),
    "an empty cell": (
        of_cell(3, "theta2_deg", ""),
        r"row 3 in line 5: theta2_deg must be a finite "
        r"number, is ''",
    ),
    "a number like 1e999": (of_cell(3, "residual", "1e999"), r"row 3 in line 5: residual is inf"),
    "a number with a blank": (
        of_cell(3, "energy_J", lambda cell: " " + cell),
        r"row 3 in line 5: "
        r"energy_J",
    ),
    "a number with a low line": (
        of_cell(3, "period_error_s", "1_0"),
        r"row 3 in line 5: "
        r"period_error_s",
    ),
    "foreign digits": (
        of_cell(3, "iterations", "\u0663"),
        r"row 3 in line 5: iterations must be "
        r"an integer",
    ),
    "a decimal comma": (
        of_text("csv", lambda text: text.replace("C1,0.0,0.", "C1,0.0,0,", 1)),
        r"row 1 in line 3 "
        r"has 19",
    ),
    "an integer with a fraction": (
        of_cell(4, "turns1", "0.5"),
        r"row 4 in line 6: turns1 must be "
        r"an integer",
    ),
    "an integer of twenty digits": (
        of_cell(4, "iterations", "9" * 20),
        r"row 4 in line 6: "
        r"iterations",
    ),
    "a row too short": (of_csv(lambda rows: rows[5].pop()), r"row 5 in line 7 has 17 cells"),
    "a row too long": (of_csv(lambda rows: rows[5].append("1")), r"row 5 in line 7 has 19 cells"),
    "a quote that never ends": (
        of_text("csv", lambda text: text.replace("\nC1", '\n"C1', 1)),
        r"line \d+: unexpected end "
        r"of data",
    ),
    "a column missing": (
        of_csv(lambda rows: [row.pop(4) for row in rows]),
        r"the header has no "
        r"period_s",
    ),
    "a column twice": (
        of_csv(lambda rows: [row.append(row[4]) for row in rows]),
        r"the header has "
        r"twice "
        r"period_s",
    ),
    "a column more": (
        of_csv(lambda rows: [row.append("note" if row is rows[0] else "1") for row in rows]),
        r"the header has unknown note",
    ),
    "no header": (of_csv(lambda rows: rows.pop(0)), r"the header has"),
    "no row": (
        of_csv(lambda rows: rows.__delitem__(slice(1, None))),
        r"rows is \d+, and there are "
        r"0",
    ),
    "the last rows cut off": (
        of_csv(lambda rows: rows.__delitem__(slice(-9, None))),
        r"rows is "
        r"(\d+), and "
        r"there",
    ),
    "a row twice": (of_csv(lambda rows: rows.insert(9, rows[9])), r"rows is"),
    "a row in another's place": (
        of_csv(lambda rows: rows.__setitem__(9, rows[8])),
        r"row 9 in line 11: arclength is",
    ),
    "two rows exchanged": (
        of_csv(lambda rows: rows.__setitem__(slice(8, 10), rows[9:7:-1])),
        r"row 9 in line 11: "
        r"arclength is",
    ),
    "cut off within a row": (of_text("csv", lambda text: text[:-40]), r"row \d+ in line \d+ has"),
    "angles exchanged": (
        swapped("theta1_deg", "theta2_deg"),
        r"row 1 in line 3: energy_J is .* "
        r"its release has",
    ),
    "duals exchanged": (
        swapped("dual_theta1_deg", "dual_theta2_deg"),
        r"row 1 in line 3: energy_J "
        r".* its dual has",
    ),
    "period and energy exchanged": (
        swapped("period_s", "energy_J"),
        r"row 1 in line 3: period_s "
        r"is -0.58",
    ),
    "kappa and its logarithm exchanged": (
        swapped("kappa", "log_abs_kappa"),
        r"row 1 in line 3: "
        r"log_abs_kappa",
    ),
    "theta1 in radians": (
        of_column("theta1_deg", radians),
        r"row 1 in line 3: energy_J is .* its "
        r"release has",
    ),
    "theta2 in radians": (
        of_column("theta2_deg", radians),
        r"row 1 in line 3: energy_J is .* its "
        r"release has",
    ),
    "duals in radians": (of_column("dual_theta2_deg", radians), r"energy_J is .* its dual has"),
    "one angle in radians": (of_cell(30, "theta1_deg", radians), r"row 30 in line 32: energy_J"),
    "an angle of the other sign": (
        of_cell(30, "theta2_deg", lambda cell: str(-float(cell))),
        r"row 30 in line 32: "
        r"dual_theta2_deg",
    ),
    "the other sign where it is not centred": (
        of_cell("B1", "theta1_deg", lambda cell: str(-float(cell))),
        r"row \d+ in line \d+: "
        r"(dual_)?theta1_deg",
    ),
    "a digit of an angle": (
        of_cell(30, "theta1_deg", lambda cell: str(float(cell) + 1e-8)),
        r"row 30 in line 32: "
        r"energy_J",
    ),
    "a digit of the energy": (
        of_cell(30, "energy_J", lambda cell: str(float(cell) * (1 + 1e-10))),
        r"row 30 in line 32: "
        r"energy_J",
    ),
    "milliseconds": (
        of_column("period_s", lambda cell: str(1e3 * float(cell))),
        r"row 1 in line "
        r"3: period_s",
    ),
    "a period below zero": (
        of_cell(7, "period_s", lambda cell: "-" + cell),
        r"row 7 in line 9: "
        r"period_s",
    ),
    "a period of zero": (
        of_cell(7, "period_s", "0.0"),
        r"row 7 in line 9: period_s is 0, and must "
        r"be positive",
    ),
    "a period above the longest": (
        of_cell(7, "period_s", "2.1"),
        r"row 7 in line 9: period_s is "
        r"2.1, max_period_s",
    ),
    "a period below the shortest": (
        of_cell(7, "period_s", "0.4"),
        r"row 7 in line 9: period_s is "
        r"0.4",
    ),
    "a period far from its neighbours'": (
        of_cell(7, "period_s", "1.0"),
        r"row 7 in line 9: "
        r"period_s is 1",
    ),
    "kappa of the other sign": (
        of_cell(7, "kappa", lambda cell: str(-9 * float(cell))),
        r"row 7 "
        r"in line "
        r"9: "
        r"log_abs",
    ),
    "a centred kappa below -1": (
        of_json(
            lambda record: record["orbits"][6].update(kappa=-1.5, log_abs_kappa=float(np.log(1.5)))
        ),
        r"row 7: kappa is -1.5, below -1",
    ),
    "an error below zero": (
        of_cell(7, "theta2_error_deg", "-1e-13"),
        r"row 7 in line 9: "
        r"theta2_error_deg",
    ),
    "a large residual": (of_cell(7, "residual", "0.1"), r"row 7 in line 9: residual is 0.1"),
    "iterations below zero": (of_cell(7, "iterations", "-3"), r"row 7 in line 9: iterations"),
    "arclength backwards": (of_cell(7, "arclength", "0.0"), r"row 7 in line 9: arclength"),
    "arclength of its own": (of_cell(7, "arclength", "nan"), r"row 7 in line 9: arclength is nan"),
    "an unknown symmetry": (of_cell(7, "symmetry", "odd"), r"row 7 in line 9: symmetry is 'odd'"),
    "another symmetry": (
        of_cell(7, "symmetry", "brake"),
        r"row 7 in line 9: symmetry is 'brake', "
        r"its family C1",
    ),
    "an unknown status": (
        of_cell(7, "status", "fine"),
        r"row 7 in line 9: status must be one of "
        r".* is 'fine'",
    ),
    "a number for a status": (of_cell(7, "status", "0"), r"row 7 in line 9: status"),
    "an unknown family": (of_cell(7, "family", "C99"), r"row 7 in line 9: family is 'C99'"),
    "another family": (of_cell(7, "family", "C2"), r"line \d+: "),
    "no family": (of_cell(7, "family", ""), r"row 7 in line 9: family is ''"),
    "half a turn more": (of_cell(7, "turns2", "1"), r"row 7 in line 9: dual_theta2_deg"),
    "turns where it is not centred": (
        of_cell("B1", "turns1", "1"),
        r"turns1 is 1, of an orbit "
        r"that is not centred",
    ),
    # --- the comment of a CSV file
    "no comment": (
        of_text("csv", lambda text: text.partition("\n")[2]),
        r"line 1 must be a "
        r"comment",
    ),
    "two comments": (
        of_text("csv", lambda text: line(text, 1) + "\n" + text),
        r"line 2 must be "
        r"the header",
    ),
    "an empty file": (of_text("csv", lambda text: ""), r"line 1 must be a comment"),
    "a comment without JSON": (
        of_text("csv", lambda text: "# an atlas\n" + text),
        r"Expecting "
        r"value: line "
        r"1",
    ),
    "a comment cut off": (
        of_text("csv", lambda text: text[:300] + "\n" + text.partition("\n")[2]),
        r"line 1",
    ),
    "null bytes": (
        of_text("csv", lambda text: text.replace("centred\x2c", "cen\0red,")),
        r"symmetry|line \d+",
    ),
    # --- the head
    "no units": (of_head("units", value=...), r"the head has no units"),
    "radians declared": (
        of_head("units", "theta1", value="rad"),
        r"units.theta1 must be deg, is "
        r"'rad'",
    ),
    "a unit missing": (of_head("units", "energy", value=...), r"units has no energy"),
    "another pendulum": (of_head("pendulum", "l1_m", value=0.3), r"row 1: energy_J"),
    "a heavier pendulum": (of_head("pendulum", "m2_kg", value=0.2), r"row 1: energy_J"),
    "less gravity": (of_head("pendulum", "g_m_s2", value=1.6), r"row 1: energy_J"),
    "a length missing": (of_head("pendulum", "l2_m", value=...), r"pendulum has no l2_m"),
    "another name of a length": (
        of_head("pendulum", "length", value=0.2),
        r"pendulum has unknown "
        r"length",
    ),
    "a length as text": (
        of_head("pendulum", "l1_m", value="0.2"),
        r"pendulum.l1_m must be a "
        r"finite number",
    ),
    "a length of true": (
        of_head("pendulum", "l1_m", value=True),
        r"pendulum.l1_m must be a finite "
        r"number, is True",
    ),
    "a length below zero": (
        of_head("pendulum", "l1_m", value=-0.2),
        r"pendulum.l1_m must be above "
        r"0",
    ),
    "no gravity": (of_head("pendulum", "g_m_s2", value=0.0), r"pendulum.g_m_s2 must be above 0"),
    "a list for a pendulum": (
        of_head("pendulum", value=[0.2, 0.2, 0.1, 0.1, 9.8]),
        r"pendulum "
        r"must be an "
        r"object",
    ),
    "a longest period of zero": (of_head("max_period_s", value=0), r"max_period_s must be above 0"),
    "a longest period too short": (of_head("max_period_s", value=0.5), r"families\[0\]"),
    "a longest period of null": (
        of_head("max_period_s", value=None),
        r"max_period_s must be a "
        r"finite number",
    ),
    "a version that is a number": (
        of_head("dpend_version", value=0.1),
        r"dpend_version must be "
        r"text",
    ),
    "no coverage": (of_head("coverage", value=...), r"the head has no coverage"),
    "coverage as a number": (of_head("coverage", value=3), r"coverage must be an object"),
    "coverage with a fraction": (
        of_head("coverage", "slices", value=1.5),
        r"coverage.slices must "
        r"be an integer",
    ),
    "coverage below zero": (
        of_head("coverage", "suspicious_cells", value=-1),
        r"coverage.suspicious_cells",
    ),
    "coverage of true": (
        of_head("coverage", "winding", value=True),
        r"coverage.winding must be an "
        r"integer",
    ),
    "more coverage": (of_head("coverage", "doubts", value=1), r"coverage has unknown doubts"),
    "families as an object": (of_head("families", value={}), r"families must be a list"),
    "no families": (
        of_head("families", value=[]),
        r"row 1: family is 'C1', and there are no "
        r"families",
    ),
    "a family missing": (
        of_head("families", 0, value=...),
        r"row 1: family is 'C1', the families "
        r"are",
    ),
    "a family as text": (of_head("families", 0, value="C1"), r"families\[0\] must be an object"),
    "a family twice": (
        of_head("families", 1, "family", value="C1"),
        r"families\[1\].family is "
        r"'C1', as another",
    ),
    "a family of another name": (
        of_head("families", 0, "family", value="B1"),
        r"families\[0\].family must be",
    ),
    "a family of no symmetry": (
        of_head("families", 0, "symmetry", value="odd"),
        r"families\[0\].symmetry",
    ),
    "a family with one end": (
        of_head("families", 0, "ends", value=["closed"]),
        r"families\[0\].ends",
    ),
    "a family with other ends": (
        of_head("families", 0, "ends", 1, value="here"),
        r"families\[0\].ends\[1\]",
    ),
    "a family of no status": (
        of_head("families", 0, "status", value="good"),
        r"families\[0\].status",
    ),
    "a family longer than all": (
        of_head("families", 0, "longest_period_s", value=3.0),
        r"families\[0\].longest",
    ),
    "special points as text": (
        of_head("families", 0, "special_points", value="none"),
        r"families\[0\].special_points",
    ),
    "a special point of null": (
        of_head("families", 0, "special_points", 0, value=None),
        r"special_points\[0\]",
    ),
    "a special point of no kind": (
        of_head("families", 0, "special_points", 0, "kind", value="strange"),
        r"special_points\[0\].kind",
    ),
    "a special point out of order": (
        of_head("families", 0, "special_points", 0, "arclength", value=9.0),
        r"special_points\[1\].arclength",
    ),
    "a special point beyond": (
        of_head("families", 0, "special_points", 0, "period_s", value=2.5),
        r"special_points\[0\].period_s",
    ),
    "a special point without kappa": (
        of_head("families", 0, "special_points", 0, "kappa", value=None),
        r"special_points\[0\].kappa",
    ),
    "fewer rows than said": (of_head("rows", value=7), r"rows is 7, and there are"),
    # --- orbits in JSON
    "no orbits": (of_head("orbits", value=...), r"a list called orbits"),
    "orbits as an object": (of_head("orbits", value={}), r"a list called orbits"),
    "an orbit deleted": (of_head("orbits", 5, value=...), r"rows is"),
    "an orbit as a list": (of_head("orbits", 5, value=[]), r"row 6 must be an object"),
    "a key missing": (of_head("orbits", 5, "kappa", value=...), r"row 6 has no kappa"),
    "a key more": (of_orbit(6, colour="red"), r"row 6 has unknown colour"),
    "a number as text": (
        of_orbit(6, period_s=lambda row: str(row["period_s"])),
        r"row 6: period_s "
        r"must be a "
        r"finite",
    ),
    "true for a number": (
        of_orbit(6, energy_J=True),
        r"row 6: energy_J must be a finite number, "
        r"is True",
    ),
    "null for a number": (
        of_orbit(6, energy_J=None),
        r"row 6: energy_J is nan, and must be "
        r"finite",
    ),
    "a list for a number": (
        of_orbit(6, energy_J=[1.0]),
        r"row 6: energy_J must be a finite "
        r"number",
    ),
    "an integer of 400 digits": (
        of_orbit(6, energy_J=10**400),
        r"row 6: energy_J must be a finite "
        r"number",
    ),
    "true for an integer": (of_orbit(6, iterations=True), r"row 6: iterations must be an integer"),
    "a fraction for an integer": (
        of_orbit(6, iterations=2.5),
        r"row 6: iterations must be an "
        r"integer",
    ),
    "one turn": (of_orbit(6, turns=[0]), r"row 6: turns must be a list of two integers"),
    "turns with fractions": (of_orbit(6, turns=[0.5, 0]), r"row 6: turns1 must be an integer"),
    "a dual of one angle": (
        of_orbit(6, dual={"theta1_deg": 1.0}),
        r"row 6: dual has no "
        r"theta2_deg",
    ),
    "a dual as a list": (of_orbit(6, dual=[1.0, 2.0]), r"row 6: dual must be an object"),
    "a dual elsewhere": (
        of_orbit(6, dual={"theta1_deg": 1.0, "theta2_deg": 2.0}),
        r"row 6: "
        r"energy_J .* "
        r"its dual",
    ),
    "null for a symmetry": (of_orbit(6, symmetry=None), r"row 6: symmetry must be text"),
    "null for a status": (of_orbit(6, status=None), r"row 6: status must be one of"),
    "another's logarithm": (
        of_orbit(6, log_abs_kappa=3.0),
        r"row 6: log_abs_kappa is 3, kappa is "
        r"-0.87",
    ),
    # --- the text of a JSON file
    "NaN": (
        of_text("json", lambda text: text.replace(": -0.5", ': NaN, "x": 5', 1)),
        r"NaN is no "
        r"JSON "
        r"number",
    ),
    "Infinity": (
        of_text("json", lambda text: text.replace('"kappa": -', '"kappa": -Infinity', 1)),
        r"-Infinity|delim",
    ),
    "1e999": (
        of_text(
            "json", lambda text: re.sub(r'"energy_J": [^,]*', '"energy_J": 1e999', text, count=1)
        ),
        r"row 1: energy_J is inf",
    ),
    "a key twice": (
        of_text("json", lambda text: text.replace('"kappa"', '"kappa": 1, "kappa"', 1)),
        r"'kappa' "
        r"stands",
    ),
    "a second head": (
        of_text("json", lambda text: text.replace('"units"', '"orbits": [], "units"')),
        r"'orbits' stands",
    ),
    "JSON cut off": (of_text("json", lambda text: text[: len(text) // 2]), r"line \d+ column \d+"),
    "JSON and more": (of_text("json", lambda text: text + "{}"), r"Extra data"),
    "a list": (of_text("json", lambda text: "[1]"), r"a list called orbits"),
    "null": (of_text("json", lambda text: "null"), r"a list called orbits"),
    "no text": (of_text("json", lambda text: ""), r"Expecting value"),
    "brackets without end": (of_text("json", lambda text: "[" * 10**6), r"nested too deeply"),
    "objects without end": (
        of_text("json", lambda text: '{"orbits":' * 10**5),
        r"nested too "
        r"deeply",
    ),
    "5000 digits": (
        of_text("json", lambda text: text.replace('"rows": ', '"rows": ' + "9" * 5000, 1)),
        r"digits",
    ),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_each_damage_is_refused_with_its_place(files, tmp_path, name):
    damage, place = DAMAGES[name]
    ending, text = damage(files)
    path = tmp_path / f"damaged.{ending}"
    path.write_text(text)
    with pytest.raises(ValueError, match=place) as refusal:
        dpend.load_atlas(path)
    said = str(refusal.value)
    assert said.startswith(f"path must be a file that Atlas.save wrote, got {path} (")
    assert said.endswith("): give another file")
    assert "\n" not in said


# --- true files -----------------------------------------------------------------------------------


def same(one, other):
    """Two atlases, but for a bit that degrees may cost."""
    assert (one.coverage, one.families, one.max_period) == (
        other.coverage,
        other.families,
        other.max_period,
    )
    assert vars(one.pendulum) == vars(other.pendulum)
    for key, column in one.table.items():
        if column.dtype.kind == "f":
            np.testing.assert_allclose(other.table[key], column, rtol=3e-16, equal_nan=True)
        else:
            np.testing.assert_array_equal(other.table[key], column)


@pytest.mark.parametrize("ending", ["csv", "json"])
def test_the_published_catalogue_comes_back(tmp_path, ending):
    whole = dpend.load_atlas(PUBLISHED / f"brake_orbits.{ending}")
    assert len(whole) == 1394
    whole.save(tmp_path / f"again.{ending}")
    same(whole, dpend.load_atlas(tmp_path / f"again.{ending}"))
    some = whole.where(kappa=(-1, 1), symmetry="brake")
    some.save(tmp_path / f"some.{ending}")
    same(some, dpend.load_atlas(tmp_path / f"some.{ending}"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("pendulum", "theta1", "max_period"),
    [
        ((0.2, 0.2, 0.1, 0.1, 9.8), 0.7, 4.0),
        ((0.2, 0.2, 0.1, 0.1, 9.8), np.pi, 2.0),
        ((0.2, 0.2, 0.1, 0.1, 9.8), 400 * np.pi + 1.0, 2.0),
        ((0.2, 0.2, 0.1, 0.1, 9.8), 1e-9, 1.0),
        ((1.0, 0.5, 3.0, 1.0, 9.81), -2.0, 4.0),
        ((0.3, 1.0, 0.1, 2.0, 9.81), 1.0, 2.5),
        ((1e-3, 2e-3, 1e6, 3e6, 1e3), 2.5, 0.012),
        ((1.0, 0.2, 1.0, 5.0, 9.8), None, 1.0),
        ((0.2, 0.6, 0.1, 0.05, 9.8), None, 1.3),
    ],
)
def test_new_atlases_come_back(tmp_path, pendulum, theta1, max_period):
    """Other pendulums, angles beyond a turn, kappa up to 1e19, whole squares."""
    pendulum = dpend.Pendulum(*pendulum)
    if theta1 is None:
        found = dpend.find_brake_families(pendulum, max_period=max_period)
    else:
        found = dpend.find_brake_orbits(pendulum, theta1=theta1, max_period=max_period)
    assert len(found)
    for ending in ("csv", "json"):
        found.save(tmp_path / f"new.{ending}")
        same(found, dpend.load_atlas(tmp_path / f"new.{ending}"))


@pytest.mark.parametrize("ending", ["csv", "json"])
def test_rows_that_failed_come_back(atlas, tmp_path, ending):
    """They may have no numbers, nor need they agree: they are told by their status."""
    table = {key: column.copy() for key, column in atlas.table.items()}
    for i, status in ((4, Status.MAX_ITERATIONS), (9, Status.NONFINITE)):
        table["status"][i] = status
        for key in (
            "theta2",
            "period",
            "energy",
            "kappa",
            "log_abs_kappa",
            "theta2_error",
            "period_error",
            "residual",
        ):
            table[key][i] = np.nan
    table["kappa"][20], table["log_abs_kappa"][20] = 0.0, -np.inf
    failed = replace(atlas, table=table)
    failed.save(tmp_path / f"failed.{ending}")
    same(failed, dpend.load_atlas(tmp_path / f"failed.{ending}"))


HARMLESS = {
    "lines of another system": ("csv", lambda text: text.replace("\n", "\r\n")),
    "lines of an old system": ("csv", lambda text: text.replace("\n", "\r")),
    "a mark of the byte order": ("csv", lambda text: "\ufeff" + text),
    "blank lines": ("csv", lambda text: text.replace("\nC2", "\n\nC2", 1) + "\n\n"),
    "no last line end": ("csv", lambda text: text.rstrip("\n")),
    "cells in quotes": ("csv", lambda text: text.replace(",centred,", ',"centred",')),
    "another version": (
        "csv",
        lambda text: text.replace('"dpend_version": "', '"dpend_version": "9'),
    ),
    "a file of 0.1.0": ("csv", lambda text: re.sub(r', "(exhausted|rows)": \w+', "", text)),
    "JSON on one line": ("json", lambda text: json.dumps(json.loads(text))),
    "JSON with other line ends": ("json", lambda text: text.replace("\n", "\r\n")),
    "JSON with a mark": ("json", lambda text: "\ufeff" + text),
    "integers for whole numbers": (
        "json",
        lambda text: text.replace('"g_m_s2": 9.8', '"g_m_s2": 9.8e0'),
    ),
    "keys in another order": ("json", lambda text: json.dumps(json.loads(text), sort_keys=True)),
}


@pytest.mark.parametrize("name", HARMLESS)
def test_what_changes_no_number_is_read(atlas, files, tmp_path, name):
    ending, change = HARMLESS[name]
    path = tmp_path / f"harmless.{ending}"
    path.write_bytes(change(files[ending]).encode())
    same(atlas, dpend.load_atlas(path))


def test_columns_may_stand_in_another_order(atlas, files, tmp_path):
    _, text = of_csv(lambda rows: [row.reverse() for row in rows])(files)
    (tmp_path / "turned.csv").write_text(text)
    same(atlas, dpend.load_atlas(tmp_path / "turned.csv"))


# --- files without end ----------------------------------------------------------------------------


def endless(tmp_path, kind):
    """A file that is no file, or too large."""
    path = tmp_path / f"{kind}.json"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "directory":
        path.mkdir()
    elif kind == "huge":  # a hole, which takes no room
        with path.open("wb") as file:
            file.truncate(LARGEST_FILE + 1)
    else:
        path.symlink_to(
            {"zero": "/dev/zero", "tty": "/dev/null", "made up": "/proc/self/maps"}[kind]
        )
    return path


@pytest.mark.parametrize(
    ("kind", "reason"),
    [
        ("pipe", "it is no regular file"),
        ("zero", "it is no regular file"),
        ("tty", "it is no regular file"),
        ("directory", "it is no regular file"),
        ("made up", "it has 0 bytes and gives more"),
        ("huge", "it has 268 MB, above the limit of 268 MB"),
    ],
)
def test_files_without_end_are_refused_unread(paper, tmp_path, kind, reason):
    """By every reader of a user's file; the pipe has no writer, which opening it would wait for."""
    path = endless(tmp_path, kind)
    with pytest.raises(
        ValueError, match=rf"path must be a file that Atlas.save wrote, got .* \({reason}"
    ):
        dpend.load_atlas(path)
    with pytest.raises(
        ValueError, match=rf"data must be a CSV file that can be read, got .* \({reason}"
    ):
        dpend.load_angles(path)
    with pytest.raises(ValueError, match=rf"store must be a file .*(\({reason}|Is a directory)"):
        dpend.find_brake_families(paper, max_period=0.1, store=path)


def test_text_that_is_none(tmp_path):
    path = tmp_path / "a.csv"
    path.write_bytes(b"# \xff")
    with pytest.raises(ValueError, match=r"got .*a.csv \(byte 2 is no UTF-8 text\)"):
        dpend.load_atlas(path)
    path.write_bytes("# {}".encode("utf-16"))
    with pytest.raises(ValueError, match="byte 0 is no UTF-8 text"):
        dpend.load_atlas(path)
    path.write_text("abc\n")
    assert read_text(path) == "abc\n"
    assert parse_json('{"a": [1, 2.5, null, true]}') == {"a": [1, 2.5, None, True]}
