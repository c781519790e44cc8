"""Parts of recordings, and several in one, have the same samples as before."""

from collections import deque
from pathlib import Path

import msgspec
import pytest

import r2p
from r2p.messages import ClockOffset
from r2p.msg import Led
from r2p.recording.bag import Bag
from r2p.recording.editing import ChannelSelection, Edited, cut, merge
from r2p.recording.writer import BagWriter
from tests.recording.checker import check
from tests.recording.making import MS, T0, Samples, damage, led, leds, of, plain, read, write


def at(number: int) -> int:
    """When the LED of this number was received."""
    return T0 + (number + 1) * MS


def edited(
    path: Path, start: int | None = None, end: int | None = None, *, keep_latched: bool = False
) -> tuple[Path, Edited]:
    out = path.parent / "out.mcap"
    with Bag(path) as bag:
        (done,) = deque(cut(bag, out, start=start, end=end, keep_latched=keep_latched), maxlen=1)
    check(out)
    return out, done


def test_whole_chunks_are_copied_and_those_at_the_ends_read(tmp_path: Path) -> None:
    samples = leds(100)
    out, done = edited(write(tmp_path / "drive.mcap", samples), at(20), at(71))
    assert read(out) == of(samples[19:70])
    with Bag(tmp_path / "drive.mcap") as bag, Bag(out) as part:
        inside = [chunk for chunk in bag.files[0].summary.chunks if chunk.start >= at(20) and chunk.end < at(71)]
        assert done.copied_chunks == len(inside) > 5
        assert part.metadata == bag.metadata
        assert list(part.attachments()) == list(bag.attachments())


def test_a_damaged_chunk_is_not_copied(tmp_path: Path) -> None:
    path = damage(write(tmp_path / "drive.mcap", leds(100)), 3)
    out, done = edited(path)
    assert done.unreadable == 1
    with Bag(path) as bag, Bag(out) as part:
        assert done.copied_chunks == len(part.files[0].summary.chunks) == len(bag.files[0].summary.chunks) - 1
        assert plain(part) == plain(bag)
        assert (len(plain(part)), part.damaged) == (sum(part.topics.values()), 0)


def test_a_cut_may_keep_latched_messages_before_it(tmp_path: Path) -> None:
    samples = [("leds", led(1, source="BASE"), Led, T0), *leds(30), ("other", led(40), Led, at(21))]
    samples.sort(key=lambda each: each[3])
    path = write(tmp_path / "drive.mcap", samples, latched=["leds"])
    out, _ = edited(path, at(20), at(22), keep_latched=True)
    before = [("leds", samples[0][1], at(20)), ("leds", samples[19][1], at(20))]
    assert read(out) == [*before, *of(samples[20:23])]


def test_parts_become_one_file(tmp_path: Path) -> None:
    samples = [*leds(20), *leds(20, 21, source="BASE")]
    (tmp_path / "parts").mkdir()
    write(tmp_path / "parts" / "drive-0001.mcap", samples[:20])
    write(tmp_path / "parts" / "drive-0002.mcap", samples[20:])  # whose channels have the ids of others
    with Bag(tmp_path / "parts") as bag:
        deque(cut(bag, tmp_path / "out.mcap"), maxlen=0)
    check(tmp_path / "out.mcap")
    assert read(tmp_path / "out.mcap") == of(samples)


def test_topics_are_selected_by_name_or_pattern(tmp_path: Path) -> None:
    samples: Samples = [
        (topic, led(i), Led, at(i)) for i, topic in enumerate(["camera/left", "camera/right", "leds", "camera/left"])
    ]
    path = write(tmp_path / "drive.mcap", samples, chunk_size=1 << 16)
    select = ChannelSelection(["camera/*", "/nothing"], ["*right"])
    with Bag(path) as bag:
        assert select.unmatched(bag.channels) == ["/nothing"]
        deque(cut(bag, tmp_path / "out.mcap", wanted=select), maxlen=0)
        with Bag(tmp_path / "out.mcap") as part:
            assert plain(part) == [of(samples)[0], of(samples)[3]]
            assert part.topics == {"camera/left": 2}


def test_recordings_are_merged_in_the_order_of_corrected_time(tmp_path: Path) -> None:
    samples = leds(20)
    clock = ClockOffset(3, 5 * MS, 0)
    late: Samples = [("base", msgspec.structs.replace(each, clock=clock), Led, time) for _, each, _, time in leds(20)]
    write(tmp_path / "robot.mcap", samples)
    write(tmp_path / "laptop.mcap", late)
    with Bag(tmp_path / "robot.mcap") as one, Bag(tmp_path / "laptop.mcap") as two:
        deque(merge([(one, 0), (two, -MS // 2)], tmp_path / "out.mcap"), maxlen=0)
    check(tmp_path / "out.mcap")
    merged = read(tmp_path / "out.mcap")
    assert [topic for topic, _, _ in merged] == ["base", "leds"] * 20
    assert merged[1::2] == of(samples)
    assert merged[::2] == [
        (
            topic,
            msgspec.structs.replace(
                sample,
                stamp=sample.stamp - MS // 2,
                deadline=sample.deadline and sample.deadline - MS // 2,
                clock=ClockOffset(3, 5 * MS - MS // 2, 0),
            ),
            time - MS // 2,
        )
        for topic, sample, time in of(late)
    ]
    with Bag(tmp_path / "out.mcap") as bag:
        assert [each.name for each in bag.attachments()] == ["r2p.toml"]


def test_attachments_with_other_contents_are_all_kept(tmp_path: Path) -> None:
    write(tmp_path / "robot.mcap", leds(1))
    write(tmp_path / "laptop.mcap", leds(1), settings=b"via = ['tcp:robot']")
    with Bag(tmp_path / "robot.mcap") as one, Bag(tmp_path / "laptop.mcap") as two:
        deque(merge([(one, 0), (two, 0)], tmp_path / "out.mcap"), maxlen=0)
    with Bag(tmp_path / "out.mcap") as bag:
        attached = {each.name: each.data for each in bag.attachments()}
    assert attached == {"r2p.toml": b"via = []", "laptop/r2p.toml": b"via = ['tcp:robot']"}


def test_what_is_not_finished_leaves_no_file(tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    with Bag(write(tmp_path / "drive.mcap", leds(30))) as bag:
        steps = cut(bag, out)
        next(steps)
        assert out.exists()
        steps.close()
        assert not out.exists()
        out.write_text("mine")
        with pytest.raises(r2p.BagError, match="is there already, and is not overwritten"):
            next(cut(bag, out))
    assert out.read_text() == "mine"


def test_a_companion_may_be_in_the_part_before_that_of_its_message(tmp_path: Path) -> None:
    samples = leds(9)
    with Bag(write(tmp_path / "drive.mcap", samples)) as bag:
        records, (whole,) = list(bag.raw()), bag.files
        behind_companion = [each.channel.kind for each in records].index("meta") + 1
        for number, part in enumerate((records[:behind_companion], records[behind_companion:])):
            with (tmp_path / f"part-{number}.mcap").open("wb") as file:
                writer = BagWriter(file)
                for record in whole.summary.channels.values():
                    writer.copy_channel(record, whole.summary.schemas[record.schema_id])
                ids = {channel: number for number, channel in whole.channels.items()}
                for each in part:
                    writer.add(ids[each.channel], each.log_time, each.publish_time, each.sequence, each.data)
                writer.finish()
    with Bag(tmp_path / "part.mcap") as bag:
        assert plain(bag) == of(samples)


def test_a_cut_without_messages_is_a_bag(tmp_path: Path) -> None:
    out, _ = edited(write(tmp_path / "drive.mcap", leds(9)), at(20), at(30))
    with Bag(out) as bag:
        assert (bag.start, bag.end, bag.topics, bag.problems, plain(bag)) == (0, 0, {"leds": 0}, [], [])
