"""`foajax export`: a folder that runs and checks itself where neither JAX nor foajax can be imported."""

from __future__ import annotations

import dataclasses
import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from foajax import cli, export
from foajax.config.parse import ConfigError, replace
from foajax.envs.base import first_step
from foajax.robot import golden
from foajax.runs.agents import save_agent

folder = pytest.importorskip("foajax.robot.folder", reason="needs the extra robot")
pytest.importorskip("onnxruntime", reason="needs the extra robot")

ROOT = Path(__file__).resolve().parent.parent.parent
# Runs a script of the folder with JAX, foajax and all that it brings out of reach.
ALONE = """
import runpy, sys
class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("foajax", "jax", "jaxlib", "flax", "jaxtyping", "onnx", *sys.argv[3:]):
            raise ImportError(name + " is out of reach")
sys.meta_path.insert(0, Missing())
script, words = sys.argv[1:3]
sys.argv = [script, *words.split()]
sys.path.insert(0, script.rpartition("/")[0])
runpy.run_path(script, run_name="__main__")
"""


def run_alone(script, words, *missing):
    """Runs a file of an exported folder; `missing` are further packages that it has to do without."""
    command = [sys.executable, "-c", ALONE, str(script), words, *missing]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, cwd="/")


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """The folder of a trained agent."""
    out = tmp_path_factory.mktemp("exported") / "robot"
    assert cli.run(export.export, [f"run={ROOT}/agents/pong-constant70_p_packed", f"out={out}"]) == 0
    return out


def test_the_folder_is_small_and_says_where_it_comes_from(exported):
    names = {file.name for file in exported.iterdir()}
    assert names == {"policy.onnx", "arrays.npz", "golden.npz", "agent.json", *folder.CODE}
    assert sum(file.stat().st_size for file in exported.iterdir()) < 6e6
    facts = json.loads((exported / "agent.json").read_text())
    assert facts["actions"] == ["noop", "fire", "right", "left", "rightfire", "leftfire"]
    assert set(facts["files"]) == names - {"agent.json"}
    provenance = facts["provenance"]
    shipped = json.loads((ROOT / "agents/pong-constant70_p_packed/agent.json").read_text())
    assert provenance["env_steps"] == shipped["env_steps"] and provenance["score"] == shipped["score"]
    assert provenance["command"][:2] == ["foajax", "export"]


def test_the_recorded_steps_are_of_the_game(exported):
    with np.load(exported / "golden.npz") as arrays:
        assert arrays["frame"].shape == (golden.STEPS, 210, 160)
        assert np.flatnonzero(arrays["is_first"]).tolist() == [0, golden.STEPS // 2]
        assert len(np.unique(arrays["frame"], axis=0)) > 100  # something moves
        assert len(np.unique(arrays["natural_action"])) > 1


@pytest.mark.parametrize("missing", [[], ["cv2"]], ids=["with OpenCV", "with NumPy and ONNX Runtime alone"])
def test_it_checks_itself_without_jax_and_foajax(missing, exported):
    ended = run_alone(exported / "agent.py", "--check", *missing)
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout.startswith("200 steps: 100.0% of the actions as recorded, logits within")
    assert ended.stderr == ""


@pytest.mark.slow
def test_an_agent_of_colours_is_exported_and_checks_itself(make_stored, tmp_path):
    stored = make_stored("experiment=constant70_p_packed", "env.color=true")
    said = folder.write(stored, tmp_path / "robot", source="x", with_stablehlo=True)
    assert said.startswith("200 steps: 100.0% of the actions as recorded")
    with np.load(tmp_path / "robot" / "golden.npz") as arrays:
        assert arrays["frame"].shape == (golden.STEPS, 210, 160, 3)


def test_the_code_is_short():
    for name in folder.CODE:
        text = (Path(folder.__file__).parent / name).read_text()
        assert len(text.splitlines()) < 300
        assert "import foajax" not in text
        assert "from foajax" not in text


def copy_with(exported, directory, **changed):
    """The folder again, with other recorded steps, whose checksum is right."""
    directory.mkdir()
    for file in exported.iterdir():
        (directory / file.name).write_bytes(file.read_bytes())
    with np.load(exported / "golden.npz") as arrays:
        np.savez(directory / "golden.npz", **(dict(arrays) | changed))
    facts = json.loads((directory / "agent.json").read_text())
    facts["files"]["golden.npz"] = folder.digest(directory / "golden.npz")
    (directory / "agent.json").write_text(json.dumps(facts))
    return directory


@pytest.mark.parametrize(
    "name, change, message",
    [
        ("natural_logits", 1e-3, "step 50: natural logits differ by 1.0e-03; accepted is 0.0001"),
        ("vision_logits", np.nan, "vision logits differ by nan"),
        ("focal_point", 1, "step 50: focal point is"),
        ("natural_action", 1, "step 50: actions are"),
        ("vision_action", 1, "step 50: actions are"),
        ("frame_1", 3, "image_1: its frame differs by"),
    ],
)
def test_the_check_finds_what_differs(name, change, message, exported, tmp_path):
    with np.load(exported / "golden.npz") as arrays:
        array = arrays[name]
    array[50] = array[50] + np.array(change).astype(array.dtype)
    ended = run_alone(copy_with(exported, tmp_path / "copy", **{name: array}) / "agent.py", "--check")
    assert ended.returncode == 1
    assert message in ended.stderr
    assert len(ended.stderr.splitlines()) == 1


def test_the_check_tells_of_changed_files(exported, tmp_path):
    changed = copy_with(exported, tmp_path / "copy")
    (changed / "node.py").write_text("# of one's own\n")
    ended = run_alone(changed / "agent.py", "--check")
    assert ended.returncode == 0
    assert ended.stderr == "check: warning: node.py has been changed since the export\n"
    (changed / "golden.npz").write_bytes(b"")
    ended = run_alone(changed / "agent.py", "--check")
    assert (ended.returncode, len(ended.stderr.splitlines())) == (1, 1)
    (changed / "golden.npz").unlink()
    ended = run_alone(changed / "agent.py", "--check")
    assert (ended.returncode, len(ended.stderr.splitlines())) == (1, 1)


def test_a_command_line_that_asks_for_nothing_says_what_it_takes(exported):
    ended = run_alone(exported / "agent.py", "--chekc")
    assert (ended.returncode, ended.stderr) == (1, "check: error: --chekc: accepted is --check\n")


def recorded(stored):
    """Steps of a game that never was, for exports that are to fail."""
    shape = (2, 210, 160)
    return {
        "frame": np.zeros(shape, np.uint8),
        "reward": np.zeros(2, np.float32),
        "is_first": np.array([True, False]),
        "focal_point": np.full((2, 2), 40),
        "natural_action": np.full(2, 1),
        "vision_action": np.zeros(2, int),
        "natural_logits": np.full((2, 4), 5.0, np.float32),
    }


def test_nothing_is_written_where_the_check_fails(make_stored, tmp_path, monkeypatch):
    monkeypatch.setattr(golden, "record", recorded)
    with pytest.raises(
        ConfigError, match=r"the folder's own check fails \(.*logits differ by .*\); nothing is written"
    ):
        folder.write(make_stored("experiment=nonfoa"), tmp_path / "robot", source="x")
    assert not list(tmp_path.iterdir())


def test_what_a_user_keeps_there_is_left_alone(make_stored, tmp_path, monkeypatch):
    monkeypatch.setattr(golden, "record", recorded)
    monkeypatch.setattr(folder, "run_check", lambda path: "well")
    out, stored = tmp_path / "robot", make_stored("experiment=nonfoa")
    out.mkdir()
    assert folder.write(stored, out, source="x") == "well"
    (out / "my_robot.py").write_text("# mine")
    (out / "agent.py").write_text("# changed")
    folder.write(stored, out, source="x")  # once more, over itself
    assert (out / "my_robot.py").read_text() == "# mine"
    assert "class Agent" in (out / "agent.py").read_text()


def test_an_earlier_agents_program_is_removed_and_one_that_is_written_has_a_checksum(
    make_stored, tmp_path, monkeypatch
):
    monkeypatch.setattr(golden, "record", recorded)
    monkeypatch.setattr(folder, "run_check", lambda path: "well")
    monkeypatch.setattr(folder.stablehlo, "serialise", lambda stored: b"program")
    monkeypatch.setattr(folder.stablehlo, "check", lambda program, recorded, agent: 0.0)
    out, stored = tmp_path / "robot", make_stored("experiment=nonfoa")
    program = out / "decide.stablehlo"
    said = folder.write(stored, out, source="x", with_stablehlo=True)
    assert said == "well; decide.stablehlo: logits within 0.0e+00" and program.read_bytes() == b"program"
    assert json.loads((out / "agent.json").read_text())["files"][program.name] == folder.digest(program)
    folder.write(stored, out, source="x")
    assert not program.exists() and program.name not in json.loads((out / "agent.json").read_text())["files"]


def test_the_directory_that_one_is_in_is_written_too(make_stored, tmp_path, monkeypatch):
    monkeypatch.setattr(golden, "record", recorded)
    monkeypatch.setattr(folder, "run_check", lambda path: "well")
    out, stored = tmp_path / "robot", make_stored("experiment=nonfoa")
    out.mkdir()
    monkeypatch.chdir(out)
    assert folder.write(stored, Path("."), source="x") == "well"
    assert (out / "agent.json").exists() and list(tmp_path.iterdir()) == [out]
    assert all(file.is_file() for file in out.iterdir())


class Watched:
    """An environment whose rules depend on the gaze; it keeps the focal points that it is told."""

    num_envs, num_actions, crop_top, lives, reads_gaze = golden.GAMES, 4, 34, None, True

    def __init__(self):
        self.told = []

    def reset(self):
        return first_step(np.zeros((golden.GAMES, 210, 160), np.uint8))

    recv = reset

    def send(self, action, focal_point):
        self.told.append(focal_point)

    def render(self):
        return np.zeros((golden.GAMES, 210, 160, 3), np.uint8)

    def close(self):
        pass


def test_a_game_that_depends_on_the_gaze_is_told_where_the_recorded_agent_looks(make_stored, monkeypatch):
    game, stored = Watched(), make_stored("experiment=constant50_sub2_packed", "gaze.start=random")
    monkeypatch.setattr(golden.games, "environment", lambda stored, **options: game)
    points = golden.record(stored)["focal_point"]
    assert len(np.unique(points, axis=0)) > 10
    np.testing.assert_array_equal(np.concatenate(np.stack(game.told, axis=1)), points)


@pytest.mark.parametrize("kind", ["file", "directory of something else", "run", "shipped agent"])
def test_no_export_over_something_else(kind, make_stored, tmp_path):
    out, stored = tmp_path / "out", make_stored("experiment=nonfoa")
    if kind == "file":
        out.write_text("x")
    elif kind == "shipped agent":
        save_agent(stored, out)
    else:
        out.mkdir()
        (out / ("run.json" if kind == "run" else "thesis.tex")).write_text("x")
    with pytest.raises(ConfigError, match="accepted is a new directory, or one that export has written"):
        folder.write(stored, out, source="x")


def test_a_directory_that_cannot_be_written_is_one_line(make_stored, tmp_path, monkeypatch):
    monkeypatch.setattr(golden, "record", recorded)
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="accepted is a directory that can be written"):
        folder.write(make_stored("experiment=nonfoa"), tmp_path / "file" / "robot", source="x")


def test_what_is_not_installed_is_one_line(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    assert cli.run(export.export, ["run=agents/breakout-nonfoa", "out=robot"]) == 2
    assert "is missing (pip install 'foajax[robot]')" in capsys.readouterr().err


def test_a_sensor_from_elsewhere_is_refused(make_stored, tmp_path, monkeypatch):
    text = "from foajax.sensors.base import Sensor\nclass Mine(Sensor):\n    window = (4, 4)\n"
    (tmp_path / "my_sensors.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    stored = make_stored("experiment=nonfoa")
    config = replace(stored.agent.config, sensor={"kind": "my_sensors:Mine"})
    agent = dataclasses.replace(stored.agent, config=config)
    with pytest.raises(ConfigError, match="sensor.kind=my_sensors:Mine: cannot be exported; accepted is one of"):
        folder.write(dataclasses.replace(stored, agent=agent), tmp_path / "robot", source="agent")


def test_statistics_that_have_seen_nothing_are_the_frames_own(untrained):
    from foajax.config.compose import compose
    from foajax.learning.agent import Agent

    stored = untrained(Agent(compose(["experiment=nonfoa"]), 4, 34))
    assert folder.facts(stored)["normalisation"] == "frame"
    arrays = folder.arrays(stored.agent, stored.statistics)
    assert not arrays["mean"].any()
    assert (arrays["weight_0"] == 1).all()


def test_the_page_shows_a_program_that_runs(exported, monkeypatch):
    page = (ROOT / "docs" / "robot.md").read_text()
    (block,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    monkeypatch.chdir(exported.parent)
    names = {"frame": np.zeros((210, 160), np.uint8)}
    exec(block, names)
    assert names["agent"].age == 0
    assert names["natural"] in range(6)
