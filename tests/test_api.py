"""What `import foajax` offers."""

import signal
import threading

import numpy as np
import pytest

import foajax
from foajax.launch.signals import STOPS, StopRequest
from foajax.sensors import compiled


@pytest.mark.parametrize("name", foajax.__all__)
def test_every_public_name_is_there_and_says_what_it_is(name):
    assert (getattr(foajax, name).__doc__ or "").strip()
    with pytest.raises(AttributeError, match="no attribute 'sensse'"):
        foajax.sensse  # noqa: B018


def test_sense_is_compiled_once_for_a_sensor_and_a_shape():
    before = compiled._sense._cache_size()
    frame = np.zeros((40, 50, 3), np.uint8)
    for y in range(3):  # equal sensors are the same
        sensor = foajax.RingSensor(rings=((6, 6, 1), (18, 18, 3)), layout="packed")
        images = foajax.sense(frame, np.array([20 + y, 20]), sensor=sensor)
    assert [image.shape for image in images] == [(6, 6, 3), (6, 6, 3)]
    assert compiled._sense._cache_size() == before + 1
    whole = foajax.picture(images, np.array([20, 20]), sensor=sensor, frame_shape=(40, 50))
    assert whole.shape == (40, 50, 3)


def test_a_closed_terminal_is_heard_of_unless_it_is_ignored():
    former = signal.getsignal(signal.SIGHUP)
    try:
        for handler, ends in ((signal.SIG_DFL, "SIGHUP"), (signal.SIG_IGN, None)):  # the second as under nohup
            signal.signal(signal.SIGHUP, handler)
            with StopRequest() as stop:
                signal.raise_signal(signal.SIGHUP)
                assert stop.name == ends
            assert signal.getsignal(signal.SIGHUP) == handler
    finally:
        signal.signal(signal.SIGHUP, former)


def test_another_thread_asks_for_no_signals_and_the_main_one_gives_them_back():
    former, found = [signal.getsignal(number) for number in STOPS], []

    def handlers():
        with StopRequest() as stop:
            found.append((stop.name, [signal.getsignal(number) for number in STOPS]))

    thread = threading.Thread(target=handlers)
    thread.start()
    thread.join()
    assert found == [(None, former)]
    with StopRequest() as stop:
        signal.raise_signal(signal.SIGTERM)
        assert stop.name == "SIGTERM"
    assert [signal.getsignal(number) for number in STOPS] == former
