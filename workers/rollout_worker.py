"""The rollout worker: unit in, result out. It keeps nothing, so it can be killed and replaced at any moment."""

import itertools
import logging
import time
import traceback
from pathlib import Path

from oodil.pipeline.collecting import collect
from oodil.pipeline.versions import collecting_versions
from oodil.workers.channels import Dealer
from oodil.workers.messages import Header, Ready, Refused, ResultMessage, UnitFailure, UnitMessage, decode, encode
from oodil.workers.reports import failure
from oodil.workers.supervisor import Link
from oodil.workers.wire import MessageError

READY_INTERVAL_S = 1.0
_POLL_S = 0.1


def main(link: Link, endpoint: str, run_id: str = "", host: str = "", keys: str = "") -> str:
    """Collect units for whichever learner is behind the endpoint, until asked to stop or refused; return which.

    On another machine, ``host`` makes the worker's name unlike all others, and it works for any run.
    """
    name = host + link.identity
    channel = Dealer(endpoint, name, Path(keys) if keys else None)
    try:
        return _serve(channel, link, name, run_id)
    finally:
        channel.close()


def _serve(channel: Dealer, link: Link, name: str, run_id: str) -> str:
    sequence = itertools.count()
    versions = collecting_versions()
    next_ready = time.monotonic()
    while not link.should_stop():
        if time.monotonic() >= next_ready:
            channel.send(encode(Ready(Header(run_id, "", name, next(sequence)), versions)))
            next_ready = time.monotonic() + READY_INTERVAL_S
        frames = channel.receive(_POLL_S)
        if frames is None:
            continue
        try:
            message = decode(frames)
        except MessageError as error:
            logging.warning("message dropped: %s", error)
            continue
        if isinstance(message, Refused):
            return f"refused: {message.reason}"
        if not isinstance(message, UnitMessage) or run_id not in ("", message.header.run_id):
            logging.warning("message dropped: no unit of run %s", run_id)
            continue
        asked = message.header
        channel.send(_answer(message, Header(asked.run_id, asked.incarnation, name, next(sequence))))
        next_ready = time.monotonic() + READY_INTERVAL_S
    return "stopped"


def _answer(message: UnitMessage, header: Header) -> list[bytes]:
    try:
        return encode(ResultMessage(header, collect(message.unit)))
    except Exception as error:
        unit, failed = message.unit, failure(error)
        logging.error("unit %d/%d failed\n%s", unit.iteration, unit.group, traceback.format_exc())
        return encode(UnitFailure(header, unit.iteration, unit.group, failed.reason, failed.is_final))
