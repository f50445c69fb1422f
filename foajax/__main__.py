"""Runs `foajax <command> [words]`, the same as `python -m foajax.<command> [words]`."""

from __future__ import annotations

import os
import runpy
import sys

from foajax.config.parse import refuse

COMMANDS = {
    "demo": "Lets a shipped agent play a game, to watch in a browser.",
    "train": "Trains one agent, or a sweep of them, or goes on training.",
    "evaluate": "Plays whole games with a trained agent and prints its scores.",
    "player": "Writes one game as a page to play, scrub and study.",
    "render": "Writes whole games as videos, and a heat map of where the agent looked.",
    "show": "Draws what a sensor sees of a game.",
    "report": "Writes curves, scores, heat maps and costs of a set of runs as one page.",
    "cost": "Measures what a decision costs, sensor by sensor.",
    "status": "Shows what every run below some directories is doing.",
    "reproduce": "Runs the paper's comparison, stage by stage.",
    "export": "Writes a folder that runs an agent without JAX and foajax.",
    "store": "Makes an agent to ship from a run.",
    "doctor": "Tells what is installed, which devices there are, and what is missing.",
    "keep": "Copies what others need to judge and repeat a run into results/runs/.",
}


def main() -> None:
    """Runs the command that the first word names, as `python -m foajax.<command>` does."""
    name, *words = sys.argv[1:] or ["--help"]
    if name in ("-h", "--help"):
        print("foajax <command> [key=value ...]; foajax <command> --help says what a command takes.\n")
        print("\n".join(f"  {command:9} {sentence}" for command, sentence in COMMANDS.items()))
        return
    if name not in COMMANDS:
        print(f"foajax: error: {refuse(name, accepted=COMMANDS, near=name)}", file=sys.stderr)
        raise SystemExit(2)
    sys.argv = [sys.argv[0], *words]
    sys.path.insert(0, os.getcwd())  # as `python -m` has it: parts of one's own may be here
    runpy.run_module(f"foajax.{name}", run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
