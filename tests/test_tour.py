"""TOUR.md says what the files say, and its commands run."""

import re
import shlex
import subprocess
import sys

import pytest

from conftest import ROOT

TEXT = (ROOT / "TOUR.md").read_text()
QUOTES = re.findall(r"`(\w+\.py)`, line (\d+):\n\n```python\n(.*?)```", TEXT, re.DOTALL)
COMMANDS = re.findall(r"^    python (.*)$", TEXT, re.MULTILINE)


@pytest.mark.parametrize("name, line, quote", QUOTES, ids=[f"{x[0]}:{x[1]}" for x in QUOTES])
def test_quotes_are_what_the_files_say(name, line, quote):
    text = (ROOT / name).read_text()
    assert text.count(quote) == 1, "the code has changed: quote it anew"
    assert text[: text.index(quote)].count("\n") + 1 == int(line)


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_run(command, tmp_path):
    words = shlex.split(command.replace("/tmp/tour", str(tmp_path / "tour")))
    if words[0] == "-m":  # of this suite: does it choose a test?
        file, *choice = words[3:]
        tests = re.findall(r"^def (test_\w+)", (ROOT / file).read_text(), re.MULTILINE)
        assert any(not choice or choice[1] in name for name in tests)
        return
    done = subprocess.run([sys.executable, *words], cwd=ROOT, capture_output=True, text=True)
    if "cannot draw" in done.stderr:
        pytest.skip(done.stderr)
    assert done.returncode == 0, done.stderr


def test_there_are_eight_stops_with_an_answer_each():
    stops, answers = TEXT.split("## Answers")
    numbers = [len(re.findall(r"^## \d", stops, re.MULTILINE)), stops.count("*Exercise.*")]
    assert numbers + [len(re.findall(r"^\d\. ", answers, re.MULTILINE)), len(COMMANDS)] == [8] * 4
