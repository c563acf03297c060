"""Every reader of files that a user, or the service itself, may hand to koop; as in `targets.py`.

A record of the service's state lies behind a digest, so damage never reaches its reader; it is
looked at all the same. What of a changed record is taken must not spoil the estimators.
"""

from __future__ import annotations

import json
import struct
import tempfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import h5py
import msgpack
import numpy as np
import torch
from fuzzing.guard import Target

from koop_protocol import Control, Frame, PredictQuery, ProtocolError
from koop_protocol import recording as names
from koop_protocol.limits import DEFAULT_LIMITS
from koop_service.encoding.autoencoder import initialised
from koop_service.encoding.catalogue import ModelEntry
from koop_service.encoding.image_codec import ImageCodec
from koop_service.encoding.weights import ModelCard, load_card, load_weights, save_weights
from koop_service.estimation.estimator import Bank
from koop_service.estimation.stream import Stream
from koop_service.learning.recording import load_manifest, load_recording
from koop_service.serving.answering import queries
from koop_service.serving.config import EstimatorChoices
from koop_service.serving.toml import load_config
from koop_service.serving.trajectories import sealing
from koop_service.serving.trajectories.equipment import settings_for
from koop_service.serving.trajectories.records import check_record, restored, snapshot_of
from koop_service.serving.trajectories.trajectory import Trajectory

NAME, EPOCH, CODE_SIZE = "cart/0", "00000000000000aa", 2

torch.set_num_threads(1)


# The service's records


@dataclass(frozen=True)
class _Setting:
    """A model and its bank, as the service has them when it reads its records."""

    entry: ModelEntry
    codec: ImageCodec
    bank: Bank


@cache
def _setting() -> _Setting:
    path = _folder() / "model.safetensors"
    save_weights(path, initialised(CODE_SIZE, 0), ModelCard("cart", "", 0.05, CODE_SIZE))
    entry = ModelEntry("cart", path, ("cart/*",))
    return _Setting(entry, entry.load(), Bank(settings_for(entry, EstimatorChoices(), 1)))


def record(data: bytes) -> bool:
    """A record of a trajectory's state: refused whole, or a trajectory that works."""
    setting = _setting()
    lanes = len(setting.bank)
    try:
        value = sealing.unseal(_sealed(data))
        check_record(value, setting.entry, setting.bank.settings)
        trajectory = restored(NAME, value, setting.entry, setting.codec, setting.bank)
    except Exception:  # the service leaves the record out, whatever is wrong with it
        assert len(setting.bank) == lanes, "a damaged record keeps a lane"
        return False
    try:
        _use(trajectory)
    finally:
        setting.bank.close(trajectory.lane)
    return True


def _sealed(body: bytes) -> bytes:
    """With the digest that belongs to it: what is behind the digest is looked at here."""
    return sealing._digest(body) + body


def _opened(sealed: bytes) -> bytes:
    return sealed[len(_sealed(b"")) :]


def _use(trajectory: Trajectory) -> None:
    """What the pipeline does with any trajectory; nothing of it may fail."""
    seq = trajectory.stream.next_seq
    for step in range(4):
        for message in (_control(seq + step - 1), _frame(seq + step)):
            _fold(trajectory, replace(message, epoch=trajectory.epoch))
    for answer in (queries.state, lambda t: queries.predict(t, PredictQuery(3), DEFAULT_LIMITS)):
        with suppress(ProtocolError):  # it may warm up, and it may be unstable
            answer(trajectory)
    sealing.seal(snapshot_of(trajectory))


def _fold(trajectory: Trajectory, message: Frame | Control) -> None:
    try:
        if isinstance(message, Control):
            trajectory.check_control(message)
            trajectory.fold_control(message)
        else:
            trajectory.check_frame(message)
            trajectory.fold_frame(message, np.full(CODE_SIZE, 0.1))
    except ProtocolError:  # it may be stale
        return
    for transition in trajectory.queue:
        trajectory.bank.fold(np.array([trajectory.lane]), transition.w[None], transition.y[None])
    trajectory.queue.clear()


def records() -> list[bytes]:
    """Records of a trajectory at its beginning, in its middle, and with a gap that waits."""
    setting, found = _setting(), []
    trajectory = Trajectory(
        NAME, setting.entry, setting.codec, setting.bank, setting.bank.open(),
        Stream(setting.bank.settings), EPOCH,
    )  # fmt: skip
    for seq in (*range(20), 22, 23):
        _fold(trajectory, _frame(seq))
        _fold(trajectory, _control(seq))
        if seq in (0, 3, 19, 23):
            found.append(_opened(sealing.seal(snapshot_of(trajectory))))
    setting.bank.close(trajectory.lane)
    return found


def _frame(seq: int) -> Frame:
    return Frame(NAME, EPOCH, max(seq, 0), 1, np.zeros((64, 64), np.uint8))


def _control(seq: int) -> Control:
    return Control(NAME, EPOCH, max(seq, 0), np.array([0.5]))


# Files of users


def weights(data: bytes) -> bool:
    """A weights file: its card, and a network that the card and the tensors agree about."""
    path = _written(data, "fuzzed.safetensors")
    try:
        load_card(path)
        load_weights(path)
    except ValueError:
        return False
    return True


def card(data: bytes) -> bool:
    """The fields of a model card, as msgpack, in an otherwise good weights file."""
    fields = _tree(data)
    header, tensors = _parts()
    metadata = {**header["__metadata__"], "card": json.dumps(fields, default=str, skipkeys=True)}
    packed = json.dumps({**header, "__metadata__": metadata}).encode()
    packed += b" " * (-len(packed) % 8)
    return weights(struct.pack("<Q", len(packed)) + packed + tensors)


def recording(data: bytes) -> bool:
    """A sound HDF5 file of any attributes and data sets, given as msgpack.

    Damage inside the file is HDF5's own affair: a changed byte can make it loop for ever.
    """
    parts = _tree(data)
    path = _folder() / "made.h5"
    try:
        with h5py.File(path, "w") as file:
            file.attrs.update(parts["attributes"])
            for name, value in parts["data"].items():
                file[name] = _array(value) if isinstance(value, dict) else value
    except Exception:  # nothing that h5py would write
        return False
    taken = 0
    for load in (load_recording, load_manifest):
        try:
            load(path)
            taken += 1
        except ValueError as error:
            refusal = str(error)
            assert str(path) in refusal, f"the error does not name the file: {refusal}"
    return taken == 2


def config(data: bytes) -> bool:
    """The configuration file of koop-serve."""
    try:
        load_config(_written(data, "fuzzed.toml"))
    except ValueError:
        return False
    return True


TARGETS: dict[str, Target] = {
    "record": record,
    "weights": weights,
    "card": card,
    "recording": recording,
    "config": config,
}


def _tree(data: bytes) -> Any:
    try:
        return msgpack.unpackb(data, strict_map_key=False)
    except Exception:  # no tree, so nothing to write down
        return None


@cache
def _temporary() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory()


def _folder() -> Path:
    return Path(_temporary().name)


def _written(data: bytes, name: str) -> Path:
    path = _folder() / name
    path.write_bytes(data)
    return path


@cache
def _parts() -> tuple[dict[str, Any], bytes]:
    """The header and the tensors of a good weights file."""
    data = weight_files()[0]
    size = struct.unpack("<Q", data[:8])[0]
    return json.loads(data[8 : 8 + size]), data[8 + size :]


# Where mutation begins


def weight_files() -> list[bytes]:
    """A small network's weights."""
    return [_setting().entry.path.read_bytes()]


def cards() -> list[bytes]:
    """The card of a small network."""
    header, _ = _parts()
    return [msgpack.packb(json.loads(header["__metadata__"]["card"]))]


def recordings() -> list[bytes]:
    """The smallest recordings, of pictures and of fields, before they are written."""
    attributes = {
        names.FORMAT_ATTRIBUTE: names.RECORDING_FORMAT,
        names.VERSION_ATTRIBUTE: names.RECORDING_VERSION,
        names.SYSTEM_ATTRIBUTE: "cart",
        names.RENDERER_ATTRIBUTE: "",
        names.DT_ATTRIBUTE: 0.05,
        names.SEED_ATTRIBUTE: 0,
    }
    pictures, fields = np.zeros((1, 2, 64, 64), np.uint8), np.ones((1, 2, 1, 4, 4), np.float16)
    data = {
        names.CONTROLS_DATASET: _map(np.zeros((1, 1, 1))),
        names.PARAMETERS_DATASET: ['{"regime": "free"}'],
    }
    return [
        msgpack.packb({"attributes": attributes, "data": {names.FRAMES_DATASET: _map(f), **data}})
        for f in (pictures, fields)
    ]


def _map(array: np.ndarray) -> dict[str, Any]:
    return {"dtype": array.dtype.str, "shape": array.shape, "data": array.tobytes()}


def _array(value: dict[str, Any]) -> np.ndarray:
    """What `_map` made a map of; unlike the wire's arrays of any type and number of axes."""
    return np.frombuffer(value["data"], value["dtype"]).reshape(value["shape"])


def configs() -> list[bytes]:
    """Settings of every section."""
    return [
        b'[network]\nlisten = ["tcp/127.0.0.1:0"]\nscouting = true\n[estimator]\nrho = 0.5\n',
        b'[limits]\nqueue_messages = 9\n[monitoring]\nlog_format = "json"\nmetrics_port = 0\n',
        b'state_folder = "state"\n[[models]]\npath = "a.safetensors"\npatterns = ["a/*", "b"]\n',
        b"[compute]\nthreads = 2\nbatch = 16\n[estimator]\nhistory = 3\naffine = false\n",
    ]


SEEDS: dict[str, Callable[[], list[bytes]]] = {
    "record": records,
    "weights": weight_files,
    "card": cards,
    "recording": recordings,
    "config": configs,
}
