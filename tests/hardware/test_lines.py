"""The codec of the wire protocol: round trips, damage, and the vectors of its description."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from knode_cosserat_hardware.driver import HardwareError
from knode_cosserat_hardware.lines import (
    STATES,
    Answer,
    Banner,
    FaultNotice,
    LineSplitter,
    Refusal,
    Remark,
    Telemetry,
    crc16,
    decode,
    decode_framed,
    decode_plain,
    encode_framed,
    encode_plain,
    encode_tensions,
    is_newer,
)
from tests.hardware.fake_board import encode_message

numbers = st.integers(0, 65535)
words = st.text("abcdefghijklmnopqrstuvwxyz0123456789-_.", min_size=1, max_size=12)
faults = st.builds("{}:{}".format, st.sampled_from(["slack", "over-tension", "watchdog"]), st.integers(0, 16))
values = st.lists(st.integers(-99999, 99999), min_size=4, max_size=4).map(tuple)
plain_telemetry = st.tuples(values, values, st.integers(0, 999)).map(lambda parts: Telemetry(*parts))
telemetry = st.builds(
    Telemetry,
    values,
    values,
    st.integers(0, 999),
    numbers,
    numbers,
    st.sampled_from(STATES),
    st.just("") | faults,
)
messages = (
    telemetry
    | st.builds(Answer, numbers, words, st.lists(words, max_size=6).map(tuple))
    | st.builds(Refusal, numbers, words)
    | st.builds(FaultNotice, faults)
    | st.builds(Banner, words, st.integers(0, 999), st.integers(0, 99))
)


@pytest.mark.parametrize(("data", "crc"), [(b"123456789", 0x29B1), (b"", 0xFFFF), (b"A", 0xB915)])
def test_the_checksum_is_that_of_the_protocol(data, crc):
    assert crc16(data) == crc


@given(messages)
def test_framed_messages_are_read_as_written(message):
    line = encode_message(message, True)
    assert line.endswith(b"\n") and decode_framed(line[:-1]) == decode(line[:-1]) == message


@given(plain_telemetry | st.builds(FaultNotice, faults) | st.builds(Refusal, st.just(0), words))
def test_plain_messages_are_read_as_written(message):
    assert decode_plain(encode_message(message, False)[:-1]) == message


def test_lines_of_the_description():
    assert decode_plain(b"# knode-tension 1.0.0 protocol 2 tendons 4") == Banner("1.0.0", 2, 4)
    assert decode_plain(b"# taring") == Remark("taring")
    assert decode_plain(b"! range") == Refusal(0, "range")
    assert decode_plain(b"! fault slack:2") == FaultNotice("slack:2")
    assert decode_plain(b"1,2,3,4,-5,6,7,255,20") == Telemetry((1, 2, 3, 4), (-5, 6, 7, 255), 20)
    assert encode_tensions([100, 0, 2300, 7]) == b"100 0 2300 7\n"
    body = b"7 tension 1 2 3 4"
    assert encode_framed(7, "tension", 1, 2, 3, 4) == body + f"*{crc16(body):04X}\n".encode()


@given(messages, st.data())
def test_a_changed_byte_is_found(message, data):
    line = bytearray(encode_message(message, True)[:-1])
    if isinstance(message, Banner):
        return
    place = data.draw(st.integers(0, len(line) - 1))
    line[place] ^= data.draw(st.integers(1, 255))
    found = decode_framed(bytes(line))
    # a line that begins with # is a remark, which has no effect
    assert found is None or isinstance(found, Remark)


@given(st.binary(max_size=300))
def test_any_bytes_are_read_without_an_error(data):
    for reader in (decode, decode_plain, decode_framed):
        reader(data)
    LineSplitter().feed(data)


@given(
    st.lists(messages, max_size=5),
    st.lists(st.integers(0, 400), max_size=5),
    st.sampled_from([b"\n", b"\r\n"]),
)
def test_lines_are_the_same_however_they_arrive(sent, cuts, ending):
    data = b"".join(encode_message(message, True)[:-1] + ending for message in sent)
    splitter, lines, start = LineSplitter(), [], 0
    for cut in [*sorted(cuts), len(data)]:
        lines += splitter.feed(data[start:cut])
        start = max(start, min(cut, len(data)))
    assert [decode_framed(line) for line in lines] == sent


def test_a_long_line_is_dropped_and_the_next_is_read():
    splitter = LineSplitter()
    assert splitter.feed(b"x" * 5000) == [] and splitter.feed(b"y" * 5000 + b"\nstop") == []
    assert splitter.feed(b"\n") == [b"stop"]


@given(numbers, numbers)
def test_numbers_wrap(number, other):
    signed = (number - other + 32768) % 65536 - 32768
    assert is_newer(number, other) == (signed > 0)


@pytest.mark.parametrize(
    "call",
    [
        lambda: encode_framed(65536, "keep"),
        lambda: encode_framed(1, "two words"),
        lambda: encode_framed(1, "star*"),
        lambda: encode_framed(1, "get", "näme"),
        lambda: encode_framed(1, "set", "x" * 40, "y" * 40),
        lambda: encode_plain("stop\nstop"),
        lambda: encode_tensions([-1, 0, 0, 0]),
    ],
)
def test_what_no_line_can_hold_is_refused(call):
    with pytest.raises(HardwareError, match="must be") as caught:
        call()
    assert "\n" not in str(caught.value)
