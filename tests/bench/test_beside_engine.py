"""Worlds as the engine of 2023 takes them: its recorded numbers, from our fields. The engine itself is not needed."""

from __future__ import annotations

import numpy as np

from tests.bench.beside_engine import numbers
from tests.recordings import read_recording
from tests.semantics.test_second_recordings import RECORDINGS, compiled

CHANNELS = ("velocity", "custom1", "custom2", "custom3")


def test_numbers_are_those_of_the_recordings() -> None:
    runner, used = compiled("powderworld2_defects", "reference"), set()
    for recording in map(read_recording, RECORDINGS):
        state = recording.states[0]
        found = numbers({name: np.asarray(value) for name, value in runner.world(state).state.items()})
        assert (found["gravity"] == (state["gravity"] == 1)).all()  # 2 is a sum of a defect
        for name in CHANNELS:
            assert np.allclose(found[name], state[name], rtol=0, atol=1e-6), name
            used |= {name} if state[name].any() else set()
    assert used == set(CHANNELS)
