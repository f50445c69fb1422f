"""Learns what to do and where to look with stable-baselines3's PPO.

    pip install -e . stable-baselines3          # in a checkout of foajax
    python stable_baselines3_ppo.py ALE/Pong-v5 --steps 1000000

PPO gives both actions as one `MultiDiscrete`, [natural, visual]. `VecNormalize` scales each value of an image by its
own mean and deviation, or a small ball would hardly show. `MultiInputPolicy` would flatten such images, and its own
network needs 36x36 pixels at least. So `Features` reads them instead.
"""

from __future__ import annotations

import argparse

import ale_py
import gymnasium
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.atari_wrappers import AtariWrapper
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

import foajax

gymnasium.register_envs(ale_py)


def see(env: gymnasium.Env, sensor: str) -> gymnasium.Env:
    """Shows the last four frames of an Atari game through a sensor. Lives are episodes, and rewards are signs."""
    env = gymnasium.wrappers.FrameStackObservation(AtariWrapper(env), 4)  # PPO has no memory
    return foajax.FoveatedObservation(env, sensor, actions="multidiscrete")


class Features(BaseFeaturesExtractor):
    """Two small convolutions per image [h, w, c], then a dense layer on their features and the focal point."""

    def __init__(self, observation_space: gymnasium.spaces.Dict) -> None:
        super().__init__(observation_space, features_dim=256)
        self.images = nn.ModuleDict()
        width = 2  # of the focal point
        for name, space in observation_space.items():
            if name == "focal_point":
                continue
            height_width, channels = space.shape[:2], space.shape[2]
            layers = [nn.Conv2d(channels, 32, 4, 2), nn.ReLU(), nn.Conv2d(32, 32, 3, 2), nn.ReLU()]
            self.images[name] = nn.Sequential(*(layers if min(height_width) >= 10 else []), nn.Flatten())
            with torch.no_grad():
                width += self.images[name](torch.zeros(1, channels, *height_width)).shape[1]
        self.dense = nn.Sequential(nn.Linear(width, self.features_dim), nn.ReLU())

    def forward(self, observation: dict[str, torch.Tensor]) -> torch.Tensor:
        parts = [network(observation[name].permute(0, 3, 1, 2)) for name, network in self.images.items()]
        return self.dense(torch.cat([*parts, observation["focal_point"]], dim=1))


def train(game: str, sensor: str, steps: int, num_envs: int, seed: int = 0) -> PPO:
    """Trains a model for `steps`, of all environments together."""
    emulator = {"frameskip": 1, "repeat_action_probability": 0.0}
    kwargs = {"env_kwargs": emulator, "wrapper_class": see, "wrapper_kwargs": {"sensor": sensor}}
    envs = make_vec_env(game, num_envs, seed=seed, **kwargs)  # scores are of whole games, from before the wrapper
    images = [name for name in envs.observation_space if name != "focal_point"]
    envs = VecNormalize(envs, norm_reward=False, norm_obs_keys=images)
    model = PPO(
        "MultiInputPolicy",
        envs,
        n_steps=128,
        batch_size=256,
        n_epochs=4,
        clip_range=0.1,
        ent_coef=0.01,
        learning_rate=2.5e-4,
        policy_kwargs={"features_extractor_class": Features, "net_arch": []},
        seed=seed,
        verbose=1,
    )
    return model.learn(steps)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("game", nargs="?", default="ALE/Pong-v5")
    parser.add_argument("--sensor", default="constant70_packed")
    parser.add_argument("--steps", type=int, default=1_000_000)
    parser.add_argument("--num-envs", type=int, default=8)
    options = parser.parse_args()
    model = train(options.game, options.sensor, options.steps, options.num_envs)
    model.save("foajax_ppo")
    model.get_vec_normalize_env().save("foajax_ppo.pkl")  # means and deviations, which playing needs too
