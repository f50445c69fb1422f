"""Exports a trained agent as a folder that runs without this package; `foajax export` calls it.

`agent.py`, `check.py`, `camera.py` and `node.py` are copied into that folder. They import nothing of this package.
"""
