"""What the scripts' command lines share: arguments that are checked at once, and errors of one line."""

import argparse
import os
import sys
import tempfile
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
        super().__init__(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False)

    def error(self, message: str) -> NoReturn:
        fail(f"{message} (--help lists what there is)")


def count(text: str, most: int = 10**12) -> int:
    """A whole number from 1 to `most`; 6e6 and 6_000_000 are fine."""
    try:
        value = float(text)
        whole = int(value)
    except (ValueError, OverflowError):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number") from None
    if whole != value or whole < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of at least 1")
    if whole > most:
        raise argparse.ArgumentTypeError(f"{text!r} is too much: at most {most}")
    return whole


def threads(text: str) -> int:
    """A whole number from 1 to twice the cores there are; up to 8 anywhere."""
    return count(text, max(8, 2 * num_cores()))


def seed(text: str) -> int:
    """A whole number from 0 to 2^31 - 1."""
    if not text.isdecimal() or int(text) >= 2**31:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 0 to 2147483647")
    return int(text)


def positive(text: str, most: float = 1e6) -> float:
    """A number above 0, up to `most`."""
    try:
        value = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number") from None
    if not 0 < value <= most:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number above 0, up to {most:g}")
    return value


def port(text: str) -> int:
    """A whole number from 0 to 65535."""
    if not text.isdecimal() or int(text) > 65535:
        raise argparse.ArgumentTypeError(f"{text!r} is not a port, a whole number from 0 to 65535")
    return int(text)


def num_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def lock_folder(path: Path):
    """Keeps other processes from training into the folder, until the returned file is closed; ends the program if one does
    so already. (Where there are no such locks, nothing happens.)"""
    if fcntl is None:
        return None
    file = open(path / ".lock", "w")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        fail(f"another process is training into {path}: wait for it, or choose another --out or --seed")
    except OSError:  # a file system without locks
        pass
    return file


def writable_folder(path: Path, option: str = "--out") -> Path:
    """Makes the folder if need be; ends the program if nothing can be written there. option: what names it."""
    try:
        path.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=path).close()
    except OSError as error:
        fail(f"cannot write to the folder {path}: {error.strerror}; choose another with {option}")
    return path
