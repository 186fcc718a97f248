"""Prints each requirement of pyproject.toml and of its extra `test` at its lowest version."""

import re
import tomllib
from pathlib import Path

project = tomllib.loads((Path(__file__).parent.parent / "pyproject.toml").read_text())["project"]
for requirement in project["dependencies"] + project["optional-dependencies"]["test"]:
    pinned = re.fullmatch(r"([\w.-]+(?:\[[\w,]+\])?)>=([\w.]+)", requirement)
    if pinned is None:
        raise SystemExit(f"{requirement!r} must be name>=version: its lowest version is not known")
    print("==".join(pinned.groups()))
