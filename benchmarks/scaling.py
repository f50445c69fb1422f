"""What does a second process give, and what does adding up gradients cost?

    python benchmarks/scaling.py [part=weak] [game=pong] [seconds=20] [out=weak.json]
    python benchmarks/scaling.py [part=allreduce] [out=allreduce.json]
    python benchmarks/scaling.py [part=model]

`weak`: training with a process per core, pinned to it, and `envs` environments per process. Measured are one process;
two that share a run; and two separate runs, which show how far a second busy core slows the machine. Speeds are
env_steps per second once everything is compiled, from the third logged row on. Efficiency is the speed of two
processes over twice that of one.

`allreduce`: medians of the time to sum a vector, by the number of parameters: over virtual devices of one process
(threads, through memory), and over two processes (gloo on the loopback address).

`model`: computes what bounds bigger machines from `Assumptions`, each of which says where it comes from.

Without two cores to pin processes to (macOS pins none), `weak` and `allreduce` are left out. Run it on an idle machine.
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any, Literal

from pydantic import Field

from foajax import cli
from foajax.config.compose import compose
from foajax.config.parse import ConfigError, to_mapping
from foajax.envs.make import make
from foajax.reporting import bench

SIZES = (100_000, 1_000_000, 10_000_000)  # parameters, float32
DEVICES = (2, 4, 8)
MINIBATCHES = 4


class Options(bench.Options):
    part: Literal["all", "weak", "allreduce", "model", "member"] = Field(
        "all", description="What to measure; member is one process of allreduce."
    )
    game: str = Field("pong", description="The game.")
    experiment: str = Field("constant70_packed", description="The experiment.")
    envs: int = Field(16, ge=1, multiple_of=MINIBATCHES, description="Environments of each process.")
    seconds: float = Field(20.0, description="Seconds that a speed is measured over.")
    devices: int = Field(1, description="For part=member: how many processes there are.")
    coordinator: str = Field("", description="For part=member: address of the first one.")
    process: int = Field(0, description="For part=member: number of this one.")


@dataclasses.dataclass(frozen=True)
class Assumptions:
    """What `model` assumes, in seconds, bytes and operations."""

    emulator: float = 700e-6  # core-seconds an env_step takes EnvPool (600 to 800 measured on this kind of core)
    decision: float = 7.3e6  # floating-point operations of a decision, constant70_packed (results/bench)
    learning: float = 3.0  # times a decision's operations: forward, and twice as much backward
    parameters: float = 1.0e6  # exchanged for each minibatch, float32
    screen: float = 210 * 160  # bytes of a frame on its way to the device
    rollout: int = 20
    minibatches: int = 8
    gpu: float = 10e12  # operations a second that a GPU sustains on such small networks: assumed, not measured
    deciding: float = 0.95e-3  # of `act` on a GPU, whatever the batch: 1.0 ms at 32, 1.5 at 256 measured on an H200
    updating: float = 3.2e-3  # of `update`, likewise: 3.4 ms for 80 steps, 3.2 for 640
    bus: float = 20e9  # bytes a second from host to GPU: assumed, and in line with that H200
    link: float = 100e9  # bytes a second between the GPUs of a host: assumed
    network: float = 12.5e9  # bytes a second between hosts, 100 Gbit/s: assumed
    delay: float = 20e-6  # of a message between hosts: assumed


def start(
    arguments: Sequence[str], *, core: int | None = None, out: IO[str] | int = subprocess.PIPE, **variables: str
) -> subprocess.Popen:
    """Starts a Python process, pinned to a core if one is given."""
    pin = [] if core is None else ["taskset", "-c", str(core)]
    environment = os.environ | {"JAX_PLATFORMS": "cpu"} | variables
    return subprocess.Popen(
        [*pin, sys.executable, *arguments], env=environment, stdout=out, stderr=subprocess.STDOUT, text=True
    )


def free_address() -> str:
    """Finds an address at which the first process of several can listen."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        return f"127.0.0.1:{server.getsockname()[1]}"


def training(options: Options, run: Path, processes: int, process: int, address: str) -> list[str]:
    """Makes the command line of one process of a run; each has the same work, whatever their number."""
    words = [f"game={options.game}", f"experiment={options.experiment}", f"run={run}", "env.threads=1"]
    words += [f"env.num_envs={options.envs * processes}", "learner=a2c", f"learner.num_minibatches={MINIBATCHES}"]
    words += ["train.log_every=0.5", "train.env_steps=100000000", "train.checkpoint_every=1000"]
    if processes > 1:
        shared = {"coordinator": address, "processes": processes, "process": process}
        words += [f"distributed.{key}={value}" for key, value in shared.items()]
    return words


def rows(run: Path) -> list[dict[str, Any]]:
    """Reads the rows that a run has logged so far."""
    file = run / "metrics.jsonl"
    return [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []


def speed(run: Path, processes: Sequence[subprocess.Popen], seconds: float) -> float:
    """Measures env_steps per second from the third row on, for `seconds`; then ends the processes."""
    try:
        while len(logged := rows(run)) < 4 or logged[-1]["time"] - logged[2]["time"] < seconds:
            for process in processes:
                if process.poll() is not None:
                    ended = f"foajax.train ended with exit code {process.returncode}"
                    raise ConfigError(f"part=weak: {ended}; its output above says why")
            time.sleep(0.2)
    finally:
        for process in processes:
            process.kill()
            process.wait()
    first, last = logged[2], logged[-1]
    return (last["env_steps"] - first["env_steps"]) / (last["time"] - first["time"])


def weak(options: Options, cores: Sequence[int]) -> dict[str, Any]:
    """Measures the speeds of one process, of two that share a run, and of two runs at a time."""
    # Raises what training would refuse once, and before it starts.
    config = compose(training(options, Path("run"), 1, 0, ""))
    make(config, num_envs=1, seed=0).close()
    with tempfile.TemporaryDirectory() as temporary:
        directory = Path(temporary)

        def measure(name: str, processes: int, beside: int = 0) -> float:
            address = free_address()
            words = [training(options, directory / name, processes, i, address) for i in range(processes)]
            words += [training(options, directory / f"{name}-beside", 1, 0, "")] * beside
            # Not to a pipe, which would fill up as nobody reads it.
            started = [
                start(["-m", "foajax.train", *w], core=core, out=sys.stderr)
                for core, w in zip(cores, words, strict=False)
            ]
            return speed(directory / name, started, options.seconds)

        one = measure("one", 1)
        two = measure("two", 2)
        beside = measure("beside", 1, beside=1)
    return {
        "one process": one,
        "two processes": two,
        "efficiency": two / (2 * one),
        "one of two separate runs": beside,
        "efficiency against separate runs": two / (2 * beside),
    }


def allreduce(cores: Sequence[int]) -> dict[str, Any]:
    """Measures microseconds of a sum, by devices and parameters."""
    found: dict[str, Any] = {}
    for devices in DEVICES:
        process = start([__file__, "part=member", f"devices={devices}"], JAX_NUM_CPU_DEVICES=str(devices))
        found[f"{devices} virtual devices"] = answer(process)
    address = free_address()
    words = [[__file__, "part=member", f"coordinator={address}", f"process={i}"] for i in (0, 1)]
    members = [start(w, core=core) for core, w in zip(cores, words, strict=True)]
    try:
        # One that fails leaves the other waiting.
        while any(m.poll() is None for m in members) and not any(m.poll() for m in members):
            time.sleep(0.1)
        members.sort(key=lambda m: not m.returncode)  # it is asked first
        found["2 processes"] = [answer(m) for m in members][0]
    finally:
        for m in members:
            m.kill()
    return found


def answer(process: subprocess.Popen) -> dict[str, float]:
    """Waits for a process of `allreduce`; returns what it has found."""
    lines = process.communicate()[0].splitlines() or [""]
    if process.returncode:
        ended = f"a process ended with exit code {process.returncode}"
        raise ConfigError(f"part=allreduce: {ended} ({lines[-1]})")
    return json.loads(lines[-1])


def member(options: Options) -> dict[str, float]:
    """Runs one process of `allreduce`; returns median microseconds by the number of parameters."""
    import jax
    import numpy as np
    from jax.sharding import Mesh, PartitionSpec

    if options.coordinator:
        jax.distributed.initialize(
            options.coordinator, num_processes=2, process_id=options.process, cluster_detection_method="deactivate"
        )
    mesh = Mesh(np.array(jax.devices()), ("data",))
    everywhere = PartitionSpec()
    add = jax.jit(
        jax.shard_map(
            lambda x: jax.lax.psum(x, "data") / mesh.size,
            mesh=mesh, in_specs=everywhere, out_specs=everywhere, check_vma=False,
        )
    )  # fmt: skip
    medians = {}
    for size in SIZES:
        place = jax.sharding.NamedSharding(mesh, everywhere)
        x = jax.make_array_from_process_local_data(place, np.ones(size, np.float32), (size,))
        times = []
        for _ in range(max(10, 60_000_000 // size // mesh.size)):
            begin = time.perf_counter()
            x = jax.block_until_ready(add(x))
            times.append((time.perf_counter() - begin) * 1e6)
        medians[str(size)] = statistics.median(times[2:])
    return medians


def rollout_seconds(a: Assumptions, *, hosts: int, gpus: int, cores: int, envs: int) -> dict[str, float]:
    """Computes seconds of a rollout by part; `gpus`, `cores` and `envs` are per host."""
    steps = a.rollout * envs  # of a host
    devices, size = hosts * gpus, 4 * a.parameters
    # A ring sends each parameter twice; between hosts the sum also waits for messages, there and back up a tree.
    inside = 2 * size * (gpus - 1) / gpus / a.link
    between = 2 * size * (hosts - 1) / hosts / a.network + 2 * math.ceil(math.log2(hosts)) * a.delay
    return {
        "emulators": steps * a.emulator / cores,
        "acting": a.rollout * a.deciding + steps / gpus * (a.decision / a.gpu + a.screen / a.bus),
        "learning": a.minibatches * a.updating + steps / gpus * a.learning * a.decision / a.gpu,
        "exchange": a.minibatches * (inside + between) if devices > 1 else 0.0,
    }


def model() -> dict[str, Any]:
    """Computes env_steps per second and the share of each part for the machines in docs/log/2026-11-25-scaling.md."""
    machines = {
        "1 host, 8 GPUs, 256 cores, 2048 environments": {"hosts": 1, "gpus": 8, "cores": 256, "envs": 2048},
        "1 host, 8 GPUs, 256 cores, 8192 environments": {"hosts": 1, "gpus": 8, "cores": 256, "envs": 8192},
        "100 such hosts, 2048 environments each": {"hosts": 100, "gpus": 8, "cores": 256, "envs": 2048},
        "100 such hosts, 256 environments each": {"hosts": 100, "gpus": 8, "cores": 256, "envs": 256},
    }
    found = {}
    for name, machine in machines.items():
        seconds = rollout_seconds(Assumptions(), **machine)
        total, steps = sum(seconds.values()), Assumptions.rollout * machine["envs"] * machine["hosts"]
        shares = {f"{part}, %": round(100 * second / total, 1) for part, second in seconds.items()}
        found[name] = {"env_steps a second": round(steps / total), **shares}
    return found


def main(arguments: Sequence[str]) -> None:
    options = cli.parse(Options, arguments)
    if options.part == "member":
        try:
            print(json.dumps(member(options)), flush=True)
        except Exception as error:
            print(" ".join(str(error).split()), flush=True)
            os._exit(1)  # an orderly end would wait for the other one
        return
    result: dict[str, Any] = {"options": to_mapping(options)}
    cores = sorted(os.sched_getaffinity(0))[:2] if hasattr(os, "sched_getaffinity") else []
    if len(cores) < 2 and options.part != "model":
        print("left out: weak and allreduce, which need two cores to pin processes to", file=sys.stderr)
    if len(cores) == 2 and options.part in ("all", "weak"):
        result["env_steps a second"] = weak(options, cores)
    if len(cores) == 2 and options.part in ("all", "allreduce"):
        result["microseconds by parameters"] = allreduce(cores)
    if options.part in ("all", "model"):
        result["model"] = model()
    print(json.dumps(result, indent=1))
    if options.out:
        bench.write("out", options.out, result, ["python", "benchmarks/scaling.py", *arguments])


if __name__ == "__main__":
    sys.exit(cli.run(main))
