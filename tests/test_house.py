"""The house rules: the wings in reading order, no private name through a door, heavy packages where
they are used.
"""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import house

import dpend

# Reading order. A file imports only files before it: those of the wings above, and those before it
# in its own wing.
# The public names, `dpend` itself, come last but for the doors, which draw, print and serve.
ORDER = """
_version _runtime checks machine executables places status records
mechanics.trig mechanics.pendulum mechanics.surface mechanics.linear mechanics.units
methods.runge_kutta methods.circle methods.gauss methods.nodes methods.collocation methods.scheme
motion.integrate motion.estimate motion.trajectory motion.adaptive motion.variation motion.saved
motion.stepped motion.tables motion.simulate motion.reference motion.root motion.events
motion.crossings motion.gradients
chaos
maps.lanes maps.grid maps.cost maps.tiles maps.disk maps.store maps.layout maps.worker
maps.cluster maps.sweep
maps.section maps.returns maps.periodic maps.rotation
orbits.stability orbits.arc orbits.newton orbits.single orbits.rest orbits.implicit orbits.walk
orbits.search orbits.curve orbits.follow orbits.path orbits.orbit orbits.derivatives orbits.samples
orbits.zones orbits.extrema orbits.special orbits.passages orbits.files orbits.through
orbits.request orbits.guess orbits.find orbits.family
orbits.family_files orbits.branching orbits.continuation
catalogue.bicubic catalogue.rows catalogue.scan catalogue.table catalogue.files catalogue.atlas
catalogue.release catalogue.energy catalogue.track catalogue.progress catalogue.entries
catalogue.survey
proofs.decimals proofs.balls proofs.taylor proofs.flow proofs.chain proofs.proof proofs.facts
proofs.digits proofs.certificate proofs.question proofs.certify proofs.ledger proofs.lanes
proofs.chebyshev proofs.sheet proofs.rests proofs.march proofs.squares proofs.complete
inverse.measurements inverse.windows inverse.gauss_newton inverse.search inverse.uncertainty
inverse.estimates inverse.fit inverse.problem inverse.nearest inverse.design
dpend
map_picture section_picture motion_picture film_picture fit_picture family_picture
plots animate tables report terminal writing reading options
orbit_commands design_commands proof_commands simulation_commands section_commands cli
""".split()
HOUSE = Path(dpend.__file__).parent
# What the public names tell type checkers of, and import when it is first asked for.
LAZY = {("dpend", "plots"), ("dpend", "animate")}
# Sizes: lines of a file, lines of code and McCabe's complexity of a function. What is above them
# says why in a comment beside it, or waits to be written anew.
LONGEST_FILE, LONGEST_FUNCTION, MOST_BRANCHES = 350, 40, 12
LONG_FILES: set[str] = set()
LONG_FUNCTIONS = {
    "map_command", "atlas", "orbit", "family", "simulate", "fit", "certify",  # options, one a line
    "newton_on_line", "_near_guess", "_accept", "_first_rest",  # straight lines of one computation
    "check_gradient", "_dopri8",
}  # fmt: skip
BRANCHING = {"follow_curve"}
# The command line prints results and, on standard error, what it does.
PRINTING = ["report", "tables", "terminal"]


def name_of(path: Path) -> str:
    return ".".join(path.relative_to(HOUSE).with_suffix("").parts)


def files() -> dict[str, Path]:
    """All files of the package but the `__init__`s of the wings, the package's own as `dpend`."""
    found = {
        name_of(path): path for path in sorted(HOUSE.rglob("*.py")) if path.name != "__init__.py"
    }
    return {**found, "dpend": HOUSE / "__init__.py"}


def imported(path: Path) -> Iterator[tuple[str, str | None]]:
    """The files that a file imports, anywhere in it, and which of their names."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            for alias in node.names:
                if alias.name.split(".")[0] == "dpend":
                    yield alias.name.removeprefix("dpend."), None
        elif (
            isinstance(node, ast.ImportFrom)
            and node.module
            and node.module.split(".")[0] == "dpend"
        ):
            for alias in node.names:
                whole = f"{node.module}.{alias.name}".removeprefix("dpend.")
                yield (
                    (whole, None)
                    if whole in ORDER
                    else (node.module.removeprefix("dpend."), alias.name)
                )


def test_every_file_has_its_place():
    assert sorted(files()) == sorted(ORDER)


def test_wings_have_empty_doors():
    doors = [path for path in HOUSE.rglob("__init__.py") if path.parent != HOUSE]
    assert {path.parent.name for path in doors} == {
        name.split(".")[0] for name in ORDER if "." in name
    }
    assert [path for path in doors if path.read_text()] == []


def test_each_file_imports_only_files_before_it():
    wrong = [
        f"{name} imports {above}"
        for name, path in files().items()
        for above, _ in imported(path)
        if ORDER.index(above) >= ORDER.index(name) and (name, above) not in LAZY
    ]
    assert wrong == []


def test_no_private_name_passes_through_a_door():
    private = [
        f"{name} imports {what} of {above}"
        for name, path in files().items()
        for above, what in imported(path)
        if what is not None and what.startswith("_") and not what.startswith("__")
    ]
    assert private == []


def test_only_the_command_line_prints():
    def prints(path):
        calls = (
            node.func
            for node in ast.walk(ast.parse(path.read_text()))
            if isinstance(node, ast.Call)
        )
        return any(isinstance(function, ast.Name) and function.id == "print" for function in calls)

    assert sorted(name for name, path in files().items() if prints(path)) == PRINTING


def test_import_leaves_heavy_packages_alone():
    code = """
import sys, dpend, dpend.cli
print(*sorted({name.split('.')[0] for name in sys.modules}
              & {'diffrax', 'equinox', 'optax', 'xarray', 'zarr', 'pandas', 'matplotlib', 'dask',
                 'distributed', 'flint'}))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


def test_files_and_functions_fit_a_sitting_and_a_screen():
    lengths = {
        path.relative_to(HOUSE).as_posix(): len(path.read_text().splitlines())
        for path in HOUSE.rglob("*.py")
    }
    assert {name for name, length in lengths.items() if length > LONGEST_FILE} == LONG_FILES
    functions = [function for path in HOUSE.rglob("*.py") for function in house.functions_of(path)]
    long = {function.name for function in functions if function.code > LONGEST_FUNCTION}
    assert long == LONG_FUNCTIONS
    branching = {f.name for f in functions if f.complexity > MOST_BRANCHES}
    assert branching == BRANCHING
    assert [function.name for function in functions if not function.typed] == []
