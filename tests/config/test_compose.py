"""experiments/ and the command line: what is composed, what is refused, and what a run leaves behind."""

from __future__ import annotations

import functools
import os
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import hydra
import pytest
import yaml

from foajax import cli
from foajax.config.compose import checked, compose, list_experiments
from foajax.config.parse import ConfigError, flatten, to_mapping
from foajax.config.schema import Config, HeadConfig, LogPolarSensor, RingSensor
from foajax.launch import sweep
from foajax.launch.launch import run

ROOT = Path(__file__).resolve().parents[2]

# Table II: window, values, peripheral. The peripheral adds at most its 16 outer cells of 25.
TABLE_II = {
    "nonfoa": ((80, 80), 6400, None),
    "constant50_sub1": ((50, 50), 2500, None),
    "constant50_sub2": ((50, 50), 625, None),
    "constant70": ((70, 70), 1225, None),
    "decreasing": ((70, 70), 1450, None),
    "constant70_p": ((70, 70), 1241, (5, 5)),
    "decreasing_p": ((70, 70), 1466, (5, 5)),
}
PACKED = [f"{name}_packed" for name in TABLE_II if name != "nonfoa"]


HERE = ["--multirun", "hydra/launcher=basic"]  # one run after another in this process


def nominal_values(sensor):
    """Pixel values as Table II counts them: each ring without the area that the rings inside it hide."""
    if isinstance(sensor, LogPolarSensor):
        return sensor.rings * sensor.wedges
    total, hidden = 0.0, 0
    for height, width, factor in sensor.rings:
        total += (height * width - hidden) / factor**2
        hidden = height * width
    return total + (16 if sensor.peripheral else 0)


@functools.cache
def composed(*overrides):
    """A config that several tests look at."""
    return compose(overrides)


def error(*overrides):
    """The message with which `overrides` are refused."""
    with pytest.raises(ConfigError) as caught:
        compose(overrides)
    assert len(str(caught.value).splitlines()) == 1
    return str(caught.value)


def test_without_a_word_every_key_has_its_default():
    assert composed() == Config(name="constant70", sensor=RingSensor(rings=((70, 70, 2),)))
    assert composed("sensor=logpolar", "gaze.bounds=point").sensor == LogPolarSensor()


def test_the_experiments_are_the_papers_their_packed_layouts_and_our_own():
    search = [
        "detect_rings_p",
        *(f"search_{kind}" for kind in ("full", "logpolar", "rings", "rings_p", "wide", "window")),
    ]
    assert list_experiments() == sorted([*TABLE_II, *PACKED, "logpolar", "seek", *search])


@pytest.mark.parametrize("name", list_experiments())
def test_an_experiment_has_its_name_and_its_sensor(name):
    config = composed(f"experiment={name}")
    assert config.name == name
    assert config.gaze.mode == ("none" if name in ("nonfoa", "search_full") else "learned")
    if name == "logpolar":
        assert nominal_values(config.sensor) == 1225 and config.gaze.bounds == "point"
        return
    if name == "seek":
        assert config.game == "seek" and config.sensor.window == (16, 16)
        return
    if name.startswith(("search_", "detect_")):
        assert config.game == name.partition("_")[0] and config.env.frame_shape == (160, 160)
        return
    window, values, peripheral = TABLE_II[name.removesuffix("_packed")]
    assert config.sensor.window == window
    assert nominal_values(config.sensor) == values
    assert config.sensor.peripheral == peripheral
    assert config.sensor.layout == ("packed" if name.endswith("_packed") else "canvas")
    assert config.gaze.bounds == "window"


@pytest.mark.parametrize("name", [*TABLE_II, *PACKED, "logpolar"])
def test_a_sensor_can_be_swapped_alone(name):
    config = compose([f"sensor={name}", "gaze.bounds=point"])
    assert config.sensor == composed(f"experiment={name}").sensor
    assert config.name == "constant70"


def test_a_sensor_can_be_ones_own():
    sensor = compose(["sensor=rings", "sensor.rings=[[40,40,1],[60,60,3]]"]).sensor
    assert sensor.rings == ((40, 40, 1), (60, 60, 3))
    assert error("sensor=rings").startswith("sensor.rings: missing")


@pytest.mark.parametrize("mode", ["none", "learned", "frozen", "random", "scripted"])
def test_gaze_is_a_choice_and_has_values(mode):
    gaze = compose([f"gaze={mode}", "gaze.step=8"]).gaze
    assert (gaze.mode, gaze.step) == (mode, 8)


def test_learner_paper_is_table_three():
    config = compose(["learner=paper"])
    learner, env = config.learner, config.env
    assert (learner.rollout_length, learner.learning_rate, env.num_envs) == (20, 1e-4, 32)
    assert learner.natural == learner.vision == HeadConfig(gamma=0.99, gae_lambda=0.92, entropy_weight=0.01)
    assert (learner.adam_b1, learner.adam_b2, learner.adam_eps) == (0.9, 0.999, 1e-8)
    assert (learner.max_grad_norm, learner.clip_ratio, learner.reduction) == (None, None, "sum")
    assert (learner.value_weight, learner.vision_weight, learner.num_epochs) == (1.0, 1.0, 1)
    assert learner.amsgrad and learner.value_target == "n_step"
    assert learner.num_minibatches == 32
    assert compose(["learner=paper", "env.num_envs=6"]).learner.num_minibatches == 6
    assert env.frame_shape == (80, 80) and env.frame_skip == 4 and env.noop_max == 30
    assert env.clip_rewards and env.episodic_life and env.fire_on_reset


def test_learner_a2c_is_one_pass_without_clipping():
    learner = compose(["learner=a2c", "learner.num_minibatches=4"]).learner
    assert (learner.rollout_length, learner.num_minibatches, learner.num_epochs) == (20, 4, 1)
    assert learner.clip_ratio is None and not learner.normalize_advantages
    assert learner.natural == learner.vision == HeadConfig(gae_lambda=0.92, entropy_weight=0.003)


def test_network_choices():
    words = [
        "network.torso=a3c",
        "network.dense=0",
        "network.lstm=512",
        "network.focal_point=packed",
        "network.lstm_norm=false",
        *("network.last_actions=false", "network.last_reward=false", "network.forget_bias=0"),
    ]
    words.append("network.normalization=running")
    assert compose(["network=a3c"]).network == compose(words).network
    assert compose(["network=nature"]) == composed()


def test_the_vision_head_follows_the_natural_head_until_it_is_set():
    both = compose(["learner.natural.gamma=0.9"]).learner
    assert both.natural.gamma == both.vision.gamma == 0.9
    one = compose(["learner.natural.gamma=0.9", "learner.vision.gamma=0.5"]).learner
    assert (one.natural.gamma, one.vision.gamma) == (0.9, 0.5)


@pytest.mark.parametrize("game", ["pong", "seek", "gymnasium:CartPole-v1", "gymnasium:ALE/Pong-v5"])
def test_game_is_a_plain_name(game):
    assert compose([f"game={game}"]).game == game


def test_a_mapping_takes_new_keys_and_a_later_word_wins():
    assert compose(["env.crop_top.pong=30"]).env.crop_top == {"default": 34, "beam_rider": 20, "pong": 30}
    assert compose(["seed=1", "experiment=nonfoa", "seed=2", "experiment=logpolar"]).seed == 2


@pytest.mark.parametrize(
    ("override", "fragments"),
    [
        ("experiment=foo", ["experiment=foo: accepted is one of constant50_sub1, ", "nonfoa"]),
        ("experiment=constnt70", ["experiment=constnt70", "did you mean constant70? accepted is one of"]),
        ("experiment=a/b", ["experiment=a/b: accepted is one of"]),
        ("experiment=", ["experiment=: accepted is one of"]),
        ("gaze=null", ["gaze=null: did you mean none? accepted is one of frozen, learned, none, random, scripted"]),
        ("gaze=[frozen]", ["gaze=[frozen]: did you mean frozen? accepted is one of"]),
        ("gaze={mode: frozen}", ["gaze={mode: frozen}: "]),
        (
            "learner.gama=0.9",
            ["learner.gama=0.9: unknown key (did you mean learner.natural.gamma?); accepted is one of r"],
        ),
        ("gama=0.9", ["gama=0.9: unknown key (did you mean learner.natural.gamma?); accepted is one of name, "]),
        ("plans=paper", ["plans=paper: unknown key; accepted is one of name, "]),  # of reproduce alone
        ("sensor.kind=logpolar", ["sensor.kind=logpolar: accepted is sensor=logpolar, which brings the keys of"]),
        ("foo/bar=1", ["foo/bar=1: unknown key"]),
        ("game.speed=2", ["game={'speed': 2}: accepted is a name"]),
        ("learner.natural=3", ["learner.", "natural", "accepted is"]),
        ("seed=one", ["seed=one: accepted is an integer"]),
        ("seed=1.5", ["seed=1.5: accepted is an integer"]),
        ("gaze.start=[80,0]", ["gaze.start=[80, 0]: accepted is [y, x] inside env.frame_shape=80x80"]),
        (
            "learner.learning_rate=1e-40",
            ["learner.learning_rate=1e-40: accepted is a number > 0, in the range of float32"],
        ),
        ("learner.natural.gamma=1.5", ["learner.natural.gamma=1.5: accepted is a number in [0, 1]"]),
        ("env.frame_shape=80", ["env.frame_shape=80: accepted is [height, width], each from 8 to 10000"]),
        ("sensor.rings.first=3", ["sensor.rings.first=3", "accepted is"]),
        ("sensor.rings.9=3", ["sensor.rings.9=3", "accepted is"]),
        ("experiment", ["experiment: accepted is key=value"]),
        ("=3", ["=3: accepted is key=value"]),
        ("game=[1", ["game=[1: accepted is key=value"]),
        ("game='x", ["game='x: accepted is key=value"]),
        ("game=a\nb", ["game=a b: accepted is key=value"]),
        ("game=x=y", ["game=x=y: accepted is key=value"]),
        ("~learner", ["~learner: accepted is key=value"]),
        ("sensor@eye=constant70", ["sensor@eye=constant70: accepted is key=value"]),
        ("game=pong,breakout", ["game=pong,breakout: accepted is one value", "--multirun"]),
        ("seed=range(3)", ["seed=range(3): accepted is one value", "--multirun"]),
        ("hydra.run.dir=x", ["hydra.run.dir=x: keys of hydra need --multirun"]),
        ("game=${nothing}", ["game: ", "'nothing'", "accepted is"]),
        ("game=${oc.env:FOAJAX_NOT_SET}", ["game: ", "'FOAJAX_NOT_SET'", "accepted is"]),
        ("game=${what:1}", ["game: ", "what", "accepted is"]),
        ("learner.natural.gamma=${learner.vision.gamma}", ["learner.natural.gamma: ", "accepted is"]),
    ],
)
def test_a_mistake_is_one_line_with_key_value_and_what_is_accepted(override, fragments):
    message = error(override)
    assert message.startswith(fragments[0])
    for fragment in fragments:
        assert fragment in message


@pytest.fixture
def cwd(tmp_path, monkeypatch):
    """An empty working directory, far from the checkout."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def runs():
    """A list of the configs that `record` was given, and `record`, which returns the seed as exit code."""

    class Runs(list):
        def record(self, config):
            self.append(config)
            if config.game == "brekout":
                raise ConfigError("game=brekout: accepted is a game")
            return config.seed

    return Runs()


def test_a_single_run_starts_directly_and_leaves_nothing_of_its_own(cwd, runs):
    assert run(runs.record, ["experiment=nonfoa", "game=pong"]) == 0
    assert [(config.name, config.game) for config in runs] == [("nonfoa", "pong")]
    assert list(cwd.iterdir()) == []
    assert run(runs.record, ["seed=3"]) == 3
    assert run(lambda config: None, []) == 0


@pytest.mark.parametrize(
    "words, said",
    [
        (
            ["--experiment=nonfoa"],
            "--experiment=nonfoa: is no flag (did you mean experiment=nonfoa?); accepted is key=",
        ),
        (["-x", "seed=1"], "-x: is no flag; accepted is key=value, --multirun, "),
        (["--config-name=mine"], "--config-name=mine: is no flag; accepted is key=value, --multirun, "),
        (["--cfg"], "--cfg='': accepted is one of job, hydra, all"),
        (["--cfg", "jobs"], "--cfg=jobs: did you mean job? accepted is one of job, hydra, all"),
        (["--multirun=yes", "seed=1"], "--multirun=yes: accepted is --multirun alone"),
    ],
)
def test_a_flag_that_is_not_there_is_refused(cwd, runs, capsys, words, said):
    assert run(runs.record, words) == 2 and runs == []
    assert capsys.readouterr().err.startswith(f"foajax: error: {said}")


@pytest.mark.parametrize(
    "arguments", [["game=brekout"], ["seed=one"], ["--multirun", "seed=0,one"], ["--cfg", "job", "a=1"]]
)
def test_a_mistake_is_one_line_on_stderr_and_exit_code_2(cwd, runs, capsys, arguments):
    assert run(runs.record, arguments) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("foajax: error: ") and len(err.splitlines()) == 1
    assert list(cwd.iterdir()) == []


def test_a_sweep_runs_every_combination_in_order(cwd, runs):
    argv = list(sys.argv)
    arguments = [*HERE, "game=pong,seek", "experiment=glob(constant50_sub?)", "env.crop_top.pong=30"]
    assert run(runs.record, arguments) == 0
    assert [(config.game, config.name) for config in runs] == [
        ("pong", "constant50_sub1"),
        ("pong", "constant50_sub2"),
        ("seek", "constant50_sub1"),
        ("seek", "constant50_sub2"),
    ]
    assert all(config.env.crop_top["pong"] == 30 for config in runs)
    assert [path.name for path in cwd.iterdir()] == ["sweeps"]
    assert [path.name for path in cwd.glob("sweeps/*/*")] == ["multirun.yaml"]
    assert sys.argv == argv


def test_all_runs_of_a_sweep_are_checked_before_the_first_one(cwd, runs, capsys):
    def check(config):
        if config.game == "pnog":
            raise ConfigError("game=pnog: accepted is a game")

    for launcher in (["-m"], HERE):
        assert run(runs.record, [*launcher, "game=seek,pnog"], check=check) == 2
        assert capsys.readouterr().err == "foajax: error: game=pnog: accepted is a game\n" and runs == []


@pytest.mark.parametrize(
    "word, said",
    [
        ("~seed", "~seed: accepted is key=value"),
        ("pong", "pong: accepted is key=value"),
        ("experiment=glob(foo*)", "experiment=glob(foo*): accepted is what matches one of constant50_sub1, "),
        ("seed=glob(*)", "seed=glob(*): accepted is what matches one of no names"),
    ],
)
def test_a_word_that_no_run_comes_of_is_refused(cwd, runs, capsys, word, said):
    for launcher in (["--multirun"], HERE):
        assert run(runs.record, [*launcher, word]) == 2
        err = capsys.readouterr().err
        assert err.startswith(f"foajax: error: {said}") and len(err.splitlines()) == 1 and runs == []


def test_a_request_to_stop_ends_a_sweep_in_one_process(cwd, runs, capsys):
    """A run that has begun and comes back before its end was asked to stop; Ctrl-C in the middle is no failure."""

    def stopped(config):
        runs.append(config)
        path = Path(config.run_dir)
        path.mkdir(parents=True)
        for name in ("config.yaml", "run.json"):
            (path / name).touch()

    def interrupted(config):
        runs.append(config)
        raise KeyboardInterrupt

    for task, code in ((stopped, 0), (interrupted, cli.INTERRUPTED)):
        assert run(task, [*HERE, "seed=1,2"]) == code
        assert [config.seed for config in runs] == [1]
        assert "sweep of 2 runs: 0 finished, 2 unfinished, 0 failed" in capsys.readouterr().err
        runs.clear()


def test_a_run_that_fails_does_not_end_a_sweep(cwd, runs, capsys):
    assert run(runs.record, [*HERE, "seed=0,5,6", "game=seek,brekout"]) == 1
    assert [config.seed for config in runs] == [0, 0, 5, 5, 6, 6]
    lines = capsys.readouterr().err.splitlines()
    assert [line for line in lines if line.startswith("  failed: ")] == [
        "  failed: runs/brekout-constant70-s0: exit 2",
        "  failed: runs/seek-constant70-s5: exit 5",
        "  failed: runs/brekout-constant70-s5: exit 2",
        "  failed: runs/seek-constant70-s6: exit 6",
        "  failed: runs/brekout-constant70-s6: exit 2",
    ]


def test_an_error_in_a_run_does_not_end_a_sweep(cwd, capsys):
    def task(config):
        return 1 // config.seed

    assert run(task, [*HERE, "seed=0,1"]) == 1
    err = capsys.readouterr().err
    assert "ZeroDivisionError" in err and "runs/breakout-constant70-s0: exit 1" in err


def test_what_a_sweep_chooses_names_its_runs(cwd, runs):
    assert run(runs.record, [*HERE, "gaze=frozen,random", "learner.natural.gamma=0.9,0.99", "seed=0"]) == 0
    assert [config.run_dir for config in runs] == [
        f"runs/breakout-constant70-gaze={gaze}-learner.natural.gamma={gamma}-s0"
        for gaze in ("frozen", "random")
        for gamma in ("0.9", "0.99")
    ]
    assert [config.gaze.mode for config in runs] == ["frozen", "frozen", "random", "random"]


def test_each_run_of_a_sweep_knows_the_words_that_start_it_alone(cwd):
    def task(config):
        seen.append((compose(sys.argv[1:]), config))

    seen = []
    assert run(task, [*HERE, "experiment=seek", "gaze=frozen,random", "seed=0"]) == 0
    assert len(seen) == 2 and all(alone == config for alone, config in seen)


@pytest.mark.parametrize("key", ["run", "name", "train.init_from"])
def test_the_name_that_a_sweep_gives_can_be_typed(key):
    config = compose(["experiment=seek", f"{key}=seek-gaze=frozen-train.log_every=1e-1"])
    assert dict(flatten(to_mapping(config)))[key] == "seek-gaze=frozen-train.log_every=1e-1"


def test_runs_of_a_sweep_may_not_share_a_directory(cwd, runs, capsys):
    assert run(runs.record, [*HERE, "gaze=frozen,random", "name=mine"]) == 2
    assert "two runs would share it" in capsys.readouterr().err
    run(runs.record, [*HERE, "gaze=frozen,random", "name=constant70-${gaze.mode}"])
    assert [config.name for config in runs] == ["constant70-frozen", "constant70-random"]


def test_without_a_launcher_each_run_is_a_command_of_its_own(cwd, runs, monkeypatch):
    started = []
    monkeypatch.setattr(sweep, "run_all", lambda runs, *, jobs, command: started.append((runs, jobs)) or 0)
    assert run(runs.record, ["-m", "gaze=frozen,random", "seed=3"]) == 0
    assert run(runs.record, ["--multirun", "--jobs=4", "seed=0,1"]) == 0
    (first, one), (_, four) = started
    assert (one, four) == (1, 4) and runs == []
    for member in first:
        assert compose(member.words) == member.config
    assert [member.config.gaze.mode for member in first] == ["frozen", "random"]


@pytest.mark.parametrize(
    "arguments, said",
    [
        (["-m", "--jobs=0"], "--jobs=0: accepted is --jobs=N"),
        (["-m", "--jobs", "4"], "--jobs: accepted is --jobs=N"),
        (["--jobs=2"], "--jobs=2: accepted is --jobs=2 --multirun, without"),
        ([*HERE, "--jobs=2"], "--jobs=2: accepted is --jobs=2 --multirun, without"),
    ],
)
def test_jobs_is_a_number_and_for_local_sweeps(cwd, runs, capsys, arguments, said):
    assert run(runs.record, arguments) == 2
    assert said in capsys.readouterr().err


def test_help_lists_the_experiments_and_cfg_prints_the_run(cwd, runs, capsys):
    assert run(runs.record, ["--help"]) == 0
    said = capsys.readouterr().out
    assert f"experiment: {', '.join(list_experiments())}" in said and "plans" not in said
    assert run(runs.record, ["--cfg", "job", "seed=7"]) == 0
    assert yaml.safe_load(capsys.readouterr().out)["seed"] == 7
    assert runs == [] and list(cwd.iterdir()) == []


def test_composing_works_inside_another_application_of_hydra(tmp_path):
    (tmp_path / "theirs.yaml").write_text("key: 1")
    with hydra.initialize_config_dir(str(tmp_path), version_base="1.3"):
        assert compose(["experiment=nonfoa"]).name == "nonfoa"
        with pytest.raises(ConfigError):
            compose(["seed=many"])
        assert hydra.compose("theirs").key == 1


def test_a_learner_and_a_network_can_be_chosen_for_seek():
    config = composed("experiment=seek", "learner=paper", "network=a3c")
    assert config.learner == composed("learner=paper").learner and config.network == composed("network=a3c").network
    assert composed("experiment=seek").learner.num_epochs == 4 and composed("experiment=seek").network.lstm == 64


@pytest.fixture
def own(tmp_path_factory):
    """A directory with choices of one's own, one of them with words of before."""
    files = {
        "experiment/mine": "# @package _global_\ndefaults:\n  - override /sensor: decreasing_packed\nname: mine\n"
        "train: {keep: 9}\nlearner: {epochs: 7, natural: {beta: 0.5}}\n",
        "sensor/small": "defaults: [rings]\nrings: [[8, 8, 1]]\n",
        "gaze/fast": "step: 16\n",
    }
    directory = tmp_path_factory.mktemp("it's, own")
    for name, text in files.items():
        (directory / f"{name}.yaml").parent.mkdir()
        (directory / f"{name}.yaml").write_text(text)
    return directory


def test_choices_of_ones_own_stand_beside_ours(own):
    config = compose(["experiment=mine", "gaze=fast"], own)
    assert (config.name, config.sensor) == ("mine", composed("experiment=decreasing_packed").sensor)
    assert config.gaze.step == 16 and compose(["sensor=small"], own).sensor.window == (8, 8)
    with pytest.raises(ConfigError, match="experiment=mien: did you mean mine. accepted is one of .*mine"):
        compose(["experiment=mien"], own)
    with pytest.raises(ConfigError, match="experiment=mine: accepted is one of"):
        compose(["experiment=mine"])


def test_words_in_one_string_and_a_missing_directory_are_refused():
    with pytest.raises(ConfigError, match="^overrides=experiment=seek: accepted is a list of words"):
        compose("experiment=seek")
    with pytest.raises(ConfigError, match="^config_dir=/nowhere: accepted is a directory"):
        compose(["experiment=seek"], "/nowhere")


def test_words_of_before_in_a_file_give_way_to_the_command_lines(own):
    config = compose(["experiment=mine", "train.keep_checkpoints=2"], own)
    assert (config.train.keep_checkpoints, config.learner.num_epochs) == (2, 7)
    assert config.learner.natural.entropy_weight == config.learner.vision.entropy_weight == 0.5


def test_a_run_of_ones_own_is_started_swept_and_shown(cwd, own, runs, capsys, monkeypatch):
    words = [f"--config-dir={own}", "experiment=mine"]
    assert run(runs.record, ["--config-dir", str(own), "experiment=mine"]) == run(runs.record, words) == 0
    assert run(runs.record, [*words, *HERE, "sensor=small,constant70"]) == 0
    assert [config.name for config in runs] == ["mine", "mine", "mine-sensor=small", "mine-sensor=constant70"]
    capsys.readouterr()
    assert run(runs.record, [*words, "--cfg", "job"]) == 0 and "name: mine" in capsys.readouterr().out
    assert run(runs.record, [words[0], "--help"]) == 0 and "gaze: fast, frozen" in capsys.readouterr().out
    monkeypatch.setattr(sweep, "run_all", lambda runs, *, jobs, command: int(command[-1] != words[0]))
    assert run(runs.record, [*words, "-m", "seed=1,2"]) == 0
    for words in (["--config-dir=nowhere"], ["--config-dir", "nowhere"]):
        assert run(runs.record, words) == 2
        assert "--config-dir=nowhere: accepted is a directory with experiment/" in capsys.readouterr().err


def test_words_of_before_are_understood_and_answered_with_todays(cwd, runs, capsys):
    assert run(runs.record, ["learner.epochs=3", "train.keep=${learner.epochs}"]) == 0
    assert (runs[0].learner.num_epochs, runs[0].train.keep_checkpoints) == (3, 3)
    said = "foajax: learner.epochs is now learner.num_epochs\nfoajax: train.keep is now train.keep_checkpoints\n"
    assert capsys.readouterr().err == said
    for launcher in (["-m"], HERE):
        assert run(runs.record, [*launcher, "learner.epochs=0,1"]) == 2
        assert capsys.readouterr().err.endswith("learner.num_epochs=0: accepted is an integer from 1 to 1000\n")
    assert run(runs.record, [*HERE, "learner.epochs=3,4"]) == 0
    assert [config.name for config in runs[1:]] == ["constant70-learner.epochs=3", "constant70-learner.epochs=4"]


def test_composing_works_from_any_directory(cwd):
    assert compose(["experiment=logpolar"]).name == "logpolar"


@pytest.mark.slow
def test_an_installed_wheel_brings_the_experiments_along(tmp_path):
    wheels = tmp_path / "wheels"
    build = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", wheels, ROOT]
    subprocess.run(build, check=True, cwd=tmp_path)
    venv.create(tmp_path / "venv", with_pip=True)
    python = tmp_path / "venv/bin/python"
    subprocess.run([python, "-m", "pip", "install", "--quiet", "--no-deps", *wheels.iterdir()], check=True)
    purelib = subprocess.run(
        [python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"],
        check=True, capture_output=True, text=True,
    ).stdout.strip()  # fmt: skip
    # The dependencies are big: those of this environment are lent to the fresh one.
    Path(purelib, "lent.pth").write_text(sysconfig.get_path("purelib"))
    code = "import foajax.config.compose as c; print(c.__file__, *c.list_experiments(), c.compose(['seed=7']).seed)"
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    printed = subprocess.run(
        [python, "-c", code], check=True, capture_output=True, text=True, cwd=tmp_path, env=environment
    ).stdout.split()
    assert Path(printed[0]).is_relative_to(tmp_path)
    assert printed[1:] == [*list_experiments(), "7"]


@pytest.mark.parametrize(
    "name",
    ["SpaceInvaders", "space_invaders", "ALE/SpaceInvaders-v5", "SpaceInvadersNoFrameskip-v4", "SpaceInvaders-v5"],
)
def test_a_game_has_one_name_whatever_it_is_called(name):
    config = compose([f"game={name}"])
    assert config.game == "space_invaders" and config.run_dir == "runs/space_invaders-constant70-s0"
    assert checked(f"game={name},pong", sweep=True) == "++game=space_invaders,pong"


@pytest.mark.parametrize("name", ["gymnasium:ALE/Pong-v5", "probe:match", "mine:Walk", "up_n_down"])
def test_other_names_of_games_stay_as_they_are(name):
    assert compose([f"game={name}"]).game == name
