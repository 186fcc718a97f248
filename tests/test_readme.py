"""The README's code prints what the README says it prints."""

import re
from pathlib import Path

README = Path(__file__).parent.parent / "README.md"


def test_printed_output_is_true(capsys):
    code, printed = re.search(r"```python\n(.*?)```\n\n```text\n(.*?)```", README.read_text(), re.DOTALL).groups()
    exec(compile(code, "README.md", "exec"), {})
    assert capsys.readouterr().out == printed


def test_every_file_it_names_is_there():
    names = re.findall(r"\]\(([^):#]+)(?:#[^)]*)?\)", README.read_text())
    assert names
    assert [name for name in names if not (README.parent / name).is_file()] == []
