"""Packets of a map that grows: the receiver's map is the sender's, whatever happens in between."""

import numpy as np
import pytest
import torch
from small_maps import same_map, wall

from lardhm_torch import (
    LardHilbertMap,
    PacketReceiver,
    PacketSender,
    PacketWriter,
    Scans,
    iter_scans,
    save_scans,
    simulate_room,
    stream_scans,
)
from lardhm_torch.cli import main


def growing_map(steps=6):
    """A map after each of some updates; it also loses clusters."""
    model = LardHilbertMap(num_neighbors=8)
    for step in range(steps):
        points, labels = wall(300, seed=step, at=1.0 + step / 2)
        model.update(points, labels, 30, seed=step)
        if step == 3:
            model.crop(torch.tensor([2.5, 1.0, 1.0], dtype=torch.float64), 0.8)
        yield model


@pytest.fixture(scope="module")
def packets(tmp_path_factory):
    """Packets of a growing map, and the packed map at each of them."""
    folder, sender = tmp_path_factory.mktemp("packed"), PacketSender()
    found = []
    for model in growing_map():
        model.pack(folder / "map.lhm")
        found.append((sender.packet(model), LardHilbertMap.load(folder / "map.lhm")))
    return found


@pytest.fixture
def folder(tmp_path):
    """A folder of four scans of the simulated room."""
    room = simulate_room(2000, seed=0)
    (tmp_path / "scans").mkdir()
    for number in range(4):
        scan = room.select(room.scan_id == number % 3)
        place = room.origins[number % 3][None]
        one = Scans(place, scan.ends, None, scan.is_return)
        save_scans(one, tmp_path / "scans" / f"{number}.npz")
    return tmp_path


def test_a_receiver_holds_the_packed_map_after_every_packet(packets):
    receiver = PacketReceiver()
    sizes = []
    for number, (packet, expected) in enumerate(packets):
        receiver.apply(packet)
        assert receiver.number == number
        assert same_map(receiver.map(), expected)
        sizes.append(len(expected))
    assert min(sizes[4:]) < max(sizes[:4])  # rows were removed, too


def test_a_packet_of_a_map_that_did_not_change_is_small():
    (model,) = growing_map(1)
    sender = PacketSender()
    sender.packet(model)
    assert len(sender.packet(model)) < 200


def test_lost_repeated_and_swapped_packets_are_refused_and_change_nothing(packets):
    receiver = PacketReceiver()
    with pytest.raises(ValueError, match="the first packet must hold a whole map; got differences"):
        receiver.apply(packets[1][0])
    for number in (0, 1, 2):
        receiver.apply(packets[number][0])
    with pytest.raises(ValueError, match=r"must be number 3 .*; number 4 came too early: some are"):
        receiver.apply(packets[4][0])
    with pytest.raises(ValueError, match=r"must be number 3 .*; number 2 was applied already"):
        receiver.apply(packets[2][0])
    assert same_map(receiver.map(), packets[2][1])
    receiver.apply(packets[3][0])
    assert same_map(receiver.map(), packets[3][1])


def test_damaged_packets_and_those_of_another_stream_are_refused(packets):
    receiver = PacketReceiver()
    receiver.apply(packets[0][0])
    damaged = bytearray(packets[1][0])
    damaged[-5] ^= 4
    with pytest.raises(ValueError, match="it is damaged"):
        receiver.apply(bytes(damaged))
    other, settings = PacketSender(), PacketSender(precision=5)
    for sender in (other, settings):
        model = LardHilbertMap(num_neighbors=8).fit(*wall(seed=9), 30)
        model.origin = growing_origin(packets)
        sender.packet(model)
    with pytest.raises(ValueError, match="must follow the map it was made from; it is of another"):
        receiver.apply(other.packet(model))
    with pytest.raises(ValueError, match="must have the origin and settings of its stream"):
        receiver.apply(settings.packet(model))
    assert same_map(receiver.map(), packets[0][1])


def growing_origin(packets):
    return packets[0][1].origin.clone()


def test_a_whole_packet_helps_a_receiver_that_missed_some(packets):
    sender, receiver = PacketSender(), PacketReceiver()
    for model in growing_map(2):
        sender.packet(model)
    receiver.apply(sender.packet(model, whole=True))
    assert receiver.number == 2
    assert same_map(receiver.map(), packets[1][1])


def test_a_map_that_was_moved_is_sent_whole():
    sender, receiver = PacketSender(), PacketReceiver()
    (model,) = growing_map(1)
    receiver.apply(sender.packet(model))
    model.transform(torch.eye(3), torch.tensor([100.0, 0.0, 0.0]))
    receiver.apply(sender.packet(model))
    assert torch.equal(receiver.map().origin, model.origin)


def test_a_receiver_without_packets_has_no_map():
    with pytest.raises(RuntimeError, match="map needs a packet; call apply first"):
        PacketReceiver().map()


@pytest.mark.parametrize("name", ["packets", "packets.lhm"])
def test_packets_in_a_folder_or_a_file_are_a_map(packets, tmp_path, name):
    writer = PacketWriter(tmp_path / name)
    for (_, expected), model in zip(packets, growing_map(), strict=True):
        writer.send(model)
        assert same_map(LardHilbertMap.load(tmp_path / name), expected)


@pytest.mark.parametrize("name", ["packets", "packets.lhm"])
def test_a_writer_continues_after_the_packets_that_are_there(packets, tmp_path, name):
    path = tmp_path / name
    models = growing_map()
    writer = PacketWriter(path)
    for _ in range(3):
        writer.send(next(models))
    if path.is_file():  # as a writer leaves it that is killed
        path.write_bytes(path.read_bytes() + packets[3][0][:100])
        with pytest.raises(ValueError, match=r"the last packet, from byte .* on, is cut short"):
            LardHilbertMap.load(path)
    writer = PacketWriter(path, resume=True)
    for model in models:
        writer.send(model)
    assert same_map(LardHilbertMap.load(path), packets[-1][1])
    with pytest.raises(ValueError, match=r"precision must be that of the packets in .*, 6; got 5"):
        PacketWriter(path, precision=5, resume=True)
    PacketWriter(path).send(model)  # without resume: a new stream
    assert same_map(LardHilbertMap.load(path), packets[-1][1])


def test_a_missing_file_of_a_folder_is_noticed(packets, tmp_path):
    writer = PacketWriter(tmp_path / "packets")
    for model in growing_map():
        writer.send(model)
    (tmp_path / "packets" / "00000003.lhm").unlink()
    with pytest.raises(ValueError, match=r"packets must be .*number 3 .*number 4 came too early"):
        LardHilbertMap.load(tmp_path / "packets")


@pytest.mark.parametrize("name", ["packets", "packets.lhm"])
def test_the_command_line_sends_packs_and_queries(folder, name, capsys):
    sent, map_file, packed = folder / name, folder / "map.pt", folder / "packed.lhm"
    fit = ["fit", str(folder / "scans"), "-o", str(map_file), "--incremental", "--send", str(sent)]
    assert main(fit) == 0
    model = LardHilbertMap.load(map_file)
    model.pack(packed)
    assert same_map(LardHilbertMap.load(sent), LardHilbertMap.load(packed))
    again = folder / "again.lhm"
    assert main(["pack", str(sent), "-o", str(again)]) == 0
    assert again.read_bytes() == packed.read_bytes()
    np.save(folder / "points.npy", np.ones((2, 3)))
    assert main(["query", str(sent), str(folder / "points.npy"), "-o", str(folder / "p.npy")]) == 0
    assert main(["info", str(sent)]) == 0
    assert "training points       unknown" in capsys.readouterr().out
    assert main(["update", str(packed), str(folder / "scans"), "-o", str(map_file)]) == 1
    assert "a packed map supports queries, but no training" in capsys.readouterr().err


def test_a_resumed_fit_sends_on(folder):
    sent, whole = folder / "packets.lhm", folder / "whole"
    scans = list(iter_scans(folder / "scans"))
    fit = ["fit", str(folder / "scans"), "-o", str(folder / "map.pt"), "--incremental"]
    model = LardHilbertMap()
    writer = PacketWriter(sent)
    stream_scans(model, scans[:2], path=folder / "map.pt", after_scan=writer.send)
    assert main([*fit, "--send", str(sent), "--resume"]) == 0
    assert main([*fit, "--send", str(whole)]) == 0
    assert same_map(LardHilbertMap.load(sent), LardHilbertMap.load(whole))


def test_options_of_packets_need_each_other(folder, capsys):
    fit = ["fit", str(folder / "scans"), "-o", str(folder / "map.pt")]
    assert main([*fit, "--send", str(folder / "packets")]) == 1
    assert "--send and --precision need --incremental" in capsys.readouterr().err
    assert main([*fit, "--incremental", "--precision", "5"]) == 1
    assert "--precision needs --send" in capsys.readouterr().err
