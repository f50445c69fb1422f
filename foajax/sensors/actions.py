"""Joins what to do and where to look into one action, in the form that a library takes."""

from __future__ import annotations

from typing import Any, Literal, get_args

import numpy as np
from gymnasium import spaces

from foajax.config.parse import brief, refuse

Form = Literal["dict", "tuple", "multidiscrete"]


def joint_space(form: Form, natural: spaces.Space, num_vision: int) -> spaces.Space:
    """Returns the space of one environment's joint actions.

    - 'dict': {"natural": the environment's own, "vision": 0 .. num_vision - 1}
    - 'tuple': (natural, vision)
    - 'multidiscrete': integers [natural, vision], or [..., vision] where the own action has several numbers

    Raises `ConfigError` for another form, or 'multidiscrete' where the environment's own actions are not discrete.
    """
    vision = spaces.Discrete(num_vision)
    if form == "dict":
        return spaces.Dict({"natural": natural, "vision": vision})
    if form == "tuple":
        return spaces.Tuple((natural, vision))
    if form != "multidiscrete":
        raise refuse("actions", form, get_args(Form))
    if isinstance(natural, spaces.Discrete):
        return spaces.MultiDiscrete([natural.n, num_vision], start=[natural.start, 0])
    if isinstance(natural, spaces.MultiDiscrete) and natural.nvec.ndim == 1:
        return spaces.MultiDiscrete([*natural.nvec, num_vision], start=[*natural.start, 0])
    raise refuse("actions", form, f"dict or tuple where the environment's own actions are {brief(natural)}")


def split(form: Form, action: Any, natural: spaces.Space, num_vision: int, batch: tuple[int, ...]) -> tuple[Any, Any]:
    """Splits actions into the environment's own and visual ones, int32 of shape `batch`; `ConfigError` for others."""
    own, vision = _parts(form, action, natural, batch)
    vision = np.asarray(vision)
    known = vision.shape == batch and np.issubdtype(vision.dtype, np.integer)
    if not known or (vision < 0).any() or (vision >= num_vision).any():
        accepted = f"integers {list(batch)}" if batch else "an integer"
        raise refuse("vision", vision, f"{accepted} from 0 to {num_vision - 1}")
    return own, vision.astype(np.int32)


def _parts(form: Form, action: Any, natural: spaces.Space, batch: tuple[int, ...]) -> tuple[Any, Any]:
    if form == "dict":
        if not (isinstance(action, dict) and action.keys() == {"natural", "vision"}):
            raise refuse("action", action, '{"natural": ..., "vision": ...}')
        return action["natural"], action["vision"]
    if form == "tuple":
        if not (isinstance(action, tuple) and len(action) == 2):
            raise refuse("action", action, "(natural, vision)")
        return action
    size = 2 if isinstance(natural, spaces.Discrete) else len(natural.nvec) + 1  # type: ignore[attr-defined]
    array = np.asarray(action)
    if array.shape != (*batch, size) or not np.issubdtype(array.dtype, np.integer):
        raise refuse("action", action, f"integers {[*batch, size]}, natural before vision")
    return array[..., 0] if isinstance(natural, spaces.Discrete) else array[..., :-1], array[..., -1]
