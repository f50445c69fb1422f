"""How a run's arrays lie on several devices: environments along one axis, everything else on all of them.

The programs are written for one device. With a `Layout` each device runs them on its share of the environments
(`jax.shard_map`), and `learner.update` adds the shares up along the axis `DATA`, whose name it is given.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array

from foajax.types import Rollout

DATA = "data"  # the mesh's only axis

EVERYWHERE = PartitionSpec()
BATCH = PartitionSpec(DATA)  # the leading axis is that of the environments
ROLLOUT: Any = Rollout(steps=cast(Any, PartitionSpec(None, DATA)), core_state=cast(Any, BATCH))


class Layout:
    """The devices of all processes, in the order of the environments, and those of this one.

    Acting needs no other process: its arrays lie on `local`. The update's lie on `job`. Changing from one to the other
    copies nothing: the pieces stay where they are.
    """

    def __init__(self, job: Sequence[jax.Device], local: Sequence[jax.Device]) -> None:
        self.job = Mesh(np.array(job), (DATA,))
        self.local = Mesh(np.array(local), (DATA,))

    def replicate(self, tree: Any) -> Any:
        """Copies host arrays, the same in every process, to all devices."""
        place = NamedSharding(self.job, EVERYWHERE)
        return jax.tree.map(lambda x: jax.make_array_from_process_local_data(place, np.asarray(x), np.shape(x)), tree)

    def nearby(self, tree: Any) -> Any:
        """Returns replicated arrays as arrays on this process's devices alone."""
        return jax.tree.map(lambda x: self._regroup(x, self.local, EVERYWHERE, x.shape), tree)

    def join(self, rollout: Rollout) -> Rollout:
        """Joins the processes' rollouts into one."""
        return Rollout(
            steps=jax.tree.map(lambda x: self._join(x, ROLLOUT.steps), rollout.steps),
            core_state=jax.tree.map(lambda x: self._join(x, ROLLOUT.core_state), rollout.core_state),
        )

    def _join(self, x: Array, spec: PartitionSpec) -> Array:
        axis = tuple(spec).index(DATA)
        whole = x.shape[axis] // self.local.size * self.job.size
        return self._regroup(x, self.job, spec, (*x.shape[:axis], whole, *x.shape[axis + 1 :]))

    def _regroup(self, x: Array, mesh: Mesh, spec: PartitionSpec, shape: tuple[int, ...]) -> Array:
        if self.job == self.local:
            return x
        pieces = [piece.data for piece in x.addressable_shards]
        return jax.make_array_from_single_device_arrays(shape, NamedSharding(mesh, spec), pieces)
