"""Rows for Weights & Biases or a class of one's own: found before a run starts, and of no harm to it."""

from __future__ import annotations

import sys
from types import ModuleType, SimpleNamespace

import pytest

from foajax.config.compose import compose
from foajax.config.parse import ConfigError, to_mapping
from foajax.runs.directory import check_same_run, open_run
from foajax.runs.logger import Logger
from foajax.runs.row_logger import find_logger

HERE = "train.logger=test_row_logger"


class Rows:
    """Keeps rows; a method named in `fails` raises."""

    def __init__(self, config, fails=()):
        self.config, self.fails, self.rows, self.closed = config, fails, [], False
        self.may("init")

    def may(self, name):
        if name in self.fails:
            raise RuntimeError(name)

    def log(self, row, env_steps):
        self.may("log")
        self.rows.append((dict(row), env_steps))

    def close(self):
        self.closed = True
        self.may("close")


def seek(*words):
    return compose(["experiment=seek", *words])


def log_to(tmp_path, other):
    return Logger(tmp_path, total_env_steps=100, start_env_steps=0, live=False, other=other)


def test_it_gets_what_is_finite_of_each_row(tmp_path):
    config = seek(f"{HERE}:Rows", "train.logger_kwargs.fails=[]")
    made = find_logger(config)()
    assert made.config is config and made.fails == []
    with log_to(tmp_path, lambda: made) as log:
        log.write({"env_steps": 64, "loss": 0.5, "games": 3, "score": float("nan"), "time": 2.5})
        log.write({"env_steps": 128, "score": 1.0, "time": 3.5})
        assert not made.closed
    assert made.rows == [({"loss": 0.5, "games": 3, "time": 2.5}, 64), ({"score": 1.0, "time": 3.5}, 128)]
    assert made.closed


@pytest.mark.parametrize("fails", ["init", "log", "close"])
def test_what_it_raises_is_one_warning(tmp_path, capsys, fails):
    make = find_logger(seek(f"{HERE}:Rows", f"train.logger_kwargs.fails=[{fails}]"))
    with log_to(tmp_path, make) as log:
        for env_steps in (64, 128):
            log.write({"env_steps": env_steps})
    assert capsys.readouterr().out.count(f"warning: train.logger fails ({fails}); training goes on") == 1
    assert len((tmp_path / "metrics.jsonl").read_text().splitlines()) == 2


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["train.logger=no_such_module:Log"], "train.logger=no_such_module:Log: No module named 'no_such_module'"),
        ([f"{HERE}:Nothing"], "test_row_logger:Nothing: .*; accepted is package.module:Name"),
        ([f"{HERE}:Rows", "train.logger_kwargs.fail=[]"], "'fail'; accepted is arguments config, fails"),
        ([f"{HERE}:seek"], "test_row_logger:seek: .*; accepted is arguments "),
        (["train.logger=pathlib:Path"], r"pathlib:Path: accepted is a class with log\(row, env_steps\) and close"),
    ],
)
def test_what_is_no_logger_is_refused_in_one_line(words, message):
    with pytest.raises(ConfigError, match=f"{message}[^\n]*$"):
        find_logger(seek(*words))


def test_a_run_may_go_on_with_another_logger(tmp_path):
    words = [f"run={tmp_path}", "train.logger=mine:Log", "train.logger_kwargs.key=1"]
    open_run(seek(*words), command=[]).close()
    (tmp_path / "metrics.jsonl").write_text('{"env_steps": 1, "time": 0}\n')  # something was learned
    check_same_run(tmp_path, seek(f"run={tmp_path}", "train.logger=wandb"))
    check_same_run(tmp_path, seek(f"run={tmp_path}"))


@pytest.fixture
def wandb(monkeypatch):
    """A stand-in for the package, which says what it was told."""
    told, module = [], ModuleType("wandb")

    def init(project=None, name=None, dir=None, config=None, mode=None):
        told.append({"project": project, "name": name, "dir": str(dir), "config": config, "mode": mode})
        record = {name: lambda *words, name=name, **more: told.append((name, *words, more)) for name in NAMES}
        return SimpleNamespace(**record)

    module.init = init
    monkeypatch.setitem(sys.modules, "wandb", module)
    return told


NAMES = ("define_metric", "log", "finish")


def test_weights_and_biases_gets_the_configuration_and_the_rows(wandb, tmp_path):
    config = seek("train.logger=wandb", "train.logger_kwargs.mode=offline", f"run={tmp_path}")
    make = find_logger(config)
    assert wandb == []  # nothing begins before the run does
    with log_to(tmp_path, make) as log:
        log.write({"env_steps": 64, "score": 1.5, "time": 2.0})
    about = {"project": "foajax", "name": tmp_path.name, "dir": str(tmp_path), "config": to_mapping(config)}
    assert wandb == [
        about | {"mode": "offline"},
        ("define_metric", "*", {"step_metric": "env_steps"}),
        ("log", {"env_steps": 64, "score": 1.5, "time": 2.0}, {}),
        ("finish", {}),
    ]


def test_what_weights_and_biases_does_not_take_is_refused(wandb):
    with pytest.raises(
        ConfigError, match=r"logger_kwargs.projct=x: unknown to wandb.init \(did you mean project\?\); accepted"
    ):
        find_logger(seek("train.logger=wandb", "train.logger_kwargs.projct=x"))


def test_where_it_is_missing_the_line_says_how_to_install_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.raises(ConfigError, match=r"^train.logger=wandb: wandb is missing \(pip install wandb\)$"):
        find_logger(seek("train.logger=wandb"))
