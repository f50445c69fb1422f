"""Plays whole Atari games with an exported agent, without JAX and foajax: `python robot_plays_atari.py robot/`.

It shows how to write a loop around `Agent.decide`, and needs `numpy onnxruntime ale-py`. Games go as in training. Each
action is held for four frames, of which the last two are seen, each pixel as bright as its brighter one. Up to 30
no-ops and FIRE begin a game. FIRE begins each further life, with memory and gaze reset.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from ale_py import Action, ALEInterface, LoggerMode, roms

FRAME_SKIP, NOOPS, MOST_STEPS = 4, 30, 27_000


def play(agent, emulator: ALEInterface, actions: list[Action], random: np.random.Generator) -> tuple[float, int]:
    """Plays one whole game; returns its unclipped score and its number of decisions."""
    emulator.reset_game()
    see = emulator.getScreenRGB if agent.facts["color"] else emulator.getScreenGrayscale
    screen, reward = begin(emulator, see, actions, int(random.integers(NOOPS + 1)))
    agent.reset()
    score, steps, lives = reward, 0, emulator.lives()
    reward = 0.0
    while not emulator.game_over() and steps < MOST_STEPS:
        natural, _ = agent.decide(screen, reward)
        screen, reward = step(emulator, see, actions[natural])
        score, steps = score + reward, steps + 1
        if emulator.lives() < lives and not emulator.game_over():
            screen, gained = begin(emulator, see, actions, 0)
            agent.reset()
            score, reward = score + gained, 0.0
        lives = emulator.lives()
    return score, steps


def begin(
    emulator: ALEInterface, see: Callable[[], np.ndarray], actions: list[Action], noops: int
) -> tuple[np.ndarray, float]:
    """Plays no-ops, a frame each, then FIRE if the game has it; returns the screen and what was earned meanwhile."""
    reward = float(sum(emulator.act(Action.NOOP) for _ in range(noops)))
    screen, gained = step(emulator, see, Action.FIRE if Action.FIRE in actions else Action.NOOP, frames=1)
    return screen, reward + gained


def step(
    emulator: ALEInterface, see: Callable[[], np.ndarray], action: Action, frames: int = FRAME_SKIP
) -> tuple[np.ndarray, float]:
    """Holds an action for some frames; returns the brighter pixels of the last two, and the reward."""
    screens, reward = [], 0.0
    for _ in range(frames):
        reward += emulator.act(action)
        screens.append(see())
        if emulator.game_over():
            break
    return np.maximum.reduce(screens[-2:]), reward


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", help="folder that foajax export wrote")
    parser.add_argument("--games", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--greedy", action="store_true")
    options = parser.parse_args()
    sys.path.insert(0, options.folder)
    from agent import Agent

    ALEInterface.setLoggerMode(LoggerMode.Error)
    agent = Agent(options.folder, seed=options.seed, greedy=options.greedy)
    actions = [Action[name.upper()] for name in agent.facts["actions"]]
    random, scores, begun = np.random.default_rng(options.seed), [], time.perf_counter()
    for game in range(options.games):
        emulator = ALEInterface()
        emulator.setFloat("repeat_action_probability", 0.0)
        emulator.setInt("random_seed", options.seed + game)
        emulator.loadROM(Path(roms.get_rom_path(agent.facts["game"])))
        score, steps = play(agent, emulator, actions, random)
        scores.append(score)
        print(f"game {game + 1}: {score:g} in {steps} decisions", flush=True)
    error = np.std(scores, ddof=1) / np.sqrt(len(scores)) if len(scores) > 1 else float("nan")
    seconds = round(time.perf_counter() - begun, 1)
    print(
        json.dumps({"games": len(scores), "mean": float(np.mean(scores)), "stderr": float(error), "seconds": seconds})
    )


if __name__ == "__main__":
    main()
