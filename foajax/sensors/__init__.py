"""From screens to what an agent sees: frames, gaze, foveated sensors and their pictures."""
