r"""Turns environments of other libraries into pixels with discrete actions, for foajax's own learner.

    cd examples
    foajax train game=gymnasium:pixels:MiniGrid env.kwargs.task=MiniGrid-Empty-8x8-v0 experiment=constant50_sub2_packed
    MUJOCO_GL=egl foajax train game=gymnasium:pixels:Camera env.kwargs.task=InvertedPendulum-v5
    foajax train game=gymnasium:pixels:Driving env.clip_rewards=false experiment=constant70_packed env.num_envs=8 \
        learner.num_minibatches=4 learner.warmup_updates=100 learner.value_weight=0.05 \
        learner.normalize_advantages=true

Driving is slow to emulate, so few environments and a short warm-up let the learner start early. Its returns are in
tens: a small `learner.value_weight` keeps errors of values from drowning the policy, and advantages are scaled down.
"""

from __future__ import annotations

import gymnasium
import numpy as np
from gymnasium.wrappers import AddRenderObservation, MaxAndSkipObservation, TransformAction


def minigrid(task: str = "MiniGrid-Empty-8x8-v0", tile_size: int = 10, **kwargs) -> gymnasium.Env:
    """Makes a MiniGrid task, seen from above in colour; `pip install minigrid`."""
    from minigrid.wrappers import ImgObsWrapper, RGBImgObsWrapper

    return ImgObsWrapper(RGBImgObsWrapper(gymnasium.make(task, **kwargs), tile_size=tile_size))


def camera(task: str = "InvertedPendulum-v5", size: int = 84, levels: int = 3, **kwargs) -> gymnasium.Env:
    """Makes a MuJoCo task as its camera sees it; `pip install "gymnasium[mujoco]"`.

    Action joint * levels + level drives one joint with one of `levels` forces, from its least to its greatest. All
    other joints get 0. Without a screen set MUJOCO_GL=egl, or osmesa.
    """
    env = AddRenderObservation(gymnasium.make(task, render_mode="rgb_array", width=size, height=size, **kwargs))
    low, high = env.action_space.low, env.action_space.high

    def drive(action: int) -> np.ndarray:
        joint, level = divmod(int(action), levels)
        forces = np.zeros_like(low)
        forces[joint] = low[joint] + (high[joint] - low[joint]) * level / (levels - 1)
        return forces

    return TransformAction(env, drive, gymnasium.spaces.Discrete(len(low) * levels))


def driving(skip: int = 4, **kwargs) -> gymnasium.Env:
    """Makes CarRacing with its five actions, each held for `skip` frames; `pip install "gymnasium[box2d]"`.

    Each frame costs 0.1 and a piece of track earns about 3: the signs of rewards would hide what driving is worth.
    """
    return MaxAndSkipObservation(gymnasium.make("CarRacing-v3", continuous=False, **kwargs), skip)


gymnasium.register("MiniGrid", minigrid)
gymnasium.register("Camera", camera)
gymnasium.register("Driving", driving)
