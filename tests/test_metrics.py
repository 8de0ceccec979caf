"""Sinks of metrics, and the stopwatch behind the times among them."""

import errno
import json
from pathlib import Path

import pytest
from tensorboardX.event_file_writer import EventsWriter
from tensorboardX.proto.event_pb2 import Event, SessionLog

from cassie_mjx.training.loggers import JsonLines, Stopwatch, TensorBoard


def test_json_lines_forget_a_lost_future(tmp_path):
    path = tmp_path / "metrics.jsonl"
    path.write_text('{"train/samples": 10}\n{"train/samples": 20}\n{"train/samples": 30}\n{"train/sam')
    JsonLines(path, samples=20).write({"train/samples": 25, "x": 0.5})
    assert [json.loads(line) for line in path.read_text().splitlines()] == [
        {"train/samples": 10},
        {"train/samples": 20},
        {"train/samples": 25, "x": 0.5},
    ]


def test_tensorboard_reads_the_curves_and_where_a_lost_future_begins(tmp_path):
    TensorBoard(tmp_path / "board", samples=20).write({"train/samples": 25, "x": 0.5})
    (path,) = (tmp_path / "board").glob("events.out.tfevents.*")
    content, events = path.read_bytes(), []
    # TFRecord: length [8], its checksum [4], the event, its checksum [4].
    while content:
        length = int.from_bytes(content[:8], "little")
        events.append(Event.FromString(content[12 : 12 + length]))
        content = content[16 + length :]
    _version, start, *points = events
    assert (start.step, start.session_log.status) == (21, SessionLog.START)
    assert [(e.step, e.summary.value[0].tag, e.summary.value[0].simple_value) for e in points] == [
        (25, "train/samples", 25),
        (25, "x", 0.5),
    ]


@pytest.mark.parametrize(("sink", "call"), [(JsonLines, (Path, "open")), (TensorBoard, (EventsWriter, "flush"))])
def test_a_full_disk_is_one_sentence(tmp_path, monkeypatch, sink, call):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    opened = sink(tmp_path / "sink", samples=0)
    monkeypatch.setattr(*call, full)
    with pytest.raises(OSError, match=r"sink could not be written \(No space left on device\).$"):
        opened.write({"train/samples": 25})


def test_a_stopwatch_counts_lap_by_lap():
    watch = Stopwatch()
    double = watch.timed("double", lambda x: 2 * x)
    assert double(3) == 6
    assert watch.since_last()["double"] > 0
    assert watch.since_last() == {}
