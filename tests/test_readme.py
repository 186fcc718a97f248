"""The README's code prints what the README says it prints."""

import re
from pathlib import Path

import speed_vs_error

README = Path(__file__).parent.parent / "README.md"


def test_printed_output_is_true(capsys):
    code, printed = re.search(r"```python\n(.*?)```\n\n```text\n(.*?)```", README.read_text(), re.DOTALL).groups()
    exec(compile(code, "README.md", "exec"), {})
    assert capsys.readouterr().out == printed


def test_every_file_it_names_is_there():
    names = re.findall(r"\]\(([^):#]+)(?:#[^)]*)?\)", README.read_text())
    assert names
    assert [name for name in names if not (README.parent / name).is_file()] == []


def test_the_table_of_speeds_is_made_of_the_measured_rows():
    shown = README.read_text().split(speed_vs_error.START)[1].split(speed_vs_error.END)[0]
    rows = speed_vs_error.read_rows()
    assert shown == speed_vs_error.table(rows)
    assert all(row.error_99 > 0 for row in rows if row.method.startswith("dpend"))
