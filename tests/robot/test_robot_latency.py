"""`cost target=onnx`: a record for each experiment, of the folders that export writes."""

from __future__ import annotations

import json
import sys

import pytest

from foajax import cli, cost
from foajax.config.compose import compose
from foajax.config.parse import ConfigError

latency = pytest.importorskip("foajax.robot.latency", reason="needs the extra robot")
pytest.importorskip("onnxruntime", reason="needs the extra robot")


@pytest.mark.slow
def test_a_record_for_each_experiment(tmp_path, capsys):
    file = tmp_path / "cost.json"
    words = ["target=onnx", "experiments=constant50_sub2_packed", "repeats=3", f"json={file}", "dtype=float16"]
    assert cli.run(cost.cost, words) == 0
    assert "energy est." in capsys.readouterr().out
    small, whole = json.loads(file.read_text())["results"]
    assert (small["experiment"], whole["experiment"]) == ("constant50_sub2_packed", "nonfoa")
    for record in (small, whole):
        assert record["dtype"] == "float16"
        for part in latency.PARTS:
            assert 0 < record[f"{part}_us"] <= record[f"{part}_us_p99"]
        assert 40 < record["memory_mb"] < 200
        assert 0 < record["start_s"] < 60
    assert whole["screen_ratio"] == 1
    assert small["bytes"] < whole["bytes"] < 3.5e6
    assert small["screen_energy_estimate_uj"] < whole["screen_energy_estimate_uj"]


def test_energy_is_of_operations_and_bytes():
    assert latency.energy(10**6, 0, 0) == pytest.approx(2.3e-6)
    assert latency.energy(0, 10**6, 10**6) == pytest.approx(320e-6)


def test_other_frames_and_missing_packages_are_one_line(monkeypatch, capsys):
    config = compose(["experiment=nonfoa", "env.frame_shape=[60,60]", "sensor.rings=[[60,60,1]]"])
    with pytest.raises(ConfigError, match=r"accepted is experiments with env.frame_shape=\[80,80\]"):
        latency._measure([config], "float32", 1)
    monkeypatch.setitem(sys.modules, "foajax.robot.latency", None)
    monkeypatch.delattr("foajax.robot.latency", raising=False)
    assert cli.run(cost.cost, ["target=onnx", "experiments=nonfoa"]) == 2
    assert "is missing (pip install 'foajax[robot]')" in capsys.readouterr().err
