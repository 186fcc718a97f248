"""A table as the command line prints it."""

from collections.abc import Sequence

# Wider than any table here: a number is never broken to fit a terminal.
_TABLE_WIDTH = 200
# Columns of words, which begin at the left; numbers end at the right.
_WORDS = ("", "symmetry", "stability", "family", "from", "to")


def print_table(title: str, headings: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(title=title, title_justify="left", title_style="")
    for heading in headings:
        table.add_column(heading, justify="left" if heading in _WORDS else "right")
    for row in rows:
        table.add_row(*row)
    console = Console(width=_TABLE_WIDTH, highlight=False)
    with console.capture() as text:
        console.print(table)
    print(text.get(), end="")
