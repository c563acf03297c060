"""Every message of the protocol, version 1.

A message checks itself when it is built, against ``limits`` (a keyword of every constructor), so
that a sender meets the same error as its receiver would.
"""

from __future__ import annotations

from koop_protocol.lifecycle import Ending, Health, TrajectoryEnd
from koop_protocol.lqr import LqrQuery, LqrReply
from koop_protocol.measurements import Control, Frame
from koop_protocol.predictions import (
    PredictQuery,
    PredictReply,
    predict_query_from_parameters,
)
from koop_protocol.replays import Durable, ReplayQuery, ReplayReply
from koop_protocol.status import ErrorReply, StateReply
from koop_protocol.tasks import Command, EndReason, LqrCancel, LqrEnd, LqrTask

VERSION = 1

Message = (
    Frame
    | Control
    | PredictQuery
    | PredictReply
    | LqrQuery
    | LqrReply
    | LqrTask
    | LqrCancel
    | Command
    | LqrEnd
    | StateReply
    | ReplayQuery
    | ReplayReply
    | Durable
    | Health
    | TrajectoryEnd
    | ErrorReply
)

__all__ = [
    "VERSION",
    "Command",
    "Control",
    "Durable",
    "EndReason",
    "Ending",
    "ErrorReply",
    "Frame",
    "Health",
    "LqrCancel",
    "LqrEnd",
    "LqrQuery",
    "LqrReply",
    "LqrTask",
    "Message",
    "PredictQuery",
    "PredictReply",
    "ReplayQuery",
    "ReplayReply",
    "StateReply",
    "TrajectoryEnd",
    "predict_query_from_parameters",
]
