"""A trained agent as a folder that runs without this package: `python -m foajax.export` writes it.

`agent.py`, `camera.py` and `node.py` are copied into that folder as they are. They import nothing of this package.
"""
