"""Tests of the log lines: text for people, JSON for programs, and one logger for each purpose."""

from __future__ import annotations

import io
import json
import logging
from pathlib import Path

import pytest

from schemas.runtime.logs import event_logger, json_values, log_warnings


def test_lines_are_text_for_people_and_json_for_programs() -> None:
    line = "status: 3 rows"
    parts = json_values(rows=3, counts={"late": 1})
    plain = io.StringIO()
    structured = io.StringIO()
    event_logger("test", "text", plain).info(line, extra=parts)
    events = event_logger("test", "json", structured, service="shard-0")
    events.info(line, extra=parts)
    events.info("compacted: 7 rows\nof <many>, 5 %")
    events.info("driving", extra=json_values(event="ready"))
    assert plain.getvalue() == "status: 3 rows\n"
    first, second, third = (json.loads(text) for text in structured.getvalue().splitlines())
    assert (first["event"], first["rows"], first["counts"], first["service"]) == (
        "status",
        3,
        {"late": 1},
        "shard-0",
    )
    assert (second["event"], second["message"], second["level"]) == (
        "compacted",
        "compacted: 7 rows\nof <many>, 5 %",
        "info",
    )
    assert (third["event"], third["message"]) == ("ready", "driving")


def test_two_loggers_of_a_process_write_to_streams_of_their_own() -> None:
    one = io.StringIO()
    other = io.StringIO()
    events = event_logger("one", "text", one)
    event_logger("other", "text", other).info("warning: ice")
    events.info("ready")
    assert (one.getvalue(), other.getvalue()) == ("ready\n", "warning: ice\n")


def test_a_full_disk_behind_the_log_does_not_end_the_process() -> None:
    full = Path("/dev/full").open("w")  # noqa: SIM115 closing it fails
    event_logger("test", "json", full).info("status: 3 rows")
    with pytest.raises(OSError, match="No space left"):
        full.close()


def test_warnings_of_the_program_take_the_same_form() -> None:
    stream = io.StringIO()
    before = logging.root.handlers[:]
    level = logging.root.level
    try:
        log_warnings("json", stream, service="shard-0")
        try:
            raise ValueError("odd")
        except ValueError:
            logging.getLogger("edge_agent.publish.publisher").exception("batch %d", 7)
    finally:
        logging.root.handlers[:] = before
        logging.root.setLevel(level)
    record = json.loads(stream.getvalue())
    assert (record["level"], record["event"], record["message"], record["service"]) == (
        "error",
        "edge_agent.publish.publisher",
        "batch 7",
        "shard-0",
    )
    assert "ValueError: odd" in record["error"]
