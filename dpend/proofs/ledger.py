"""`certify_atlas`: the rows of an atlas proved, on several cores; a store keeps all proofs.

The store is a file of JSON objects, one a line. A line is appended and flushed as soon as its proof
ends, so that nothing computed is lost, however the process ends; a line that was cut off then is
proved again. Each line holds a certificate, and of what question it is: row, pendulum and digits.

python-flint has one setting for a whole process, so that proofs run in processes and not in
threads.
"""

import collections
import concurrent.futures
import hashlib
import multiprocessing
import os
import signal
from collections.abc import Callable, Generator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from dpend.catalogue.atlas import Atlas
from dpend.catalogue.table import column_values
from dpend.checks import function, instance, integer
from dpend.places import check_place, file_path, read_text
from dpend.proofs.certificate import Certificate, Question, Release, read_certificate
from dpend.proofs.certify import answer, require_flint
from dpend.proofs.decimals import shortest
from dpend.proofs.question import decimals_of
from dpend.records import json_text, parse_json
from dpend.status import Status

# CPU time of a row's proof [s]: 0.2 to 0.3 on the paper's pendulum; each digit adds to it.
SECONDS_PER_PROOF = 0.3


def certify_atlas(
    atlas: Atlas | Any,
    store: str | os.PathLike[str] | Any,
    *,
    digits: int | Any | None = None,
    processes: int | Any = 1,
    progress: Callable[[int, int], None] | Any | None = None,
) -> tuple[Atlas, tuple[Certificate, ...]]:
    """Proves each orbit of an atlas, see `certify`.

    The release angle of a row is exactly the decimal of degrees that `Atlas.save` writes. A proof
    that does not succeed is a certificate whose `status` and `reason` say so.

    Arguments:
        atlas: from `find_brake_orbits`, `find_brake_families` or `load_atlas`.
        store: F.jsonl, a certificate a line. If it is there, proofs in it are not made again.
        digits: prove as many decimals of theta2 and the period.
        processes: how many work at once. With more than one, a script must keep what it does at the
            top below `if __name__ == "__main__":`, because it is imported by each of them.
        progress: called with the number of rows proved so far, and that of all rows.
    Returns:
        the atlas with the column `certificate`, and the certificates in the order of its rows. The
        column is empty where nothing is proved.
    Raises:
        ValueError: no atlas; a store that holds something else, or cannot be written; digits or
            processes that are no positive integers.
        RuntimeError: python-flint is missing.
    """
    instance("atlas", atlas, Atlas, "dpend.load_atlas(path)")
    path = file_path("store", store)
    wanted = None if digits is None else integer("digits", digits, least=1)
    workers = integer("processes", processes, least=1)
    if progress is not None:
        function("progress", progress, "(rows proved, rows)", "print")
    check_place("store", path, (".jsonl",))
    require_flint()
    known = _read_store(path)
    questions = questions_of(atlas)
    names = [name_of(question, wanted) for question in questions]
    missing = {
        name: question for name, question in zip(names, questions, strict=True) if name not in known
    }
    done = len(questions) - len(missing)
    with (
        path.open("a", encoding="utf-8") as file,
        closing(_prove(missing, wanted, workers)) as found,
    ):
        for name, certificate in found:
            line = {"question": name, "certificate": certificate.record()}
            file.write(json_text(line, indent=None) + "\n")
            file.flush()
            known[name], done = certificate, done + 1
            if progress is not None:
                progress(done, len(questions))
    certificates = tuple(known[name] for name in names)
    column = np.array([one.identifier if one.exists else "" for one in certificates], str)
    return replace(atlas, table=atlas.table | {"certificate": column}), certificates


def questions_of(atlas: Atlas) -> list[Question]:
    """The rows as proofs take them."""
    pendulum, table = decimals_of(atlas.pendulum), atlas.table
    theta1 = column_values("theta1", table["theta1"])
    return [
        Question(
            pendulum,
            Release(shortest(degrees), "deg"),
            float(table["theta2"][i]),
            float(table["period"][i]),
            (int(table["turns1"][i]), int(table["turns2"][i]))
            if table["symmetry"][i] == "centred"
            else None,
        )
        for i, degrees in enumerate(theta1)
    ]


def summary(certificates: tuple[Certificate, ...]) -> str:
    """How many are proved and what they are; each that is not, or whose stability is not decided,
    with its reason.
    """
    proved = [one for one in certificates if one.exists]
    kinds = collections.Counter(one.stability for one in proved)
    said = ", ".join(f"{count} {kind}" for kind, count in kinds.most_common())
    lines = [
        f"{len(proved)} of {len(certificates)} orbits are proved to exist: {said or 'none'}; "
        f"{sum(one.minimal for one in proved)} periods are proved minimal, "
        f"{sum(bool(one.unique_period) for one in proved)} orbits are proved to be the only ones "
        "nearby"
    ]
    for one in certificates:
        place = one.place()
        if one.status != Status.PROVED:
            lines.append(f"{place}, {one.status.name.lower()}: {one.status.sentence} {one.reason}")
        elif one.stability == "not decided":
            lines.append(f"{place}, T = {one.period} s: not decided, kappa = {one.kappa}")
    return "\n".join(lines)


def name_of(question: Question, digits: int | None) -> str:
    """What a store calls a question."""
    text = json_text({"question": question, "digits": digits}, indent=None)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _read_store(path: Path) -> dict[str, Certificate]:
    """The certificates of a store by the names of their questions; the last line is taken off the
    file if it was cut off.
    """
    if not path.exists():
        return {}
    try:
        text = read_text(path)
        whole = text[: text.rfind("\n") + 1]
        found = {}
        for number, line in enumerate(whole.splitlines(), 1):
            try:
                entry = parse_json(line)
                found[str(entry["question"])] = read_certificate(entry["certificate"])
            except (KeyError, TypeError, ValueError) as error:
                raise ValueError(f"line {number}: {error}") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise ValueError(
            f"store must be a file that certify_atlas wrote, got {path} ({reason}): give another "
            f"name"
        ) from None
    if whole != text:
        os.truncate(path, len(whole.encode()))
    return found


def _prove(
    questions: dict[str, Question], digits: int | None, workers: int
) -> Generator[tuple[str, Certificate], None, None]:
    """Names and certificates as they come."""
    if workers == 1 or len(questions) < 2:
        for name, question in questions.items():
            yield name, answer(question, digits)
        return
    # `spawn`: a fork of a process with JAX's threads may hang.
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(
        min(workers, len(questions)), context, initializer=_leave_interrupts
    ) as pool:
        futures = {pool.submit(answer, one, digits): name for name, one in questions.items()}
        try:
            for future in concurrent.futures.as_completed(futures):
                yield futures[future], future.result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def _leave_interrupts() -> None:
    """Ctrl-C reaches all processes of a terminal; the one that writes the store answers it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
