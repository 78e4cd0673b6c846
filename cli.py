"""What the scripts' command lines share: arguments that are checked at once, and errors of one line."""

import argparse
import os
import sys
from pathlib import Path
from typing import NoReturn

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None


def fail(message: object) -> NoReturn:
    """One line on stderr, exit code 2."""
    print("error:", " ".join(str(message).split()), file=sys.stderr)
    sys.exit(2)


class Parser(argparse.ArgumentParser):
    """argparse, but a wrong value ends in one line without the usage in front of it."""

    def __init__(self, doc: str):
        super().__init__(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)

    def error(self, message: str) -> NoReturn:
        fail(f"{message} (--help lists what there is)")


def count(text: str) -> int:
    """A whole number of at least 1; 6e6 and 6_000_000 are fine."""
    try:
        value = float(text)
        whole = int(value)
    except (ValueError, OverflowError):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number") from None
    if whole != value or whole < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of at least 1")
    return whole


def seed(text: str) -> int:
    """A whole number from 0 to 2^31 - 1."""
    if not text.isdecimal() or int(text) >= 2**31:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 0 to 2147483647")
    return int(text)


def positive(text: str) -> float:
    """A finite number above 0."""
    try:
        value = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number") from None
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number above 0")
    return value


def num_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def lock_folder(path: Path):
    """Keeps other processes from training into the folder, until the returned file is closed; ends the program if one does
    so already. (Where the system has no such locks, nothing happens.)"""
    if fcntl is None:
        return None
    file = open(path / ".lock", "w")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        fail(f"another process is training into {path}: wait for it, or choose another --out or --seed")
    return file


def writable_folder(path: Path) -> Path:
    """Makes the folder if need be; ends the program if nothing can be written there."""
    try:
        path.mkdir(parents=True, exist_ok=True)
        probe = path / f".writable-{os.getpid()}"
        probe.touch()
        probe.unlink()
    except OSError as error:
        fail(f"cannot write to the folder {path}: {error.strerror}; choose another with --out")
    return path
