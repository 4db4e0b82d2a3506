"""Work for the workers of a cluster, and what a machine says of itself."""

import os
import signal
import time
from pathlib import Path
from typing import NamedTuple

SAME = {"pancam_graph": "1", "processor": "abacus"}


class Folder(NamedTuple):
    """What all items share: where they leave their marks."""

    path: Path


def same() -> dict[str, str]:
    return SAME


def mark(folder: Folder, item: int) -> None:
    """Leave a file, as a step leaves its result in the cache."""
    (folder.path / f"{item}").write_text(str(item * item))


def mark_but_for_seven(folder: Folder, item: int) -> None:
    with (folder.path / "tries").open("a") as tries:
        tries.write(f"{item}\n")
    if item == 7:
        raise ValueError("seven is not to be done")
    mark(folder, item)


def die_of_seven(folder: Folder, item: int) -> None:
    """Item 7 takes its worker with it, as a picture for which there is too little memory."""
    if item == 7:
        os.kill(os.getpid(), signal.SIGKILL)
    mark(folder, item)


def mark_slowly(folder: Folder, item: int) -> None:
    (folder.path / f"pid-{os.getpid()}").touch()
    time.sleep(0.05)
    mark(folder, item)


def mark_after(folder: Folder, item: tuple[int, tuple[int, ...]]) -> None:
    """Leave a file, once the files of others are there."""
    number, before = item
    assert all((folder.path / f"{other}").exists() for other in before)
    mark(folder, number)


def hang_of_seven_once(folder: Folder, item: int) -> None:
    """Item 7 does not end where it is tried first."""
    first = folder.path / "hangs"
    if item == 7 and not first.exists():
        first.write_text(str(os.getpid()))
        time.sleep(3600)
    mark(folder, item)


def hang_of_seven(folder: Folder, item: int) -> None:
    if item == 7:
        with (folder.path / "hangs").open("a") as tries:
            tries.write(f"{os.getpid()}\n")
        time.sleep(3600)
    mark(folder, item)
