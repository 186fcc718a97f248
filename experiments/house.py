"""The house, measured: how long files and functions are, how they branch, and how names are used.

Prints one table of the package as it is. It reads the source of the package that Python would
import, and runs none of it.

Why we trust it: it counts what Python's own parser sees.
"""

import argparse
import ast
import importlib.util
import statistics
import tokenize
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

SPEC = importlib.util.find_spec("dpend")
if SPEC is None or SPEC.origin is None:
    raise SystemExit("dpend is not installed: run `pip install .` first")
HOUSE = Path(SPEC.origin).parent
FUNCTION = ast.FunctionDef | ast.AsyncFunctionDef
# What adds a way through a function: McCabe's count, as radon takes it.
BRANCHES = (ast.If, ast.IfExp, ast.For, ast.While, ast.ExceptHandler, ast.Assert, ast.comprehension)
# Past participles that do not end in "ed"; words that do and are none.
IRREGULAR = {
    "told",
    "laid",
    "begun",
    "found",
    "known",
    "shown",
    "kept",
    "met",
    "cut",
    "drawn",
    "taken",
    "given",
    "seen",
    "left",
}
NO_PARTICIPLES = {"speed", "feed", "need", "seed", "shed", "bed", "red"}


@dataclass(frozen=True)
class Function:
    """A function and its sizes."""

    name: str
    file: str
    lines: int
    code: int
    parameters: int
    complexity: int
    typed: bool


def text_lines(node: ast.AST) -> set[int]:
    """The lines of the docstrings in a tree."""
    found: set[int] = set()
    for inner in ast.walk(node):
        if (
            isinstance(inner, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef))
            and inner.body
        ):
            first = inner.body[0]
            if (
                isinstance(first, ast.Expr)
                and isinstance(first.value, ast.Constant)
                and isinstance(first.value.value, str)
            ):
                found |= set(range(first.lineno, (first.end_lineno or first.lineno) + 1))
    return found


def code_lines(path: Path) -> tuple[set[int], set[int]]:
    """The lines that hold code, and those that hold nothing but a comment."""
    code: set[int] = set()
    comments: set[int] = set()
    quiet = {
        tokenize.NL,
        tokenize.NEWLINE,
        tokenize.INDENT,
        tokenize.DEDENT,
        tokenize.ENCODING,
        tokenize.ENDMARKER,
    }
    with tokenize.open(path) as file:
        for token in tokenize.generate_tokens(file.readline):
            if token.type == tokenize.COMMENT:
                comments.add(token.start[0])
            elif token.type not in quiet:
                code |= set(range(token.start[0], token.end[0] + 1))
    return code, comments - code


def complexity(node: ast.AST) -> int:
    """One, and one for each way that branches off; functions inside count with the one that holds
    them.
    """
    count = 1
    for inner in ast.walk(node):
        if isinstance(inner, BRANCHES):
            count += 1 + (len(inner.ifs) if isinstance(inner, ast.comprehension) else 0)
        elif isinstance(inner, ast.BoolOp):
            count += len(inner.values) - 1
        elif isinstance(inner, ast.match_case):
            count += 1
    return count


def is_typed(node: FUNCTION) -> bool:
    """Whether every parameter but self and cls, and the result, has a type."""
    arguments = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
    rest = [argument for argument in (node.args.vararg, node.args.kwarg) if argument]
    own = [argument for argument in arguments if argument.arg not in ("self", "cls")]
    return node.returns is not None and all(argument.annotation for argument in own + rest)


def functions_of(path: Path) -> Iterator[Function]:
    tree = ast.parse(path.read_text())
    code, _ = code_lines(path)
    words = text_lines(tree)
    for node in ast.walk(tree):
        if isinstance(node, FUNCTION):
            span = range(node.lineno, (node.end_lineno or node.lineno) + 1)
            arguments = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
            yield Function(
                node.name,
                str(path.relative_to(HOUSE)),
                len(span),
                len([line for line in span if line in code and line not in words]),
                len([argument for argument in arguments if argument.arg not in ("self", "cls")]),
                complexity(node),
                is_typed(node),
            )


def names_of(path: Path) -> Iterator[str]:
    """The names that a file defines at its top."""
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            yield node.name
        elif isinstance(node, (ast.Assign, ast.AnnAssign)):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            yield from (
                inner.id
                for target in targets
                for inner in ast.walk(target)
                if isinstance(inner, ast.Name)
            )


def is_participle(name: str) -> bool:
    """Whether a function's name begins or ends with a past participle."""
    words = name.strip("_").split("_")
    return any(
        word in IRREGULAR or (word.endswith("ed") and word not in NO_PARTICIPLES)
        for word in (words[0], words[-1])
    )


def private_imports(path: Path) -> int:
    """How many underscore names a file imports from another of the package."""
    return sum(
        alias.name.startswith("_") and not alias.name.startswith("__")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("dpend.")
        for alias in node.names
    )


def spread(values: list[int]) -> str:
    """Median, 90th percentile and largest."""
    ordered = sorted(values)
    return f"{statistics.median(ordered):.0f} / {ordered[int(0.9 * len(ordered))]} / {ordered[-1]}"


def rows() -> Iterator[tuple[str, object]]:
    """What is counted, and how much it comes to."""
    files = [path for path in sorted(HOUSE.rglob("*.py")) if path.read_text()]
    sizes = {str(path.relative_to(HOUSE)): len(path.read_text().splitlines()) for path in files}
    functions = [function for path in files for function in functions_of(path)]
    homes = defaultdict(set)
    for path in files:
        for name in names_of(path):
            homes[name.strip("_")].add(path)
    longest = max(functions, key=lambda function: function.code)
    worst = max(functions, key=lambda function: function.complexity)
    yield "files", len(files)
    yield "lines", sum(sizes.values())
    yield (
        "of them code",
        sum(len(code_lines(path)[0] - text_lines(ast.parse(path.read_text()))) for path in files),
    )
    yield "of them docstrings", sum(len(text_lines(ast.parse(path.read_text()))) for path in files)
    yield "of them comments", sum(len(code_lines(path)[1]) for path in files)
    yield "longest file", f"{max(sizes.values())} ({max(sizes, key=sizes.__getitem__)})"
    yield "files above 350 lines", sum(size > 350 for size in sizes.values())
    yield "widest line", max(len(line) for path in files for line in path.read_text().splitlines())
    yield "functions", len(functions)
    yield (
        "lines of a function, median / 90 % / largest",
        spread([function.lines for function in functions]),
    )
    yield "lines of code of one", spread([function.code for function in functions])
    yield "longest function", f"{longest.code} ({longest.file}: {longest.name})"
    yield "functions above 40 lines of code", sum(function.code > 40 for function in functions)
    yield "functions above 7 parameters", sum(function.parameters > 7 for function in functions)
    yield "largest complexity", f"{worst.complexity} ({worst.file}: {worst.name})"
    yield (
        "functions of complexity above 12",
        sum(function.complexity > 12 for function in functions),
    )
    yield "untyped functions", sum(not function.typed for function in functions)
    yield "underscore names imported across files", sum(private_imports(path) for path in files)
    yield "names at the top of files", sum(1 for path in files for _ in names_of(path))
    yield "of them in several files", sum(len(places) > 1 for places in homes.values())
    yield (
        "functions named by a participle",
        sum(is_participle(function.name) for function in functions),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="the same: it takes a second")
    parser.parse_args()
    for what, much in rows():
        print(f"{what:<46}{much}")


if __name__ == "__main__":
    main()
