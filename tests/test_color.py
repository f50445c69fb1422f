"""`env.color=true`, from the emulator's screens to what is trained, played and drawn."""

from __future__ import annotations

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image
from processes import TINY, finish, rows

from foajax import cli, cost, evaluate, player, render, show
from foajax.config.compose import compose
from foajax.config.parse import ConfigError
from foajax.learning.agent import Agent
from foajax.learning.programs import make_state
from foajax.reporting import cost as measured
from foajax.runs.agents import begin_from, load_agent, save_agent
from foajax.sensors import numpy as host
from foajax.sensors.frames import normalise, pixel_statistics, to_frame, update_statistics
from foajax.viewing import heatmap
from foajax.viewing.recording import record
from foajax.viewing.scene import Scene

COLOR = ["env.color=true", "network.dense=8", "network.lstm=8"]
EXPERIMENTS = ["constant70", "constant50_sub2_packed", "constant70_p_packed", "constant70_p", "logpolar", "nonfoa"]


def agent(*words, crop_top=34):
    return Agent(compose([*COLOR, *words]), 4, crop_top)


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_every_sensor_gives_the_network_three_channels(experiment):
    of_colours, random = agent(f"experiment={experiment}"), np.random.default_rng(0)
    screens = random.integers(0, 256, (2, 210, 160, 3), np.uint8)
    frames = of_colours.frame(screens)
    mean, std = (x.mean(0) for x in jax.vmap(pixel_statistics, (0, None))(frames, of_colours.initial_statistics()))
    statistics = update_statistics(of_colours.initial_statistics(), mean, std, 2)
    points = np.array([[40, 40], [36, 43]], np.int32)
    images, mean, _ = jax.jit(of_colours.see)(screens, jnp.asarray(points), statistics)
    assert mean.shape == (2, 80, 80, 3) and tuple(image.shape[1:] for image in images) == of_colours.image_shapes
    gaze, sensor = of_colours.config.gaze, of_colours.config.sensor
    for i, (frame, point) in enumerate(zip(frames, points, strict=True)):
        normalised = np.asarray(normalise(frame, statistics, mode="pixel"))
        wanted = host.sense(normalised, point, sensor=sensor, bounds=gaze.sense_bounds)
        for image, part in zip(images, wanted, strict=True):
            np.testing.assert_allclose(image[i], part, atol=1e-4)
    params = jax.eval_shape(of_colours.initial_params, jax.random.key(0))["params"]
    assert params["torso_0"]["Convolution_0"]["kernel"].shape[2] == 3


def test_screens_without_colours_are_refused():
    with pytest.raises(ConfigError, match=r"frame=uint8 \[1, 210, 160\]: accepted is uint8 \[B, 210, 160, 3\], RGB"):
        agent("experiment=nonfoa").check(np.zeros((1, 210, 160), np.uint8))


def test_a_gray_agent_is_no_beginning_of_one_of_colours(untrained, tmp_path):
    save_agent(untrained(Agent(compose(["experiment=nonfoa", *COLOR[1:]]), 4, 34)), tmp_path)
    here = agent("experiment=nonfoa")
    with pytest.raises(ConfigError, match=r"; that one has env.color=False$"):
        begin_from(str(tmp_path), make_state(here, 0), here.config)


@pytest.fixture(scope="module", params=["envpool", "ale"])
def recording(request, untrained):
    words = ["experiment=decreasing_p_packed", "gaze.bounds=point", f"env.engine={request.param}"]
    return next(record(untrained(agent(*words)), seed=0, max_steps=20))


def test_a_recording_holds_the_colours_that_were_seen(recording):
    assert recording.values.shape[2] == 3 and recording.mean_frame.shape == (80, 80, 3)
    if recording.config.env.engine == "envpool":
        return  # the screens shown are not those decided upon, each the brighter of two
    sensor = recording.config.sensor
    for step in (0, 7, 19):
        frame = np.asarray(to_frame(jnp.asarray(recording.screens[step]), recording.crop_top))
        wanted = host.sense(frame, recording.focal_point[step], sensor=sensor)
        for image, part in zip(recording.images, wanted, strict=True):
            np.testing.assert_allclose(image[step], 255 * part, atol=0.51)


def test_pictures_show_colours(recording):
    picture = np.asarray(Scene(recording).draw(5)).astype(int)
    view = picture[80 : 80 + 320, 2 * 16 + 320 : 2 * 16 + 640]
    assert (abs(view[..., 0] - view[..., 2]) > 100).mean() > 0.05  # the rows of red bricks
    figure = heatmap.draw(heatmap.heat_map([recording]), "")
    assert figure.axes[0].images[0].get_array().shape == (80, 80, 3)


def test_show_takes_the_key(tmp_path, capsys):
    words = ["sensor=constant70", "env.color=true", f"out={tmp_path / 'show.png'}"]
    assert cli.run(show.show, words) == 0
    levels = np.asarray(Image.open(tmp_path / "show.png").convert("RGB")).astype(int)
    gray = {(255, 176, 0), (47, 184, 255), (255, 92, 154)}  # the areas' outlines
    shown = {tuple(c) for c in levels.reshape(-1, 3) if np.ptp(c) > 60} - gray
    assert len(shown) > 5
    assert cli.run(show.show, ["game=seek", "env.color=true", f"out={tmp_path / 'no.png'}"]) == 2
    assert "env.color=true: accepted is false for game=seek" in capsys.readouterr().err


def test_a_decision_in_colour_costs_two_more_channels_of_the_first_layer(tmp_path, monkeypatch):
    monkeypatch.setattr(measured, "medians", lambda calls, repeats: [dict.fromkeys(group, 1.0) for group in calls])
    words = ["experiments=nonfoa", "repeats=1", "env.color=true", f"json={tmp_path / 'cost.json'}"]
    assert cli.run(cost.cost, words) == 0
    (found,) = json.loads((tmp_path / "cost.json").read_text())["results"]
    gray = measured.count(compose(["experiment=nonfoa"]))
    assert found["torso_flops"] - gray["torso_flops"] == 2 * (2 * 19 * 19 * 32 * 8 * 8)
    assert found["pixels_nominal"] == gray["pixels_nominal"] == 6400


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["envpool", "ale"])
def test_a_run_in_colour_trains_resumes_and_plays(engine, tmp_path):
    run = tmp_path / "run"
    words = ["experiment=constant50_sub2_packed", *TINY, f"run={run}", "env.color=true", f"env.engine={engine}"]
    for steps in (400, 600):
        code, out, err = finish(*words, f"train.env_steps={steps}")
        assert code == 0, err
        assert rows(run)[-1]["env_steps"] == steps
    assert "resumed at 400 env_steps" in out
    code, out, err = finish(*words, "env.color=false", "train.env_steps=800")
    assert code == 2 and "env.color" in err
    assert load_agent(run).statistics.mean.shape == (80, 80, 3)
    assert cli.run(evaluate.evaluate, [f"run={run}", "episodes=1", "env.max_episode_steps=20"]) == 0
    assert cli.run(player.player, [f"run={run}", "steps=20", f"out={tmp_path / 'player'}"]) == 0
    assert cli.run(render.render, [f"run={run}", "steps=20", f"out={tmp_path / 'render'}"]) == 0
    assert (tmp_path / "render" / "heatmap.png").exists()
