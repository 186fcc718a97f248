"""The pages of docs/: their code runs as printed, prints what they say, and every public name has
its place.
"""

import re
import shlex
from pathlib import Path

import jax
import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import pytest
from typer.main import get_command

import dpend
from dpend import cli

DOCS = Path(__file__).parent.parent / "docs"
PAGES = sorted(path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md"))
# A block of Python, and what it prints, if a block of text follows at once.
CODE = re.compile(r"^```python\n(.*?)^```\n(?:```text\n(.*?)^```\n)?", re.DOTALL | re.MULTILINE)
SHELL = re.compile(r"^```sh\n(.*?)^```\n", re.DOTALL | re.MULTILINE)
SPANS = re.compile(r"`dpend (\w+ [^`|.]*--[^`|]+)`")
WITH_CODE = [page for page in PAGES if CODE.search((DOCS / page).read_text())]
# What shares its compiled code with other quick tests.
QUICK = ("howto/partners.md",)


@pytest.mark.parametrize(
    "page", [page if page in QUICK else pytest.param(page, marks=pytest.mark.slow)
             for page in WITH_CODE]
)  # fmt: skip
def test_a_page_prints_what_it_says(page, capsys, tmp_path, monkeypatch):
    """Its blocks in order, in one namespace and an empty folder; a user's JAX promotes types."""
    if "certify" in (text := (DOCS / page).read_text()):
        pytest.importorskip("flint")
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    with jax.numpy_dtype_promotion("standard"):
        for code, printed in CODE.findall(text):
            exec(compile(code, page, "exec"), names)
            assert _lines(capsys.readouterr().out) == _lines(printed)
    plt.close("all")


def _lines(text):
    return [line.rstrip() for line in text.splitlines()]


@pytest.mark.parametrize("page", PAGES)
def test_every_command_is_understood(page):
    text = (DOCS / page).read_text()
    lines = [line for block in SHELL.findall(text) for line in block.splitlines()]
    commands = [line.removeprefix("dpend ") for line in lines if line.startswith("dpend ")]
    spans = [" ".join(span.split()) for span in SPANS.findall(text)]
    for command in [*commands, *spans]:
        name, *options = shlex.split(command)
        assert get_command(cli.app).commands[name].make_context(name, options).params


def test_every_public_name_is_on_the_page_of_names():
    listed = re.findall(r"^\.\. auto(?:function|class|exception):: (\w+)", _api(), re.MULTILINE)
    public = [
        name
        for name, value in vars(dpend).items()
        if not name.startswith("_") and getattr(value, "__module__", "").startswith("dpend")
    ]
    assert sorted(listed) == sorted(public)
    assert set(re.findall(r"automodule:: dpend\.(\w+)", _api())) == {"chaos", "plots", "animate"}


def _api():
    return (DOCS / "api.md").read_text()


def test_every_page_is_in_a_table_of_contents():
    linked = set()
    for page in PAGES:
        place = (DOCS / page).parent
        for block in re.findall(
            r"^```\{toctree\}\n(.*?)^```", (DOCS / page).read_text(), re.M | re.S
        ):
            names = [line for line in block.split() if not line.startswith(":") and line != "1"]
            linked |= {(place / f"{name}.md").resolve() for name in names}
    missing = [page for page in PAGES if (DOCS / page).resolve() not in linked]
    assert missing == ["index.md"]
