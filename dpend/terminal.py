"""What the command line says on standard error: progress, costs, complaints; and how it ends."""

import contextlib
import errno
import math
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from typing import Any

from dpend.maps.store import StoreWarning

# What is told before it is spent: more seconds, or bytes.
_LONG, _LARGE = 60.0, 1e9
# Seconds between two lines about a search whose standard error is no terminal.
_BETWEEN_LINES = 15.0


def on_terminal() -> bool:
    return sys.stderr is not None and sys.stderr.isatty()


def complain(text: str) -> None:
    if sys.stderr is not None:  # the shell may have closed it
        print("dpend: " + " ".join(text.split()), file=sys.stderr)


def tell_cost(steps: int | float, seconds: float, size: int | float = 0, more: str = "") -> None:
    """Says before it begins what takes more than a minute, or more than a gigabyte of `size`
    [bytes].
    """
    tell_wait(f"about {steps:.1e} time steps", seconds, size, more)


def tell_wait(what: str, seconds: float, size: int | float = 0, more: str = "") -> None:
    """The same of any work."""
    if seconds > _LONG or size > _LARGE:
        room = f" and {size / 1e9:.2g} GB" if size > _LARGE else ""
        complain(f"{what}, which may take {math.ceil(seconds / 60)} minutes{room}{more}")


@contextlib.contextmanager
def bar(shown: bool, unit: str) -> Iterator[Callable[..., None]]:
    """A progress bar on standard error with the time left, and the rate where steps are told
    too.
    """
    if not shown:
        yield lambda done, total, steps=0: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.completed:.0f}/{task.total:.0f} " + unit),
        BarColumn(),
        TextColumn("{task.fields[rate]}"),
    )
    with Progress(*columns, TimeRemainingColumn(), console=Console(stderr=True)) as progress:
        task, started = progress.add_task("", total=1, rate=""), time.perf_counter()

        def show(done: int, total: int, steps: int = 0) -> None:
            millions = steps / max(time.perf_counter() - started, 1e-9) / 1e6
            progress.update(
                task, completed=done, total=total, rate=f"{millions:.1f} M steps/s" if steps else ""
            )

        yield show


@contextlib.contextmanager
def clock(doing: str) -> Iterator[None]:
    """What is being done and for how long, on a terminal: for what cannot tell how far it is."""
    if not on_terminal():
        yield
        return
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = SpinnerColumn(), TextColumn(doing), TimeElapsedColumn()
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        progress.add_task("", total=None)
        yield


@contextlib.contextmanager
def work(unit: str) -> Iterator[Callable[[float, float], None]]:
    """A progress bar on standard error; where that is no terminal a line now and then."""
    with bar(on_terminal(), unit) as show:
        started = last = time.perf_counter()

        def tell(done: int | float, planned: int | float) -> None:
            nonlocal last
            show(done, planned)
            if not on_terminal() and time.perf_counter() - last > _BETWEEN_LINES:
                last = time.perf_counter()
                print(
                    f"dpend: {done:.3g} of about {planned:.3g} {unit}, {last - started:.0f} s",
                    file=sys.stderr,
                )

        yield tell


@contextlib.contextmanager
def complaints_of_stores() -> Iterator[None]:
    """Warnings about a store in one line each."""
    with warnings.catch_warnings():
        show = warnings.showwarning

        def tell(message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> None:
            if issubclass(category, StoreWarning):
                complain(str(message))
            else:
                show(message, category, *where, **more)

        warnings.simplefilter("always", StoreWarning)
        warnings.showwarning = tell
        yield


def tell_error(error: Exception) -> int:
    """One line about an error, and the exit status; a fault of this program is raised again."""
    # The command line's own errors know how to name the option they are about.
    usage = getattr(error, "format_message", None)
    if usage is not None:
        complain(usage())
        return 2
    if isinstance(error, MemoryError):
        complain(f"there is not enough memory ({error}): give fewer steps, cells or points")
        return 1
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EIO, errno.EBADF):
        complain(
            f"{error.filename or 'standard output'} cannot be written ({error.strerror}): make "
            f"room for it"
        )
        return 1
    if not isinstance(error, (ValueError, OSError, RuntimeError)):
        raise error
    complain(str(error))
    return 1 if isinstance(error, RuntimeError) else 2
