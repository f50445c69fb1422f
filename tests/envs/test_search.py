"""foajax.envs.search: what can be earned, by whom, what a scene is made of, and what low resolution gives away."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from foajax.config.compose import compose
from foajax.config.parse import ConfigError
from foajax.config.schema import Config
from foajax.envs import glyphs, search
from foajax.envs import scenes as scenery
from foajax.envs import tasks as jax_envs
from foajax.envs.make import action_names, make
from foajax.envs.own import OWN

EPISODES = 200
VARIANTS = ["letter", "feature", "conjunction", "cued"]


def configured(*words: str, game: str = "search") -> Config:
    return compose(
        ["experiment=search_rings", "search.staircase=false", "search.set_sizes=[8]", f"game={game}", *words]
    )


@functools.cache
def scenes(*words: str, game: str = "search", episodes: int = EPISODES) -> search.SearchState:
    """Start states of many episodes, as NumPy arrays with a leading [episodes]."""
    task = OWN[game](configured(*words, game=game))
    keys = jax.random.split(jax.random.key(0), episodes)
    return jax.tree.map(np.asarray, jax.jit(jax.vmap(task.start))(keys))


@functools.cache
def made(config: Config) -> jax_envs.JaxEnvironment:
    environment = make(config, num_envs=32, seed=3)
    assert isinstance(environment, jax_envs.JaxEnvironment)
    return environment


def play(policy, *words: str, game: str = "search", steps: int = 80):
    """Returns of whole episodes, and their facts; `policy(state, t)` gives actions [B] and focal points [B, 2]."""
    environment, num_envs = made(configured(*words, game=game)), 32
    environment.reset()
    total, returns, tables = np.zeros(num_envs), [], []
    for t in range(steps):
        action, point = policy(jax.tree.map(np.asarray, environment.get_state().task), t)
        environment.send(np.asarray(action, np.int32), np.asarray(point, np.int32))
        _, outcome = environment.recv()
        total += outcome.score
        over = outcome.is_over
        returns.extend(total[over])
        facts = environment.facts()
        assert facts is not None
        tables.append({name: values[over] for name, values in facts.items()})
        total[over] = 0
    return np.array(returns), {name: np.concatenate([table[name] for table in tables]) for name in tables[0]}


def centres(state) -> np.ndarray:
    return state.boxes[:, 0, :2] + state.boxes[:, 0, 2:] // 2


def full_sight(state, t):
    """Waits while the cue is shown, then answers at once, looking at the target."""
    return state.answer, centres(state)


MORE = [("search.classes=2",), ("search.absent=true",), ("search.set_sizes=[1,4,16]",)]


@pytest.mark.parametrize("words", [(), *(pytest.param(words, marks=pytest.mark.slow) for words in MORE)])
@pytest.mark.parametrize("game", ["search", "detect"])
def test_full_sight_earns_the_optimal_return(words, game):
    config = configured(*words, game=game)
    returns, facts = play(full_sight, *words, game=game)
    np.testing.assert_allclose(returns, search.optimal_return(config.search), atol=1e-6)
    assert search.optimal_return(config.search) == 0.99
    assert facts["right"].all() and (facts["decisions"] == 1).all() and len(returns) == 40 * 32
    assert (facts["on_target"] == facts["targets"]).all()


@pytest.mark.slow
def test_a_cue_costs_full_sight_one_decision():
    def policy(state, t):
        return np.where(state.time > 0, state.answer, search.WAIT), centres(state)

    returns, _ = play(policy, "search.target=cued")
    np.testing.assert_allclose(returns, 0.98, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("words", [(), ("search.classes=2",), ("search.classes=2", "search.absent=true")])
def test_whoever_sees_nothing_earns_nothing(words):
    random = np.random.default_rng(0)
    answers = len(search.action_names(configured(*words))) - 1
    for choose in (lambda: random.integers(1, answers + 1, 32), lambda: np.full(32, answers)):
        returns, _ = play(lambda state, t, choose=choose: (choose(), np.zeros((32, 2))), *words, steps=160)
        # Of 2,560 answers of +-1 the mean has a deviation of 0.02.
        expected = 0.0 if words else -0.5
        assert returns.mean() < expected + 0.06
        if "search.absent=true" not in words:
            assert returns.mean() > expected - 0.08


@pytest.mark.slow
def test_to_wait_for_ever_is_worse_than_any_answer():
    returns, facts = play(lambda state, t: (np.zeros(32), np.zeros((32, 2))), steps=62)
    np.testing.assert_allclose(returns, -1 - 0.3, atol=1e-5)
    assert (facts["decisions"] == 30).all() and (facts["fixations"] == 1).all() and not facts["right"].any()


def test_detect_asks_for_the_whole_target_inside_the_finest_ring():
    for offset, hits in (((0, 0), True), ((1, -1), True), ((2, 0), False), ((0, -40), False)):
        returns, facts = play(lambda state, t, o=offset: (np.ones(32), centres(state) + o), game="detect", steps=4)
        np.testing.assert_allclose(returns, 0.99 if hits else -1.01, atol=1e-6)
        np.testing.assert_allclose(facts["distance"], np.hypot(*offset), atol=1e-5)
        common = max(0, 14 - max(0, abs(offset[0]) - 1)) * max(0, 14 - max(0, abs(offset[1]) - 1))
        np.testing.assert_allclose(facts["overlap"], common / (14**2 + 16**2 - common), atol=1e-5)


def test_the_grid_of_detect_reaches_every_target():
    """From the middle of its cell, the finest ring holds a target wherever it lies in the cell."""
    config = compose(["experiment=detect_rings_p"])
    cells = np.array(config.env.frame_shape) // np.array(config.gaze.grid)
    boxes = scenes(game="detect").boxes[:, 0]
    middles = boxes[:, :2] // cells * cells + cells // 2
    ring = np.array(config.sensor.finest)
    first = middles - ring // 2
    assert ((boxes[:, :2] >= first) & (boxes[:, :2] + boxes[:, 2:] <= first + ring)).all()
    assert len(np.unique(boxes[:, :2] % cells, axis=0)) > 40  # of the 49 places in a cell


@pytest.mark.slow
def test_fixations_are_places_and_not_decisions():
    def policy(state, t):
        away = np.tile([[0, 0]], (32, 1))
        return np.where(state.time == 5, state.answer, 0), np.where((state.time < 3)[:, None], away, centres(state))

    _, facts = play(policy)
    assert (facts["decisions"] == 6).all() and (facts["fixations"] == 2).all() and (facts["on_target"] == 1).all()


def plates(state, episode: int) -> list[tuple[int, int]]:
    """Upper left pixels of the plates of a scene without noise or clutter, found by flood filling."""
    lit = state.scene[episode] != scenery.BACKGROUND
    found = []
    for cell_y in range(0, 160, scenery.CELL):
        for cell_x in range(0, 160, scenery.CELL):
            ys, xs = np.nonzero(lit[cell_y : cell_y + scenery.CELL, cell_x : cell_x + scenery.CELL])
            if len(ys):
                # A letter's black pixels may have the background's gray level, a plate's rim has not.
                assert (ys.max() - ys.min(), xs.max() - xs.min()) == (glyphs.PLATE - 1, glyphs.PLATE - 1)
                found.append((cell_y + int(ys.min()), cell_x + int(xs.min())))
    return found


@pytest.mark.parametrize("target", VARIANTS)
def test_letters_do_not_overlap_and_are_as_many_as_the_set_size(target):
    state = scenes(f"search.target={target}", "search.set_sizes=[1,4,8,16]", "search.absent=true")
    for episode in range(40):
        found = plates(state, episode)
        assert len(found) == state.set_size[episode]
        if state.targets[episode]:
            assert tuple(state.boxes[episode, 0, :2]) in found
    counts = np.bincount(state.set_size, minlength=17)[[1, 4, 8, 16]]
    assert counts.sum() == EPISODES and counts.min() > 25
    assert 0.38 < state.targets.mean() < 0.62


@pytest.mark.slow
def test_places_are_anywhere_in_the_frame():
    corners = scenes(episodes=2000).boxes[:, 0, :2]
    assert corners.min() == 0 and corners.max() == 146
    cells, counts = np.unique(corners // scenery.CELL, axis=0, return_counts=True)
    assert len(cells) == 64 and np.abs(counts - 2000 / 64).max() < 5 * np.sqrt(2000 / 64)
    assert set(np.unique(corners % scenery.CELL)) == set(range(7))


def letter_at(scene: np.ndarray, corner) -> tuple[str, int]:
    """Which letter is on a plate, and how it is turned: the mask that explains it best."""
    y, x = corner
    patch = scene[y : y + glyphs.PLATE, x : x + glyphs.PLATE].astype(float)
    carried = (patch - np.median(patch)) * glyphs.checkerboard()
    fits = np.abs((glyphs.masks() * carried).sum((2, 3))) / np.sqrt((glyphs.masks() ** 2).sum((2, 3)))
    letter, turns = np.unravel_index(fits.argmax(), fits.shape)
    return glyphs.LETTERS[letter], int(turns)


TURNS = {"left": 3, "right": 1, "up": 2, "down": 0}


@pytest.mark.slow
@pytest.mark.parametrize("target", VARIANTS)
@pytest.mark.parametrize("classes", [2, 4])
def test_the_target_points_where_the_answer_says_and_is_one_of_its_kind(target, classes):
    words = (f"search.target={target}", f"search.classes={classes}")
    state, names = scenes(*words), search.action_names(configured(*words))
    assert names == ("wait", "left", "right", "up", "down")[: classes + 1]
    for episode in range(40):
        corner = tuple(state.boxes[episode, 0, :2])
        letter, turns = letter_at(state.scene[episode], corner)
        assert turns == TURNS[names[state.answer[episode]]]
        others = [c for c in plates(state, episode) if c != corner]
        grays = {c: np.median(state.scene[episode][c[0] : c[0] + 14, c[1] : c[1] + 14]) for c in (corner, *others)}
        kinds = [letter_at(state.scene[episode], c)[0] for c in others]
        if target in ("letter", "feature"):
            assert letter == "T" and set(kinds) == {"L"}
        if target == "feature":
            assert grays[corner] > 180 and max(grays[c] for c in others) < 130
        if target == "conjunction":
            assert letter == "T" and grays[corner] > 180
            bright = [grays[c] > 180 for c in others]
            assert all(kind == ("L" if b else "T") for kind, b in zip(kinds, bright, strict=True))
        if target == "cued":
            assert letter not in kinds
            cue = (state.cue[episode] / 255.0)[None]
            assert np.abs(glyphs.masks()[:, 0] - cue).sum((1, 2)).argmin() == glyphs.LETTERS.index(letter)


@pytest.mark.slow
def test_answers_are_fair():
    for words, share in ((("search.classes=2",), 1 / 2), ((), 1 / 4)):
        answers = scenes(*words, episodes=2000).answer
        _, counts = np.unique(answers, return_counts=True)
        np.testing.assert_allclose(counts / 2000, share, atol=0.05)


def test_a_cued_episode_shows_the_cue_and_then_the_scene():
    task = search.search(configured("search.target=cued"))
    draw = jax.jit(task.draw)
    state = jax.jit(task.start)(jax.random.key(5))
    first = np.asarray(draw(state))
    assert (first[:70] == scenery.BACKGROUND).all() and (first[73:87, 73:87] > 200).any()
    after, reward, is_over = jax.jit(task.advance)(state, jnp.int32(0), jnp.array([80, 80]))
    np.testing.assert_array_equal(draw(after), state.scene)
    assert reward == np.float32(-0.01) and not is_over


@pytest.mark.slow
def test_noise_and_clutter_leave_the_letters_where_they_are():
    plain, busy = scenes(), scenes("search.noise=6", "search.clutter=9")
    assert np.abs(busy.scene.astype(float) - 32).mean() > np.abs(plain.scene.astype(float) - 32).mean()
    background = busy.scene[plain.scene == 32].astype(float)
    assert 5 < background[np.abs(background - 32) < 20].std() < 7
    with pytest.raises(
        ConfigError, match=r"search\.set_sizes=\[60\]: accepted is at most 64 letters and bars \(search.clutt"
    ):
        search.search(configured("search.set_sizes=[60]", "search.clutter=5"))


@pytest.mark.slow
def test_large_frames_have_the_same_rules():
    task = search.search(configured("env.frame_shape=[1080,1920]"))
    state = jax.jit(task.start)(jax.random.key(1))
    assert task.draw(state).shape == (1080, 1920)
    y, x = np.asarray(state.boxes[0, :2])
    assert letter_at(np.asarray(state.scene), (y, x))[0] == "T"


def views(block: int, samples: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Block means around a target that lies anywhere to the blocks, [samples, n], and which way it points."""
    task = search.search(configured("search.set_sizes=[1]", "search.classes=2"))
    keys = jax.random.split(jax.random.key(seed), samples)
    state = jax.tree.map(np.asarray, jax.jit(jax.vmap(task.start))(keys))
    padded = np.pad(state.scene.astype(float), ((0, 0), (12, 12), (12, 12)), constant_values=32)
    random = np.random.default_rng(seed)
    cut = []
    for scene, (y, x) in zip(padded, state.boxes[:, 0, :2] + 12, strict=True):
        dy, dx = random.integers(0, 4, 2)
        cut.append(scene[y - 4 - dy : y + 20 - dy, x - 4 - dx : x + 20 - dx])
    blocks = np.array(cut).reshape(samples, 24 // block, block, 24 // block, block).mean((2, 4))
    return blocks.reshape(samples, -1), state.answer - 1


@pytest.mark.slow
@pytest.mark.parametrize("block", [2, 4])
def test_block_means_tell_where_and_a_linear_classifier_not_what(block):
    (seen, answer), (unseen, truth) = views(block, 3000, 1), views(block, 3000, 2)
    x = np.column_stack([seen, np.ones(3000)])
    weights = np.linalg.lstsq(x, 2.0 * answer - 1, rcond=None)[0]
    right = ((np.column_stack([unseen, np.ones(3000)]) @ weights > 0) == truth).mean()
    assert abs(right - 0.5) < 0.04  # of 3,000 coins the deviation is 0.009


@pytest.mark.parametrize("block", [2, 4])
def test_a_letter_leaves_an_eighth_of_its_depth_in_block_means(block):
    """Each letter alone on its plate, at every place of the blocks: what is left of the checkerboard.

    Along one axis, smoothing by [1, 2, 1] / 4 and alternating signs leave [1, 1, -1, -1] / 4 of a block of two and
    [1, 1, 0, 0, -1, -1] / 4 of a block of four, which no ink makes larger than 1 / 2. Of two axes, half of the products
    have either sign: (1 / 2) ** 2 * 2 * block ** -2.
    """
    left = []
    for letter in glyphs.masks().reshape(-1, glyphs.PLATE, glyphs.PLATE):
        for dy in range(block):
            for dx in range(block):
                padded = np.zeros((20, 20))
                padded[dy : dy + 14, dx : dx + 14] = letter * glyphs.checkerboard()
                left.append(np.abs(padded.reshape(20 // block, block, 20 // block, block).mean((1, 3))).max())
    assert 0.01 < max(left) <= 0.5 * block**-2 + 1e-6


def test_the_staircase_goes_down_by_one_and_up_by_two():
    environment = make(configured("search.staircase=true", "search.set_sizes=[6]"), num_envs=2, seed=0)
    assert isinstance(environment, jax_envs.JaxEnvironment)
    environment.reset()
    levels = []
    for right in [True] * 7 + [False, False, True]:
        state = jax.tree.map(np.asarray, environment.get_state().task)
        levels.append(state.targets.tolist())
        assert [len(plates(state, i)) for i in range(2)] == [6, 6]
        assert ((state.boxes[..., 2] > 0).sum(1) == state.targets).all()
        # The second environment is always wrong.
        answer = np.where([right, False], state.answer, 1 + state.answer % 4)
        for action in (answer, np.zeros(2)):  # the step after an episode's end is nobody's
            environment.send(action.astype(np.int32), centres(state))
            environment.recv()
    assert [first for first, _ in levels] == [6, 5, 4, 3, 2, 1, 1, 1, 3, 5]
    assert {second for _, second in levels} == {6}


def test_a_scene_without_a_target_leaves_the_staircase_where_it_is():
    words = "search.staircase=true", "search.set_sizes=[6]", "search.absent=true"
    before = scenes(*words, episodes=40)
    before = before._replace(step=np.full(40, 4), right=np.arange(40) % 2 == 0)
    follow = search.search(configured(*words)).follow
    assert follow is not None
    after = jax.jit(jax.vmap(follow))(before, jax.random.split(jax.random.key(1), 40))
    expected = np.where(before.targets == 0, 4, np.where(before.right, 3, 6))
    np.testing.assert_array_equal(after.step, expected)
    assert set(expected.tolist()) == {3, 4, 6}


def test_environments_begin_the_same_episodes_together_and_alone():
    """`step_all` gives what `step` gives, at an episode's end too."""
    task = search.search(configured())
    keys = jax.random.split(jax.random.key(2), 6)
    state, _ = jax.jit(jax.vmap(functools.partial(jax_envs.reset, task)))(keys)
    together = jax.jit(functools.partial(jax_envs.step_all, task))
    alone = jax.jit(jax.vmap(functools.partial(jax_envs.step, task)))
    random = np.random.default_rng(0)
    for _ in range(8):
        action, point = jnp.asarray(random.integers(0, 3, 6), jnp.int32), jnp.asarray(random.integers(0, 160, (6, 2)))
        (state, timestep), (other, expected) = together(state, action, point), alone(state, action, point)
        jax.tree.map(np.testing.assert_array_equal, timestep, expected)
        np.testing.assert_array_equal(jax.random.key_data(state.key), jax.random.key_data(other.key))


@pytest.mark.slow
def test_a_saved_environment_goes_on_bit_for_bit():
    environment = make(configured("search.noise=4"), num_envs=5, seed=1)
    assert isinstance(environment, jax_envs.JaxEnvironment)
    environment.reset()
    random = np.random.default_rng(1)
    plan = [(random.integers(0, 3, 5).astype(np.int32), random.integers(0, 160, (5, 2))) for _ in range(12)]

    def go(part):
        seen = []
        for action, point in part:
            environment.send(action, point.astype(np.int32))
            seen.append(environment.recv())
        return seen

    go(plan[:5])
    saved = environment.get_state()
    first = go(plan[5:])
    environment.set_state(saved)
    jax.tree.map(np.testing.assert_array_equal, go(plan[5:]), first)


def test_who_is_told_no_focal_point_looks_at_the_centre():
    environment = made(configured())
    environment.reset()
    environment.send(np.zeros(32, np.int32))
    environment.recv()
    np.testing.assert_array_equal(environment.get_state().task.point, np.full((32, 2), 80))


def test_the_names_of_the_actions():
    assert action_names(configured()) == ("wait", "left", "right", "up", "down")
    assert action_names(configured("search.absent=true", game="detect")) == ("wait", "here", "absent")
