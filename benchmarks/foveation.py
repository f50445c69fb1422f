"""How long does sensing take: per sensor, on large frames, and against OpenCV?

    python benchmarks/foveation.py [out=results.json]

Prints the device and median times. Frames are float32 in the device's memory, and results stay there. Calls that are
compared take turns, so that other load slows all alike. Run it on an idle machine.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from foajax import cli, runtime
from foajax.config.compose import compose
from foajax.config.schema import LogPolarSensor, RingSensor, SensorConfig
from foajax.reporting import bench, cost
from foajax.sensors.sense import sense
from foajax.viewing.sheet import PAPER

TABLE_II = {name: compose([f"experiment={name}"]).sensor for name in PAPER}
CONSTANT70_PACKED = RingSensor(((70, 70, 2),), layout="packed")
REPEATS = 200


def sensors() -> dict[str, SensorConfig]:
    """Makes every sensor of Table II, on the canvas and packed, and the log-polar ones."""
    packed = {
        f"{name} packed": RingSensor(s.rings, peripheral=s.peripheral, layout="packed") for name, s in TABLE_II.items()
    }
    logpolar = {f"logpolar {s}": LogPolarSensor(sampling=s) for s in ("area", "bilinear")}
    return {**{f"{name} canvas": s for name, s in TABLE_II.items()}, **packed, **logpolar}


def batch(size: int, shape: tuple[int, int] = (80, 80)) -> tuple[np.ndarray, np.ndarray]:
    """Makes random frames, and focal points at which a 70x70 area lies inside 80x80."""
    rng = np.random.default_rng(0)
    return rng.normal(size=(size, *shape)).astype(np.float32), rng.integers(35, 46, (size, 2)).astype(np.int32)


def sensing(sensor: SensorConfig, frames: np.ndarray, points: np.ndarray) -> Callable[[], tuple[jax.Array, ...]]:
    """Makes a compiled call on arrays in the device's memory, vmapped if there is a batch."""
    run = functools.partial(sense, sensor=sensor, bounds="window")
    compiled = jax.jit(jax.vmap(run) if frames.ndim == 3 else run)
    inputs = jnp.asarray(frames), jnp.asarray(points)
    return lambda: jax.block_until_ready(compiled(*inputs))


def per_sensor() -> dict[str, float]:
    """Times sensing 32 frames of 80x80, in microseconds."""
    calls = {}
    frames, points = batch(32)
    for name, sensor in sensors().items():
        centred = np.full_like(points, 40)
        inside = points if sensor.window is not None and sensor.window[0] <= 70 else centred
        calls[name] = sensing(sensor, frames, inside)
    (results,) = cost.medians([calls], REPEATS)
    for name, median in results.items():
        print(f"  {name:24} {median:8.0f} us")
    return results


def large_frame() -> dict[str, float]:
    """Times one small and one large frame with the same sensor, in microseconds."""
    calls = {}
    for height, width in ((80, 80), (1080, 1920)):
        frames, _ = batch(1, (height, width))
        middle = np.array([height // 2, width // 2], np.int32)
        calls[f"{height}x{width}"] = sensing(CONSTANT70_PACKED, frames[0], middle)
    (results,) = cost.medians([calls], REPEATS)
    small, large = results.values()
    print(f"  80x80 {small:8.1f} us    1080x1920 {large:8.1f} us    ratio {large / small:.2f}")
    return results | {"ratio": large / small}


def against_opencv() -> dict[str, float] | None:
    """Times the 35x35 views of 256 frames against a loop over OpenCV's resize, in microseconds."""
    try:
        import cv2
    except ImportError:
        print("  left out: OpenCV is not installed")
        return None
    print(f"  OpenCV {cv2.__version__}, {cv2.getNumThreads()} threads")
    frames, points = batch(256)
    out = np.empty((256, 35, 35), np.float32)

    def loop() -> np.ndarray:
        for index, (y, x) in enumerate(points):
            window = frames[index, y - 35 : y + 35, x - 35 : x + 35]
            out[index] = cv2.resize(window, (35, 35), interpolation=cv2.INTER_AREA)
        return out

    ours = sensing(CONSTANT70_PACKED, frames, points)
    np.testing.assert_allclose(ours()[0][..., 0], loop(), atol=1e-5)
    (results,) = cost.medians([{"foajax": ours, "opencv": loop}], REPEATS)
    sensed, looped = results.values()
    print(f"  foajax {sensed:8.0f} us    OpenCV {looped:8.0f} us    {looped / sensed:.1f} times faster")
    return results | {"speedup": looped / sensed}


def main(arguments: Sequence[str]) -> None:
    options = cli.parse(bench.Options, arguments)
    runtime.wait_in_place()
    results: dict[str, object] = {"device": jax.devices()[0].device_kind}
    print(f"device {results['device']}")
    print("Sensing 32 frames of 80x80")
    results["batch32_us"] = per_sensor()
    print("One frame, constant70 packed")
    results["large_frame_us"] = large_frame()
    print("256 frames, constant70 packed, against a loop of OpenCV crop and resize")
    results["opencv_us"] = against_opencv()
    if options.out:
        bench.write("out", options.out, results, ["python", "benchmarks/foveation.py", *arguments])


if __name__ == "__main__":
    sys.exit(cli.run(main))
