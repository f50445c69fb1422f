"""Whatever is typed for any key: a run, or exit code 2 and one line that names key, value and what is accepted."""

from __future__ import annotations

import contextlib
import io

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from processes import finish
from test_config import LOG_POLAR, OUT_OF_RANGE, RINGS, SECTIONS, paths

from foajax.config.parse import to_mapping
from foajax.launch.launch import run

KEYS = {".".join(path): [] for path in paths(to_mapping(RINGS))}
KEYS |= {
    f"sensor.{name}": ["experiment=logpolar"] for name in to_mapping(LOG_POLAR)["sensor"] if name not in "rings kind"
}
GROUPS = {"sensor", "gaze", "network", "learner"}  # at the top they are choices
FREE_TEXT = {"name", "game", "run"}


def answer(*words):
    """Exit code, the configs that a run would have been started with, and stderr."""
    started, err = [], io.StringIO()
    with contextlib.redirect_stderr(err):
        code = run(started.append, words)
    return code, started, err.getvalue()


def assert_refused(words, *said):
    code, started, err = answer(*words)
    assert (code, started) == (2, []), err
    assert len(err.splitlines()) == 1 and err.startswith("foajax: error: "), err
    for text in said:
        assert text in err


# Composing takes a tenth of a second; what every key has in common is tried with some, and with all in the slow tests.
SOME = ["name", "seed", "sensor.rings", "gaze.start", "env.num_envs", "learner.natural.gamma", "train.log_every"]
ALL = pytest.mark.slow


def some_and_all(keys):
    return [key if key in SOME else pytest.param(key, marks=ALL) for key in keys]


@pytest.mark.parametrize("key", some_and_all(KEYS))
def test_a_wrong_type_is_one_line_from_the_command_line_too(key):
    takes_mappings = key in FREE_TEXT | {"env.crop_top"} or key.endswith("kwargs")
    value = "[[x],{y:1}]" if takes_mappings else "{no_key: 1}"
    assert_refused([*KEYS[key], f"{key}={value}"], key, "accepted")


@pytest.mark.parametrize("key", some_and_all(sorted(set(KEYS) - GROUPS)))
def test_a_missing_value_is_one_line(key):
    assert_refused([*KEYS[key], f"{key}=???"], f"{key}: missing; accepted is ")


@pytest.mark.parametrize("section", SECTIONS, ids=".".join)
def test_an_unknown_name_is_one_line(section):
    key = ".".join([*section, "no_such_key"])
    assert_refused([f"{key}=17"], f"{key}=17: unknown key; accepted is one of ")


def as_word(value):
    """A Python value as it is typed."""
    if isinstance(value, bool) or value is None:
        return {True: "true", False: "false", None: "null"}[value]
    if isinstance(value, dict):
        return "{" + ",".join(f"{name}:{as_word(inner)}" for name, inner in value.items()) + "}"
    if isinstance(value, list):
        return f"[{','.join(map(as_word, value))}]"
    return f"'{value}'" if isinstance(value, str) else str(value)


@pytest.mark.slow
@pytest.mark.parametrize(("key", "value"), [pair for pair in OUT_OF_RANGE if pair[1] != {}])
def test_a_wrong_range_is_one_line_from_the_command_line_too(key, value):
    override = [] if key != "sensor.rings" else ["sensor=constant70"]
    assert_refused([*override, f"{key}={as_word(value)}"], key, "accepted")


words = st.text("abz019.,:;=[]{}()'\"\\$+-~@/*# \n\té\0", max_size=12) | st.integers().map(str) | st.floats().map(str)


@pytest.mark.parametrize("examples", [30, pytest.param(1000, marks=ALL)])
def test_whatever_is_typed_is_a_run_or_one_line(examples):
    key = st.sampled_from(sorted(KEYS)) | st.from_regex(r"[a-z_.]{1,12}", fullmatch=True)
    settings(deadline=None, max_examples=examples)(given(key, words)(assert_answered))()


def assert_answered(key, value):
    code, started, err = answer(f"{key}={value}")
    if code == 0:
        assert len(started) == 1 and err == ""
    else:
        assert code == 2 and started == []
        assert len(err.splitlines()) == 1 and err.startswith("foajax: error: ") and "accepted" in err


@pytest.mark.parametrize("word", ["name=???", "seed='x"])
def test_a_word_that_is_none_is_one_line(word):
    assert_refused([word], word.partition("=")[0], "accepted")


def test_the_command_itself_says_it_in_one_line(tmp_path):
    code, out, err = finish("env.threads=100000", f"run={tmp_path / 'run'}")
    assert code == 2 and out == "" and len(err.splitlines()) == 1
    assert err.startswith("foajax: error: env.threads=100000: accepted")
    assert not (tmp_path / "run").exists()
