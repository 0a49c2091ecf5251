# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests time stamps: the rate computed from them, and the detection of clock columns."""

import re

import numpy as np
import pytest

from torchrl_koap.data.formats.clocks import Clock, find_rate, rises_evenly, time_stamps, told_rate

TIME = np.arange(60) / 30


def clock(*times):
    return Clock("time", times, [f"{index}.csv" for index in range(len(times))])


def test_the_usual_step_is_the_rate():
    problems: list[str] = []
    assert find_rate(clock(TIME, TIME[:5]), None, problems) == pytest.approx(30) and not problems
    assert find_rate(clock(TIME), 29.97, problems) == 29.97 and not problems


@pytest.mark.parametrize(
    ("name", "rate"), [("timestamp_ms", 0.5), ("time_s", 0.1), ("stamp_us", 5000.0), ("Time [s]", 0.5)]
)
def test_slow_and_fast_clocks_are_read_if_their_name_gives_the_unit(name, rate):
    problems: list[str] = []
    assert find_rate(Clock(name, [TIME * 30 / rate], ["0.csv"]), None, problems) == pytest.approx(rate) and not problems


@pytest.mark.parametrize(
    ("times", "declared", "message"),
    [
        (TIME * 1e3, None, "gives 0.03 frames per second if it is in seconds: name it time_s if it is, time_ms"),
        (-TIME, None, r"do not increase, or are missing, in column 'time' of 1 of 2 .*: 1.csv \(frame 1\)"),
        (
            np.where(TIME == TIME[5], np.nan, TIME),
            None,
            r"are missing, in column 'time' of 1 of 2 .*: 1.csv \(frame 5\)",
        ),
        (np.r_[TIME, 9.0], None, r"1.csv: frames are 0.03333 to 7.033 s apart \(frame 59\); .* pass resample .* 30"),
        (np.insert(TIME, 9, 0.29), None, r"1.csv: frames are 0.01 to 0.03333 s apart"),
        (TIME, 20, "gives 30 frames per second, the source declares 20: pass control_hz"),
        (TIME, 40, "gives 30 frames per second, the source declares 40"),
    ],
)
def test_impossible_time_stamps_are_named(times, declared, message):
    problems: list[str] = []
    scale = 1e3 if times[-1] > 99 else 1
    find_rate(clock(TIME * scale, times), declared, problems)
    assert re.search(message, problems[0])


def test_stamps_of_another_unit_may_be_too_fast_for_seconds():
    problems: list[str] = []
    assert find_rate(clock(TIME / 1e3), None, problems) is None
    assert problems[0].startswith("column 'time' gives 3e+04 frames per second if it is in seconds: name it time_s if")


def test_parts_of_seconds_are_added_to_whole_ones_alone():
    whole, part = np.arange(3.0), np.array([0, 0.5, 0.25])
    both = [{"s": whole, "ns": part}, {"s": whole + 4, "ns": part}]
    assert {name: np.stack(times).tolist() for name, times in time_stamps(both).items()} == {
        "s": [[0, 1.5, 2.25], [4, 5.5, 6.25]]
    }
    for other in ({"s": whole / 2, "ns": part}, {"s": whole, "ns": part + 1}, {"s": whole, "ns": part - 1}):
        assert list(time_stamps([both[0], other])) == ["s", "ns"]


def test_messages_on_the_rate_of_regular_and_irregular_time_stamps():
    assert told_rate(clock(TIME), 20) == " (it says 30 frames per second)"
    assert told_rate(clock(TIME), 31) == ""
    assert told_rate(clock(TIME, 2 * TIME[:9]), 30) == " (its frames are 1 to 2 usual steps apart)"
    microseconds = 1e6 * np.delete(TIME, 5)
    assert told_rate(clock(microseconds), 30) == " (its frames are 1 to 2 usual steps apart)"
    assert told_rate(clock(0 * TIME), 20) == " (its time stamps are ignored)"


@pytest.mark.parametrize("clock", [TIME, TIME.astype(np.float32), TIME.round(3), np.arange(60, dtype=np.uint8)])
def test_clocks_rise_evenly(clock):
    assert rises_evenly([clock, clock[:9]])
    assert not rises_evenly([clock, -1.0 * clock]) and not rises_evenly([np.sin(clock)])
    assert rises_evenly([clock[:21]]) and not rises_evenly([clock[:20]])  # twenty steps
    assert not rises_evenly([np.sort(np.r_[clock, 0.5 * clock[1]])])


@pytest.mark.parametrize("rate", [30, 60, 120])
def test_a_clock_in_whole_milliseconds_gives_the_rate_of_its_frames(rate):
    stamps = np.round(1000 * np.arange(121) / rate) / 1000
    assert find_rate(Clock("time_ms", [stamps], ["a"]), None, []) == pytest.approx(rate, rel=2e-3)
