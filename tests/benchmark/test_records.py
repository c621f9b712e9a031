from __future__ import annotations

import pytest

pytest.importorskip("mujoco", reason="needs thinkgrasp[sim]")
pytest.importorskip("trimesh", reason="needs thinkgrasp[sim]")

from fakes.benchmark import episode, scene

from thinkgrasp.benchmark.records import RECORDS_FILE, EpisodeKey, EpisodeRecord, RecordLog, Records, read_records
from thinkgrasp.errors import ConfigError, InputError

FIRST, SECOND = EpisodeKey("offline", "clutter-09-pear", 1000), EpisodeKey("oracle", "clutter-09-pear", 1000)


def test_what_is_written_is_read_back(tmp_path):
    written = [scene("clutter-09-pear", 1000), *episode(FIRST), *episode(SECOND)]
    with RecordLog(tmp_path) as log:
        for record in written:
            log.add(record)
    assert list(read_records(tmp_path).all()) == written
    assert len((tmp_path / RECORDS_FILE).read_bytes().splitlines()) == len(written)


def test_each_record_is_on_the_disk_when_it_was_added(tmp_path):
    with RecordLog(tmp_path) as log:
        for n, record in enumerate(episode(FIRST), 1):
            log.add(record)
            assert len((tmp_path / RECORDS_FILE).read_bytes().splitlines()) == n


def test_an_unfinished_episode_is_started_anew(tmp_path):
    *steps, _ = episode(FIRST)
    with RecordLog(tmp_path) as log:
        for record in (*episode(SECOND), *steps):
            log.add(record)
    assert read_records(tmp_path).steps[FIRST] == steps
    with RecordLog(tmp_path) as log:
        assert FIRST not in log.records.steps
        for record in episode(FIRST):
            log.add(record)
    assert list(read_records(tmp_path).all()) == [*episode(SECOND), *episode(FIRST)]


@pytest.mark.parametrize("torn", [b'{"method":"offline","task"', b"\x00\xff"])
def test_a_torn_last_line_is_cut_off(tmp_path, torn):
    with RecordLog(tmp_path) as log:
        for record in episode(FIRST):
            log.add(record)
    path = tmp_path / RECORDS_FILE
    whole = path.read_bytes()
    path.write_bytes(whole + torn)
    assert list(read_records(tmp_path).all()) == episode(FIRST)
    with RecordLog(tmp_path):
        assert path.read_bytes() == whole


def test_forgetting_one_episode_leaves_the_other_unfinished_one(tmp_path):
    (*first, _), (*second, end) = episode(FIRST), episode(SECOND)
    with RecordLog(tmp_path) as log:
        for record in (*first, *second):
            log.add(record)
        log.forget(FIRST)
        log.add(end)
        for record in episode(FIRST):
            log.add(record)
    assert list(read_records(tmp_path).all()) == [*episode(SECOND), *episode(FIRST)]


def test_finished_episodes_can_be_dropped(tmp_path):
    with RecordLog(tmp_path) as log:
        for record in (*episode(FIRST), *episode(SECOND)):
            log.add(record)
    with RecordLog(tmp_path, drop=lambda e: e.method == "oracle") as log:
        assert list(log.records.all()) == episode(FIRST)


def test_one_process_writes(tmp_path):
    with RecordLog(tmp_path), pytest.raises(ConfigError, match="another benchmark is writing"):
        RecordLog(tmp_path)
    RecordLog(tmp_path).__exit__()


def test_nothing_is_taken_twice_or_out_of_order():
    first, *rest = episode(FIRST)
    with pytest.raises(InputError, match="step 1 of offline clutter-09-pear 1000 follows 1 steps"):
        Records([first, first])
    with pytest.raises(InputError, match="occurs twice"):
        Records([first, *rest, rest[-1]])
    with pytest.raises(InputError, match="scene clutter-09-pear 1000 occurs twice"):
        Records([scene("clutter-09-pear", 1000)] * 2)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b'{"kind":"episode"}\n', r"records.jsonl:1: is no record of a benchmark"),
        (b"hello\n", r"records.jsonl:1: is no record"),
        (b'{"kind":"dream"}\n', r"records.jsonl:1: is no record"),
    ],
)
def test_what_is_no_record_is_named(tmp_path, content, message):
    (tmp_path / RECORDS_FILE).write_bytes(content)
    with pytest.raises(InputError, match=message):
        read_records(tmp_path)


def test_a_folder_without_records_is_named(tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        read_records(tmp_path)


def test_a_wrong_delivery_is_another_thing_delivered_as_the_goal():
    steps = [s for s in episode(FIRST) if not isinstance(s, EpisodeRecord)]
    assert not any(s.is_wrong_delivery for s in steps)
    from dataclasses import replace

    assert replace(steps[0], delivered="mug", is_goal_delivered=False).is_wrong_delivery
    assert not replace(steps[0], delivered="mug", role="obstruction").is_wrong_delivery
