"""Robot logs of any common format, as immutable `Log`s; the only room that knows mcap and rosbags."""

from __future__ import annotations

from amhe_cli.logs.collect import Fields, read_topic
from amhe_cli.logs.containers.lerobot import episode_paths
from amhe_cli.logs.convert import convert
from amhe_cli.logs.data_set import is_data_set, members, only_member
from amhe_cli.logs.messages.writer import LogWriter
from amhe_cli.logs.read import inspect_log, read_log, read_signals, read_truth
from amhe_cli.logs.survey import Inspection, SignalCheck, Survey, TopicSurvey, read_metadata, survey

__all__ = [
    "Fields",
    "Inspection",
    "LogWriter",
    "SignalCheck",
    "Survey",
    "TopicSurvey",
    "convert",
    "episode_paths",
    "inspect_log",
    "is_data_set",
    "members",
    "only_member",
    "read_log",
    "read_metadata",
    "read_signals",
    "read_topic",
    "read_truth",
    "survey",
]
