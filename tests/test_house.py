"""The house rules: each module imports only modules above it, and heavy packages only where they are used."""

import ast
import subprocess
import sys
from pathlib import Path

import dpend

ORDER = """_runtime checks files trig pendulum steppers trajectory events lanes chaos stores sweeps stability
shooting continuation orbits families scan catalogue atlas survey certify measurements windows fit gradients design
plots animate cli""".split()
HOUSE = Path(dpend.__file__).parent


def imported(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("dpend."):
            yield node.module.split(".")[1]


def test_each_module_imports_only_modules_above_it():
    modules = sorted(path.stem for path in HOUSE.glob("*.py") if path.stem != "__init__")
    assert set(modules) <= set(ORDER)
    wrong = [
        (module, above)
        for module in modules
        for above in imported(HOUSE / f"{module}.py")
        if ORDER.index(above) >= ORDER.index(module)
    ]
    assert wrong == []


def test_only_the_command_line_prints():
    def prints(path):
        calls = (node.func for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call))
        return any(isinstance(function, ast.Name) and function.id == "print" for function in calls)

    assert [path.stem for path in HOUSE.glob("*.py") if prints(path)] == ["cli"]


def test_import_leaves_heavy_packages_alone():
    code = """
import sys, dpend, dpend.cli
print(*sorted({name.split('.')[0] for name in sys.modules}
              & {'diffrax', 'equinox', 'optax', 'xarray', 'zarr', 'matplotlib', 'dask'}))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []
