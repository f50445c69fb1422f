"""The terminal: a drawing on one, lines elsewhere, and no error from either."""

from __future__ import annotations

import fcntl
import os
import pty
import re
import struct
import subprocess
import sys
import termios
from pathlib import Path

import pytest

from foajax.runs.display import Display

ROOT = Path(__file__).parents[2]
ROWS = (
    {"env_steps": 1_000_000, "time": 900.0, "score": 1.5, "best_score": 2.5, "natural_entropy": 1.25, "games": 12345},
    {"env_steps": 2_500_000, "time": 1900.0, "score": None, "natural_entropy": 1e-7, "games": 12346},
)
# Hand-computed: 1,500,000 steps in 1000 s, and from the start 2,000,000 in 1500 s.
LINES = [
    "env_steps 1,000,000 of 5,000,000 (20.0%), 1,250 steps/s, 0:53:20 left, score 1.5, best 2.5",
    "env_steps 2,500,000 of 5,000,000 (50.0%), 1,429 steps/s, 0:29:10 left, score -",
]


def make(**options: object) -> Display:
    start = {"start": (500_000, 500.0)}
    return Display(**{"total_env_steps": 5_000_000, "live": None} | start | options)


def test_a_short_line_a_row_where_there_is_no_terminal(capsys):
    display = make()
    for row in ROWS:
        display.show(row)
    display.message("a [bold]message[/bold]")
    display.close()
    assert capsys.readouterr().out.splitlines() == [*LINES, "a [bold]message[/bold]"]


def test_the_speed_is_that_of_the_last_ten_rows(capsys):
    display = make()
    for i in range(1, 21):  # ten slow rows, ten fast ones
        steps = 500_000 + 100 * i + 900 * max(i - 10, 0)
        display.show({"env_steps": steps, "time": 500.0 + i})
    *_, slow, fast = (re.search("([0-9,]+) steps/s", line)[1] for line in capsys.readouterr().out.splitlines()[9::10])
    assert (slow, fast) == ("100", "1,000")


def test_at_the_end_and_beyond_nothing_is_left(capsys):
    make().show({"env_steps": 5_000_640, "time": 600.0})
    assert "(100.0%)" in (line := capsys.readouterr().out)
    assert "0:00:00 left" in line


def test_no_speed_yet_no_time_left(capsys):
    make().show({"env_steps": 500_000, "time": 500.0})
    assert capsys.readouterr().out == "env_steps 500,000 of 5,000,000 (10.0%), 0 steps/s\n"


_SHOW = f"""
from foajax.runs.display import Display
display = Display(total_env_steps=5_000_000, start=(500_000, 500.0), live=None)
for row in {ROWS!r}:
    display.message("a [bold]message")
    display.show(row)
display.close()
"""


def on_terminal(code: str, term: str, columns: int = 100) -> str:
    """What a program writes on a terminal of its own."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, columns, 0, 0))
    environment = {k: v for k, v in os.environ.items() if k not in ("COLUMNS", "LINES")} | {"TERM": term}
    with subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, stdout=theirs, env=environment) as process:
        os.close(theirs)
        output = b""
        while True:
            try:
                part = os.read(ours, 4096)
            except OSError:  # how Linux says that the other end is closed
                break
            if not part:
                break
            output += part
    os.close(ours)
    assert process.returncode == 0
    return output.decode()


def test_a_terminal_is_drawn_on_in_place():
    output = on_terminal(_SHOW, "xterm")
    plain = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", output)
    assert "\x1b[1A" in output  # back up over the last picture
    assert "a [bold]message" in plain
    picture = plain[plain.rindex("env_steps 2,500,000 of") :]
    assert picture.split("\r\n")[0].strip() == LINES[1].partition(", score")[0]
    assert "━━━" in picture
    for text in ("score", "natural_entropy", "1e-07", "games", "12,346"):
        assert text in picture
    assert output.rstrip().endswith("\x1b[?25h")  # the cursor is back


def test_a_dumb_terminal_gets_lines():
    lines = on_terminal(_SHOW, "dumb").replace("\r\n", "\n").splitlines()
    assert lines == ["a [bold]message", LINES[0], "a [bold]message", LINES[1]]


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="there is no /dev/full")
@pytest.mark.parametrize("live", ["True", "None"])
def test_an_output_that_cannot_be_written_ends_nothing(live):
    code = _SHOW.replace("live=None", f"live={live}") + "import sys; print('survived', file=sys.stderr)"
    with open("/dev/full", "w") as full:
        command = [sys.executable, "-c", code]
        result = subprocess.run(command, cwd=ROOT, stdout=full, stderr=subprocess.PIPE, text=True)
    assert result.stderr.startswith("survived\n")  # Python itself has something to say when it ends
