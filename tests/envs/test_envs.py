"""foajax.envs, with the engines behind it, on really running games."""

from __future__ import annotations

from types import SimpleNamespace

import chex
import cv2
import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ale_py import Action, ALEInterface, LoggerMode, roms
from gymnasium import spaces

from foajax.config.parse import ConfigError
from foajax.config.schema import Config, EnvConfig, RingSensor
from foajax.envs import probes, tasks
from foajax.envs.atari import atari_name, envpool_id
from foajax.envs.gymnasium import area_weights, gray_frames
from foajax.envs.make import action_names, make
from foajax.sensors.frames import to_frame

ENGINES = ["envpool", "ale"]
NOOP, FIRE, RIGHT, LEFT = range(4)  # Breakout's actions


def config(game: str = "breakout", **env) -> Config:
    rings = ((16, 16, 1),)
    return Config(name="test", sensor=RingSensor(rings), game=game, env=EnvConfig(**env))


def play(environment, actions: np.ndarray) -> SimpleNamespace:
    """Every field of the time steps and outcomes, [T+1, B, ...], after `reset` and actions [T, B]."""
    steps = [environment.reset()]
    for action in actions:
        environment.send(action.astype(np.int32))
        steps.append(environment.recv())
    environment.close()
    fields = [{**timestep._asdict(), **outcome._asdict()} for timestep, outcome in steps]
    return SimpleNamespace(**{name: np.stack([f[name] for f in fields]) for name in fields[0]})


def noops(steps: int, num_envs: int = 1) -> np.ndarray:
    return np.full((steps, num_envs), NOOP)


def random_actions(steps: int, num_envs: int, num_actions: int) -> np.ndarray:
    return np.random.default_rng(0).integers(0, num_actions, (steps, num_envs))


@pytest.fixture(scope="module", params=ENGINES)
def breakout(request) -> SimpleNamespace:
    """200 random steps of 3 games of Breakout; FIRE, which serves, is left to the engine."""
    environment = make(config(engine=request.param), num_envs=3, seed=0)
    assert (environment.num_envs, environment.num_actions) == (3, 4)
    assert environment.crop_top == 34
    return play(environment, np.array([NOOP, RIGHT, LEFT])[random_actions(200, 3, 3)])


def test_every_field_has_its_type(breakout):
    assert breakout.frame.shape == (201, 3, 210, 160) and breakout.frame.dtype == np.uint8
    for name, dtype in (("reward", "f4"), ("score", "f4"), ("is_first", "?"), ("is_terminal", "?"), ("is_over", "?")):
        field = getattr(breakout, name)
        assert field.shape == (201, 3) and field.dtype == dtype


def test_the_step_after_an_end_is_a_first_one(breakout):
    ended = breakout.is_terminal | breakout.is_over
    assert ended.sum() > 10
    np.testing.assert_array_equal(breakout.is_first[0], True)
    np.testing.assert_array_equal(breakout.is_first[1:], ended[:-1])
    assert not np.any(ended & breakout.is_first)
    assert not np.any(breakout.reward[breakout.is_first])


def test_a_game_of_breakout_is_five_episodes(breakout):
    assert breakout.is_over.sum() >= 1
    assert np.all(breakout.is_terminal[breakout.is_over])
    for env in range(3):
        games = np.split(breakout.is_terminal[:, env], np.flatnonzero(breakout.is_over[:, env]) + 1)
        assert [game.sum() for game in games[:-1]] == [5] * (len(games) - 1)


def test_the_last_frame_shows_the_end_and_the_first_a_new_game(breakout):
    """The ball has left the field when a life is lost; a new game has all its bricks again."""
    ball = (breakout.frame[:, :, 99:180, 8:152] > 0).sum((2, 3))
    assert not np.any(ball[breakout.is_terminal & ~breakout.is_over]) and np.mean(ball > 0) > 0.4
    bricks = (breakout.frame[:, :, 57:93, 8:152] > 0).all((2, 3))
    new_game = np.roll(breakout.is_over, 1, axis=0)
    new_game[0] = True
    assert bricks[new_game].all() and not bricks[breakout.is_over].all()


@pytest.mark.parametrize("engine", ENGINES)
def test_without_the_crop_the_whole_screen_shrinks_by_area_means(engine):
    """As in gymnasium's AtariPreprocessing, to the gray level."""
    actions = random_actions(60, 2, 4)
    whole = make(config(engine=engine, crop=False, frame_shape=(84, 100)), num_envs=2, seed=0)
    assert whole.crop_top is None
    shrunk, screens = play(whole, actions), play(make(config(engine=engine), num_envs=2, seed=0), actions)
    expected = [[cv2.resize(screen, (100, 84), interpolation=cv2.INTER_AREA) for screen in t] for t in screens.frame]
    np.testing.assert_array_equal(shrunk.frame, expected)
    np.testing.assert_array_equal(shrunk.reward, screens.reward)


def play_rgb(actions: np.ndarray, first_noops: int) -> np.ndarray:
    """Breakout on a single ale-py emulator: the larger RGB values of the last two frames, [T+1, 210, 160, 3]."""
    ALEInterface.setLoggerMode(LoggerMode.Error)
    emulator = ALEInterface()
    emulator.setFloat("repeat_action_probability", 0.0)
    emulator.loadROM(roms.get_rom_path("breakout"))
    for _ in range(first_noops):
        emulator.act(Action.NOOP)
    screens, names = [emulator.getScreenRGB()], emulator.getMinimalActionSet()
    for action in actions:
        last = [(emulator.act(names[action]), emulator.getScreenRGB())[1] for _ in range(4)]
        screens.append(np.maximum(*last[2:]))
    return np.stack(screens)


@pytest.mark.parametrize(("engine", "first_noops"), [("envpool", 1), ("ale", 0)])
def test_in_colour_screens_and_frames_have_the_emulators_colours(engine, first_noops):
    actions = np.array([FIRE, RIGHT, RIGHT, LEFT, NOOP, LEFT] * 4)
    words = {"engine": engine, "color": True, "noop_max": 0, "fire_on_reset": False}
    screens = play_rgb(actions, first_noops)
    assert len(np.unique(screens.reshape(-1, 3), axis=0)) > 8 and (screens[1:] != screens[:-1]).any((1, 2, 3)).all()
    environment = make(config(**words), num_envs=1, seed=0)
    run = play(environment, actions[:, None])
    np.testing.assert_array_equal(run.frame[:, 0], screens)
    halved = to_frame(jnp.asarray(run.frame[-1, 0]), environment.crop_top)
    blocks = screens[-1, 34:194].reshape(80, 2, 80, 2, 3).mean((1, 3))
    np.testing.assert_allclose(255 * halved, blocks, atol=1e-4)
    shrunk = play(make(config(**words, crop=False, frame_shape=(84, 100)), num_envs=1, seed=0), actions[:, None])
    expected = [cv2.resize(screen, (100, 84), interpolation=cv2.INTER_AREA) for screen in screens]
    np.testing.assert_array_equal(shrunk.frame[:, 0], expected)


@pytest.mark.parametrize("engine", ENGINES)
def test_all_actions_are_those_of_the_game_by_their_names_and_more(engine):
    few, every = (config(engine=engine, full_action_space=full) for full in (False, True))
    environment = make(every, num_envs=2, seed=0)
    names = action_names(every)
    assert environment.num_actions == len(names) == len(set(names)) == 18
    actions = random_actions(60, 2, 4)
    same = np.array([names.index(name) for name in action_names(few)])[actions]
    run = play(make(few, num_envs=2, seed=0), actions)
    np.testing.assert_array_equal(play(environment, same).frame, run.frame)
    assert (run.frame[1:] != run.frame[:-1]).any()


@pytest.mark.parametrize("engine", ENGINES)
def test_fire_on_reset_serves_after_every_lost_life(engine):
    """Who does nothing loses a life each 24 or 25 steps, and never where nobody serves."""
    run = play(make(config(engine=engine, noop_max=0), num_envs=1, seed=0), noops(130))
    np.testing.assert_array_equal(np.flatnonzero(run.is_terminal), [24, 49, 74, 99, 124])
    np.testing.assert_array_equal(np.flatnonzero(run.is_over), [124])
    unserved = make(config(engine=engine, noop_max=0, fire_on_reset=False), num_envs=1, seed=0)
    run = play(unserved, noops(60))
    assert not np.any(run.is_terminal)


@pytest.mark.parametrize("engine", ENGINES)
def test_without_episodic_life_an_episode_is_a_game(engine):
    environment = make(config(engine=engine, episodic_life=False, noop_max=0), num_envs=2, seed=0)
    actions = np.random.default_rng(1).integers(0, 4, (220, 2))
    run = play(environment, actions)
    assert run.is_over.sum() >= 2
    np.testing.assert_array_equal(run.is_terminal, run.is_over)
    np.testing.assert_array_equal(run.is_first[1:], run.is_over[:-1])


@pytest.mark.parametrize("engine", ENGINES)
def test_the_step_limit_ends_the_game_without_a_terminal(engine):
    """EnvPool does not count the step that begins the next episode of a game, ale-py does."""
    environment = make(config(engine=engine, noop_max=0, max_episode_steps=30), num_envs=1, seed=0)
    run = play(environment, noops(80))
    last = 31 if engine == "envpool" else 30
    assert np.flatnonzero(run.is_over)[0] == last
    np.testing.assert_array_equal(np.flatnonzero(run.is_terminal), [24, last + 1 + 24])
    np.testing.assert_array_equal(np.flatnonzero(run.is_first), [0, 25, last + 1, last + 26, 2 * last + 2][:5])
    np.testing.assert_array_equal(run.frame[last + 1], run.frame[0])  # a new game


@pytest.mark.parametrize("engine", ENGINES)
def test_a_life_lost_at_the_step_limit_is_a_terminal(engine):
    limit = 48 if engine == "envpool" else 49
    environment = make(config(engine=engine, noop_max=0, max_episode_steps=limit), num_envs=1, seed=0)
    run = play(environment, noops(60))
    np.testing.assert_array_equal(np.flatnonzero(run.is_terminal), [24, 49])
    np.testing.assert_array_equal(np.flatnonzero(run.is_over), [49])
    np.testing.assert_array_equal(run.frame[50], run.frame[0])


@pytest.mark.parametrize(("engine", "clip"), [(engine, clip) for engine in ENGINES for clip in (True, False)])
def test_rewards_are_clipped_and_scores_are_not(engine, clip):
    environment = make(config("space_invaders", engine=engine, clip_rewards=clip), num_envs=2, seed=0)
    run = play(environment, random_actions(60, 2, environment.num_actions))
    assert run.score.max() > 1
    np.testing.assert_array_equal(run.reward, np.sign(run.score) if clip else run.score)


@pytest.mark.parametrize("engine", ENGINES)
def test_a_batch_is_its_environments_one_by_one(engine):
    """Environment i is seeded with seed + i, takes action i and gives row i, whatever the threads do."""
    actions = random_actions(40, 3, 4)
    batch = play(make(config(engine=engine, threads=2), num_envs=3, seed=7), actions)
    for i in (0, 2):
        alone = play(make(config(engine=engine), num_envs=1, seed=7 + i), actions[:, i : i + 1])
        for name, values in vars(alone).items():
            np.testing.assert_array_equal(getattr(batch, name)[:, i], values[:, 0])
    assert np.any(batch.frame[0, 0] != batch.frame[0, 1])  # another number of no-ops


@pytest.mark.parametrize("engine", ENGINES)
def test_frames_handed_out_stay_as_they_are(engine):
    environment = make(config(engine=engine), num_envs=2, seed=0)
    timestep, _ = environment.reset()
    handed_out, copies = [timestep.frame], [timestep.frame.copy()]
    for _ in range(40):
        environment.send(np.array([RIGHT, LEFT], np.int32))
        timestep, _ = environment.recv()
        handed_out.append(timestep.frame)
        copies.append(timestep.frame.copy())
    np.testing.assert_array_equal(handed_out, copies)
    paddle = handed_out[-1][:, 189:193, 8:152].max(1) > 0
    assert np.flatnonzero(paddle[0]).mean() > 100 > 40 > np.flatnonzero(paddle[1]).mean()
    environment.close()


@pytest.mark.parametrize("engine", ENGINES)
def test_sticky_actions_repeat_the_last_action(engine):
    """Of an episode's start, whose action is none: the paddle stays where it is."""
    for stickiness, moves in ((0.0, True), (0.999, False)):
        environment = make(config(engine=engine, noop_max=0, sticky_actions=stickiness), num_envs=1, seed=0)
        paddle = play(environment, np.full((12, 1), RIGHT)).frame[:, 0, 189:193, 8:152].max(1)
        assert (paddle[-1] != paddle[0]).any() == moves


def test_a_game_that_ends_in_the_no_ops_is_over_with_the_next_first_step():
    environment = make(config(), num_envs=2, seed=0)
    environment.reset()

    def answer(lives, terminated):
        screen, zeros = np.zeros((2, 1, 210, 160), np.uint8), np.zeros(2, np.float32)
        info = {"lives": np.array(lives), "terminated": np.zeros(2, int), "reward": zeros}
        return screen, zeros, np.array(terminated), np.zeros(2, bool), info

    answers = [answer([1, 1], [True, True]), answer([5, 1], [False, False]), answer([5, 1], [False, False])]
    environment._pool = SimpleNamespace(recv=lambda: answers.pop(0), close=lambda: None)
    environment.lives = np.array([2, 2])
    outcomes = [environment.recv()[1].is_over.tolist() for _ in range(3)]
    assert outcomes == [[False, False], [True, False], [False, False]]


def test_rendering_gives_the_colour_screens():
    environment = make(config(), num_envs=2, seed=0, render=True)
    timestep, _ = environment.reset()
    screen = environment.render()
    assert screen.shape == (2, 210, 160, 3) and screen.dtype == np.uint8
    luma = screen @ [0.299, 0.587, 0.114]
    np.testing.assert_allclose(luma, timestep.frame, atol=2)
    environment.close()


def test_games_go_by_any_of_their_names():
    known = ["beam_rider", "pong", "up_n_down", "tic_tac_toe_3d"]
    names = ("beam_rider", "BeamRider", "beamrider", "BeamRider-v5", "ALE/BeamRider-v5", "BeamRiderNoFrameskip-v4")
    assert {atari_name(game, known) for game in names} == {"beam_rider"}
    assert atari_name("TicTacToe3D-v5", known) == "tic_tac_toe_3d"
    assert envpool_id("up_n_down") == "UpNDown-v5"
    environment = make(config("BeamRider-v5"), num_envs=1, seed=0)
    assert (environment.num_actions, environment.crop_top) == (9, 20)
    environment.close()


@pytest.mark.parametrize(
    ("game", "env", "message"),
    [
        ("braekout", {}, r"game=braekout: did you mean breakout\? accepted is an Atari game such as breakout, seek"),
        ("brekout", {"engine": "ale"}, r"game=brekout: did you mean breakout\? accepted"),
        ("probe:mach", {}, r"game=probe:mach: did you mean probe:match\? .*probe:match, "),
        ("pong", {"frame_shape": (84, 84)}, r"env.frame_shape=\[84, 84\]: accepted is \[80, 80\] for game=pong"),
        ("pong", {"frame_shape": (84, 84)}, r".* or a size up to \[210, 160\] with env.crop=false"),
        (
            "pong",
            {"frame_shape": (84, 161), "crop": False},
            r"env.frame_shape=\[84, 161\]: accepted is a size up to the",
        ),
        ("pong", {"crop_top": {"default": 34, "pnog": 20}}, r"env.crop_top.pnog=20: accepted is default or an Atari"),
        ("seek", {"color": True}, "env.color=true: accepted is false for game=seek, whose frames are gray"),
        ("probe:match", {"color": True}, "env.color=true: accepted is false for game=probe:match, whose frames are"),
        ("gymnasium:Nowhere-v0", {}, r"game=gymnasium:Nowhere-v0: .*Nowhere.*accepted is the id of an environment"),
        (
            "gymnasium:no_such_module:X-v0",
            {},
            r"game=gymnasium:no_such_module:X-v0: .*pip install no_such_module",
        ),
        ("gymnasium:Sized-v0", {}, r"game=gymnasium:Sized-v0: .*'shape'.*accepted is env.kwargs that the"),
        ("gymnasium:CartPole-v1", {}, r"game=gymnasium:CartPole-v1: accepted is .* uint8 images .*, not Box"),
    ],
)
def test_bad_input_is_one_clear_line(game, env, message, monkeypatch):
    sized = gymnasium.envs.registration.EnvSpec("Sized-v0", entry_point=Strict)  # without the shape that it needs
    monkeypatch.setitem(gymnasium.registry, "Sized-v0", sized)
    with pytest.raises(ConfigError, match=f"^{message}[^\n]*$"):
        make(config(game, **env), num_envs=1, seed=0)


def test_ale_does_not_render():
    with pytest.raises(ConfigError, match="env.engine=ale: accepted is envpool"):
        make(config(engine="ale"), num_envs=1, seed=0, render=True)


# --- pure JAX ---------------------------------------------------------------------------------------------------------


def play_probe(name: str, policy, steps: int = 32, num_envs: int = 16) -> SimpleNamespace:
    """`play` with a policy that reads the state."""
    environment = make(config(f"probe:{name}"), num_envs=num_envs, seed=0)
    steps_seen = [environment.reset()]
    states = [environment.get_state().task]
    for _ in range(steps):
        environment.send(np.broadcast_to(policy(states[-1]), (num_envs,)).astype(np.int32))
        steps_seen.append(environment.recv())
        states.append(environment.get_state().task)
    fields = [{**t._asdict(), **o._asdict(), **s._asdict()} for (t, o), s in zip(steps_seen, states, strict=True)]
    return SimpleNamespace(**{key: np.stack([f[key] for f in fields]) for key in fields[0]})


def values(run: SimpleNamespace, gamma: float) -> np.ndarray:
    """Discounted returns of each step of complete episodes, [T, B]; NaN where nothing follows or is complete."""
    returns = np.full(run.reward.shape, np.nan)
    for t in reversed(range(len(returns) - 1)):
        later = np.where(run.is_terminal[t + 1], 0.0, returns[t + 1])
        returns[t] = np.where(run.is_terminal[t], np.nan, run.reward[t + 1] + gamma * later)
    return returns


def optimal_value(name: str, run: SimpleNamespace, gamma: float) -> np.ndarray:
    """What the docstrings promise."""
    one = np.ones(run.cue.shape)
    return {
        "constant": one,
        "observation": 2.0 * run.cue - 1,
        "delay": gamma ** (1.0 - run.time),
        "action": one,
        "match": one,
        "memory": gamma ** (3.0 - run.time),
        "gaze": (1 - gamma ** (16.0 - run.time)) / (1 - gamma),
    }[name]


@pytest.mark.parametrize("name", probes.PROBES)
def test_the_optimal_policy_has_the_documented_values(name):
    policy = {"action": lambda s: 1, "match": lambda s: s.cue, "memory": lambda s: s.cue, "gaze": lambda s: s.cue}
    run = play_probe(name, policy.get(name, lambda s: 0), steps=40)
    got = values(run, 0.9)
    assert np.isfinite(got).sum() > 200
    expected = np.where(np.isfinite(got), optimal_value(name, run, 0.9), np.nan)
    np.testing.assert_allclose(got, expected, rtol=1e-5)
    assert set(run.cue.ravel()) == {0, 1}


@pytest.mark.parametrize("name", ["match", "memory", "gaze"])
def test_blind_policies_earn_nothing_on_average(name):
    run = play_probe(name, lambda s: 1, steps=200, num_envs=64)
    assert abs(run.reward[run.reward != 0].mean()) < 0.1  # 600 episodes or more: a deviation of 0.04
    assert abs(run.cue.mean() - 0.5) < 0.1


@pytest.mark.parametrize("name", probes.PROBES)
def test_probes_show_what_they_should(name):
    run = play_probe(name, lambda s: 0, steps=20)
    left, right = (run.frame[..., columns].mean((2, 3)) for columns in (slice(40), slice(40, 80)))
    shown = {
        "observation": (run.cue == 0, run.cue == 1),
        "match": (run.cue == 0, run.cue == 1),
        "delay": (run.time == 0, run.time == 1),
        "memory": ((run.cue == 0) & (run.time == 0), (run.cue == 1) & (run.time == 0)),
    }
    ended = run.is_terminal  # what a terminal shows is of no value
    if name in shown:
        np.testing.assert_array_equal(left[~ended], 255 * shown[name][0][~ended])
        np.testing.assert_array_equal(right[~ended], 255 * shown[name][1][~ended])
    elif name == "gaze":
        patch = run.frame[..., 36:44, 10:18]
        stripes = np.where(np.arange(8) % 2 == 0, 255, 0)
        assert np.all(patch[run.cue == 1] == stripes[:, None]) and np.all(patch[run.cue == 0] == stripes)
        assert np.all(run.frame.sum((2, 3), dtype=int) == 32 * 255)
    else:
        assert not np.any(run.frame)


@pytest.mark.parametrize("game", ["seek", "probe:memory"])
def test_jax_environments_begin_anew_after_a_terminal(game):
    environment = make(config(game), num_envs=8, seed=5)
    assert (environment.num_actions, environment.crop_top) == (2, None)
    run = play(environment, random_actions(200, 8, 2))
    assert run.is_terminal.sum() >= 16
    np.testing.assert_array_equal(run.is_over, run.is_terminal)
    np.testing.assert_array_equal(run.is_first[1:], run.is_terminal[:-1])
    assert run.is_first[0].all() and not np.any(run.is_first & run.is_terminal)
    assert not np.any(run.reward[run.is_first])
    np.testing.assert_array_equal(run.score, run.reward)


def test_a_saved_state_goes_on_bit_for_bit():
    """Across an episode's end, so that the next episode's randomness is saved too."""
    first, second = (make(config("seek"), num_envs=3, seed=seed) for seed in (1, 2))
    actions = random_actions(150, 3, 2).astype(np.int32)
    first.reset()
    for action in actions[:90]:
        first.send(action)
        before = first.recv()
    restored = second.set_state(first.get_state())
    chex.assert_trees_all_equal(restored, before)
    for action in actions[90:]:
        first.send(action)
        second.send(action)
        chex.assert_trees_all_equal(first.recv(), second.recv())


def test_environments_differ_and_a_seed_repeats():
    actions = random_actions(100, 3, 2)
    run, again, other = (play(make(config("seek"), num_envs=3, seed=seed), actions) for seed in (1, 1, 2))
    np.testing.assert_array_equal(run.frame, again.frame)
    np.testing.assert_array_equal(run.reward, again.reward)
    assert np.any(run.frame != other.frame)
    assert np.any(run.frame[:, 0] != run.frame[:, 1]) and np.any(run.frame[:, 1] != run.frame[:, 2])


def test_the_pure_functions_scanned_are_the_host_environment():
    task = probes.memory((8, 8))
    actions = random_actions(20, 1, 2).astype(np.int32)
    host = play(tasks.JaxEnvironment(task, num_envs=1, seed=4), actions)
    state, first = tasks.reset(task, jax.random.key(4))  # environment i has the key of seed + i
    np.testing.assert_array_equal(first.frame, host.frame[0, 0])
    _, steps = jax.lax.scan(lambda s, a: tasks.step(task, s, a), state, actions[:, 0])
    for name in ("frame", "reward", "is_first", "is_terminal"):
        np.testing.assert_array_equal(getattr(steps, name), getattr(host, name)[1:, 0])


@pytest.mark.parametrize("pixel", [(), (3,)], ids=["gray", "colour"])
def test_jax_environments_render_what_they_draw(pixel):
    task = probes.PROBES["observation"]((8, 9))
    task = task._replace(draw=lambda state: jnp.full((8, 9, *pixel), 7 * state.cue, jnp.uint8))
    environment = tasks.JaxEnvironment(task, num_envs=2, seed=0)
    timestep, _ = environment.reset()
    assert timestep.frame.shape == (2, 8, 9, *pixel)
    np.testing.assert_array_equal(environment.render(), timestep.frame.reshape(2, 8, 9, -1) + np.zeros(3, np.uint8))


# --- Gymnasium --------------------------------------------------------------------------------------------------------


class Pixels(gymnasium.Env):
    """An episode of 5 steps; the image's brightness counts them. Action 3 earns 2, action 4 costs 2."""

    metadata = {"render_modes": ["rgb_array"]}

    def __init__(self, shape=(160, 240, 3), start=3, render_mode=None, length=5):
        self.observation_space = spaces.Box(0, 255, shape, np.uint8)
        self.action_space = spaces.Discrete(2, start=start)
        self.render_mode, self.length = render_mode, length

    def image(self):
        noise = np.random.default_rng(self.count).integers(0, 200, self.observation_space.shape)
        return (noise + 10 * self.count).astype(np.uint8)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count = 0
        return self.image(), {"seed": seed}

    def step(self, action):
        assert self.action_space.contains(action)
        self.count += 1
        return self.image(), 2.0 if action == 3 else -2.0, self.count >= self.length, False, {}

    def render(self):
        return np.full((4, 6, 3), self.count, np.uint8)


@pytest.fixture
def pixels():
    """Registers `Pixels`; gives the configuration of a game of it."""
    registered = []

    def register(shape=(160, 240, 3), length=5, **env):
        name = f"Pixels{len(registered)}-v0"
        gymnasium.register(name, entry_point=Pixels, kwargs={"shape": shape, "length": length})
        registered.append(name)
        return config(f"gymnasium:{name}", **env)

    yield register
    for name in registered:
        del gymnasium.registry[name]


def reference_frame(image: np.ndarray) -> np.ndarray:
    """Gray and 80x80, pixel by pixel."""
    if image.ndim == 3:
        image = np.floor(image @ [0.299, 0.587, 0.114] + 0.5) if image.shape[-1] == 3 else image[..., 0]
    height, width = image.shape[0] // 80, image.shape[1] // 80
    frame = np.zeros((80, 80))
    for y in range(80):
        for x in range(80):
            frame[y, x] = image[y * height : (y + 1) * height, x * width : (x + 1) * width].mean()
    return np.floor(frame + 0.5)


@pytest.mark.parametrize("shape", [(160, 240, 3), (80, 160, 1), (80, 80)])
def test_gymnasium_images_become_gray_frames(pixels, shape):
    environment = make(pixels(shape), num_envs=1, seed=0)
    assert (environment.num_actions, environment.crop_top) == (2, None)
    run = play(environment, np.zeros((3, 1)))
    reference = Pixels(shape)
    for reference.count in range(4):
        got = run.frame[reference.count, 0].astype(int)
        assert np.abs(got - reference_frame(reference.image())).max() <= 1  # exact ties may round either way
        assert np.mean(got != reference_frame(reference.image())) < 0.01


def test_gymnasium_images_become_frames_in_colour(pixels):
    run = play(make(pixels(color=True), num_envs=2, seed=0), np.zeros((3, 2)))
    assert run.frame.shape == (4, 2, 80, 80, 3) and run.frame.dtype == np.uint8
    reference = Pixels()
    for reference.count in range(4):
        expected = [reference_frame(reference.image()[..., channel]) for channel in range(3)]
        np.testing.assert_allclose(run.frame[reference.count, 1], np.stack(expected, -1), atol=1)  # ties


@pytest.mark.parametrize("shape", [(80, 80), (80, 80, 1)])
def test_gymnasium_images_that_are_gray_have_no_colours(pixels, shape):
    with pytest.raises(ConfigError, match=r"accepted is .* uint8 images \[h, w, 3\] where env.color=true, not Box"):
        make(pixels(shape, color=True), num_envs=1, seed=0)


def test_gymnasium_episodes_end_as_the_others_do(pixels):
    environment = make(pixels(), num_envs=2, seed=0)
    run = play(environment, np.tile([0, 1], (13, 1)))
    np.testing.assert_array_equal(np.flatnonzero(run.is_terminal[:, 0]), [5, 11])
    np.testing.assert_array_equal(np.flatnonzero(run.is_first[:, 0]), [0, 6, 12])
    np.testing.assert_array_equal(run.is_over, run.is_terminal)
    np.testing.assert_array_equal(run.frame[6], run.frame[0])
    np.testing.assert_array_equal(run.score[:7], [[0, 0]] + [[2, -2]] * 5 + [[0, 0]])
    np.testing.assert_array_equal(run.reward, np.sign(run.score))


def test_gymnasium_step_limit_is_no_terminal(pixels):
    run = play(make(pixels(max_episode_steps=3, clip_rewards=False), num_envs=1, seed=0), np.zeros((9, 1)))
    assert not np.any(run.is_terminal)
    np.testing.assert_array_equal(np.flatnonzero(run.is_over), [3, 7])
    np.testing.assert_array_equal(np.flatnonzero(run.is_first), [0, 4, 8])
    np.testing.assert_array_equal(run.reward, run.score)
    # An episode that ends at the very limit does end.
    run = play(make(pixels(max_episode_steps=5), num_envs=1, seed=0), np.zeros((6, 1)))
    np.testing.assert_array_equal(np.flatnonzero(run.is_terminal & run.is_over), [5])


def test_gymnasium_renders(pixels):
    environment = make(pixels(), num_envs=2, seed=0, render=True)
    environment.reset()
    environment.send(np.zeros(2, np.int32))
    environment.recv()
    np.testing.assert_array_equal(environment.render(), np.ones((2, 4, 6, 3), np.uint8))
    environment.close()


class Bare(Pixels):
    """Knows nothing of rendering."""

    metadata = {"render_modes": []}

    def __init__(self, shape):
        super().__init__(shape)

    def render(self):
        raise NotImplementedError


@pytest.mark.parametrize("shape", [(160, 240, 3), (80, 80, 1), (80, 80)])
def test_gymnasium_without_rendering_shows_its_images(shape):
    gymnasium.register("Bare-v0", entry_point=Bare, kwargs={"shape": shape})
    try:
        environment = make(config("gymnasium:Bare-v0"), num_envs=2, seed=0, render=True)
    finally:
        del gymnasium.registry["Bare-v0"]
    environment.reset()
    screens = environment.render()
    assert screens.shape == (2, *shape[:2], 3) and screens.dtype == np.uint8
    reference = Pixels(shape)
    reference.count = 0
    np.testing.assert_array_equal(screens[1], reference.image().reshape(*shape[:2], -1) + np.zeros(3, np.uint8))


class Strict(Pixels):
    """Says that it renders, and cannot be told to."""

    def __init__(self, shape):
        super().__init__(shape)


def test_gymnasium_that_cannot_be_told_to_render_shows_its_images(monkeypatch):
    spec = gymnasium.envs.registration.EnvSpec("Strict-v0", entry_point=Strict, kwargs={"shape": (8, 9)})
    monkeypatch.setitem(gymnasium.registry, "Strict-v0", spec)
    environment = make(config("gymnasium:Strict-v0"), num_envs=2, seed=0, render=True)
    environment.reset()
    assert environment.render().shape == (2, 8, 9, 3)


@pytest.mark.parametrize(
    "images",
    [
        np.zeros((1, 8, 8, 3), np.float32),
        np.zeros((8, 9), np.uint8),
        np.zeros((1, 3, 8, 8), np.uint8),
        np.zeros((1, 8, 8, 4), np.uint8),
    ],
)
def test_other_images_are_refused(images):
    with pytest.raises(ValueError, match=r"^images=.*\]: accepted is uint8 \[B, h, w\], "):
        gray_frames(images, (8, 8))


@pytest.mark.parametrize(("source", "target"), [(160, 80), (210, 80), (96, 80), (50, 80), (80, 80)])
def test_area_weights_are_the_covered_shares(source, target):
    weights = area_weights(source, target)
    expected = np.zeros((target, source))
    fine = source * target  # both grids' borders fall on it
    for k in range(fine):
        expected[k // source, k // target] += 1 / source
    np.testing.assert_allclose(weights, expected, atol=1e-6)
    np.testing.assert_allclose(weights.sum(1), 1, rtol=1e-6)


def test_shrinking_is_the_area_interpolation_of_opencv():
    image = np.random.default_rng(0).integers(0, 256, (210, 96), dtype=np.uint8)
    rows, columns = (area_weights(side, 80) for side in image.shape)
    expected = cv2.resize(image.astype(np.float32), (80, 80), interpolation=cv2.INTER_AREA)
    np.testing.assert_allclose(rows @ image @ columns.T, expected, atol=0.01)
