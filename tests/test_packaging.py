"""What a package index, a type checker and somebody who cites are told."""

import re
import sys
import tomllib
from importlib.resources import files
from pathlib import Path
from types import SimpleNamespace

import dpend
from dpend import cli

HOUSE = Path(__file__).parent.parent
PROJECT = tomllib.loads((HOUSE / "pyproject.toml").read_text())["project"]


def test_a_checker_reads_the_types():
    assert (files(dpend) / "py.typed").is_file()
    assert "Typing :: Typed" in PROJECT["classifiers"]


def test_the_citation_is_of_this_version():
    citation = dict(re.findall(r"^(\w+): (.+)$", (HOUSE / "CITATION.cff").read_text(), re.M))
    assert citation["version"] == dpend.__version__
    assert citation["license"] == PROJECT["license"]


def test_the_command_tells_the_version(capsys):
    assert cli._run(["--version"]) == 0
    assert capsys.readouterr().out == f"dpend {dpend.__version__}\n"


def test_an_index_shows_the_pictures(monkeypatch):
    """No link of the README is relative once the repository is named; addresses stay."""
    plugin = SimpleNamespace(MetadataHookInterface=object)  # hatchling is there when one builds
    monkeypatch.setitem(sys.modules, "hatchling.metadata.plugin.interface", plugin)
    monkeypatch.syspath_prepend(str(HOUSE))
    monkeypatch.setenv("DPEND_REPOSITORY", "https://host.example/o/dpend/")
    import hatch_build

    hook = hatch_build.IndexReadme()
    hook.root, metadata = str(HOUSE), {"version": "1.2.3"}
    hook.update(metadata)
    there = "https://host.example/o/dpend"
    assert metadata["urls"]["Repository"] == there
    links = re.findall(r"(!?)\[[^\]]*\]\(([^)]+)\)", metadata["readme"]["text"])
    assert {bool(picture) for picture, _ in links} == {True, False}
    for picture, target in links:
        assert target.startswith((f"{there}/{'raw' if picture else 'blob'}/v1.2.3/", "#"))
    web = "[a](https://jax.dev) [b](#here)"
    assert hatch_build.absolute(web, there, "1") == web
