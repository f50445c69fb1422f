"""foajax.cli: words, files that cannot be written, Ctrl-C."""

from __future__ import annotations

import errno
import re

import pytest

from foajax import cli
from foajax.config.parse import ConfigError, Section


class Words(Section):
    count: int = 1
    every: float | None = 2.0
    name: str | None = None
    points: tuple[tuple[int, int], ...] = ()


@pytest.mark.parametrize(
    "word, value",
    [
        ("count=010", 10),  # 8 in YAML
        ("every=1e1", 10.0),  # text in YAML
        ("every=3", 3.0),
        ("every=null", None),
        ("name=010", "010"),
        ("name=", None),
        ("points=[[1,2],[3,4]]", ((1, 2), (3, 4))),
    ],
)
def test_a_word_is_what_it_looks_like(word, value):
    assert getattr(cli.parse(Words, [word]), word.partition("=")[0]) == value


@pytest.mark.parametrize("word", ["count=1:30", "count=1.5", "count=true", "every=nan", "every=2e+300", "every=soon"])
def test_what_is_no_number_is_refused(word):
    with pytest.raises(ConfigError, match=f"^{re.escape(word)}: accepted is "):
        cli.parse(Words, [word])


def test_a_full_disk_is_one_line(capsys):
    def command(words):
        raise OSError(errno.ENOSPC, "No space left on device", "page.html")

    assert cli.run(command, []) == 2
    assert capsys.readouterr().err == "foajax: error: page.html: cannot be written (No space left on device)\n"


def test_another_fault_of_the_system_is_not_hidden():
    def command(words):
        raise ConnectionResetError(errno.ECONNRESET, "reset")

    with pytest.raises(ConnectionResetError):
        cli.run(command, [])


def test_ctrl_c_is_the_shells_exit_code():
    def command(words):
        raise KeyboardInterrupt

    assert cli.run(command, []) == cli.INTERRUPTED == 130
